"""How far a finished calibration can be trusted: draws from the posterior, what they tell, and a free offset beside."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.observable import PATH_LOSS
from calibray.fitting.cheap_replay import ReplayedModel
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, Trail, find_minima, relevant_minima
from calibray.parameters import Parameters
from calibray.result.remark import Remark, RemarkKind
from calibray.result.verdict import CONFIDENCE, Interval, Reason, ReasonKind, Verdict
from calibray.support.blas_threads import single_blas_thread
from calibray.support.progress import Progress
from calibray.uncertainty.buildings import over_buildings
from calibray.uncertainty.curvature import alone, by_curvature, covariances
from calibray.uncertainty.emulator import ensemble
from calibray.uncertainty.importance_sampling import ENOUGH, Draws, pooled, sample
from calibray.uncertainty.likelihood import Explaining
from calibray.uncertainty.remarks import departures, missed, outside_interval
from calibray.uncertainty.undeclared_offset import forgotten_offset
from calibray.uncertainty.verdicts import verdicts
from calibray.uncertainty.widening import widened

COST: Final = 10
"""Replays of the draws by those of the calibration, at most; these take derivatives, which doubles their cost."""

INTERACTIONS: Final = 100_000_000
"""Interactions times replays that draws may take in any case: some seconds."""

SIZES: Final = ((512, 20), (512, 8), (384, 6), (256, 5), (128, 4), (64, 3))
"""Points of a round and rounds, the first that the cost allows; most posteriors take two to four rounds."""

SHARED: Final = ((128, 4), (64, 3))
"""The same where several engines share them."""

PLACE: Final = 4
"""Points of the first round for each place that draws start around, where that makes more places than `BASINS`: of many
parameters that hardly matter, each place of one that does is found many times."""

ROUNDS: Final = 20
"""Rounds at most, where those before cost less than they might have: noise that explains little asks no replays."""

TIMES: Final = 3
"""How many times as many rounds as the cost was thought to allow there may be then."""

ALIKE: Final = 0.1
"""Differences of functions that stand in for an engine, by the links' errors, below which their mean does as well."""

KNOWN: Final = 200
"""Minima by least squares that may be such."""

WEIGHED: Final = 250
"""Draws that models of the noise are weighed at."""

KEPT: Final = 128
"""Draws that are kept with the result."""

FEW: Final = 500
"""Links up to which linear algebra takes one thread."""

LINKS: Final = 10_000
"""Links beyond which errors that neighbours share are not looked at: all pairs of them would have to be."""

COLUMNS: Final = 100
"""Columns of the nuisance beyond which draws leave them as they are at the optimum."""

EXACT_DB: Final = 1e-6
"""RMSE of data without noise, which tell everything [dB]."""


@dataclass(frozen=True)
class Certainty:
    """How far a calibration can be trusted.

    Attributes:
        intervals: Interval and verdict by parameter.
        draws: Values of the parameters, by name, that explain the data about as well as those found.
        posterior: All draws, in the search space, of what explains the links; None where none were made.
        means: The same of what buildings have on the mean, where those that were seen may differ from it.
        noise: Weights of the kinds of noise, and of a forgotten offset.
        free_offset_db: The offset that fits best beside the study's model, where that has none [dB].
        free_offset_error_db: Its standard error [dB].
        remarks: Warnings and advice.
        calls: Replays that this took.
        seconds: Time that this took [s].
    """

    intervals: dict[str, Interval] = field(default_factory=dict)
    draws: dict[str, list[float]] = field(default_factory=dict)
    posterior: Draws | None = None
    means: Draws | None = None
    noise: dict[str, float] = field(default_factory=dict)
    free_offset_db: float | None = None
    free_offset_error_db: float | None = None
    remarks: tuple[Remark, ...] = ()
    calls: int = 0
    seconds: float = 0.0


def certainty(
    problem: Problem, trail: Trail, progress: Progress | None = None, model: ReplayedModel | None = None
) -> Certainty:
    """Work out how far a calibration can be trusted.

    Args:
        problem: The problem.
        trail: Its finished search.
        progress: Called with the stage "drawing" after every round.
        model: The replay of the study's own scene, where the search had one as a cheap model.

    Returns:
        What the data tell of the parameters.
    """
    started = time.perf_counter()
    # Matrices of few links are small: threads of the linear algebra cost more there than they give.
    with single_blas_thread(problem.objective.num_counted <= FEW):
        if problem.differentiable:
            calls = problem.engine.calls
            found = _certain(problem, [problem], trail, trail.rt_calls, progress)
            calls = problem.engine.calls - calls
        else:
            found, calls = _approximate(problem, trail, progress, model)
    return replace(found, calls=calls, seconds=time.perf_counter() - started)


def _approximate(
    problem: Problem, trail: Trail, progress: Progress | None, model: ReplayedModel | None
) -> tuple[Certainty, int]:
    """The same by what stands in for an engine without derivatives, and the replays that it took."""
    stands, name = ensemble(problem, trail, model), problem.setup.study.engine.name
    if stands is None:
        reason = Reason(ReasonKind.TOO_FEW_CALLS, {"calls": len(trail.candidates)})
        return Certainty(_whole(problem.parameters, reason)), 0
    mean, *drawn = (
        replace(problem, engine=engine, observable=PATH_LOSS) for engine in (stands.mean, *stands.drawn)
    )
    alike = stands.apart_db < ALIKE * trail.best_value
    spent = trail.rt_calls if model is None else model.calls
    found = _certain(mean, [mean] if alike else drawn, trail, spent, progress)
    remark = Remark(
        RemarkKind.APPROXIMATE_INTERVALS,
        {
            "engine": name,
            "calls": stands.calls,
            "error_db": float(stands.error_db),
            "replay": stands.replayed is not None,
        },
    )
    intervals = {name: replace(each, approximate=True) for name, each in found.intervals.items()}
    calls = 0 if stands.replayed is None else stands.replayed.calls
    return replace(found, intervals=intervals, remarks=(remark, *found.remarks)), calls


def _whole(parameters: Parameters, reason: Reason) -> dict[str, Interval]:
    """Intervals that tell nothing."""
    return {
        each.name: Interval(
            (each.upper - each.lower) / np.sqrt(12.0),
            each.lower,
            each.upper,
            Verdict.NOT_IDENTIFIABLE,
            (),
            reason,
            True,
        )
        for each in parameters
    }


def _certain(
    problem: Problem, engines: Sequence[Problem], trail: Trail, spent: int, progress: Progress | None
) -> Certainty:
    """What the data tell, by a problem and by those that differ in their engine alone, each as likely as the others."""
    told = problem.squares(problem.parameters.to_search(trail.best)[None], derivatives=True)
    local = by_curvature(problem, trail, told)
    freedom = told.num_rows - problem.unknowns
    if freedom < 1:
        reason = Reason(ReasonKind.TOO_FEW_LINKS, {"links": told.num_rows})
        return Certainty(
            {
                name: replace(each, verdict=Verdict.NOT_IDENTIFIABLE, reason=reason)
                for name, each in local.items()
            }
        )
    if told.value[0] < EXACT_DB:
        reason = Reason(ReasonKind.NO_NOISE)
        return Certainty({name: replace(each, reason=reason) for name, each in local.items()})
    return _from_draws(problem, engines, trail, local, freedom, spent, progress)


def _from_draws(
    problem: Problem,
    engines: Sequence[Problem],
    trail: Trail,
    local: dict[str, Interval],
    freedom: int,
    spent: int,
    progress: Progress | None,
) -> Certainty:
    known, square = find_minima(problem, trail)
    lowest, least = relevant_minima(known, square, freedom), float(square.min())
    offset = forgotten_offset(problem, lowest, least, freedom)
    found = Certainty(
        free_offset_db=offset.offset_db, free_offset_error_db=offset.error_db, remarks=offset.remarks
    )
    if problem.objective.num_counted > LINKS:
        crowd = Reason(ReasonKind.TOO_MANY_LINKS, {"limit": LINKS})
        return replace(found, intervals=alone(local, crowd))
    explaining = Explaining.of(problem, lowest[0], least, freedom)
    tried = explaining.marginal.models
    size = _size(problem, spent, len(engines), explaining.replays)
    if size is None:
        return replace(found, intervals=alone(local, Reason(ReasonKind.TOO_EXPENSIVE)))
    # What fits worse by least squares may fit best where errors are alike or have heavy tails.
    places = np.concatenate([known[np.argsort(square)[:KNOWN]], offset.minima[:BASINS]])
    explained = explaining(places)
    order = np.argsort(-np.logaddexp.reduce(explained, axis=1), kind="stable")
    starts = places[order[: max(BASINS, size[0] // PLACE)]]
    explaining = explaining.without_negligible(explained)
    wide = covariances(problem, starts, freedom)
    posterior = pooled(_drawn(explaining, engines, starts, wide, size, progress))
    each = explaining(posterior.resampled(WEIGHED))
    noise = explaining.kinds(np.exp(each - np.logaddexp.reduce(each, axis=1, keepdims=True)))
    means = over_buildings(explaining, posterior, each, tried)
    told = _told(explaining, posterior, means, local)
    behind = float(posterior.density.max() - np.logaddexp.reduce(explained[0]))
    top = problem.parameters.from_search(posterior.point[np.argmax(posterior.density)])
    best, likeliest = problem.parameters.named(trail.best), problem.parameters.named(top)
    said = (
        *offset.remarks, *departures(noise), *(missed(problem, posterior, trail) if problem in engines else ()),
        *outside_interval(problem, best, told, likeliest, behind, noise),
        *(Remark(RemarkKind.FEW_DRAWS),) * posterior.flattened,
    )  # fmt: skip
    return replace(
        found,
        intervals=told,
        draws=_draws(problem, posterior),
        posterior=posterior,
        means=means,
        noise=noise,
        remarks=said,
    )


def _drawn(
    explaining: Explaining,
    engines: Sequence[Problem],
    starts: NDArray[np.float64],
    wide: NDArray[np.float64],
    size: tuple[int, int, int],
    progress: Progress | None,
) -> list[Draws]:
    """Draws by every engine: from minima [k, d] of so much covariance [k, d, d], as many as `_size` allows."""
    (batch, turns, allowed), done = size, 0

    def drawn(engine: Problem) -> Draws:
        own, before, first = replace(explaining, problem=engine), engine.engine.calls, done

        def more() -> bool:
            spent = engine.engine.calls - before
            return (
                done - first <= min(ROUNDS, TIMES * turns) and spent + batch * explaining.replays <= allowed
            )

        def density(points: NDArray[np.float64]) -> NDArray[np.float64]:
            nonlocal done
            done += 1
            if progress is not None:
                progress("drawing", done, max(done, (turns + 1) * len(engines)))
            return np.logaddexp.reduce(own(points), axis=1)

        return sample(
            density, *engine.parameters.search_bounds, starts, wide, batch=batch, rounds=turns, more=more,
            enough=ENOUGH / len(engines), seed=engine.setup.study.method.seed,
        )  # fmt: skip

    return [drawn(engine) for engine in engines]


def _told(
    explaining: Explaining, posterior: Draws, means: Draws, local: dict[str, Interval]
) -> dict[str, Interval]:
    """Interval and verdict by parameter, from draws of the buildings seen and of the mean over all."""
    parameters = explaining.problem.parameters
    lower, upper = parameters.search_bounds

    def shown(index: int, value: float) -> float:
        point = lower.copy()
        point[index] = value
        return float(parameters.from_search(point)[index])

    def in_unit(index: int, value: float) -> float:
        point = parameters.lower.copy()
        point[index] = value
        return float(parameters.to_unit(point)[index])

    told = verdicts(
        means, explaining.modelled, parameters.names, lower, upper, explaining.marginal.noise_db,
        level=CONFIDENCE, shown=shown, seen=posterior,
    )  # fmt: skip
    found = {}
    for index, (name, verdict) in enumerate(zip(parameters.names, told, strict=True)):
        pieces = tuple((shown(index, low), shown(index, high)) for low, high in verdict.pieces)
        found[name] = Interval(
            local[name].standard_error, pieces[0][0], pieces[-1][1], verdict.name, pieces, verdict.reason
        )
        if posterior.flattened:
            found[name] = widened(found[name], local[name], lambda value, k=index: in_unit(k, value))
    return found


def _size(problem: Problem, spent: int, engines: int, replays: int) -> tuple[int, int, int] | None:
    """Points of a round, rounds that their cost of so many replays each allows, and replays that may be spent in all.

    None where not even the fewest are. Where several engines share the draws, each needs the fewest that do.
    """
    interactions = getattr(problem.engine, "interactions", 1)
    allowed = max(COST * spent, INTERACTIONS // max(interactions, 1)) // engines
    sizes = SIZES if engines == 1 else SHARED
    fitting = ((batch, turns) for batch, turns in sizes if batch * (turns + 2) * replays <= allowed)
    return next(((batch, turns, allowed) for batch, turns in fitting), None)


def _draws(problem: Problem, posterior: Draws) -> dict[str, list[float]]:
    """Draws from the posterior by parameter, in the fields' units."""
    parameters = problem.parameters
    found = posterior.resampled(KEPT, problem.setup.study.method.seed)
    named = dict(zip(parameters.names, parameters.from_search(found).T.tolist(), strict=True))
    columns = problem.objective.nuisance.columns
    if len(columns) > COLUMNS:
        return named
    coefficients = problem.objective.coefficients(problem.modelled(found))
    return named | dict(zip(columns, coefficients.T.tolist(), strict=True))
