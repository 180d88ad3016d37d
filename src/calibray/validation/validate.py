"""Refit several models without each block of links in turn, and compare the models on the held-out block."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from calibray import engines
from calibray.engines.cluster.workers import Workers
from calibray.engines.protocol import Answering
from calibray.engines.rays.export import Exporting
from calibray.errors import InputError
from calibray.fitting.nuisance import CONSTANT
from calibray.fitting.preliminary_fits import with_preliminary_fits
from calibray.fitting.problem import Problem
from calibray.fitting.ray_mapping import maps_rays, search_rays
from calibray.result.held_out import Model
from calibray.scenes.obstruction import CLUSTER
from calibray.study import Setup, Study
from calibray.study.calibration_sections import DEFAULT_BLOCKS, MOST_BLOCKS
from calibray.study.model import StudyModel
from calibray.support.progress import Progress
from calibray.tracing import SIONNA
from calibray.tracing.protocol import TracerFactory
from calibray.validation.held_out_statistics import (
    MODELS,
    held_out_gaps,
    moving_end,
    observable_errors,
    place_blocks,
)
from calibray.validation.models import NO_MINIMA, averages, fit_variants, kriged, without_paths
from calibray.validation.validation import Validation

_LOG: Final = logging.getLogger(__name__)

TX: Final = "tx"
"""Name that stands for the position of the transmitter, unless the table has a column with this name."""


def validate(
    study: Study | Setup,
    *,
    blocks: int | None = None,
    by: str | None = None,
    workers: Workers | None = None,
    progress: Progress | None = None,
    tracer: TracerFactory = SIONNA,
    ledger: str | Path | None = None,
) -> Validation:
    """Compare models on held-out links. Each block of links is held out in turn and predicted.

    Args:
        study: The study, which may already be open; its engine must be "replay".
        blocks: Number of spatial blocks, each held out in turn. If `blocks` and `by` are None, the number in the study
            applies, or 4 if the study does not state a number.
        by: Column of labels; all links with the same label are held out together. "tx" stands for the position of the
            transmitter.
        workers: Workers that trace and replay chunks of links (`engines.open_workers`). If None, this process does all
            of this work.
        progress: Called with the name of the stage, the completed work and the total work.
        tracer: Function that opens the scene in a ray tracer; ignored if the study is already open.
        ledger: SQLite file that stores RT calls for a program that returns rays, such as `ledger.sqlite` in the folder
            of a run. Stored calls are not repeated.

    Returns:
        Held-out errors of every model, with a table and a conclusion.

    Raises:
        InputError: The engine of the study is not "replay", or the links cannot be divided into these blocks.
        EngineError: The engine failed.
    """
    if by is not None and isinstance(study, Study):
        # Rows of the same link with different labels remain separate links.
        study = Study.from_content(study.content() | {"holdout": {"by": by}}, study.path)
    setup = study if isinstance(study, Setup) else Setup.open(study, tracer)
    if blocks is not None and by is not None:
        raise InputError("validate: give blocks or by, not both")
    if blocks is not None and not (isinstance(blocks, Integral) and 2 <= blocks <= MOST_BLOCKS):
        raise InputError(
            f"validate: blocks = {blocks!r}; must be a whole number from 2 to {MOST_BLOCKS}, because each block "
            "requires a calibration"
        )
    # Links that the study holds out are treated like all others: they are held out in turn.
    setup = replace(setup, held_out=np.zeros(len(setup.links), dtype=bool))
    check_engine(setup.study)
    engine = engines.make(setup, None, progress, ledger, workers)
    if maps_rays(setup):
        exporting = Exporting(cast(Answering, engine), setup)
        problem, *_ = search_rays(Problem.of(setup, exporting), exporting, progress)
    else:
        problem = Problem.of(setup, engine)
    return validate_problem(with_preliminary_fits(problem, progress), blocks, by, progress)


def check_engine(study: StudyModel) -> None:
    """Raise an error if the dozen or so calibrations would be too expensive with this engine.

    Raises:
        InputError: The engine is not "replay".
    """
    if not study.allows_blocks:
        raise InputError(
            f"{study.path}: each held-out block requires a calibration, which is too expensive with the engine "
            f"{study.engine.name!r}; set engine.name to 'replay', or hold out links with holdout.where"
        )


def validate_problem(
    problem: Problem,
    blocks: int | None = None,
    by: str | None = None,
    progress: Progress | None = None,
    known_minima: Mapping[Model, NDArray[np.float64]] = NO_MINIMA,
) -> Validation:
    """Compare models on all links of a problem, with each block held out in turn.

    There are `blocks` spatial blocks, or one block for each label in the column `by`. If both are None, the blocks of
    the study are used. `known_minima` contains minima of fits to all links, by model [k, d]; missing minima of the
    study's own model are searched for. `progress` reports the stage "validating".

    Raises:
        InputError: The links cannot be divided into these blocks.
    """
    problem = replace(problem, setup=problem.setup.with_obstruction())
    links, objective = problem.setup.links, problem.objective
    block, labels = _divide(problem, blocks, by)
    _announce_new_groups(problem, block)
    if progress is not None:
        progress("validating", 0, len(labels))
    all_link_minima = {name: minima for name, (_, minima) in fit_variants(problem, known_minima).items()}
    errors: dict[str, NDArray[np.float64]] = {}
    gaps = {observable.name: np.full((len(MODELS), len(links)), np.nan) for observable in problem.observed}
    for number in range(len(labels)):
        held_out = block == number
        weight = np.where(held_out, 0.0, objective.weight)
        part = replace(problem, objective=objective.reweighted(weight))
        fits = fit_variants(part, all_link_minima)
        best = part.parameters.from_search(fits[Model.CALIBRATED][1][0])
        for name, gap in held_out_gaps(part, best, held_out).items():
            gaps[name][:, held_out] = gap[:, held_out]
        for name, modelled in fit_models(part, fits).items():
            residual = errors.setdefault(name, np.full(len(links), np.nan))
            residual[held_out] = (modelled - objective.measured)[held_out]
        if progress is not None:
            progress("validating", number + 1, len(labels))
    judged = (block >= 0) & np.isfinite(errors[Model.INITIAL]) & np.isfinite(errors[Model.CALIBRATED])
    # A model that is missing for one of the blocks, such as kriging, is not compared.
    complete = {name: residual for name, residual in errors.items() if np.isfinite(residual[judged]).all()}
    return Validation(
        labels, np.where(judged, block, -1), complete, moving_end(links), objective.measured,
        observables=observable_errors(gaps, problem.setup.study),
    )  # fmt: skip


def _announce_new_groups(problem: Problem, block: NDArray[np.int64]) -> None:
    """Warn of offsets that are unknown for held-out links because a group's links are all in the same block [n]."""
    counted = np.flatnonzero(block >= 0)
    stated = problem.setup.study.nuisance_terms
    for term in problem.objective.nuisance.terms:
        if term.by != CONSTANT or len(term.labels) == 1 or CLUSTER in stated[term.around or term.name].per:
            continue
        pairs = np.unique(np.stack([term.group[counted], block[counted]]), axis=1)
        groups, number = np.unique(pairs[0], return_counts=True)
        alone = np.isin(term.group[counted], groups[number == 1]).sum()
        if alone:
            _LOG.warning(
                "%s: %s of %s links are held out together with all links of their group. Their offset is then the mean "
                "of the other groups, so held-out errors contain the spread between groups",
                term.around or term.name, f"{alone:,}", f"{len(counted):,}",
            )  # fmt: skip


def _divide(problem: Problem, count: int | None, by: str | None) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """The block of every link (-1 for links of weight 0), and the labels of the blocks."""
    links, holdout = problem.setup.links, problem.setup.study.holdout
    if count is None and by is None and holdout is not None:
        count, by = holdout.blocks, holdout.by
    counted = problem.objective.weight > 0
    block = np.full(len(links), -1, dtype=np.int64)
    if by is None:
        count = DEFAULT_BLOCKS if count is None else count
        block[counted] = place_blocks(moving_end(links)[counted], count)
        labels = tuple(str(number + 1) for number in range(block.max() + 1))
    else:
        if by == TX and by not in links.frame:
            link_labels = np.unique(links.tx, axis=0, return_inverse=True)[1].reshape(-1).astype(str)
        else:
            link_labels = links.table.labels(by)
        names, block[counted] = np.unique(link_labels[counted], return_inverse=True)
        labels = tuple(map(str, names))
    # `fewest` links remain when the largest block is held out; all unknowns must then be fitted to these links.
    fewest = int(counted.sum()) - int(np.bincount(block[counted]).max())
    unknowns = counted.sum() - problem.freedom
    if len(labels) < 2 or counted.sum() < len(labels) or fewest <= unknowns:
        raise InputError(
            f"{links.source}: {int(counted.sum())} links in {len(labels)} blocks leave {fewest} links to calibrate "
            f"{unknowns:.0f} unknowns; use at least two blocks, with fewer links in each block, or remove [holdout]"
        )
    return block, labels


def fit_models(
    part: Problem, fits: Mapping[Model, tuple[Problem, NDArray[np.float64]]]
) -> dict[str, NDArray[np.float64]]:
    """Path loss [links], [dB], on all links, by model. The models are fitted to the links with nonzero weight.

    Kriging is omitted if it is impossible. `fits` contains the fitted variants that use the scene (see `fit_variants`).
    """
    setup, objective = part.setup, part.objective
    # If paths are traced around calibrated positions, replay only interpolates path loss at the stated positions,
    # whereas `before` is exact there.
    path_loss_db: dict[str, NDArray[np.float64]] = {
        name: variant.objective.with_nuisance(
            part.before if name == Model.INITIAL else variant.modelled(minima[:1])[0]
        )
        for name, (variant, minima) in fits.items()
    }
    path_loss_db |= without_paths(setup, objective)
    path_loss_db |= averages(path_loss_db)
    field = kriged(Model.RESIDUAL_FIELD, setup.links, objective, path_loss_db[Model.CALIBRATED])
    return path_loss_db | field
