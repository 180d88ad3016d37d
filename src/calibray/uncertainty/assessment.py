"""Uncertainty of a finished calibration: posterior draws, intervals, verdicts and remarks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import PATH_LOSS
from calibray.fitting.cheap_replay import ReplayedModel
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, Trail, find_minima, relevant_minima
from calibray.parameters import Parameters
from calibray.result.remark import Remark, RemarkKind
from calibray.result.verdict import CONFIDENCE, Interval, Reason, ReasonKind, Verdict
from calibray.support.memory import single_blas_thread
from calibray.support.progress import Progress
from calibray.uncertainty.between_buildings import population_means
from calibray.uncertainty.emulator import emulate
from calibray.uncertainty.importance_sampling import ENOUGH, Draws, pooled, sample
from calibray.uncertainty.likelihood import PosteriorDensity
from calibray.uncertainty.linear_theory import covariances, local_intervals, with_reason
from calibray.uncertainty.remarks import departures, fit_undeclared_offset, missed, outside_interval
from calibray.uncertainty.verdicts import Axes, consistent, verdicts, widened

COST: Final = 10
"""Replays for draws, at most, per replay of the calibration; the latter compute derivatives and cost twice as much."""

INTERACTIONS: Final = 100_000_000
"""Interactions times replays that draws may take in any case: some seconds."""

SIZES: Final = ((512, 20), (512, 8), (384, 6), (256, 5), (128, 4), (64, 3))
"""Points per round and number of rounds; the first pair within the cost is used. Most posteriors take two to four
rounds."""

SHARED_SIZES: Final = ((128, 4), (64, 3))
"""`SIZES` if several engines share the cost."""

POINTS_PER_START: Final = 4
"""Points of the first round per start, if that gives more starts than `BASINS`. With many parameters of little effect,
each mode of the others is found at many minima."""

MAX_ROUNDS: Final = 20
"""Largest number of rounds if earlier rounds cost less than planned: points of low density need fewer replays."""

MORE_ROUNDS: Final = 3
"""Largest ratio of these rounds to the planned ones."""

EQUAL: Final = 0.1
"""Difference between emulators, relative to the errors of the links, below which only their mean is used."""

MINIMA: Final = 200
"""Largest number of least-squares minima evaluated as starts."""

NOISE_DRAWS: Final = 250
"""Draws at which noise models are compared."""

KEPT_DRAWS: Final = 128
"""Draws kept with the result."""

FEW_LINKS: Final = 500
"""Links up to which linear algebra takes one thread."""

MAX_LINKS: Final = 10_000
"""Links beyond which no draws are made: the correlation models need all pairs of links."""

MAX_COLUMNS: Final = 100
"""Columns of the nuisance up to which the draws include its coefficients."""

EXACT_DB: Final = 1e-6
"""RMSE below which the data have no noise, so that linear theory is exact [dB]."""


@dataclass(frozen=True)
class Certainty:
    """Uncertainty of a calibration.

    Attributes:
        intervals: Interval and verdict by parameter.
        draws: Posterior draws of parameters and nuisance coefficients, by name.
        posterior: All draws for the measured buildings, in the search space; None if none were made.
        means: Draws of the means over all buildings; the posterior itself if buildings do not differ.
        noise: Posterior weights of the kinds of noise, and of an undeclared offset.
        undeclared_offset_db: The best offset in addition to the study's model; None if the study declares one [dB].
        undeclared_offset_error_db: Its standard error [dB].
        remarks: Warnings and advice.
        calls: Replays that the draws took.
        seconds: Time of the assessment [s].
    """

    intervals: dict[str, Interval] = field(default_factory=dict)
    draws: dict[str, list[float]] = field(default_factory=dict)
    posterior: Draws | None = None
    means: Draws | None = None
    noise: dict[str, float] = field(default_factory=dict)
    undeclared_offset_db: float | None = None
    undeclared_offset_error_db: float | None = None
    remarks: tuple[Remark, ...] = ()
    calls: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class _Budget:
    """Cost of the draws from one engine.

    Attributes:
        points: Points per round.
        rounds: Planned rounds.
        replays: Largest number of replays in total.
    """

    points: int
    rounds: int
    replays: int


def certainty(
    problem: Problem, trail: Trail, progress: Progress | None = None, model: ReplayedModel | None = None
) -> Certainty:
    """Assess the uncertainty of a calibration.

    Args:
        problem: The problem.
        trail: Its finished search.
        progress: Called with the stage "drawing" after every round.
        model: The replay of the study's scene, if the search had one as a cheap model.

    Returns:
        The uncertainty.
    """
    started = time.perf_counter()
    # Matrices of few links are small; BLAS threads cost more than they save.
    with single_blas_thread(problem.objective.num_counted <= FEW_LINKS):
        if problem.differentiable:
            calls = problem.engine.calls
            assessment = _assess(problem, [problem], trail, trail.rt_calls, progress)
            calls = problem.engine.calls - calls
        else:
            assessment, calls = _assess_emulated(problem, trail, progress, model)
    return replace(assessment, calls=calls, seconds=time.perf_counter() - started)


def _assess_emulated(
    problem: Problem, trail: Trail, progress: Progress | None, model: ReplayedModel | None
) -> tuple[Certainty, int]:
    """Uncertainty from emulators of an engine without derivatives, and the number of replays."""
    ensemble, name = emulate(problem, trail, model), problem.setup.study.engine.name
    if ensemble is None:
        reason = Reason(ReasonKind.TOO_FEW_CALLS, {"calls": len(trail.candidates)})
        return Certainty(_full_ranges(problem.parameters, reason)), 0
    mean, *drawn = (
        replace(problem, engine=engine, observable=PATH_LOSS) for engine in (ensemble.mean, *ensemble.drawn)
    )
    equal = ensemble.apart_db < EQUAL * trail.best_value
    spent = trail.rt_calls if model is None else model.calls
    assessment = _assess(mean, [mean] if equal else drawn, trail, spent, progress)
    remark = Remark(
        RemarkKind.APPROXIMATE_INTERVALS,
        {
            "engine": name,
            "calls": ensemble.calls,
            "error_db": float(ensemble.error_db),
            "replay": ensemble.replayed is not None,
        },
    )
    intervals = {name: replace(interval, approximate=True) for name, interval in assessment.intervals.items()}
    calls = 0 if ensemble.replayed is None else ensemble.replayed.calls
    return replace(assessment, intervals=intervals, remarks=(remark, *assessment.remarks)), calls


def _full_ranges(parameters: Parameters, reason: Reason) -> dict[str, Interval]:
    """Intervals over the whole range, with the standard deviation of a uniform distribution."""
    return {
        parameter.name: Interval(
            (parameter.upper - parameter.lower) / np.sqrt(12.0),
            parameter.lower,
            parameter.upper,
            Verdict.NOT_IDENTIFIABLE,
            reason=reason,
            approximate=True,
        )
        for parameter in parameters
    }


def _assess(
    problem: Problem, engines: Sequence[Problem], trail: Trail, spent: int, progress: Progress | None
) -> Certainty:
    """Uncertainty of a problem; draws come from problems with equally likely engines."""
    optimum = problem.squares(problem.parameters.to_search(trail.best)[None], derivatives=True)
    local = local_intervals(problem, trail, optimum)
    freedom = optimum.num_rows - problem.unknowns
    if freedom < 1:
        reason = Reason(ReasonKind.TOO_FEW_LINKS, {"links": optimum.num_rows})
        unknown = {
            name: replace(interval, verdict=Verdict.NOT_IDENTIFIABLE) for name, interval in local.items()
        }
        return Certainty(with_reason(unknown, reason))
    if optimum.value[0] < EXACT_DB:
        return Certainty(with_reason(local, Reason(ReasonKind.NO_NOISE)))
    minima, squares = find_minima(problem, trail)
    relevant, least = relevant_minima(minima, squares, freedom), float(squares.min())
    offset = fit_undeclared_offset(problem, relevant, least, freedom)
    assessment = Certainty(
        undeclared_offset_db=offset.offset_db,
        undeclared_offset_error_db=offset.error_db,
        remarks=offset.remarks,
    )
    if problem.objective.num_counted > MAX_LINKS:
        reason = Reason(ReasonKind.TOO_MANY_LINKS, {"limit": MAX_LINKS})
        return replace(assessment, intervals=with_reason(local, reason))
    density = PosteriorDensity.of(problem, relevant[0], least, freedom)
    budget = _budget(problem, spent, len(engines), density.replays)
    if budget is None:
        return replace(assessment, intervals=with_reason(local, Reason(ReasonKind.TOO_EXPENSIVE)))
    tried = density.marginal.models
    # A higher minimum of least squares may have the highest density under correlated or heavy-tailed errors.
    points = np.concatenate([minima[np.argsort(squares)[:MINIMA]], offset.minima[:BASINS]])
    at_minima = density(points)
    order = np.argsort(-np.logaddexp.reduce(at_minima, axis=1), kind="stable")
    starts = points[order[: max(BASINS, budget.points // POINTS_PER_START)]]
    density = density.without_negligible(at_minima)
    posterior = _draw(density, engines, starts, covariances(problem, starts, freedom), budget, progress)
    at_draws = density(posterior.resampled(NOISE_DRAWS))
    noise = density.noise_weights(np.exp(at_draws - np.logaddexp.reduce(at_draws, axis=1, keepdims=True)))
    means = population_means(density, posterior, at_draws, tried)
    intervals = _intervals(density, posterior, means, local)
    log_odds = float(posterior.density.max() - np.logaddexp.reduce(at_minima[0]))
    most_probable = problem.parameters.from_search(posterior.point[np.argmax(posterior.density)])
    best, most_probable = problem.parameters.named(trail.best), problem.parameters.named(most_probable)
    remarks = [*offset.remarks, *departures(noise)]
    if problem in engines:
        remarks += missed(problem, posterior, trail)
    remarks += outside_interval(problem, best, intervals, most_probable, log_odds, noise)
    intervals = {name: consistent(interval, best[name]) for name, interval in intervals.items()}
    if posterior.flattened:
        remarks.append(Remark(RemarkKind.FEW_DRAWS))
    return replace(
        assessment,
        intervals=intervals,
        draws=_named_draws(problem, posterior),
        posterior=posterior,
        means=means,
        noise=noise,
        remarks=tuple(remarks),
    )


def _draw(
    density: PosteriorDensity,
    engines: Sequence[Problem],
    starts: NDArray[np.float64],
    covariance: NDArray[np.float64],
    budget: _Budget,
    progress: Progress | None,
) -> Draws:
    """Draw from the posterior of every engine: starts [k, d] with covariances [k, d, d]."""
    done = 0

    def draw(engine: Problem) -> Draws:
        of_engine, before, first = replace(density, problem=engine), engine.engine.calls, done

        def more() -> bool:
            within_rounds = done - first <= min(MAX_ROUNDS, MORE_ROUNDS * budget.rounds)
            spent = engine.engine.calls - before
            return within_rounds and spent + budget.points * density.replays <= budget.replays

        def log_density(points: NDArray[np.float64]) -> NDArray[np.float64]:
            nonlocal done
            done += 1
            if progress is not None:
                progress("drawing", done, max(done, (budget.rounds + 1) * len(engines)))
            return np.logaddexp.reduce(of_engine(points), axis=1)

        return sample(
            log_density,
            *engine.parameters.search_bounds,
            starts,
            covariance,
            batch=budget.points,
            rounds=budget.rounds,
            more=more,
            enough=ENOUGH / len(engines),
            seed=engine.setup.study.method.seed,
        )

    return pooled([draw(engine) for engine in engines])


def _intervals(
    density: PosteriorDensity, posterior: Draws, means: Draws, local: dict[str, Interval]
) -> dict[str, Interval]:
    """Interval and verdict by parameter, from draws for the measured buildings and of the means over all."""
    parameters = density.problem.parameters
    lower, upper = parameters.search_bounds

    def value_at(index: int, coordinate: float) -> float:
        point = lower.copy()
        point[index] = coordinate
        return float(parameters.from_search(point)[index])

    judged = verdicts(
        means,
        density.modelled,
        Axes(parameters.names, lower, upper, value_at),
        density.marginal.noise_db,
        level=CONFIDENCE,
        seen=posterior,
    )
    intervals = {}
    for index, (name, verdict) in enumerate(zip(parameters.names, judged, strict=True)):
        pieces = tuple((value_at(index, low), value_at(index, high)) for low, high in verdict.pieces)
        interval = Interval(
            local[name].standard_error, pieces[0][0], pieces[-1][1], verdict.name, pieces, verdict.reason
        )
        if posterior.flattened:

            def to_unit(value: float, index: int = index) -> float:
                point = parameters.lower.copy()
                point[index] = value
                return float(parameters.to_unit(point)[index])

            interval = widened(interval, local[name], to_unit)
        intervals[name] = interval
    return intervals


def _budget(problem: Problem, spent: int, engines: int, replays: int) -> _Budget | None:
    """The largest budget within the cost; None if the smallest is too expensive.

    Args:
        problem: The problem.
        spent: Replays of the calibration.
        engines: Number of engines that share the cost.
        replays: Replays per point.
    """
    interactions = getattr(problem.engine, "interactions", 1)
    allowed = max(COST * spent, INTERACTIONS // max(interactions, 1)) // engines
    for points, rounds in SIZES if engines == 1 else SHARED_SIZES:
        if points * (rounds + 2) * replays <= allowed:
            return _Budget(points, rounds, allowed)
    return None


def _named_draws(problem: Problem, posterior: Draws) -> dict[str, list[float]]:
    """Draws of equal weight by name: parameters in the fields' units, and coefficients of the nuisance."""
    parameters, columns = problem.parameters, problem.objective.nuisance.columns
    points = posterior.resampled(KEPT_DRAWS, problem.setup.study.method.seed)
    draws = dict(zip(parameters.names, parameters.from_search(points).T.tolist(), strict=True))
    if len(columns) <= MAX_COLUMNS:
        coefficients = problem.objective.coefficients(problem.modelled(points))
        draws |= dict(zip(columns, coefficients.T.tolist(), strict=True))
    return draws
