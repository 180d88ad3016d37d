"""Directions of transmit antennas: do residuals depend on direction as if an antenna pointed elsewhere than stated?"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from calibray.engines.kinds.replay import replay
from calibray.engines.replay import Replay
from calibray.fitting.problem import Evaluation, Problem
from calibray.result.verdict import Remark, RemarkKind
from calibray.study import Study
from calibray.tracing.mounting import EVERY, POSE

FEWEST: Final = 10
"""Links of a transmitter from which its direction is tested: five for each of two angles."""

MOST: Final = 50
"""Transmitters that are tested, those with the most links: each takes three derivatives of all links."""

SIGNIFICANCE: Final = 0.01
"""Probability of a remark about any transmitter if all directions are right and errors are independent."""

SMALLEST_DB: Final = 0.05
"""Improvement of the RMSE from which a direction is reported [dB]; less changes no prediction that one would notice."""


class Direction(NamedTuple):
    """What would explain the residuals of a transmitter: changes of its stated angles with standard errors [deg]."""

    azimuth: float
    azimuth_error: float
    downtilt: float
    downtilt_error: float


def directions_remark(problem: Problem, best: NDArray[np.float64]) -> tuple[Remark, ...]:
    """Test whether other directions of transmit antennas than the stated ones would explain residuals.

    For each transmitter, an F test of two columns: the derivatives of path loss by azimuth and downtilt at the
    calibrated values, in addition to the parameters, the nuisance and a gain of that transmitter.

    Args:
        problem: The problem, on stored paths.
        best: The calibrated values [d].

    Returns:
        A remark that names the transmitters, or none.
    """
    setup, engine = problem.setup, problem.engine
    study, table = setup.study, setup.links.table
    known = any(name.startswith(POSE) for name in study.parameters)
    compressed = getattr(study.engine, "compress_db", None) is not None
    section = study.links.mountings.get("tx")
    stated = section is not None and section.aim is None
    if not stated or known or compressed or problem.observed:
        return ()
    if not isinstance(engine, Replay) or study.links.transmitter not in table.frame:
        return ()
    labels = table.labels(study.links.transmitter)[problem.objective.weight > 0].tolist()
    tested = [
        label for label, count in Counter(labels).most_common(MOST) if count >= FEWEST and label != EVERY
    ]
    if not tested:
        return ()
    evaluation, columns = _derivatives(problem, engine, best, tested)
    directions = {}
    for label in tested:
        direction = _direction(evaluation, columns, label, problem.freedom, SIGNIFICANCE / len(tested))
        if direction is not None:
            directions[label] = direction
    if not directions:
        return ()
    numbers = {
        f"{name}_deg": [float(getattr(each, name)) for each in directions.values()]
        for name in Direction._fields
    }
    return (Remark(RemarkKind.ANTENNA_DIRECTIONS, {"transmitters": list(directions), **numbers}),)


def _derivatives(
    problem: Problem, engine: Replay, best: NDArray[np.float64], transmitters: list[str]
) -> tuple[Evaluation, dict[str, int]]:
    """Residuals and derivatives at the calibrated values, also by the directions and gains of transmitters; columns."""
    content = problem.setup.study.content()
    poses = {
        f"{POSE}{label}.{field}": {"bounds": [-1.0, 1.0], "start": 0.0}
        for label in transmitters
        for field in ("azimuth", "downtilt", "gain")
    }
    study = Study.from_content(
        content | {"parameters": content["parameters"] | poses}, problem.setup.study.path
    )
    scene = problem.setup.scene
    parameters = study.parameter_set(scene.materials, scene.laws)
    setup = replace(problem.setup, study=study, parameters=parameters)
    values = problem.parameters.named(best)
    candidate = np.array([values.get(name, 0.0) for name in parameters.names])
    trial = replace(problem, setup=setup, engine=replay(setup, engine.paths), priors=study.priors)
    evaluation = trial.evaluate(parameters.to_search(candidate)[None], derivatives=True)
    return evaluation, {name: number for number, name in enumerate(parameters.names)}


def _direction(
    evaluation: Evaluation, columns: dict[str, int], label: str, freedom: int, significance: float
) -> Direction | None:
    """The direction of one transmitter that explains the residuals; None if it is not significant."""
    residuals, slopes = evaluation.residuals[0], evaluation.slopes[0]
    own = [columns[f"{POSE}{label}.{field}"] for field in ("azimuth", "downtilt", "gain")]
    common = [column for name, column in columns.items() if not name.startswith(POSE)]
    stated, turned = slopes[:, [*common, own[2]]], slopes[:, [*common, own[2], *own[:2]]]
    without, _, rank, _ = np.linalg.lstsq(stated, -residuals, rcond=None)
    step, _, full_rank, _ = np.linalg.lstsq(turned, -residuals, rcond=None)
    before = float(np.sum((residuals + stated @ without) ** 2))
    after = float(np.sum((residuals + turned @ step) ** 2))
    further, left = int(full_rank - rank), freedom - 1 - int(full_rank - rank)
    improvement = (np.sqrt(before) - np.sqrt(after)) / np.sqrt(len(residuals))
    if further < 1 or left < 1 or improvement < SMALLEST_DB:
        return None
    if fdtrc(further, left, (before - after) / further / max(after / left, 1e-300)) > significance:
        return None
    errors = np.sqrt(after / left * np.diag(np.linalg.pinv(turned.T @ turned)))
    return Direction(float(step[-2]), float(errors[-2]), float(step[-1]), float(errors[-1]))
