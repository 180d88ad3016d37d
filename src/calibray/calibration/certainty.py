"""How far a finished calibration can be trusted: profiles, draws from the posterior, and a free offset tried beside."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from calibray.calibration.problem import Problem
from calibray.calibration.search import Trail, rounds
from calibray.inference.intervals import CONFIDENCE, Interval, intervals
from calibray.inference.nuisance import Nuisance, make_term
from calibray.inference.posterior import draws
from calibray.inference.profile import LIKELY, Profile, profiles, threshold_square
from calibray.inference.verdicts import verdicts
from calibray.optimizers import LeastSquares
from calibray.progress import Progress

COST: Final = 10
"""Replays of the profiles by those of the calibration, at most."""

INTERACTIONS: Final = 50_000_000
"""Interactions times replays that profiles may take in any case: some seconds."""

SIZES: Final = ((31, 24), (31, 8), (15, 6), (9, 4), (7, 2), (5, 1))
"""Values of each profile and minima that it starts from, the first that the cost allows."""

EVALUATIONS: Final = 6
"""Evaluations that a minimization with one parameter held takes, about, from the nearest known minimum."""

SEARCHES: Final = 64
"""Local searches for the minima, where the method kept none."""

COLUMNS: Final = 100
"""Columns of the nuisance beyond which draws leave them as they are at the optimum."""

NOTED_DB: Final = 0.1
"""Offset below which none is spoken of [dB]."""

EXACT_DB: Final = 1e-6
"""RMSE of data without noise, which tell everything [dB]."""


@dataclass(frozen=True)
class Certainty:
    """How far a calibration can be trusted.

    Attributes:
        intervals: Interval and verdict by parameter; empty where the engine gives no derivatives.
        draws: Values of the parameters, by name, that explain the data about as well as those found.
        free_offset_db: The offset that fits best beside the study's model, where that has none [dB].
        free_offset_error_db: Its standard error [dB].
        remarks: What is to be said aloud, a sentence each.
        calls: Replays that this took.
        seconds: Time that this took [s].
    """

    intervals: dict[str, Interval] = field(default_factory=dict)
    draws: dict[str, list[float]] = field(default_factory=dict)
    free_offset_db: float | None = None
    free_offset_error_db: float | None = None
    remarks: tuple[str, ...] = ()
    calls: int = 0
    seconds: float = 0.0


def certainty(problem: Problem, trail: Trail, progress: Progress | None = None) -> Certainty:
    """Work out how far a calibration can be trusted.

    Args:
        problem: The problem.
        trail: Its finished search.
        progress: Called with the stage "profiling" after every parameter.

    Returns:
        What the data tell of the parameters.
    """
    if not problem.differentiable:
        name = problem.setup.study.engine.name
        return Certainty(
            remarks=(
                f"Intervals are not known: the engine {name!r} gives no derivatives, which profiles take.",
            )
        )
    started, calls = time.perf_counter(), problem.engine.calls
    told = problem.evaluate(problem.parameters.to_search(trail.best)[None], derivatives=True)
    local = _curvature(problem, trail, told.residuals[0], told.slopes[0])
    freedom = _freedom(problem, told.residuals.shape[1])
    if freedom < 1:
        reason = f"{told.residuals.shape[1]} links are too few for so many unknowns"
        found = Certainty(
            {name: replace(each, verdict="not identifiable", reason=reason) for name, each in local.items()}
        )
    elif told.value[0] < EXACT_DB:
        reason = "the data hold no noise"
        found = Certainty({name: replace(each, reason=reason) for name, each in local.items()})
    else:
        found = _from_profiles(problem, trail, local, freedom, progress)
    return replace(found, calls=problem.engine.calls - calls, seconds=time.perf_counter() - started)


def _from_profiles(
    problem: Problem, trail: Trail, local: dict[str, Interval], freedom: int, progress: Progress | None
) -> Certainty:
    parameters = problem.parameters
    lower, upper = parameters.search_bounds
    minima, square = _minima(problem, trail)
    likely = _likely(minima, square, freedom)
    offset = _free_offset(problem, likely, float(square.min()), freedom)
    size = _size(problem, trail, len(likely))
    if size is None:
        reason = "by the curvature at the optimum alone: profiles would cost more than ten calibrations"
        return replace(offset, intervals={name: replace(each, reason=reason) for name, each in local.items()})
    values, starts = size

    def evaluate(
        points: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        told = problem.evaluate(points, derivatives=True)
        return told.value, told.residuals, told.slopes

    curves = profiles(
        evaluate, lower, upper, likely[:starts], freedom, level=CONFIDENCE, values=values, progress=progress
    )

    def shown(index: int, value: float) -> float:
        point = lower.copy()
        point[index] = value
        return float(parameters.from_search(point)[index])

    told = verdicts(curves, evaluate, parameters.names, lower, upper, freedom, level=CONFIDENCE, shown=shown)
    found = {}
    for index, (name, verdict) in enumerate(zip(parameters.names, told, strict=True)):
        pieces = tuple((shown(index, low), shown(index, high)) for low, high in verdict.pieces)
        found[name] = Interval(
            local[name].standard_error, pieces[0][0], pieces[-1][1], verdict.name, pieces, verdict.reason
        )
    return replace(
        offset,
        intervals=found,
        draws=_draws(problem, curves, freedom),
        remarks=(*offset.remarks, *_missed(curves, trail)),
    )


def _freedom(problem: Problem, rows: int) -> int:
    """Rows of the residuals less what is fitted to them."""
    return rows - len(problem.parameters) - int(problem.objective.determined.sum())


def _curvature(
    problem: Problem, trail: Trail, residuals: NDArray[np.float64], jacobian: NDArray[np.float64]
) -> dict[str, Interval]:
    """Intervals by linear theory, taken in the search space: of what spans decades, the logarithm is uncertain."""
    parameters = problem.parameters
    nuisances = int(problem.objective.determined.sum())
    point = parameters.to_search(trail.best)
    found = intervals(point, residuals, jacobian, *parameters.search_bounds, nuisances)
    lower, upper = (
        parameters.from_search(np.array(ends))
        for ends in zip(*((each.lower, each.upper) for each in found), strict=True)
    )
    unit = parameters.search_slope(trail.best)
    return {
        name: Interval(each.standard_error * float(unit[k]), float(lower[k]), float(upper[k]), each.verdict)
        for k, (name, each) in enumerate(zip(parameters.names, found, strict=True))
    }


def _minima(problem: Problem, trail: Trail) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Every minimum known, as points of the search space [k, d], and their mean squares; the best found leads."""
    minima = np.concatenate([problem.parameters.to_search(trail.best)[None], trail.minima])
    if len(minima) <= 2:  # the method kept its best alone
        search = LeastSquares(*problem.parameters.search_bounds, starts=SEARCHES, x0=minima)
        for _ in rounds(search, problem.evaluate):
            pass
        minima = np.concatenate([minima, search.minima])
    return minima, problem.evaluate(minima).value ** 2


def _likely(minima: NDArray[np.float64], square: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Those that may matter for an interval, the lowest first."""
    least = square.min()
    order = np.argsort(square, kind="stable")
    order = order[square[order] <= least + LIKELY * (threshold_square(least, freedom) - least)]
    return minima[order]


def _size(problem: Problem, trail: Trail, minima: int) -> tuple[int, int] | None:
    """Values of each profile and minima to start from, as the cost allows; None where not even the fewest do."""
    interactions = getattr(problem.engine, "interactions", 1)
    allowed = max(COST * trail.rt_calls, INTERACTIONS // max(interactions, 1))
    for values, starts in SIZES:
        starts = min(starts, minima)
        if len(problem.parameters) * (values + 8 * starts) * starts * EVALUATIONS <= allowed:
            return values, starts
    return None


def _draws(problem: Problem, curves: list[Profile], freedom: int) -> dict[str, list[float]]:
    """Draws from the posterior by parameter, in the fields' units."""
    parameters = problem.parameters
    least = min(curve.square.min() for curve in curves)
    threshold = threshold_square(least, freedom)
    starts = np.concatenate([curve.point[curve.square <= threshold] for curve in curves])

    def square(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return problem.evaluate(points).value ** 2

    seed = problem.setup.study.method.seed
    found = draws(square, starts, *parameters.search_bounds, freedom + len(parameters), seed=seed)
    named = dict(zip(parameters.names, parameters.from_search(found).T.tolist(), strict=True))
    columns = problem.objective.nuisance.columns
    if len(columns) > COLUMNS:
        return named
    coefficients = problem.objective.coefficients(problem.evaluate(found).modelled)
    return named | dict(zip(columns, coefficients.T.tolist(), strict=True))


def _missed(curves: list[Profile], trail: Trail) -> tuple[str, ...]:
    """Said where a profile lies below what the method found."""
    lowest = float(np.sqrt(min(curve.square.min() for curve in curves)))
    if lowest > trail.best_value - 0.01:
        return ()
    return (
        f"The method missed the optimum: the profiles reach {lowest:.2f} dB, it found {trail.best_value:.2f} dB; "
        "intervals are those around the optimum.",
    )


def _free_offset(problem: Problem, minima: NDArray[np.float64], square: float, freedom: int) -> Certainty:
    """An offset for all links tried beside a model that has no term of that kind."""
    objective, study = problem.objective, problem.setup.study
    constant = any(term.by == "constant" and not np.isfinite(term.prior) for term in objective.nuisance.terms)
    if study.offset is not None or constant or freedom < 2:
        return Certainty()
    term = make_term(problem.setup.links, "free offset")
    terms = (*objective.nuisance.terms, term)
    trial = replace(problem, objective=replace(objective, nuisance=Nuisance(len(objective.weight), terms)))
    search = LeastSquares(*problem.parameters.search_bounds, starts=16, x0=minima)
    for _ in rounds(search, trial.evaluate):
        pass
    told = trial.evaluate(search.best.x[None])
    offset = float(trial.objective.coefficients(told.modelled)[0, -1])
    left = float(told.value[0] ** 2)
    # F of one further column: the offset over its standard error, squared.
    ratio = (square - left) / left * (freedom - 1) if left > 0 else np.inf
    if not ratio > 0 or not np.isfinite(ratio):
        return Certainty()
    error = abs(offset) / float(np.sqrt(ratio))
    remarks: tuple[str, ...] = ()
    if ratio > fdtri(1, freedom - 1, CONFIDENCE) and abs(offset) >= NOTED_DB:
        remarks = (
            f"A free offset would be {offset:+.1f} dB, with a standard error of {error:.1f} dB, and not zero: the RMSE "
            f"would be {np.sqrt(left):.2f} instead of {np.sqrt(square):.2f} dB. Say [offset] if cables or gains may be "
            "off.",
        )
    return Certainty(free_offset_db=offset, free_offset_error_db=error, remarks=remarks)
