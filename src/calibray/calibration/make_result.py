"""Make the result of a finished run: its accuracy, the accuracy of baselines, intervals, and a row for every link."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.calibration.held_out_accuracy import (
    Models,
    fit_fallback,
    held_out_rmse,
    log_distance_errors,
    on_blocks,
    on_held_out_links,
    rmse_of,
)
from calibray.calibration.link_diagnostics import diagnose_links
from calibray.calibration.result import Result
from calibray.engines.protocol import PATH_LOSS, Differentiable, Engine
from calibray.engines.replay import Replay
from calibray.fitting.cheap_replay import CheapReplay
from calibray.fitting.fidelity_loop import largest_gap
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.measurements import Measurements, position_columns
from calibray.paths import Paths
from calibray.prediction.corrections import calibration_residuals, fill_missing
from calibray.prediction.observables import MOST_DRAWS
from calibray.result.held_out import Model, ResidualField
from calibray.result.record import (
    Accuracy,
    Cost,
    Fit,
    Nuisance,
    ObservableFit,
    Prediction,
    Provenance,
)
from calibray.result.verdict import Remark, RemarkKind, Value
from calibray.scenes.obstruction import OUT_OF_SIGHT, REGION
from calibray.study import Setup, Study
from calibray.study.calibration_sections import OFFSET
from calibray.study.facades import without_facade_materials
from calibray.study.model import StudyModel
from calibray.tracing.protocol import EnclosedAntennas
from calibray.uncertainty.assessment import Certainty
from calibray.uncertainty.draws import evenly_spaced
from calibray.uncertainty.emulator import emulate
from calibray.uncertainty.noise_models import HEAVY
from calibray.uncertainty.residual_correlation import shared_errors
from calibray.validation.choice import fit_prediction_model
from calibray.validation.models import log_distance, without_scene
from calibray.validation.validation import Validation

WORSE_DB: Final = 0.05
"""A remark is made if the RMSE exceeds that of the initial values by more than this value [dB]."""

FAINT: Final = "predicted too near the noise floor, left out"
"""Label, in the row counts, of links that the model predicts near the noise floor."""


@dataclass(frozen=True)
class Timing:
    """Durations [s] of the search and of the loading and tracing before it, and the start time [s] of the run."""

    search: float
    trace: float
    started: float


@dataclass(frozen=True, eq=False)
class Run:
    """A finished search.

    Attributes:
        problem: The problem, with the paths of the last trace.
        trail: The search.
        retrace_gap_db: Change in every link's path loss [links], [dB], when the scene is traced again; None if it is
            not traced again.
        cheap: The cheap model, if the method used one.
        enclosed: Antennas inside closed bodies; None if the antennas were not checked.
        on_links: Remarks on ray mapping, links without a path, antenna directions, missing regions and groups of links.
        timing: Durations of the parts of the run.
    """

    problem: Problem
    trail: Trail
    retrace_gap_db: NDArray[np.float64] | None
    cheap: CheapReplay
    enclosed: EnclosedAntennas | None
    on_links: tuple[Remark, ...]
    timing: Timing


def make_result(run: Run, certainty: Certainty, validation: Validation | None) -> Result:
    """Make the result of a finished run, with its held-out errors if blocks were held out in turn."""
    problem, trail, gap_db, cheap = run.problem, run.trail, run.retrace_gap_db, run.cheap
    setup, objective, parameters = problem.setup, problem.objective, problem.parameters
    study, links = setup.study, setup.links
    calibrated, counted = trail.best_modelled, objective.weight > 0
    coefficients, fitted = objective.coefficients(calibrated[None]), bool(objective.nuisance.terms)
    nuisance_only, with_nuisance = objective.model(np.stack([problem.before, calibrated]))
    models = Models(
        objective.capped(problem.before),
        nuisance_only,
        with_nuisance,
        log_distance(links, objective, without_scene(study, links)).path_loss_db(),
    )
    paths = _replayed_paths(problem)
    diagnostics = diagnose_links(problem, trail.best, paths)
    table = pd.DataFrame(
        {
            "row": links.row,
            "measured_db": objective.measured,
            "before_db": problem.before,
            "after_db": calibrated + objective.nuisance.contribution(coefficients)[0],
            "log_distance_db": models.log_distance,
            "has_path": np.isfinite(problem.before) & np.isfinite(calibrated),
            "held_out": setup.held_out,
            "retrace_gap_db": np.nan if gap_db is None else gap_db,
            **({} if problem.faint is None else {"faint": problem.faint}),
            **({} if links.censored is None else {"censored": links.censored}),
            **position_columns(links.tx, links.rx),
            **({} if links.group is None else {"group": links.group}),
            **({} if links.frequency is None else {"frequency": links.frequency}),
            **_obstruction(setup),
            **({"offset_only_db": nuisance_only} if fitted else {}),
            **diagnostics.columns,
        }
    )
    further, further_columns = observable_fits(run, certainty.record.draws)
    table = table.assign(**_as_measured(study, links, table), **further_columns)
    if validation is None:
        accuracy, name, residuals = on_held_out_links(problem, trail, models)
    else:
        accuracy, name, residuals = on_blocks(
            validation, problem, held_out_rmse(problem, models.initial, validation.judged), fitted
        )
    chosen = fit_prediction_model(problem, trail, name, residuals, gap_db)
    table = table.assign(predicted_db=chosen.path_loss_db, scene_db=chosen.scene_db, basis=str(name))
    prediction = Prediction(chosen.model, chosen.materials, _residual_field(problem, table, validation))
    # If the study has a ceiling, the ceiling is the prediction for links without a path.
    if chosen.model.parameters is not None and objective.ceiling_db is None:
        without_path = ~table["has_path"].to_numpy(bool)
        fallback = fit_fallback(problem, without_path, *log_distance_errors(problem, models, validation))
        prediction = replace(prediction, fallback=fallback)
        predictions = pd.DataFrame({"path_loss_db": chosen.path_loss_db, "basis": table["basis"]})
        predictions = fill_missing(prediction, study, links, predictions)
        table = table.assign(predicted_db=predictions["path_loss_db"], basis=predictions["basis"])
    return Result(
        study=cast(Study, study),
        fit=Fit(
            parameters=parameters.named(trail.best),
            initial_parameters=parameters.named(parameters.start),
            materials=parameters.materials(trail.best, setup.scene.materials),
            rmse_db=trail.best_rmse_db,
            initial_rmse_db=rmse_of(problem, models.initial, counted),
            nuisance_only_rmse_db=rmse_of(problem, nuisance_only, counted) if fitted else None,
            log_distance_rmse_db=rmse_of(problem, models.log_distance, counted),
            retrace_gap_db=largest_gap(gap_db, counted),
            laws=parameters.law_coefficients(trail.best),
            power_shares=diagnostics.power_shares,
            observables=further,
        ),
        accuracy=accuracy,
        uncertainty=replace(
            certainty.record,
            remarks=(
                *([cheap.remark] if cheap.remark else []),
                *run.on_links,
                *_lost_paths(problem, trail),
                *_worse_than_start(problem, trail, nuisance_only if fitted else models.initial),
                *_worse_than_mean(
                    problem, trail.best_rmse_db, rmse_of(problem, models.log_distance, counted)
                ),
                *certainty.record.remarks,
                *_retraced(gap_db, counted, study.fidelity.tolerance_db),
                *_not_judged(study, accuracy),
            ),
        ),
        nuisance=_nuisance(problem, coefficients[0]),
        prediction=prediction,
        cost=Cost(
            rt_calls=trail.rt_calls,
            ledger_hits=trail.ledger_hits,
            seconds=run.timing.search,
            trace_seconds=run.timing.trace,
            uncertainty_replays=certainty.calls,
            uncertainty_seconds=certainty.seconds,
            cheap_replays=0 if cheap.model is None else cheap.model.calls,
            cheap_seconds=0.0 if cheap.model is None else cheap.model.seconds,
            total_seconds=time.perf_counter() - run.timing.started,
        ),
        provenance=Provenance(setup.files, links.prepared | _faint_rows(problem), run.enclosed),
        links=table,
        history=trail.history(),
        held_out=validation,
        scene=without_facade_materials(setup.scene, study.facades),
        paths=paths,
    )


def _retraced(
    gap_db: NDArray[np.float64] | None, counted: NDArray[np.bool_], tolerance_db: float
) -> tuple[Remark, ...]:
    """A remark if the path loss of any link [L] changes by more than the tolerance when the scene is traced again."""
    if gap_db is None or not (np.abs(gap_db[counted]) > tolerance_db).any():
        return ()
    change_db = np.abs(gap_db[counted])
    values: dict[str, Value] = {
        "links": int((np.isfinite(change_db) & (change_db > tolerance_db)).sum()),
        "lost": int(np.isinf(change_db).sum()),
        "of": len(change_db),
        "tolerance_db": tolerance_db,
        "largest_db": largest_gap(gap_db, counted) or 0.0,
    }
    return (Remark(RemarkKind.RETRACED, values),)


def given_engine_remark(setup: Setup, engine: Engine | None) -> tuple[Remark, ...]:
    """A remark if the user passed an engine of their own; predictions nevertheless use the engine of the study."""
    if engine is None or type(engine).__module__.partition(".")[0] == __name__.partition(".")[0]:
        return ()
    values: dict[str, Value] = {
        "engine": type(engine).__name__,
        "differentiable": isinstance(engine, Differentiable),
        "used": setup.study.engine.name,
    }
    return (Remark(RemarkKind.GIVEN_ENGINE, values),)


def _lost_paths(problem: Problem, trail: Trail) -> tuple[Remark, ...]:
    """A remark if links without a path make the objective infinite at any candidate; failed calls do not count."""
    if problem.setup.study.engine.exports_rays or not trail.modelled:
        return ()
    reached = np.isfinite(trail.modelled)
    wasted = reached.any(axis=1) & np.isinf(trail.rmse_db)
    lost = ~reached[wasted].all(axis=0) & (problem.objective.weight > 0)
    if not wasted.any():
        return ()
    values: dict[str, Value] = {
        "calls": int(wasted.sum()),
        "of": len(wasted),
        "rows": problem.setup.links.row[lost].tolist(),
    }
    return (Remark(RemarkKind.LOST_PATHS, values),)


def _worse_than_start(problem: Problem, trail: Trail, start_db: NDArray[np.float64]) -> tuple[Remark, ...]:
    """A remark if the initial values, with path loss `start_db` [L], fit better than the method's best candidate.

    With priors or further observables, the method minimizes more than the RMSE of path loss, so no remark is made.
    """
    study = problem.setup.study
    priors = [entry.prior for entry in (*study.parameters.values(), *study.nuisance_terms.values())]
    start = rmse_of(problem, start_db, problem.objective.weight > 0)
    if (
        study.observables
        or any(prior is not None for prior in priors)
        or not (found := min(trail.rmse_db)) > start + WORSE_DB
    ):
        return ()
    kept = bool(trail.best_rmse_db < found)
    values = {"start_db": start, "found_db": found, "method": study.method.name, "kept": kept}
    return (Remark(RemarkKind.WORSE_THAN_START, values),)


def _worse_than_mean(problem: Problem, found_db: float, log_distance_db: float) -> tuple[Remark, ...]:
    """A remark if the calibrated model fits worse than the mean measured path loss, as when links are mixed up."""
    objective = problem.objective
    mean = np.average(objective.measured, weights=objective.weight)
    mean_db = rmse_of(problem, np.full(problem.num_links, mean), objective.weight > 0)
    if not found_db > mean_db:
        return ()
    values: dict[str, Value] = {
        "found_db": found_db,
        "mean_db": mean_db,
        "log_distance_db": log_distance_db,
        "program": problem.setup.study.engine.external,
    }
    return (Remark(RemarkKind.WORSE_THAN_MEAN, values),)


def _not_judged(study: StudyModel, accuracy: Accuracy) -> tuple[Remark, ...]:
    """A remark that no link was held out, made if the study allows blocks to be held out."""
    if accuracy.judgement is None and study.allows_blocks:
        return (Remark(RemarkKind.NOT_JUDGED),)
    return ()


def _faint_rows(problem: Problem) -> dict[str, int]:
    """Number of links measured above the noise floor that are left out because the model predicts them near it."""
    faint, censored = problem.faint, problem.setup.links.censored
    count = 0 if faint is None else int((faint if censored is None else faint & ~censored).sum())
    return {FAINT: count} if count else {}


def _residual_field(
    problem: Problem, table: pd.DataFrame, validation: Validation | None
) -> ResidualField | None:
    """The correlated part of the prediction model's residuals.

    None if the residuals are uncorrelated, or if the correlated part does not improve predictions of held-out blocks.
    """
    if validation is not None and Model.RESIDUAL_FIELD in validation.errors:
        rmse_db = validation.table["rmse_db"]
        if rmse_db[Model.RESIDUAL_FIELD] >= rmse_db[Model.CALIBRATED]:
            return None
    links, noise = problem.setup.links, problem.setup.study.noise
    if links.frequency is not None or noise.range_m == 0 or noise.kind == HEAVY:
        return None
    rows, residuals = calibration_residuals(table)
    correlation = shared_errors(residuals, np.hstack([links.tx, links.rx])[rows])
    if correlation is None:
        return None
    return ResidualField(correlation.range_m, correlation.shared_db, correlation.own_db)


def _nuisance(problem: Problem, coefficients: NDArray[np.float64]) -> Nuisance:
    """Coefficients by term and group, and the groups with an offset that no calibration link determines."""
    objective = problem.objective
    by_term = objective.nuisance.by_term(coefficients, objective.determined)
    without_path = [
        label
        for term in objective.nuisance.terms
        if term.name == OFFSET
        for label in term.labels
        if label not in by_term[term.name]
    ]
    centres = {term.name: term.centre for term in objective.nuisance.terms if term.centre}
    return Nuisance(by_term, centres, tuple(without_path))


def _obstruction(setup: Setup) -> dict[str, NDArray[np.float64]]:
    """Columns that describe the obstruction of each link's line of sight."""
    table = setup.with_obstruction().links.table
    names = (OUT_OF_SIGHT, "obstruction_m", *([REGION] if setup.study.regions else []))
    return {name: table.numbers(name) for name in names}


def _as_measured(
    study: StudyModel, links: Measurements, table: pd.DataFrame
) -> dict[str, NDArray[np.float64]]:
    """Columns in the measured quantity, which is path gain or received power; no columns if path loss was measured."""
    quantity, column = study.links.quantity, study.links.value
    if quantity == "path_loss" or column not in links.frame:
        return {}
    # The reference is 0 dB for path gain, and the transmitted power for received power.
    reference = links.frame[column].to_numpy(float) + links.path_loss_db
    unit = "db" if quantity == "path_gain" else "dbm"
    return {
        f"{name}_{quantity}_{unit}": reference - table[f"{name}_db"].to_numpy()
        for name in ("measured", "before", "after")
    }


def _replayed_paths(problem: Problem) -> Paths | None:
    """The replayed paths, if they are in memory and uncompressed."""
    section = problem.setup.study.engine
    uncompressed = getattr(section, "compress_db", None) is None
    return problem.engine.paths if uncompressed and isinstance(problem.engine, Replay) else None


def observable_fits(
    run: Run, draws: Mapping[str, Sequence[float]]
) -> tuple[dict[str, ObservableFit], dict[str, NDArray[np.float64]]]:
    """The fit of every further observable by name, and the columns of the observables in the table of links.

    The columns [L] are the measured, initial and calibrated values and the biases, in the unit of the observable.
    `draws` contains the posterior draws by parameter and may be empty.
    """
    problem = run.problem
    if not problem.observed:
        return {}, {}
    weight, sections = problem.objective.weight, problem.setup.study.observables
    before, after = problem.respond(np.stack([problem.parameters.start, run.trail.best])).observed
    spread = _observed_at_draws(run, draws)
    fits, columns = {}, {}
    for index, observable in enumerate(problem.observed):
        unit, used = sections[observable.name].unit, observable.used(weight)
        initial, _ = observable.residuals(before[index][None], weight)
        residuals, biases = observable.residuals(after[index][None], weight)
        groups = np.unique(observable.group[used]) if observable.labels else np.zeros(0, dtype=np.int64)
        count = (
            np.bincount(observable.group[used], minlength=len(observable.labels))[groups]
            if observable.labels
            else groups
        )
        of_draws = (
            observable.residuals(np.stack([values[index] for values in spread]), weight)[1]
            if spread
            else biases
        )
        # The standard error of the mean, combined with the error due to the uncertainty of the parameters.
        errors = np.sqrt(
            observable.std**2 / np.maximum(count, 1) + np.mean((of_draws - biases)[:, groups] ** 2, axis=0)
        )
        labels = [observable.labels[group] for group in groups]
        fits[observable.name] = ObservableFit(
            kind=observable.statistic.kind,
            unit=unit,
            links=len(used),
            rmse=_rms(residuals),
            initial_rmse=_rms(initial),
            mean_rmse=float(np.std(observable.measured[used])),
            error=observable.std,
            biases=dict(zip(labels, biases[0, groups].tolist(), strict=True)),
            bias_errors=dict(zip(labels, errors.tolist(), strict=True)),
        )
        columns |= {
            f"{observable.name}_measured_{unit}": observable.measured,
            f"{observable.name}_before_{unit}": before[index] / observable.scale,
            f"{observable.name}_after_{unit}": after[index] / observable.scale,
        }
        if observable.labels:
            # The last element belongs to the index -1, which marks a link without a bias.
            known = np.append(np.isin(np.arange(len(observable.labels)), groups), False)
            of_links = np.append(biases[0], np.nan)[observable.group]
            columns[f"{observable.name}_bias_{unit}"] = np.where(known[observable.group], of_links, np.nan)
    return fits, columns


def _observed_at_draws(run: Run, draws: Mapping[str, Sequence[float]]) -> tuple[NDArray[np.float64], ...]:
    """Observables [K, L] at posterior draws, for the errors of biases; an emulator replaces an expensive engine."""
    problem = run.problem
    if not draws or not any(observable.labels for observable in problem.observed):
        return ()
    if not problem.differentiable:
        ensemble = emulate(problem, run.trail, run.cheap.model)
        if ensemble is None:
            return ()
        problem = replace(problem, engine=ensemble.mean, observable=PATH_LOSS)
    drawn = np.stack([draws[name] for name in problem.parameters.names], axis=1)
    return tuple(problem.respond(drawn[evenly_spaced(len(drawn), MOST_DRAWS)]).observed)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
