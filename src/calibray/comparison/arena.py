"""What methods are compared on: a study on its stored paths, or a landscape in closed form."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibray import engines
from calibray.calibration.calibration import Problem, from_search, local_searches, search_slope, to_search
from calibray.engines.fingerprint import fingerprint
from calibray.errors import InputError
from calibray.optimizers import landscapes
from calibray.study import Study

Told = tuple[np.ndarray, np.ndarray, np.ndarray | None]
"""Objective [n], residuals [n, m], and their derivatives [n, m, d] or None."""


@dataclass(frozen=True, eq=False)
class Arena:
    """A problem that any method can be run on.

    Attributes:
        name: Its name.
        fingerprint: All that an answer depends on.
        lower: Lower bounds of the search space [d].
        upper: Upper bounds [d].
        start: Where a user would start [d]; None if that is nowhere in particular.
        starts: Further starting points for the methods that take them; their own number if None.
        large: Whether an evaluation is so dear that searches from few starts have to do.
        minimum: Lowest objective known beforehand; +inf if none is.
        evaluate: Points [n, d], and whether derivatives are wanted, to what an optimizer is told.
    """

    name: str
    fingerprint: str
    lower: np.ndarray
    upper: np.ndarray
    start: np.ndarray | None
    starts: int | None
    large: bool
    minimum: float
    evaluate: Callable[[np.ndarray, bool], Told]


def study_arena(path: str | Path) -> Arena:
    """A study on its stored paths, which are traced if they are not in the cache.

    Args:
        path: The study file.

    Returns:
        The arena.

    Raises:
        InputError: The study cannot be used, or its engine is an external program.
    """
    study = Study.load(path)
    if study.engine.name == "command":
        raise InputError(
            f"{path}: engine 'command' is too dear for hundreds of runs; methods are compared on stored paths: "
            "set engine.name to 'replay'"
        )
    links, scene = study.measurements(), engines.make_scene(study)
    engine = engines.make(study, "replay")
    problem = Problem.of(study, links, engine)
    objective, parameters = problem.objective, engine.parameters
    lower, upper = to_search(parameters, parameters.lower), to_search(parameters, parameters.upper)

    def evaluate(points: np.ndarray, derivatives: bool) -> Told:
        candidates = from_search(parameters, points)
        if not derivatives:
            loss = engine.path_loss(candidates)
            return objective.rmse(loss), objective.residuals(loss), None
        loss, slope = engine.path_loss_and_jacobian(candidates)
        slope = slope * search_slope(parameters, candidates)[:, None, :]
        return objective.rmse(loss), objective.residuals(loss), objective.jacobian(loss, slope)

    digest = hashlib.sha256(fingerprint(study, scene, links, parameters, "replay").encode())
    for part in (lower, upper, objective.measured, objective.weight, objective.group, objective.bounds):
        digest.update(np.asarray(part, dtype="<f8").tobytes())
    digest.update(repr((objective.num_groups, objective.ceiling_db)).encode())
    digest.update(b"" if links.frequency is None else links.frequency.astype("<f8").tobytes())
    start = to_search(parameters, parameters.start)
    starts = local_searches(engine.interactions)
    return Arena(
        Path(path).stem, digest.hexdigest(), lower, upper, start, starts, engine.large, np.inf, evaluate
    )


def landscape_arena(name: str) -> Arena:
    """A landscape of `calibray.optimizers.landscapes`.

    Args:
        name: The function that makes it.

    Returns:
        The arena.
    """
    land: landscapes.Landscape = getattr(landscapes, name)()

    def evaluate(points: np.ndarray, derivatives: bool) -> Told:
        value, residuals, jacobian = land.evaluate(points)
        return value, residuals, jacobian if derivatives else None

    known = float(np.nan_to_num(land.minimum, nan=np.inf))
    middle = 0.5 * (land.lower + land.upper)
    digest = hashlib.sha256(name.encode())
    for part in (land.lower, land.upper, *evaluate(middle[None], True)):
        digest.update(np.round(part, 9).astype("<f8").tobytes())
    return Arena(name, digest.hexdigest(), land.lower, land.upper, None, None, False, known, evaluate)
