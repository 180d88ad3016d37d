"""From a finished search to its result: accuracy beside its rivals, intervals, and a row for every link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.engines.kinds.replay import ReplaySection
from calibray.engines.replay import Replay
from calibray.fitting.cheap_replay import Aid
from calibray.fitting.fidelity_loop import largest
from calibray.fitting.nuisance import OFFSET
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.measurements import Measurements
from calibray.paths import Paths
from calibray.prediction.residual_field import measured_errors
from calibray.result import Result
from calibray.result.residuals import ResidualField
from calibray.study import Study
from calibray.tracing.positions import EnclosedAntennas
from calibray.uncertainty.assessment import Certainty
from calibray.uncertainty.link_diagnostics import examined
from calibray.uncertainty.noise_models import HEAVY
from calibray.uncertainty.residuals import shared_errors
from calibray.validation.baselines import log_distance
from calibray.validation.choice import choose_model
from calibray.validation.judgement import compare
from calibray.validation.validation import BEFORE, CALIBRATED, LAW, Validation

FEWEST: Final = 8
"""Links held out that a scale of residuals can be taken from."""


UNJUDGED: Final = (
    "No link was held out to tell which model predicts best elsewhere: say [holdout] blocks = 4, or ask calibray "
    "validate."
)
"""Said where no link judges the calibration."""

FAINT: Final = "expected too near the noise floor, left out"
"""What links are counted as that the model expects near the noise floor."""


@dataclass(frozen=True, eq=False)
class Models:
    """Path loss by each model at all links [L], [dB].

    Attributes:
        before: Before anything was fitted.
        offset_only: With the nuisances fitted alone.
        after: Calibrated.
        rival: Of the log-distance model.
    """

    before: NDArray[np.float64]
    offset_only: NDArray[np.float64]
    after: NDArray[np.float64]
    rival: NDArray[np.float64]


def outcome(
    problem: Problem,
    trail: Trail,
    gap: NDArray[np.float64] | None,
    certainty: Certainty,
    validation: Validation | None,
    enclosed: EnclosedAntennas | None,
    seconds: float,
    trace_seconds: float,
    helper: Aid,
) -> Result:
    """What a calibration found.

    Args:
        problem: The problem, on the last trace calibrated on.
        trail: Its search.
        gap: Change of every link's path loss on tracing again [L], [dB]; None where nothing was checked.
        certainty: How far it can be trusted.
        validation: Held-out errors, where blocks are held out in turn.
        enclosed: Antennas inside closed bodies; None where nothing was looked for.
        seconds: Time that the method took [s].
        trace_seconds: Time that tracing and loading took before [s].
        helper: The cheap model that the method had, if any.

    Returns:
        The result.
    """
    setup, objective, parameters = problem.setup, problem.objective, problem.parameters
    study, links = setup.study, setup.links
    best, counted = trail.best_modelled, objective.weight > 0
    offsets, fitted = objective.coefficients(best[None]), bool(objective.nuisance.terms)
    offset_only, after = objective.model(np.stack([problem.before, best]))
    rival = log_distance(links, objective, study.scene.frequency)
    models = Models(objective.capped(problem.before), offset_only, after, rival)
    terms, paths = _terms(problem, offsets[0]), _traced(problem)
    seen = examined(problem, trail.best, paths)
    table = pd.DataFrame(
        {
            "row": links.row,
            "measured_db": objective.measured,
            "before_db": problem.before,
            "after_db": best + objective.nuisance.contribution(offsets)[0],
            "log_distance_db": rival,
            "has_path": np.isfinite(problem.before) & np.isfinite(best),
            "held_out": setup.held_out,
            "retrace_gap_db": np.nan if gap is None else gap,
            **({} if problem.faint is None else {"faint": problem.faint}),
            **({} if links.censored is None else {"censored": links.censored}),
            **_places(links),
            **({"offset_only_db": offset_only} if fitted else {}),
            **seen.columns,
        }
    )
    table = table.assign(**_as_measured(study, links, table))
    chosen = None
    if validation is None:
        judged = _held_out(problem, trail, models)
    else:
        judged = _in_turn(validation, _rmse(problem, models.before, validation.block >= 0), fitted)
        chosen, by_chosen = choose_model(problem, validation, parameters.to_search(trail.best))
        table = table.assign(chosen_db=by_chosen)
        if chosen.name != CALIBRATED:
            beside = f"{chosen.residual_db:.2f} dB, the calibrated one {judged['holdout_rmse_db']:.2f} dB"
            judged["judgement"] += (f"{validation.choice} On blocks held out it has {beside}.",)
    judgement = judged.pop("judgement")
    return Result(
        study=study,
        parameters=parameters.named(trail.best),
        initial_parameters=parameters.named(parameters.start),
        intervals=certainty.intervals,
        materials=parameters.materials(trail.best, problem.engine.materials),
        offsets_db={label: value for label, value in terms.get(OFFSET, {}).items() if value is not None},
        groups_without_path=tuple(label for label, value in terms.get(OFFSET, {}).items() if value is None),
        rmse_db=trail.best_rmse_db,
        initial_rmse_db=_rmse(problem, models.before, counted),
        offset_only_rmse_db=_rmse(problem, offset_only, counted) if fitted else None,
        log_distance_rmse_db=_rmse(problem, rival, counted),
        **judged,
        retrace_gap_db=largest(gap, counted),
        rt_calls=trail.rt_calls,
        ledger_hits=trail.ledger_hits,
        seconds=seconds,
        trace_seconds=trace_seconds,
        links=table,
        history=trail.history(),
        laws=parameters.law_coefficients(trail.best),
        enclosed=enclosed,
        scene=setup.scene,
        files=setup.files,
        paths=paths,
        power_shares=seen.power_shares,
        prepared=links.prepared | _left_out(problem),
        validation=validation,
        nuisances={
            name: {label: value for label, value in values.items() if value is not None}
            for name, values in terms.items()
            if name != OFFSET
        },
        nuisance_centres={term.name: term.centre for term in objective.nuisance.terms if term.centre},
        draws=certainty.draws,
        noise=certainty.noise,
        free_offset_db=certainty.free_offset_db,
        free_offset_error_db=certainty.free_offset_error_db,
        remarks=(*([helper.remark] if helper.remark else []), *certainty.remarks, *judgement),
        chosen=chosen,
        residual_field=_shared(problem, table),
        profile_calls=certainty.calls,
        profile_seconds=certainty.seconds,
        cheap_calls=0 if helper.model is None else helper.model.calls,
        cheap_seconds=0.0 if helper.model is None else helper.model.seconds,
    )


def _rmse(problem: Problem, model: NDArray[np.float64], mask: NDArray[np.bool_]) -> float:
    weight = problem.setup.links.weight[mask]
    return float(np.sqrt(np.average((model - problem.objective.measured)[mask] ** 2, weights=weight)))


def _held_out(problem: Problem, trail: Trail, models: Models) -> dict[str, Any]:
    """Accuracy on the links that a filter holds out, and what follows from it."""
    objective, links, study = problem.objective, problem.setup.links, problem.setup.study
    fitted = bool(objective.nuisance.terms)
    reached = np.isfinite(problem.before) & np.isfinite(trail.best_modelled)
    judged = problem.setup.held_out & (reached | (objective.ceiling_db is not None))
    if links.censored is not None:
        judged &= ~links.censored
    judgement: tuple[str, ...] = () if judged.any() or study.engine.name != "replay" else (UNJUDGED,)
    errors = (models.after - objective.measured)[judged]
    if judged.any():
        rivals = {
            "materials as before, with the nuisances fitted"
            if fitted
            else "materials as before": models.offset_only,
            "a log-distance model": models.rival,
        }
        others = {name: (model - objective.measured)[judged] for name, model in rivals.items()}
        judgement = (compare(errors, others, links.rx[judged]).sentence,)
    size, basis = None, "too few links"
    if len(errors) >= FEWEST:
        size, basis = float(np.sqrt(np.mean(errors**2))), f"{len(errors)} links held out"
    elif problem.freedom >= 1:
        size = float(trail.best_rmse_db * np.sqrt(objective.num_counted / problem.freedom))
        basis = f"{objective.num_counted} links calibrated on"

    def rmse(model: NDArray[np.float64]) -> float | None:
        return _rmse(problem, model, judged) if judged.any() else None

    return {
        "holdout_rmse_db": rmse(models.after),
        "initial_holdout_rmse_db": rmse(models.before),
        "offset_only_holdout_rmse_db": rmse(models.offset_only) if fitted else None,
        "log_distance_holdout_rmse_db": rmse(models.rival),
        "residual_db": size,
        "residual_basis": basis,
        "judgement": judgement,
    }


def _left_out(problem: Problem) -> dict[str, int]:
    """How many links are left out that were heard, by what the model expects of them."""
    faint, unheard = problem.faint, problem.setup.links.censored
    count = 0 if faint is None else int((faint if unheard is None else faint & ~unheard).sum())
    return {FAINT: count} if count else {}


def _in_turn(validation: Validation, before_db: float | None, fitted: bool) -> dict[str, Any]:
    """Accuracy on blocks held out in turn, and what follows from it."""
    figures = validation.table["rmse_db"]
    return {
        "holdout_rmse_db": float(figures[CALIBRATED]),
        "initial_holdout_rmse_db": before_db,
        "offset_only_holdout_rmse_db": float(figures[BEFORE]) if fitted else None,
        "log_distance_holdout_rmse_db": float(figures[LAW]),
        "residual_db": validation.scale(CALIBRATED),
        "residual_basis": f"{len(validation.labels)} blocks held out in turn",
        "judgement": (validation.sentence,),
    }


def _shared(problem: Problem, table: pd.DataFrame) -> ResidualField | None:
    """What neighbours' errors share under the model that predictions go by; None where they show nothing."""
    links, noise = problem.setup.links, problem.setup.study.noise
    if links.frequency is not None or noise.range_m == 0 or noise.kind == HEAVY:
        return None
    known, errors = measured_errors(table)
    found = shared_errors(errors, np.hstack([links.tx, links.rx])[known])
    return None if found is None else ResidualField(found.range_m, found.shared_db, found.own_db)


def _terms(problem: Problem, coefficients: NDArray[np.float64]) -> dict[str, dict[str, float | None]]:
    """Coefficients by term and group; None where no link tells one."""
    found, first = {}, 0
    known = problem.objective.determined
    for term in problem.objective.nuisance.terms:
        last = first + len(term.labels)
        values = zip(term.labels, coefficients[first:last].tolist(), known[first:last], strict=True)
        found[term.name] = {label: value if determined else None for label, value, determined in values}
        first = last
    return found


def _places(links: Measurements) -> dict[str, NDArray[Any]]:
    """Where the links' ends stand, and what sets them apart: columns of a table of links."""
    ends = {
        f"{end}_{axis}": position[:, k]
        for end, position in (("tx", links.tx), ("rx", links.rx))
        for k, axis in enumerate("xyz")
    }
    group = {} if links.group is None else {"group": links.group}
    carrier = {} if links.frequency is None else {"frequency": links.frequency}
    return ends | group | carrier


def _as_measured(study: Study, links: Measurements, table: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    """Path gain or received power, with the sign it was measured with; nothing where that is path loss."""
    quantity, column = study.links.quantity, study.links.value
    if quantity == "path_loss" or column not in links.frame:
        return {}
    # Path gain is 0 dB less path loss, received power the transmitted power less it.
    start = links.frame[column].to_numpy(float) + links.path_loss_db
    unit = "dbm" if quantity == "received_power" else "db"
    return {
        f"{when}_{quantity}_{unit}": start - table[f"{when}_db"].to_numpy()
        for when in ("measured", "before", "after")
    }


def _traced(problem: Problem) -> Paths | None:
    """The paths calibrated on, where they are at hand as they were traced."""
    section = problem.setup.study.engine
    whole = isinstance(section, ReplaySection) and section.compress_db is None
    return problem.engine.paths if whole and isinstance(problem.engine, Replay) else None
