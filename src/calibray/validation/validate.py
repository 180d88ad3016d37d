"""Calibrate again without each block of links in turn, by several models, and judge them by the block left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray import engines
from calibray.engines.cluster.workers import Workers
from calibray.errors import EngineError, InputError
from calibray.fitting.preliminary_fits import estimate_noise, leave_out_near_floor
from calibray.fitting.problem import Problem
from calibray.result.held_out import Model
from calibray.study import Setup, Study
from calibray.support.progress import Progress
from calibray.tracing.default_tracer import SIONNA
from calibray.tracing.protocol import TracerFactory
from calibray.validation.baselines import kriging, log_distance
from calibray.validation.blocks import blocks as parted
from calibray.validation.validation import Validation
from calibray.validation.variants import NOTHING, fitted, predicted

BLOCKS: Final = 4
"""Spatial blocks where the study names none."""

MOST_BLOCKS: Final = 100
"""The largest number of spatial blocks, here as in a study."""

TX: Final = "tx"
"""Label of a link's transmitter where the table has no such column: its position."""


def validate(
    study: Study | Setup,
    *,
    blocks: int | None = None,
    by: str | None = None,
    workers: Workers | None = None,
    progress: Progress | None = None,
    tracer: TracerFactory = SIONNA,
) -> Validation:
    """Judge models by links that they were not fitted to: leave one block out.

    Args:
        study: The study, opened or not; on the engine "replay".
        blocks: Number of spatial blocks, each held out in turn; the study's, or 4, if None and `by` is None.
        by: Column whose labels are held out in turn; "tx" for the place of the transmitter.
        workers: Where blocks of links live that are traced and replayed together (`engines.open_workers`).
        progress: Called with the stages "tracing" and "validating".
        tracer: What opens the scene in a ray tracer; a study that is open brings its own.

    Returns:
        Held-out errors of every model, with their table and one sentence.

    Raises:
        InputError: The study is on another engine, or cannot be parted so.
        EngineError: The engine failed.
    """
    setup = study if isinstance(study, Setup) else Setup.open(study, tracer)
    if blocks is not None and by is not None:
        raise InputError("validate: give blocks or by, not both")
    if blocks is not None and not 2 <= blocks <= MOST_BLOCKS:
        raise InputError(f"validate: blocks = {blocks}; must be 2 to {MOST_BLOCKS}: each takes a calibration")
    # Links that the study holds out are held out in turn like all others.
    setup = replace(setup, held_out=np.zeros(len(setup.links), dtype=bool))
    check_engine(setup.study)
    problem = estimate_noise(
        leave_out_near_floor(Problem.of(setup, engines.make(setup, progress=progress, workers=workers)))
    )
    return validated(problem, blocks, by, progress)


def check_engine(study: Study) -> None:
    """Refuse an engine on which calibrating a dozen times over would be too dear.

    Args:
        study: The study.

    Raises:
        InputError: The engine is not "replay".
    """
    if study.engine.name != "replay":
        raise InputError(
            f"{study.path}: blocks held out in turn take a calibration each, and the engine {study.engine.name!r} is "
            "too dear; set engine.name to 'replay', or hold links out by where"
        )


def validated(
    problem: Problem,
    blocks: int | None = None,
    by: str | None = None,
    progress: Progress | None = None,
    known: Mapping[Model, NDArray[np.float64]] = NOTHING,
) -> Validation:
    """Judge models on a problem that is set up, over all its links.

    Args:
        problem: The problem.
        blocks: Number of spatial blocks; the study's if None and `by` is None.
        by: Column whose labels are held out in turn.
        progress: Called with the stage "validating".
        known: Minima of the study's own model over all links, under its name [k, d]; looked for if absent.

    Returns:
        Held-out errors of every model.

    Raises:
        InputError: The links cannot be parted so.
    """
    links, objective = problem.setup.links, problem.objective
    block, labels = _parted(problem, blocks, by)
    known = {name: points for name, (_, points) in fitted(problem, known).items()}
    errors: dict[str, NDArray[np.float64]] = {}
    for number in range(len(labels)):
        here = block == number
        part = replace(problem, objective=replace(objective, weight=np.where(here, 0.0, objective.weight)))
        for name, model in models(part, known).items():
            errors.setdefault(name, np.full(len(links), np.nan))[here] = (model - objective.measured)[here]
        if progress is not None:
            progress("validating", number + 1, len(labels))
    judged = (block >= 0) & np.isfinite(errors[Model.INITIAL]) & np.isfinite(errors[Model.CALIBRATED])
    whole = {name: each for name, each in errors.items() if np.isfinite(each[judged]).all()}
    position = np.where(judged, block, -1)
    return Validation(labels, position, whole, links.rx)


def _parted(problem: Problem, count: int | None, by: str | None) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Block of every link, -1 where it does not count, and the blocks' labels."""
    links, holdout = problem.setup.links, problem.setup.study.holdout
    if count is None and by is None and holdout is not None:
        count, by = holdout.blocks, holdout.by
    counted = problem.objective.weight > 0
    block = np.full(len(links), -1, dtype=np.int64)
    if by is None:
        count = BLOCKS if count is None else count
        block[counted] = parted(links.rx[counted, :2], count)
        labels = tuple(str(number + 1) for number in range(count))
    else:
        if by == TX and by not in links.frame:
            given = np.unique(links.tx, axis=0, return_inverse=True)[1].reshape(-1).astype(str)
        else:
            given = links.table.labels(by)
        names, place = np.unique(given[counted], return_inverse=True)
        block[counted], labels = place, tuple(map(str, names))
    fewest = int(counted.sum()) - int(np.bincount(block[counted]).max())
    if len(labels) < 2 or counted.sum() < len(labels) or fewest <= problem.unknowns:
        raise InputError(
            f"{links.source}: {int(counted.sum())} links in {len(labels)} blocks leave {fewest} to calibrate "
            f"{problem.unknowns} unknowns on; name two blocks or more, of fewer links each"
        )
    return block, labels


def models(
    part: Problem, known: Mapping[Model, NDArray[np.float64]] = NOTHING
) -> dict[str, NDArray[np.float64]]:
    """Every model, fitted to the links that count.

    Args:
        part: The problem, other links without weight.
        known: Points that searches start from beside their own, by name of the model [k, d].

    Returns:
        Path loss at all links by name of the model [L], [dB]; NaN where nothing could be kriged.
    """
    setup, objective = part.setup, part.objective
    found = {
        name: predicted(variant.objective, variant.modelled(points[:1])[0])
        for name, (variant, points) in fitted(part, known).items()
    }
    found[Model.LOG_DISTANCE] = log_distance(setup.links, objective, setup.study.scene.frequency)
    for name, law in ((Model.KRIGING, Model.LOG_DISTANCE), (Model.RESIDUAL_FIELD, Model.CALIBRATED)):
        try:
            found[name] = kriging(setup.links, objective, found[law])
        except (InputError, EngineError):
            # Too few or too many links, or all at one place: nothing to krige.
            found[name] = np.full(len(setup.links), np.nan)
    return found
