"""Ray mapping: an expensive engine that exports its rays is understood from a few calls.

Every call gives the power of each path. Ratios of a path's powers at two sets of constants are free of antenna gains
and units, so they tell what the engine assumes: thickness, conductivity, slabs or half-spaces, the polarization of its
antennas. We fit these to all ratios of the calls so far, by many local searches with exact derivatives. The last call
then corrects the power of every path, and the corrected program is replayed: its minimum is the next call, which checks
it.

The first call is at the start values. The second one is where the ratios say most about the assumed constants: of some
points of the box, that with the largest mean log determinant of their information.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.export import Export
from calibray.engines.rays.surfaces import TOLERANCE
from calibray.engines.replay import Replay
from calibray.fitting.problem import Problem
from calibray.fitting.ray_model import BATCH, Assumption, Call, RayModel
from calibray.fitting.search import least_squares
from calibray.optimizers.descent import Residuals, descend_all
from calibray.optimizers.sampling import design
from calibray.paths import Paths

Ask = Callable[[NDArray[np.float64]], Export]
"""Calls the engine for a candidate [d]; returns its rays."""

STARTS: Final = (4, 32)
"""Local searches for every assumption, and for the two best ones."""

STEPS: Final = (12, 40)
"""Steps of each of them."""

CONVERGED: Final = 1e-9
"""Relative decrease of the cost, or step in the unit cube, at which it has converged."""

SEARCHES: Final = 64
"""Local searches for the minimum of the corrected program."""

PROBES: Final = 64
"""Points of the box of which the second call is one."""

SIGMA_DB: Final = 0.1
"""Error of a ratio in the information [dB]."""

UNDERSTOOD_DB: Final = 0.05
"""Misfit of the ratios up to which the engine counts as understood [dB]; wrong minima had 0.8 dB and more."""

MOST_CALLS: Final = 10
"""Calls after which ray mapping ends, whatever the gap."""


@dataclass(frozen=True, eq=False)
class Understanding:
    """The assumption and the constants that explain an engine's ratios best.

    Attributes:
        model: The model of the last export's paths.
        constants: The assumed constants [k], in the fields' units.
        misfit_db: Weighted root mean square of the errors of the ratios [dB].
    """

    model: RayModel
    constants: NDArray[np.float64]
    misfit_db: float

    def replay(self, problem: Problem, last: Call) -> Replay:
        """The replay of a call's paths, corrected so that it agrees with it."""
        level, _ = self.model.level_and_slope(last.candidate, self.constants[None])
        correction = 10 ** ((last.export.level_db - level[0]) / 10)
        materials = self.model.materials(last.candidate, self.constants)
        paths = replace(self.model.paths, materials=materials, correction=correction)
        return Replay(paths, problem.parameters)


@dataclass(frozen=True, eq=False)
class RayMap:
    """A finished ray mapping.

    Attributes:
        engine: Replay that agrees with the engine at the best call.
        calls: The calls; from the third on, each is at the minimum of the program that the others corrected.
        best: The call of least objective.
        understanding: What explains the engine.
        gap_db: Root mean square over the links of the answered minus the predicted path loss at the last call [dB].
        changed: Number of paths of the best call that another call lacks.
        changed_db: Largest change of a link's path loss without them [dB].
    """

    engine: Replay
    calls: tuple[Call, ...]
    best: Call
    understanding: Understanding
    gap_db: float
    changed: int
    changed_db: float

    @property
    def understood(self) -> bool:
        """Whether the assumed constants explain all calls, and predicted the last one."""
        return max(self.understanding.misfit_db, self.gap_db) <= UNDERSTOOD_DB


def map_rays(
    problem: Problem, ask: Ask, *, tolerance_db: float = 0.01, most_calls: int = MOST_CALLS, seed: int = 0
) -> RayMap:
    """Call an engine until its path loss at the minimum is predicted.

    Args:
        problem: The problem; its engine is not called.
        ask: Calls the engine.
        tolerance_db: Gap at which it ends [dB].
        most_calls: Calls after which it ends.
        seed: Seed of the random numbers.

    Returns:
        The replay that stands for the engine, and how well it does.
    """
    parameters = problem.parameters

    def call(candidate: NDArray[np.float64]) -> Call:
        return Call(candidate, ask(candidate))

    calls = [call(parameters.start)]
    calls.append(call(_most_informative(problem, calls[0], np.random.default_rng(seed))))
    while True:
        understanding = _understand(problem, calls, seed)
        replay = understanding.replay(problem, calls[-1])
        starts = parameters.to_search(np.array([candidate for candidate, _ in calls]))
        minimum = least_squares(with_engine(problem, replay), SEARCHES, starts).best.x
        calls.append(call(parameters.from_search(minimum)))
        gap = _gap(replay, calls[-1])
        if gap <= tolerance_db or len(calls) >= most_calls:
            break
    best = min(calls, key=lambda each: _objective(problem, each))
    ordered = [*(each for each in calls if each is not best), best]
    model = RayModel.of(parameters, best.export, understanding.model.assumption)
    final = _fit(model, ordered, STARTS[1], seed, understanding.constants)
    changed, changed_db = _changes(ordered)
    return RayMap(final.replay(problem, best), tuple(calls), best, final, gap, changed, changed_db)


def with_engine(problem: Problem, replay: Replay) -> Problem:
    """The problem on a replay; links without a path there are left out unless they are censored."""
    objective = problem.objective
    if objective.ceiling_db is None:
        reached = np.isfinite(replay.path_loss(problem.parameters.start[None])[0])
        objective = replace(objective, weight=np.where(reached, objective.weight, 0.0))
    return replace(problem, engine=replay, objective=objective)


def _objective(problem: Problem, call: Call) -> float:
    residuals = problem.residuals(call.candidate[None], call.export.path_loss_db[None])
    return float(np.sqrt(np.mean(residuals**2)))


def _gap(replay: Replay, call: Call) -> float:
    """Root mean square over the links of the answered minus the predicted path loss [dB]."""
    change = call.export.path_loss_db - replay.path_loss(call.candidate[None])[0]
    return float(np.sqrt(np.mean(change[np.isfinite(change)] ** 2)))


def _most_informative(problem: Problem, call: Call, random: np.random.Generator) -> NDArray[np.float64]:
    """The candidate whose ratios to the first call say most about the assumed constants [d]."""
    export = call.export
    model = RayModel.of(problem.parameters, export, Assumption(_all_ports(export), half_space=False))
    probes = problem.parameters.from_unit(design("sobol", PROBES, model.count, random))
    assumed = model.parameters.from_unit(random.random((BATCH, len(model.parameters))))
    scale = model.parameters.search_slope(assumed)[:, None, model.count :]
    constants, weight = assumed[:, model.count :], np.sqrt(export.weight)[:, None] / SIGMA_DB
    _, first = model.level_and_slope(call.candidate, constants)
    information = []
    for probe in probes:
        slope = (model.level_and_slope(probe, constants)[1] - first) * scale * weight
        fisher = np.swapaxes(slope, 1, 2) @ slope
        information.append(np.linalg.slogdet(np.eye(fisher.shape[2]) + fisher)[1].mean())
    return probes[int(np.argmax(information))]


def _all_ports(export: Export) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (1.0,) * export.paths.tx_field.shape[1], (1.0,) * export.paths.rx_field.shape[1]


def _assumptions(export: Export, known: bool) -> Iterator[Assumption]:
    """Half-spaces or slabs, with any polarization unless the antennas are known."""
    ends = ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))
    choices = [_all_ports(export)] if known else [(tx, rx) for tx in ends for rx in ends]
    for ports, half_space in product(choices, (True, False)):
        yield Assumption(ports, half_space)


def _understand(problem: Problem, calls: list[Call], seed: int) -> Understanding:
    """Fit every assumption with few searches, and the two best ones with many."""
    last, known = calls[-1].export, problem.setup.known_antennas is not None
    models = [RayModel.of(problem.parameters, last, item) for item in _assumptions(last, known)]
    first = [_fit(model, calls, STARTS[0], seed) for model in models]
    best = sorted(first, key=lambda fit: fit.misfit_db)[:2]
    refined = [_fit(fit.model, calls, STARTS[1], seed, fit.constants) for fit in best]
    return min(refined, key=lambda fit: fit.misfit_db)


class _Ratios(NamedTuple):
    """Paths that the last call shares with an earlier one: their indices in both, and their weights [m]."""

    call: Call
    last: NDArray[np.int64]
    earlier: NDArray[np.int64]
    weight: NDArray[np.float64]


def _fit(
    model: RayModel, calls: list[Call], starts: int, seed: int, x0: NDArray[np.float64] | None = None
) -> Understanding:
    """Least squares of the ratios to the last export, over the assumed constants."""
    last, count, parameters = calls[-1], model.count, model.parameters
    shared = [(call, *_common(last.export.paths, call.export.paths)) for call in calls[:-1]]
    weight = last.export.weight
    total = sum(weight[here].sum() for _, here, _ in shared)
    if not total:  # no two calls share a path
        return Understanding(model, parameters.start[count:], np.inf)
    ratios = [_Ratios(call, a, b, np.sqrt(weight[a] / total)) for call, a, b in shared]
    if len(parameters) == count:
        residuals, _ = _errors(model, ratios, last, np.zeros((1, 0)))
        return Understanding(model, np.zeros(0), float(np.linalg.norm(residuals)))
    known = parameters.to_unit(parameters.start)[:count]
    lower, upper = (bound[count:] for bound in parameters.search_bounds)

    def constants(unit: NDArray[np.float64]) -> NDArray[np.float64]:
        return parameters.from_unit(np.hstack([np.tile(known, (len(unit), 1)), unit]))

    def evaluate(unit: NDArray[np.float64]) -> Residuals:
        values = constants(unit)
        residuals, slopes = _errors(model, ratios, last, values[:, count:])
        return residuals, slopes * (parameters.search_slope(values)[:, count:] * (upper - lower))[:, None]

    drawn = design("sobol", starts, len(lower), np.random.default_rng(seed))
    first = parameters.start[count:] if x0 is None else x0
    first = parameters.to_unit(np.concatenate([last.candidate, first]))[count:]
    ends = descend_all(np.vstack([first, drawn]), evaluate, STEPS[starts > STARTS[0]], CONVERGED)
    best = ends.unit[np.argmin(ends.cost)][None]
    misfit = float(np.linalg.norm(evaluate(best)[0]))
    return Understanding(model, constants(best)[0, count:], misfit)


def _errors(
    model: RayModel, ratios: list[_Ratios], last: Call, constants: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted errors of the ratios [n, m], [dB], and their derivatives by the constants [n, m, k]."""
    level, slope = model.level_and_slope(last.candidate, constants)
    residuals, slopes = [], []
    for call, here, there, weight in ratios:
        other, other_slope = model.level_and_slope(call.candidate, constants)
        observed = last.export.level_db[here] - call.export.level_db[there]
        residuals.append(weight * ((level - other)[:, here] - observed))
        slopes.append(weight[:, None] * (slope - other_slope)[:, here])
    return np.concatenate(residuals, axis=1), np.concatenate(slopes, axis=1)


def _common(one: Paths, other: Paths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the paths that two programs share, in each of them: same link, kinds and points."""
    rows, pairs = _by_kinds(other), []
    for key, members in _by_kinds(one).items():
        for index, points in members:
            same = (
                k for k, others in rows.get(key, ()) if np.abs(points - others).max(initial=0) <= TOLERANCE
            )
            if (match := next(same, None)) is not None:
                pairs.append((index, match))
    here, there = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return here, there


def _by_kinds(paths: Paths) -> dict[tuple[int, ...], list[tuple[int, Any]]]:
    """Indices and points of paths by their link and kinds of interaction."""
    groups: dict[tuple[int, ...], list[tuple[int, Any]]] = {}
    for index, (start, stop) in enumerate(pairwise(paths.first.tolist())):
        key = (int(paths.link[index]), *paths.kind[start:stop].tolist())
        groups.setdefault(key, []).append((index, paths.vertex[start:stop]))
    return groups


def _changes(calls: list[Call]) -> tuple[int, float]:
    """Paths of the last call that another one lacks, and the largest change of path loss without them [dB]."""
    last = calls[-1].export
    kept = np.ones(last.paths.num_paths, dtype=bool)
    for call in calls[:-1]:
        kept &= np.isin(np.arange(len(kept)), _common(last.paths, call.export.paths)[0])
    power, link = 10 ** (last.level_db / 10), last.paths.link
    share = np.bincount(link, power * ~kept) / np.maximum(np.bincount(link, power), 1e-300)
    return int((~kept).sum()), float(-10 * np.log10(max(1 - share.max(initial=0.0), 1e-12)))
