"""Accuracy on links held out by a filter or in blocks, choice of the prediction model, and fit of the fallback model.

The fallback is a log-distance model with the study's nuisances. The fallback is fitted to the calibration links, like
the log-distance baseline in validation. Links without a path are behind obstacles, so their path loss usually exceeds
the prediction of the fallback. If enough links without a path or, failing that, enough non-line-of-sight links were
measured, their mean residual is added to the prediction. The scatter of their residuals then determines the errors of
the fallback.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.nuisance import CONSTANT
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.measurements import FEW
from calibray.result.held_out import BASELINES, FittedTerm, Model, PredictionModel
from calibray.result.record import Accuracy
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.study.calibration_sections import DEFAULT_BLOCKS
from calibray.validation.choice import HeldOutResiduals, fit_variant, fitted_terms, quantiles
from calibray.validation.held_out_statistics import (
    compare,
    held_out_gaps,
    moving_end,
    observable_errors,
    out_of_sight_ratio,
    place_blocks,
    predicting,
    two_levels,
)
from calibray.validation.models import averages, initial_objective, log_distance, without_paths, without_scene
from calibray.validation.validation import Validation


@dataclass(frozen=True, eq=False)
class Models:
    """Path loss of all links according to each model [links], [dB].

    Attributes:
        initial: Initial materials without nuisances.
        nuisance_only: Initial materials with fitted nuisances.
        calibrated: Calibrated materials with fitted nuisances.
        log_distance: The log-distance model.
    """

    initial: NDArray[np.float64]
    nuisance_only: NDArray[np.float64]
    calibrated: NDArray[np.float64]
    log_distance: NDArray[np.float64]


def rmse_of(problem: Problem, model: NDArray[np.float64], mask: NDArray[np.bool_]) -> float:
    """RMSE [dB] of modelled path loss [L] over the calibration links in a mask [L], with the weights of the fit."""
    weight = problem.objective.weight[mask]
    return float(np.sqrt(np.average((model - problem.objective.measured)[mask] ** 2, weights=weight)))


def held_out_rmse(problem: Problem, model: NDArray[np.float64], mask: NDArray[np.bool_]) -> float | None:
    """RMSE [dB] of modelled path loss [L] over the held-out links in a mask [L]; None if the mask is empty.

    All links have equal weight, as in the comparison of models and in prediction intervals.
    """
    errors = (model - problem.objective.measured)[mask]
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else None


def on_held_out_links(
    problem: Problem, trail: Trail, models: Models
) -> tuple[Accuracy, str, HeldOutResiduals]:
    """Accuracy on links held out by a filter, name of the chosen prediction model, and residuals of this model."""
    objective, links = problem.objective, problem.setup.links
    fitted = bool(objective.nuisance.terms)
    reached = np.isfinite(problem.before) & np.isfinite(trail.best_modelled)
    judged = problem.setup.held_out & (reached | (objective.ceiling_db is not None))
    if links.censored is not None:
        judged &= ~links.censored
    modelled, judgement = _compared(problem, models) if judged.any() else {}, None
    if judged.any():
        errors = {name: (model - objective.measured)[judged] for name, model in modelled.items()}
        baselines = {name: errors[name] for name in BASELINES if name in errors}
        judgement = compare(errors[Model.CALIBRATED], baselines, moving_end(links)[judged])
        # None if no link has a residual for every model.
        judgement = judgement if judgement.links else None
    name, residuals = _choice(problem, trail, modelled, judged)
    accuracy = Accuracy(
        holdout_rmse_db=held_out_rmse(problem, models.calibrated, judged),
        initial_holdout_rmse_db=held_out_rmse(problem, models.initial, judged),
        nuisance_only_holdout_rmse_db=held_out_rmse(problem, models.nuisance_only, judged)
        if fitted
        else None,
        log_distance_holdout_rmse_db=held_out_rmse(problem, models.log_distance, judged),
        judgement=judgement,
        observables=observable_errors(held_out_gaps(problem, trail.best, judged), problem.setup.study),
    )
    return accuracy, name, residuals


def _compared(problem: Problem, models: Models) -> dict[str, NDArray[np.float64]]:
    """Path loss [dB] of all links [links] according to the calibrated model and every baseline."""
    objective, setup = problem.objective, problem.setup
    return {
        Model.INITIAL: initial_objective(objective, setup).with_nuisance(problem.before),
        Model.CALIBRATED: models.calibrated,
        **without_paths(setup, objective),
    }


def _choice(
    problem: Problem, trail: Trail, modelled: dict[str, NDArray[np.float64]], judged: NDArray[np.bool_]
) -> tuple[str, HeldOutResiduals]:
    """Name and residuals of the model chosen on held-out links; with too few links, the calibrated model is chosen.

    `modelled` contains the path loss of the compared models. This dictionary is empty if no held-out link can be
    judged.
    """
    objective, setup = problem.objective, problem.setup
    # Kriging is never chosen.
    modelled = {name: model for name, model in modelled.items() if name != Model.KRIGING}
    if problem.differentiable and np.count_nonzero(judged) >= FEW:
        variant = fit_variant(problem, trail, Model.PRIOR)
        modelled[Model.PRIOR] = variant.objective.with_nuisance(variant.modelled)
        modelled |= averages(modelled)
    errors = {name: (path_loss_db - objective.measured)[judged] for name, path_loss_db in modelled.items()}
    finite = np.isfinite([*errors.values(), np.zeros(judged.sum())]).all(axis=0)
    errors, count = {name: values[finite] for name, values in errors.items()}, int(finite.sum())
    if count >= FEW:
        name = predicting(errors, moving_end(setup.links)[judged][finite])
        rms_db, basis = float(np.sqrt(np.mean(errors[name] ** 2))), f"errors of {count} links held out"
        basis = basis if name == Model.CALIBRATED else f"{name}, {basis}"
        ends = np.hstack([setup.links.tx, setup.links.rx])
        # These links were held out together; the blocks serve only to separate errors within blocks from errors between
        # blocks.
        block = place_blocks(moving_end(setup.links)[judged][finite], DEFAULT_BLOCKS)
        levels = two_levels(errors[name], block, ends[judged][finite], ends[objective.weight > 0])
        if levels is not None:
            kept = np.flatnonzero(judged)[finite]
            sets = np.where(objective.weight > 0, 0, -1)
            sets[kept] = 1
            levels = replace(
                levels,
                groups_db=_groups_db(problem, sets, kept),
                out_of_sight=_out_of_sight(problem, errors[name], kept),
            )
        return name, HeldOutResiduals(rms_db, basis, count, errors[name], levels)
    rms_db, errors_db = None, objective.model(trail.best_modelled[None])[0] - objective.measured
    if problem.freedom >= 1:
        # A new link has no weight, so all calibration links count equally here, as held-out links do.
        rms_db = float(np.sqrt(np.sum(errors_db[objective.weight > 0] ** 2) / problem.freedom))
    basis = f"errors of {objective.num_counted} calibration links"
    return Model.CALIBRATED, HeldOutResiduals(rms_db, basis, max(round(problem.freedom), 1), np.zeros(0))


def log_distance_errors(
    problem: Problem, models: Models, validation: Validation | None
) -> tuple[NDArray[np.float64], str]:
    """Residuals [n], [dB], of the log-distance model on held-out links with a path, and a label for the residuals."""
    if validation is not None:
        basis = f"errors on {len(validation.labels)} blocks held out in turn"
        return validation.errors[Model.LOG_DISTANCE][validation.judged], basis
    links = problem.setup.links
    judged = problem.setup.held_out & np.isfinite(models.calibrated)
    judged &= True if links.censored is None else ~links.censored
    errors = (models.log_distance - problem.objective.measured)[judged]
    return errors, f"errors of {len(errors)} links held out"


def on_blocks(
    validation: Validation, problem: Problem, initial_db: float | None, fitted: bool
) -> tuple[Accuracy, str, HeldOutResiduals]:
    """Accuracy on blocks held out in turn, name of the chosen prediction model, and residuals of this model."""
    rmse = validation.table["rmse_db"]
    name, judged = validation.chosen, validation.judged
    levels = validation.levels(name, problem.setup.links)
    if levels is not None:
        ratio = _out_of_sight(problem, validation.errors[name][judged], np.flatnonzero(judged))
        groups_db = _groups_db(problem, validation.block, np.flatnonzero(judged))
        levels = replace(levels, groups_db=groups_db, out_of_sight=ratio)
    residuals = HeldOutResiduals(
        validation.scale(name),
        f"{name}, errors on {len(validation.labels)} blocks held out in turn",
        int(np.count_nonzero(judged)),
        validation.errors[name][judged],
        levels,
    )
    accuracy = Accuracy(
        holdout_rmse_db=float(rmse[Model.CALIBRATED]),
        initial_holdout_rmse_db=initial_db,
        nuisance_only_holdout_rmse_db=float(rmse[Model.INITIAL]) if fitted else None,
        log_distance_holdout_rmse_db=float(rmse[Model.LOG_DISTANCE]),
        judgement=validation.judgement,
        observables=validation.observables,
    )
    return accuracy, name, residuals


def _groups_db(problem: Problem, block: NDArray[np.int64], links: NDArray[np.int64]) -> float:
    """RMS spread [dB] of random effects over `links` [n], counting only groups that occur in a single `block` [L]."""
    return float(np.sqrt(np.mean(problem.objective.nuisance.new_group_spread(block)[links] ** 2)))


def _out_of_sight(problem: Problem, errors: NDArray[np.float64], links: NDArray[np.int64]) -> float:
    """RMS error of non-line-of-sight links, divided by that of all links; 1 if unknown or modelled by a nuisance."""
    terms = problem.objective.nuisance.terms
    table = problem.setup.with_obstruction().links.table
    if any(term.around and term.by == OUT_OF_SIGHT for term in terms) or OUT_OF_SIGHT not in table.frame:
        return 1.0
    return out_of_sight_ratio(errors, table.numbers(OUT_OF_SIGHT)[links] > 0)


WITHOUT_PATH: Final = "without a path"
"""Name of the term for the mean residual of links without a path."""


def fit_fallback(
    problem: Problem, without_path: NDArray[np.bool_], held_out_db: NDArray[np.float64], basis: str
) -> PredictionModel:
    """Fit the fallback, the log-distance model, to the calibration links.

    The errors of the fallback are estimated from links without a path. If there are too few of these, they are
    estimated from non-line-of-sight links, some of which are near the noise floor, as links without a path are. If
    there are too few of these as well, the residuals on held-out links [n], [dB], are used; `basis` describes them.
    Without enough held-out links, the residuals on the calibration links are used.
    """
    setup, links = problem.setup, problem.setup.links
    objective, known_db = log_distance(links, problem.objective, without_scene(setup.study, links))
    terms = fitted_terms(objective, known_db, setup.study)
    residuals = objective.measured - objective.with_nuisance(known_db)
    measured = ~setup.held_out if links.censored is None else ~setup.held_out & ~links.censored
    usable, name = without_path & measured, WITHOUT_PATH
    usable = usable if problem.faint is None else usable & ~problem.faint
    # Testing links for line of sight takes time, so this is done only if needed.
    if usable.sum() < FEW and OUT_OF_SIGHT in (table := setup.with_obstruction().links.table).frame:
        usable, name = (table.numbers(OUT_OF_SIGHT) > 0) & measured, OUT_OF_SIGHT.replace("_", " ")
    count = int(usable.sum())
    if count >= FEW:
        mean_db = float(residuals[usable].mean())
        terms += (FittedTerm(name, CONSTANT, "", {"": mean_db}),)
        # The error of each link relative to the mean of the other links.
        errors = (residuals[usable] - mean_db) * count / (count - 1)
        basis = f"errors of {count} links {name}"
    elif len(held_out_db) >= FEW:
        errors = held_out_db
    else:
        counted = objective.weight > 0
        count, unknowns = int(counted.sum()), int(objective.determined.sum())
        # Errors on the calibration links are too small, because the unknowns were fitted to the same links.
        inflation = np.sqrt(count / (count - unknowns)) if count > unknowns else np.nan
        errors = residuals[counted] * inflation
        errors, basis = errors[np.isfinite(errors)], f"errors of {count} calibration links"
    rms_db = float(np.sqrt(np.mean(errors**2))) if len(errors) else None
    absolute_errors = quantiles(np.sort(np.abs(errors)))
    return PredictionModel(
        Model.LOG_DISTANCE,
        None,
        terms,
        rms_db,
        f"{Model.LOG_DISTANCE}, {basis}",
        len(errors),
        absolute_errors,
    )
