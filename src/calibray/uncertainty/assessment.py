"""Uncertainty of a finished calibration: posterior draws, intervals, verdicts and remarks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from calibray.engines.protocol import PATH_LOSS
from calibray.fitting.cheap_replay import ReplayedModel
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail, find_minima, relevant_minima
from calibray.parameters import Parameters
from calibray.result.record import Uncertainty
from calibray.result.verdict import (
    CONFIDENCE,
    Cause,
    Interval,
    Reason,
    ReasonKind,
    Remark,
    RemarkKind,
    Verdict,
)
from calibray.support.memory import single_blas_thread
from calibray.support.progress import Progress, start_stage
from calibray.uncertainty.buildings import can_split
from calibray.uncertainty.draws import systematic_resampling
from calibray.uncertainty.emulator import emulate
from calibray.uncertainty.joint_model import JointModel, has_offset, joint_model
from calibray.uncertainty.noise_models import CORRELATED, DIFFERING, HEAVY, OFFSET, OUT_OF_SIGHT
from calibray.uncertainty.remarks import (
    conflict,
    departures,
    fit_undeclared_offset,
    missed,
    outside_interval,
)
from calibray.uncertainty.sequential_monte_carlo import Posterior, draw_posterior, joined
from calibray.uncertainty.verdicts import Axes, JudgedSet, consistent, local_intervals, verdicts, with_reason

LARGEST_ERROR: Final = 0.5
"""The posterior is drawn only if the emulator's leave-one-out error is at most this fraction of the best call's RMSE.
With larger errors, candidates near a call would seem to fit better merely because the emulator is exact at the calls.
Without this limit, the intervals of parameters judged identified or weakly identified contained 2 of 7 true values for
runs with 2 calls per parameter. For runs with 8 or 16 calls per parameter, they contained 14 of 14
(docs/measurements/intervals.md)."""

NEGLIGIBLE_DB: Final = 0.05
"""An emulator error up to this value is always accepted [dB]; path loss is not measured more precisely."""

DRAWS_PER_CALL: Final = 40
"""Number of evaluations that larger populations may use per calibration call if small populations disagree. A
call with derivatives takes as long as 10 to 16 of these evaluations. Populations of 64 members disagreed in 8 of 24
runs in districts 100 to 106. With 256 members, the worst 90 % set contained 0.80 of the posterior instead of 0.76, on
average over the 5 runs with a reference (`benchmarks/simulation_based.py --members 64 256`)."""

EQUAL: Final = 0.1
"""If the drawn emulators differ from their mean by less than this fraction of the lowest objective, only the mean is
used."""

KEPT_DRAWS: Final = 128
"""Number of draws that are kept with the result."""

FEW_LINKS: Final = 500
"""Number of links up to which linear algebra uses one thread."""

MAX_LINKS: Final = 100_000
"""Number of links above which no draws are made, because whitening correlated errors would take minutes."""

MAX_COLUMNS: Final = 100
"""Maximum number of nuisance columns for which the draws include the coefficients."""

SHOWN_DIFFERENCE: Final = 0.1
"""The credible set for the measured buildings is reported only if it and the set for all buildings differ over more
than this fraction of the range that they span together."""

CUSTOMARY: Final = {("relative_permittivity", "linear"): 10.0, ("conductivity", "log"): float(np.log(1000.0))}
"""Usual widths of parameter ranges: building materials have permittivities between 2 and 12, and conductivities that
span three decades. Verdicts refer to these widths, so that wider bounds do not improve a verdict."""

EXACT_DB: Final = 1e-6
"""RMSE below which the data are treated as noise-free, and linear theory is treated as exact [dB]."""

FEWEST_DRAWS: Final = 30
"""Minimum number of effective draws for comparing standard deviations, which are then uncertain by 13 %."""

NOTABLE_SHARE: Final = 0.85
"""Maximum remaining fraction of an interval's width that is reported. Larger fractions may be due to chance, because
standard deviations from few draws are uncertain."""


@dataclass(frozen=True)
class Certainty:
    """Uncertainty of a calibration.

    Attributes:
        record: The uncertainty as stored in the result.
        posterior: All draws; None if no draws were made.
        calls: Number of replays made for the assessment.
        seconds: Time taken by the assessment [s].
    """

    record: Uncertainty
    posterior: Posterior | None = None
    calls: int = 0
    seconds: float = 0.0


def certainty(
    problem: Problem, trail: Trail, progress: Progress | None = None, model: ReplayedModel | None = None
) -> Certainty:
    """Assess the uncertainty of a calibration from its finished search.

    `model` is the replay of the study's scene, if the search used it as a cheap model. The stages of `progress` are
    "finding minima", "drawing" and "judging intervals".
    """
    started = time.perf_counter()
    # With few links, the matrices are small, so BLAS threads cost more time than they save.
    with single_blas_thread(problem.objective.num_counted <= FEW_LINKS):
        if problem.differentiable:
            before = problem.engine.calls
            averaged = average_repeats(problem, trail.best)
            assessment = _assess(averaged, [averaged], trail, progress)
            draws = 0 if assessment.posterior is None else assessment.posterior.replays
            calls = problem.engine.calls - before + (draws if can_split(problem) else 0)
        else:
            assessment, calls = _assess_emulated(problem, trail, progress, model)
    return replace(assessment, calls=calls, seconds=time.perf_counter() - started)


def _assess_emulated(
    problem: Problem, trail: Trail, progress: Progress | None, model: ReplayedModel | None
) -> tuple[Certainty, int]:
    """Uncertainty from emulators of an engine without derivatives, and the number of replays made."""
    ensemble, name = emulate(problem, trail, model), problem.setup.study.engine.name
    error_db = np.inf if ensemble is None else float(ensemble.error_db)
    if ensemble is None or error_db > max(LARGEST_ERROR * trail.best_value, NEGLIGIBLE_DB):
        values: dict[str, float | int | str] = {"calls": len(trail.candidates)}
        if ensemble is not None:
            values |= {"error_db": error_db, "rmse_db": trail.best_value}
        reason = Reason(ReasonKind.TOO_FEW_CALLS, values)
        intervals = _full_ranges(problem.parameters, reason)
        return Certainty(Uncertainty(_approximate(intervals))), 0
    mean, *drawn = (
        replace(problem, engine=engine, observable=PATH_LOSS) for engine in (ensemble.mean, *ensemble.drawn)
    )
    equal = ensemble.apart_db < EQUAL * trail.best_value
    assessment = _assess(mean, [mean] if equal else drawn, trail, progress)
    remark = Remark(
        RemarkKind.APPROXIMATE_INTERVALS,
        {
            "engine": name,
            "calls": ensemble.calls,
            "error_db": error_db,
            "replay": ensemble.replayed is not None,
        },
    )
    record = assessment.record
    record = replace(record, intervals=_approximate(record.intervals), remarks=(remark, *record.remarks))
    return replace(assessment, record=record), 0 if ensemble.replayed is None else ensemble.replayed.calls


def _full_ranges(parameters: Parameters, reason: Reason) -> dict[str, Interval]:
    """Intervals that cover the whole range, with the standard deviation of a uniform distribution."""
    return {
        parameter.name: Interval(
            (parameter.upper - parameter.lower) / np.sqrt(12.0),
            parameter.lower,
            parameter.upper,
            Verdict.NOT_IDENTIFIABLE,
            reason=reason,
        )
        for parameter in parameters
    }


def _approximate(intervals: dict[str, Interval]) -> dict[str, Interval]:
    return {name: replace(interval, approximate=True) for name, interval in intervals.items()}


def _assess(
    problem: Problem, engines: Sequence[Problem], trail: Trail, progress: Progress | None
) -> Certainty:
    """Uncertainty of a problem, from draws for `engines`: copies of the problem, each with an equally likely engine."""
    optimum = problem.squares(problem.parameters.to_search(trail.best)[None], derivatives=True)
    freedom = optimum.num_rows - problem.unknowns
    if freedom < 1:
        # The residuals contain no information about the errors unless there are more residuals than unknowns.
        reason = Reason(ReasonKind.TOO_FEW_LINKS, {"links": optimum.num_rows})
        return Certainty(Uncertainty(_full_ranges(problem.parameters, reason)))
    local = local_intervals(problem, trail, optimum)
    if optimum.value[0] < EXACT_DB:
        return Certainty(Uncertainty(with_reason(local, Reason(ReasonKind.NO_NOISE))))
    start_stage(progress, "finding minima")
    minima, squares = find_minima(problem, trail)
    relevant, least = relevant_minima(minima, squares, freedom), float(squares.min())
    offset = fit_undeclared_offset(problem, relevant, least, freedom)
    record = Uncertainty(
        undeclared_offset_db=offset.offset_db,
        undeclared_offset_error_db=offset.error_db,
        remarks=offset.remarks,
    )
    if problem.objective.num_counted > MAX_LINKS:
        reason = Reason(ReasonKind.TOO_MANY_LINKS, {"limit": MAX_LINKS})
        return Certainty(replace(record, intervals=with_reason(local, reason)))
    models = [joint_model(engine, relevant[0], least, freedom) for engine in engines]
    model, posterior = models[0], _draw(models, problem.setup.study.method.seed, progress, trail.rt_calls)
    start_stage(progress, "judging intervals")
    noise = _noise_weights(model, posterior, offset=not has_offset(problem))
    intervals = _intervals(problem, model, posterior, local)
    best = problem.parameters.named(trail.best)
    top = posterior.means.point[np.argsort(-posterior.means.density)[:64]]
    most_probable = top[np.argmax(model.at_scene_constants(top))]
    at_both = model.at_scene_constants(np.stack([relevant[0], most_probable]))
    log_odds = float(at_both[1] - at_both[0])
    most_probable = problem.parameters.named(problem.parameters.from_search(most_probable))
    remarks = [*offset.remarks, *departures(noise, problem.setup.study)]
    if problem in engines:
        remarks += missed(problem, posterior.means, float(optimum.value[0]))
    remarks += outside_interval(problem, best, intervals, most_probable, log_odds, noise)
    intervals = {name: consistent(interval, best[name]) for name, interval in intervals.items()}
    if problem.observed:
        remarks += conflict(problem, relevant)
    if not posterior.means.agree:
        remarks.append(Remark(RemarkKind.FEW_DRAWS))
    record = replace(
        record,
        intervals=intervals,
        draws=_named_draws(problem, model, posterior),
        constants_db=model.effects_db,
        noise=noise,
        remarks=tuple(remarks),
    )
    return Certainty(record, posterior)


def _draw(models: Sequence[JointModel], seed: int, progress: Progress | None, calls: int) -> Posterior:
    """Draw from the posterior of every model; `calls` is the number of RT calls of the calibration."""
    parts = []
    for number, model in enumerate(models):

        def drawn(share: float, number: int = number) -> None:
            if progress is not None:
                progress("drawing", round(100 * (number + share) / len(models)), 100)

        largest = DRAWS_PER_CALL * calls * model.interactions
        parts.append(draw_posterior(model, seed, drawn, models=len(models), largest_budget=largest))
    return joined(parts)


def _noise_weights(model: JointModel, posterior: Posterior, *, offset: bool) -> dict[str, float]:
    """Posterior weights of each kind of noise, of differences between buildings, and of an undeclared offset."""
    models, weight = model.marginal.models, posterior.means.weight
    weights = {kind: 0.0 for kind in dict.fromkeys(each.kind for each in models)}
    by_model = np.bincount(posterior.model, weight, len(models))
    for each, share in zip(models, by_model.tolist(), strict=True):
        weights[each.kind] += share
    if len(model.parameter_of):
        weights[DIFFERING] = float(weight[posterior.spread > 0].sum())
    if offset:
        with_offset = np.array([each.offset for each in models])
        weights[OFFSET] = float(by_model[with_offset].sum())
    return weights


def _intervals(
    problem: Problem, model: JointModel, posterior: Posterior, local: dict[str, Interval]
) -> dict[str, Interval]:
    """Interval and verdict of each parameter."""
    parameters, counted = problem.parameters, problem.objective.weight > 0
    lower, upper = parameters.search_bounds

    def value_at(index: int, coordinate: float) -> float:
        point = lower.copy()
        point[index] = coordinate
        return float(parameters.from_search(point)[index])

    customary = np.array([CUSTOMARY.get((item.field, item.scale), np.inf) for item in parameters])
    judged = verdicts(
        posterior.means,
        lambda points: problem.objective.capped(problem.modelled(points))[:, counted],
        Axes(parameters.names, lower, upper, value_at, customary),
        model.marginal.noise_db,
        level=CONFIDENCE,
        seen=posterior.seen,
    )
    intervals, without = {}, remaining_widths(model, posterior)
    for index, (name, verdict) in enumerate(zip(parameters.names, judged, strict=True)):
        pieces, seen = (
            tuple((value_at(index, low), value_at(index, high)) for low, high in ranges)
            for ranges in (verdict.pieces, verdict.seen)
        )
        intervals[name] = Interval(
            local[name].standard_error,
            pieces[0][0],
            pieces[-1][1],
            verdict.name,
            pieces,
            verdict.reason,
            seen=seen if _differ(verdict) else (),
            without=without[index],
        )
    return intervals


def _differ(verdict: JudgedSet) -> bool:
    """Whether the sets for the measured buildings and for all buildings differ by more than `SHOWN_DIFFERENCE`."""
    both = (np.array(verdict.pieces), np.array(verdict.seen))
    line = np.linspace(min(each.min() for each in both), max(each.max() for each in both), 1000)
    one, other = (((each[:, :1] <= line) & (line <= each[:, 1:])).any(axis=0) for each in both)
    return bool(np.mean(one != other) > SHOWN_DIFFERENCE)


def _named_draws(problem: Problem, model: JointModel, posterior: Posterior) -> dict[str, list[float]]:
    """Equally weighted draws by name: parameters, constants that the scene fixes, and coefficients of the nuisance."""
    parameters, nuisance, draws = model.parameters, problem.objective.nuisance, posterior.seen
    random = np.random.default_rng(problem.setup.study.method.seed)
    kept = systematic_resampling(draws.weight, KEPT_DRAWS, random)
    values = parameters.from_unit(posterior.joint[kept])
    values[:, : len(model.study)] = model.study.from_search(draws.point[kept])
    by_name = dict(zip(parameters.names, values.T.tolist(), strict=True))
    if 0 < len(nuisance.columns) <= MAX_COLUMNS:
        # For given parameters, determined coefficients scatter about their best values; undetermined coefficients do
        # not.
        objective = replace(problem.objective, noise_db=model.marginal.noise_db)
        normal = random.standard_normal((len(values), len(nuisance.columns)))
        scatter = np.where(objective.determined, normal @ objective.coefficient_root().T, 0.0)
        coefficients = objective.coefficients(model.loss(values)) + scatter
        coefficients = np.clip(coefficients, nuisance.lower, nuisance.upper)
        by_name |= dict(zip(nuisance.columns, coefficients.T.tolist(), strict=True))
    return by_name


def remaining_widths(model: JointModel, posterior: Posterior) -> list[dict[Cause, float]]:
    """For each parameter, the fraction of its interval's width that would remain without each cause of uncertainty.

    Draws in which a cause is absent (for example, in which all buildings are equal) follow the posterior of a study
    that excludes this cause. The effect of the constants that the scene fixes is removed by linear regression of the
    parameter on these constants. The remaining fraction is an upper bound, because the true dependence may be
    nonlinear. Only causes that noticeably widen an interval are listed, in ascending order of the fractions.
    """
    draws, width = posterior.means, len(model.study)
    models = [model.marginal.models[index] for index in posterior.model]
    present = {
        Cause.BUILDINGS: posterior.spread > 0,
        Cause.CORRELATION: np.array([each.kind == CORRELATED for each in models]),
        Cause.MISSING_PATHS: np.array([each.kind == OUT_OF_SIGHT for each in models]),
        Cause.HEAVY_TAILS: np.array([each.kind == HEAVY for each in models]),
        Cause.OFFSET: np.array([each.offset for each in models]),
    }
    shares: list[dict[Cause, float]] = [{} for _ in range(width)]
    full = _deviation(draws.point, draws.weight)
    for cause, mask in present.items():
        without = np.where(mask, 0.0, draws.weight)
        if mask.any() and _effective(without) >= FEWEST_DRAWS:
            _note(shares, cause, _deviation(draws.point, without) / full)
    # Coordinates that represent the same value, such as a scattering coefficient of 0, become one coordinate.
    parameters = model.parameters
    constants = parameters.to_unit(parameters.from_unit(posterior.joint))[:, width:]
    if constants.shape[1] and _effective(draws.weight) >= FEWEST_DRAWS + constants.shape[1]:
        root = np.sqrt(draws.weight)[:, None]
        design = np.hstack([np.ones((len(constants), 1)), constants]) * root
        fitted = design @ np.linalg.lstsq(design, draws.point * root, rcond=None)[0]
        left = np.sqrt(np.sum((draws.point * root - fitted) ** 2, axis=0))
        _note(shares, Cause.CONSTANTS, left / full)
    return [dict(sorted(each.items(), key=lambda entry: entry[1])) for each in shares]


def _note(shares: list[dict[Cause, float]], cause: Cause, share: NDArray[np.float64]) -> None:
    for noted, left in zip(shares, share.tolist(), strict=True):
        if left <= NOTABLE_SHARE:
            noted[cause] = left


def _deviation(point: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = weight / weight.sum()
    return np.sqrt(np.maximum(weight @ (point - weight @ point) ** 2, 1e-300))


def _effective(weight: NDArray[np.float64]) -> float:
    return float(weight.sum() ** 2 / max(float(weight @ weight), 1e-300))


REPEAT_M: Final = 0.01
"""Maximum distance [m] between the link ends of two rows that count as repeats of one link; antennas are larger than
this."""

REPEAT_DB: Final = 0.1
"""Maximum difference [dB] in modelled path loss between two rows that repeat a link; a different antenna or carrier
frequency causes a larger change."""


def average_repeats(problem: Problem, best: NDArray[np.float64]) -> Problem:
    """Replace the rows that repeat a link with their mean; the problem is unchanged if no row repeats a link.

    Rows at the same position share the link's error. If these rows were treated as independent, intervals would be too
    narrow by a factor of the square root of the number of rows. The scatter of the rows contains no information about
    the shared error. If the rows agree closely, a noise model with one variance for scatter and shared error would
    underestimate the shared error.

    Rows repeat a link if they have the same end positions, nuisances and biases, and if their modelled path losses
    agree, both at the initial values and at the best candidate. The first row is assigned the mean path loss, the mean
    weight and the means of further observables. The other rows are assigned a weight of 0.

    Args:
        problem: The problem.
        best: The best candidate, in physical units [d].
    """
    objective, links = problem.objective, problem.setup.links
    counted = np.flatnonzero(objective.weight > 0)
    position = np.hstack([links.tx, links.rx])[counted]
    if len(counted) < 2:
        return problem
    tree = KDTree(position)
    if tree.query(position, k=2)[0][:, 1].min() > REPEAT_M:
        return problem
    parameters = problem.parameters
    candidates = np.stack([parameters.to_search(best), parameters.to_search(parameters.start)])
    terms = objective.nuisance.terms
    # Scale the columns by the maximum difference between repeats; different groups then differ by 2 or more.
    columns = np.array([
        *np.nan_to_num(problem.modelled(candidates)[:, counted] / REPEAT_DB),  # inf without a path
        *(term.value[counted] / 1e-3 for term in terms),
        *(term.group[counted] * 2.0 for term in terms),
        *(observable.group[counted] * 2.0 for observable in problem.observed),
    ])  # fmt: skip
    first = np.full(len(counted), -1)
    for row in range(len(counted)):
        if first[row] < 0:
            # All later rows that agree with the first row repeat the same link.
            near = np.array(tree.query_ball_point(position[row], REPEAT_M))
            equal = (np.abs(columns[:, near] - columns[:, [row]]) <= 1.0).all(axis=0) & (first[near] < 0)
            first[near[equal]] = row
    rows, weights = np.bincount(first), np.bincount(first, weights=objective.weight[counted])
    total = np.bincount(first, weights=(objective.weight * objective.measured)[counted])
    kept = np.flatnonzero(rows)
    measured, weight = objective.measured.copy(), np.zeros(len(links))
    measured[counted[kept]] = total[kept] / weights[kept]
    weight[counted[kept]] = weights[kept] / rows[kept]
    observed = tuple(
        replace(observable, measured=_means(observable.measured, counted, first))
        for observable in problem.observed
    )
    objective = replace(objective, measured=measured).reweighted(weight)
    return replace(problem, objective=objective, observed=observed)


def _means(
    values: NDArray[np.float64], counted: NDArray[np.int64], first: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Copy of the values [L] with the mean of a link's known values in its first row; NaN if no value is known.

    For each of the m rows with nonzero weight, `first` [m] is the index of the first row of the same link.
    """
    known = np.isfinite(values[counted])
    number = np.bincount(first[known], minlength=len(counted))
    total = np.bincount(first[known], values[counted][known], len(counted))
    means = values.copy()
    means[counted] = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return means
