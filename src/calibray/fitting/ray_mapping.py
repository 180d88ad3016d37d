"""Ray mapping identifies the assumptions of an expensive engine from its rays, and replaces the engine with a replay.

A few calls are enough. Each call returns the power of each path. The ratio of a path's powers between two calls does
not depend on antenna gains or units. The ratios therefore reveal the engine's assumptions: thickness, conductivity,
slabs or half-spaces, and the polarization of its antennas. We fit these assumptions to all ratios of the calls so far
(`ray_fit.py`). The power of every path is then corrected to agree with the last call. The next call is at the minimum
of this corrected replay and so tests the replay. If the assumptions are not identified, calls far from all others also
test the replay, until one of them is predicted.

The first call is at the initial values. The second call is at the point where the ratios are most informative about the
assumed constants. Among `PROBES` random points, this point has the largest mean log determinant of the information
matrix.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.export import Export, Exporting
from calibray.engines.replay import Replay
from calibray.errors import EngineError
from calibray.fitting.problem import Problem
from calibray.fitting.ray_fit import Understanding, common, half_spaces, understand
from calibray.fitting.ray_model import Call, RayModel
from calibray.fitting.search import AUTO, Trail, least_squares, local_searches
from calibray.optimizers.arguments import whole
from calibray.optimizers.least_squares import LeastSquares
from calibray.optimizers.sampling import design
from calibray.result.verdict import Remark, RemarkKind
from calibray.study import Setup
from calibray.support.progress import Progress

Ask = Callable[[NDArray[np.float64]], Export]
"""Calls the engine for a candidate [d]; returns its rays."""

PROBES: Final = 32
"""Number of random points of the search space from which the second call is chosen."""

DRAWS: Final = 3
"""Number of sets of assumed constants over which the information is averaged."""

DRAWN: Final = 3.0
"""Maximum factor between an assumed constant in one of the `DRAWS` sets and the study's value."""

SIGMA_DB: Final = 0.1
"""Standard deviation of a ratio's error that the information matrix assumes [dB]."""

LEFT_DB: Final = 0.05
"""An optimum counts as reached only if the best call and the minimum of the replay differ by at most this much, in the
objective and in RMS path loss [dB]."""

GAP_DB: Final = 0.2
"""An optimum counts as reached only if the gap at the last call is at most this large [dB]. After six calls, the excess
RMSE was at most 0.016 dB in six runs with gaps of 0.06 to 0.17 dB, and 0.020 to 0.15 dB in eight runs with gaps above
0.36 dB."""

MISFIT_DB: Final = 0.2
"""An engine counts as understood only if the misfit of its ratios is at most this large [dB]. With misfits of 0.07 to
0.19 dB, the optimum was reached within 0.006 dB (docs/measurements/expensive-engines.md)."""

CHANGED_DB: Final = 0.5
"""An engine counts as understood only if leaving out the paths that are not common to all calls changes no link's path
loss by more than this [dB]. Paths that appear between calls may be missing at the minimum of the replay."""

SEARCHES: Final = 4
"""Number of local searches, as a multiple of the number in a calibration by replay; one call costs more than many
searches. In a district with 557 interactions, 512 and 1,024 searches missed a minimum that is 0.076 dB lower for two of
five seeds; 2,048 searches found this minimum for all five seeds."""

LEAST_CALLS: Final = 3
"""Minimum number of calls in ray mapping: two to identify the assumptions, and one at the minimum."""

MOST_CALLS: Final = 10
"""Maximum number of calls in ray mapping."""

SEARCHED: Final = 5
"""Number of calls up to which the assumptions are searched globally; after further calls, they are only refined. In 174
runs with engines that the model represents, at most five calls were made."""

DISTANT_GAP_DB: Final = 1.0
"""If the assumptions are not identified, a distant call must be predicted with at most this gap [dB]. In district 3906,
calls near a wrong minimum had gaps below 0.1 dB, and the distant call had a gap of 5.3 dB."""


@dataclass(frozen=True, eq=False)
class RayMap:
    """A finished ray mapping.

    Attributes:
        engine: Replay that agrees with the engine at the best call.
        calls: The calls; from the third call on, each is at the minimum of the replay fitted to the earlier calls, or
            far from the earlier calls.
        best: The call with the lowest objective.
        understanding: The assumptions that explain the engine.
        gap_db: RMS difference, over the links, between the engine's path loss and the predicted path loss at the last
            call at a minimum of the replay [dB].
        distant_gap_db: The same difference at the last call that tested the replay far from all other calls [dB]; +inf
            if there is no such call.
        changed: Largest number of paths that occur in the best call but not in another call, or vice versa.
        changed_db: Largest change [dB] in a link's path loss if these paths are left out, among the links that keep a
            path.
        lost: Number of links that lose all their paths, or that have no path in the replay at the best call.
        half_spaces: Materials whose thickness the calls do not determine.
        minima: Minima of the replay that replaces the engine, as points [k, d] of the search space, lowest first.
        remaining_db: Objective of this replay at the best call minus the objective at the lowest of these minima [dB].
        moved_db: RMS difference, over the links, between the replay's path loss at the lowest minimum and at the best
            call [dB].
    """

    engine: Replay
    calls: tuple[Call, ...]
    best: Call
    understanding: Understanding
    gap_db: float
    distant_gap_db: float
    changed: int
    changed_db: float
    lost: int
    half_spaces: tuple[str, ...]
    minima: NDArray[np.float64]
    remaining_db: float
    moved_db: float

    @property
    def reached(self) -> bool:
        """Whether the last call was predicted accurately and the replay has no minimum better than the best call.

        The optimum is then probably reached. If the engine's assumptions are not identified, a distant call must have
        been predicted as well.
        """
        nothing_left = max(self.remaining_db, self.moved_db) <= LEFT_DB
        tested = _tested(self.understanding, self.distant_gap_db)
        return self.gap_db <= GAP_DB and nothing_left and not self.lost and tested

    @property
    def understood(self) -> bool:
        """Whether the optimum is reached, the model explains all calls, and the calls share their strong paths.

        The replay then represents the engine at other candidates as well. For paths without a calibrated material, the
        ratios are 1 in any model, so they reveal nothing.
        """
        model = self.understanding.model
        explained = model.meets_calibrated and self.understanding.misfit_db <= MISFIT_DB
        return self.reached and explained and self.changed_db <= CHANGED_DB


def maps_rays(setup: Setup) -> bool:
    """Whether a study is calibrated by ray mapping: its method is `auto`, and its program returns rays.

    Raises:
        InputError: The study's budget is too small for ray mapping.
    """
    mapped = setup.study.engine.exports_rays and setup.study.method.name == AUTO
    if mapped:
        _most_calls(setup)
    return mapped


def _most_calls(setup: Setup) -> int:
    budget = setup.study.method.options.get("budget", MOST_CALLS)
    reason = "ray mapping needs two calls to identify the program's assumptions, and one at the minimum"
    name = f"{setup.study.path}: {reason}; method.options.budget"
    return min(whole(name, budget, at_least=LEAST_CALLS), MOST_CALLS)


def search_rays(
    problem: Problem, engine: Exporting, progress: Progress | None = None
) -> tuple[Problem, Trail, Remark]:
    """Search by ray mapping, with an engine that returns its rays.

    Returns the problem on the replay that replaces the engine, the search, and a remark on how well the engine's
    assumptions are identified. The stage of `progress` is "calibrating".

    Raises:
        InputError: The study's budget is too small.
        EngineError: A call failed.
    """
    started, trail, method = time.perf_counter(), Trail(), problem.setup.study.method
    most_calls = _most_calls(problem.setup)

    def ask(candidate: NDArray[np.float64]) -> Export:
        export = engine.export(candidate)
        # `engine` keeps its answers, so a repeated candidate does not count as a call.
        if any(np.array_equal(candidate, earlier) for earlier in trail.candidates):
            return export
        evaluation = problem.evaluate_candidates(candidate[None])
        number = len(trail.candidates) + 1
        trail.add(candidate[None], evaluation, number, time.perf_counter() - started)
        if progress is not None:
            progress(f"calibrating: best RMSE {trail.best_rmse_db:.2f} dB", number, most_calls)
        return export

    mapped = map_rays(problem, ask, most_calls=most_calls, seed=method.seed)
    trail.minima = mapped.minima
    trail.rt_calls, trail.ledger_hits = len(trail.candidates), engine.hits
    return with_engine(problem, mapped.engine), trail, _remark(mapped, problem)


def map_rays(
    problem: Problem, ask: Ask, *, tolerance_db: float = 0.01, most_calls: int = MOST_CALLS, seed: int = 0
) -> RayMap:
    """Call an engine until path loss at the minimum is predicted within the tolerance, with at most `most_calls` calls.

    The result contains the replay that replaces the engine, and the accuracy of this replay. Calls also continue if the
    minimum of the replay is not at the best call: an accurate prediction over a short step does not show that the model
    is accurate elsewhere. For the same reason, calls far from all others are made if the assumptions are not
    identified. Calling stops if links lose all their paths in two successive calls at minima. The engine is called
    through `ask`, never through `problem`.
    """
    parameters, known = problem.parameters, problem.setup.known_antennas is not None

    def call(candidate: NDArray[np.float64]) -> Call:
        export = ask(candidate)
        if not export.paths.num_paths:
            values = ", ".join(f"{name} = {value:.6g}" for name, value in parameters.named(candidate).items())
            raise EngineError(
                f"The program finds no path for any link at {values}; check its scene and its answer"
            )
        return Call(candidate, export)

    def refit(calls: list[Call], before: Understanding) -> Understanding:
        return understand(parameters, calls, known, before, search=len(calls) <= SEARCHED)

    calls = [call(parameters.start)]
    calls.append(call(_most_informative(problem, calls[0], np.random.default_rng(seed))))
    ordered, further = calls, np.empty((0, len(parameters)))
    understanding, distant_gap = understand(parameters, calls, known), np.inf
    lost = 0  # successive calls at minima that have an infinite objective
    while True:
        replay = understanding.replay(parameters, ordered[-1])
        starts = parameters.to_search(np.array([candidate for candidate, _ in calls]))
        minimum = _search_replay(problem, replay, np.vstack([starts, further]), len(calls)).best.x
        calls = [*calls, call(parameters.from_search(minimum))]
        gap, last = _gap(replay, calls[-1]), len(calls) >= most_calls
        lost = lost + 1 if np.isinf(_objective(problem, calls[-1])) else 0
        predicted = gap <= tolerance_db or last
        # The model contains the rays of the last call in this order.
        ordered = _best_last(problem, calls) if predicted else calls
        understanding = refit(ordered, understanding)
        untested = not _tested(understanding, distant_gap) and np.isfinite(understanding.misfit_db)
        if untested and gap <= GAP_DB and len(calls) < most_calls - 1:
            replay = understanding.replay(parameters, ordered[-1])
            calls = [*calls, call(_distant(problem, calls))]
            distant_gap, ordered = _gap(replay, calls[-1]), _best_last(problem, calls)
            understanding = refit(ordered, understanding)
            continue
        if not predicted:
            continue
        mapped = _finish(problem, calls, understanding, gap, distant_gap)
        # Links that lose their paths at the minimum make the objective infinite there, so no call can become the best.
        if mapped.moved_db <= LEFT_DB or lost >= 2 or last:
            return mapped
        further = mapped.minima[:1]


def _tested(understanding: Understanding, distant_gap: float) -> bool:
    """Whether the model explains the ratios, or the replay predicted a distant call."""
    return understanding.misfit_db <= MISFIT_DB or distant_gap <= DISTANT_GAP_DB


def _distant(problem: Problem, calls: list[Call]) -> NDArray[np.float64]:
    """The candidate [d], among `PROBES` points of the unit cube, whose distance from the nearest call is largest."""
    parameters = problem.parameters
    probes = design("sobol", PROBES, len(parameters), np.random.default_rng(len(calls)))
    made = parameters.to_unit(np.array([candidate for candidate, _ in calls]))
    nearest = np.linalg.norm(probes[:, None] - made, axis=2).min(axis=1)
    return parameters.from_unit(probes[int(np.argmax(nearest))])


def _search_replay(problem: Problem, replay: Replay, starts: NDArray[np.float64], calls: int) -> LeastSquares:
    """Search the replay from given points [k, d] and from many random points, which differ after each call.

    A search can miss the lowest minimum. The next search starts from different points and can then find this minimum.
    """
    searches = SEARCHES * local_searches(replay.interactions)
    return least_squares(with_engine(problem, replay), searches, starts, seed=calls)


def _finish(
    problem: Problem, calls: list[Call], understanding: Understanding, gap: float, distant_gap: float
) -> RayMap:
    """The ray mapping, with the replay that agrees with the engine at the best call.

    `understanding` contains the assumptions found from all calls, with the best call last.
    """
    parameters, ordered = problem.parameters, _best_last(problem, calls)
    best = ordered[-1]
    replay = understanding.replay(parameters, best)
    replayed, point = with_engine(problem, replay), parameters.to_search(best.candidate)[None]
    found = _search_replay(problem, replay, point, len(calls))
    remaining = float(replayed.squares(point).value[0]) - found.best.y
    changed, changed_db, lost = _changes(ordered)
    answered = best.export.path_loss_db
    predicted, lowest = replay.path_loss(np.stack([best.candidate, parameters.from_search(found.best.x)]))
    lost = max(lost, int((np.isfinite(answered) & np.isinf(predicted)).sum()))
    moved = _distance(lowest, predicted)
    return RayMap(
        replay, tuple(calls), best, understanding, gap, distant_gap, changed, changed_db, lost,
        half_spaces(understanding, ordered), found.minima, remaining, moved,
    )  # fmt: skip


def _best_last(problem: Problem, calls: list[Call]) -> list[Call]:
    best = min(calls, key=lambda each: _objective(problem, each))
    return [*(each for each in calls if each is not best), best]


def with_engine(problem: Problem, replay: Replay) -> Problem:
    """The problem with a replay as its engine; without a ceiling, links without a path in the replay are left out."""
    objective = problem.objective
    if objective.ceiling_db is None:
        reached = np.isfinite(replay.path_loss(problem.parameters.start[None])[0])
        objective = objective.reweighted(np.where(reached, objective.weight, 0.0))
    return replace(problem, engine=replay, objective=objective)


def _objective(problem: Problem, call: Call) -> float:
    residuals = problem.residuals(call.candidate[None], call.export.path_loss_db[None])
    return float(np.sqrt(np.mean(residuals**2)))


def _gap(replay: Replay, call: Call) -> float:
    """RMS difference, over the links, between the engine's path loss and the predicted path loss [dB]."""
    return _distance(call.export.path_loss_db, replay.path_loss(call.candidate[None])[0])


def _distance(path_loss: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """RMS difference [dB] over the links that have a path in both; +inf if there are no such links."""
    both = np.isfinite(path_loss) & np.isfinite(other)
    return float(np.sqrt(np.mean((path_loss[both] - other[both]) ** 2))) if both.any() else np.inf


def _most_informative(problem: Problem, call: Call, random: np.random.Generator) -> NDArray[np.float64]:
    """The candidate [d] at which the ratios to the first call are most informative about the assumed constants."""
    known = problem.setup.known_antennas is not None
    model = RayModel.of(problem.parameters, call.export.paths, known)
    probes = problem.parameters.from_unit(design("sobol", PROBES, len(problem.parameters), random))
    count = len(model.assumed)
    drawn = np.tile(model.start, (DRAWS, 1))
    drawn[:, :count] += np.log(DRAWN) * random.uniform(-1.0, 1.0, (DRAWS, count))
    weight = np.sqrt(call.export.weight)[:, None] / SIGMA_DB
    information, tables = np.zeros(PROBES), model.tables([call.candidate, *probes])
    for values in drawn:
        _, (first, *slopes) = model.levels_and_slopes(tables, values, (False, False))
        for number, slope in enumerate(slopes):
            part = ((slope - first) * weight)[:, :count]
            # The identity is a prior: each constant is known within a factor of e.
            information[number] += np.linalg.slogdet(np.eye(count) + part.T @ part)[1]
    return probes[int(np.argmax(information))]


def _changes(calls: list[Call]) -> tuple[int, float, int]:
    """Largest number of paths that occur in the last call but not in another call, or vice versa, and their effect.

    The second result is the largest change in path loss [dB] if these paths are left out. The third result is the
    largest number of links that lose all their paths.
    """
    last, changed, change_db, lost = calls[-1].export, 0, 0.0, 0
    for call in calls[:-1]:
        pairs = zip((last, call.export), common(last.paths, call.export.paths), strict=True)
        for export, shared in pairs:
            kept = np.isin(np.arange(export.paths.num_paths), shared)
            power, link = 10 ** (export.level_db / 10), export.paths.link
            before, after = np.bincount(link, power), np.bincount(link, power * kept)
            share = after[after > 0] / before[after > 0]
            changed = max(changed, int((~kept).sum()))
            change_db = max(change_db, float(-10 * np.log10(share.min(initial=1.0))))
            lost = max(lost, int((before[after == 0] > 0).sum()))
    return changed, change_db, lost


def _remark(mapped: RayMap, problem: Problem) -> Remark:
    reached = np.isfinite([call.export.path_loss_db for call in mapped.calls])
    sometimes = reached.any(axis=0) & ~reached.all(axis=0) & (problem.objective.weight > 0)
    understanding = mapped.understanding
    model = understanding.model
    constants = model.described(understanding.values, mapped.half_spaces)
    levels = {
        "misfit_db": understanding.misfit_db,
        "gap_db": mapped.gap_db,
        "distant_gap_db": mapped.distant_gap_db,
        "remaining_db": mapped.remaining_db,
        "moved_db": mapped.moved_db,
    }
    return Remark(
        RemarkKind.RAY_MAPPING,
        {
            # A value is infinite if the calls share no path or no link, or if no distant call was made.
            **{name: value for name, value in levels.items() if np.isfinite(value)},
            "understood": mapped.understood,
            "reached": mapped.reached,
            "meets_calibrated": model.meets_calibrated,
            "calls": len(mapped.calls),
            "changed": mapped.changed,
            "changed_db": mapped.changed_db,
            "lost": mapped.lost,
            "lost_rows": problem.setup.links.row[sometimes].tolist(),
            "excluded": problem.objective.ceiling_db is None,
            "half_space": bool(mapped.half_spaces)
            and not any(name.endswith(".thickness") for name in constants),
            "half_spaces": list(mapped.half_spaces),
            "names": list(constants),
            "values": list(constants.values()),
        },
    )
