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
from functools import cached_property
from itertools import pairwise, product
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.compile import RaySetting, compile_rays, powers
from calibray.engines.rays.surfaces import TOLERANCE
from calibray.engines.rays.table import RayTable
from calibray.engines.replay import Replay
from calibray.fields import GroupedProgram, Layout, jax_settings, layout, path_powers
from calibray.fitting.cheap_replay import METAL
from calibray.fitting.problem import Problem
from calibray.fitting.search import least_squares
from calibray.materials import Material
from calibray.optimizers.descent import Residuals, descend_all
from calibray.optimizers.sampling import design
from calibray.parameters import Parameter, Parameters
from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.paths import Paths
from calibray.tracing.settings import Antenna

Ask = Callable[[NDArray[np.float64]], RayTable]
"""Calls the engine for a candidate [d]; returns its rays."""

Antennas = tuple[Antenna, Antenna] | None
"""Transmit and receive antenna of an engine; None if they are unknown."""

FACTOR: Final = {"thickness": 10.0, "conductivity": 30.0, "relative_permittivity": 2.0}
"""Largest factor between a constant of the study and that of the engine."""

HALF_SPACE: Final = 1e4
"""Thickness that no wave crosses [m]: it decays there unless the conductivity is below 1e-6 S/m."""

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

FAINT: Final = 0.1
"""Weight of a path without power in its link, relative to the only path of a link."""

BATCH: Final = 8
"""Sets of constants evaluated at once, for which the program is compiled; the information is averaged over as many."""


@dataclass(frozen=True, eq=False)
class Export:
    """The rays of one call.

    Attributes:
        candidate: Its candidate [d].
        paths: Its rays as a program, whose powers at the scene's constants are those of the engine.
        level_db: Power of every path [P], [dB].
    """

    candidate: NDArray[np.float64]
    paths: Paths
    level_db: NDArray[np.float64]

    @classmethod
    def of(
        cls, problem: Problem, candidate: NDArray[np.float64], table: RayTable, antennas: Antennas
    ) -> Export:
        """Compile the rays of a call.

        Raises:
            InputError: The rays do not agree with the scene or the links.
        """
        setup = problem.setup
        paths = compile_rays(table, RaySetting(setup.scene, setup.radio.frequency, antennas, setup.links))
        return cls(candidate, paths, 10 * np.log10(powers(paths)))

    @property
    def path_loss_db(self) -> NDArray[np.float64]:
        """The engine's path loss [L]; +inf without a path."""
        power = np.bincount(self.paths.link, 10 ** (self.level_db / 10), self.paths.num_links)
        with np.errstate(divide="ignore"):
            return -10 * np.log10(power)

    @property
    def weight(self) -> NDArray[np.float64]:
        """Weight of every path [P]: its share of the link's power, and a little more."""
        power = 10 ** (self.level_db / 10)
        return power / np.bincount(self.paths.link, power)[self.paths.link] + FAINT


class Assumption(NamedTuple):
    """What an engine may assume besides constants.

    Attributes:
        ports: Which ports of the program's antennas count, at the transmitter and at the receiver.
        half_space: Whether surfaces are half-spaces, else slabs.
    """

    ports: tuple[tuple[float, ...], tuple[float, ...]]
    half_space: bool


@dataclass(frozen=True, eq=False)
class RayModel:
    """The powers of an export's paths as a function of the parameters and the assumed constants.

    Attributes:
        paths: The program, without correction.
        parameters: The study's parameters, and then the assumed constants.
        count: Number of the study's parameters.
        assumption: What it is computed with.
    """

    paths: Paths
    parameters: Parameters
    count: int
    assumption: Assumption

    @classmethod
    def of(cls, problem: Problem, export: Export, assumption: Assumption) -> RayModel:
        """The model of the paths of an export."""
        paths, (tx, rx) = export.paths, (np.array(ports)[:, None] for ports in assumption.ports)
        paths = replace(paths, correction=None, tx_field=paths.tx_field * tx, rx_field=paths.rx_field * rx)
        parameters = _with_assumed(problem.parameters, _used(paths))
        return cls(paths, parameters, len(problem.parameters), assumption)

    def level_and_slope(
        self, candidate: NDArray[np.float64], constants: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Power of every path [n, P], [dB], and its derivatives by the constants [n, P, k], for constants [n, k]."""
        rows, columns = self.parameters.matrix_indices(list(self.paths.materials))
        base, count = self.paths.material_table(), self.count
        base[rows[:count], columns[:count]] = candidate
        assumed, levels, slopes = self._thick(constants), [], []
        order = np.argsort(self._layout.order)
        with jax_settings():
            for start in range(0, len(constants), BATCH):
                batch = assumed[start : start + BATCH]
                filled = np.concatenate([batch, np.repeat(batch[:1], BATCH - len(batch), axis=0)])
                level, slope = _levels_and_slopes(
                    self._layout.program, base, rows[count:], columns[count:], filled
                )
                levels.append(np.asarray(level)[: len(batch), order])
                slopes.append(np.asarray(slope)[: len(batch), order])
        slope = np.concatenate(slopes)
        return np.concatenate(levels), slope * ~self._is_thickness if self.assumption.half_space else slope

    def materials(
        self, candidate: NDArray[np.float64], constants: NDArray[np.float64]
    ) -> dict[str, Material]:
        """The materials with parameters [d] and constants [k]."""
        values = np.concatenate([candidate, self._thick(constants)])
        return self.parameters.materials(values, self.paths.materials)

    def _thick(self, constants: NDArray[np.float64]) -> NDArray[np.float64]:
        return (
            np.where(self._is_thickness, HALF_SPACE, constants) if self.assumption.half_space else constants
        )

    @cached_property
    def _is_thickness(self) -> NDArray[np.bool_]:
        return np.array([item.constant == "thickness" for item in self.parameters], dtype=bool)[self.count :]

    @cached_property
    def _layout(self) -> Layout:
        return layout(self.paths)


@jax.jit
def _levels_and_slopes(
    program: GroupedProgram, base: jax.Array, rows: jax.Array, columns: jax.Array, values: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Powers [n, P], [dB], and derivatives [n, P, k], in the order of the program."""

    def level(constants: jax.Array) -> jax.Array:
        power = path_powers(program, base.at[rows, columns].set(constants))
        return 10 * jnp.log10(jnp.maximum(power, 1e-30))

    return jax.vmap(lambda constants: (level(constants), jax.jacfwd(level)(constants)))(values)


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

    def replay(self, problem: Problem, last: Export) -> Replay:
        """The replay of the last export's paths, corrected so that it agrees with it."""
        level, _ = self.model.level_and_slope(last.candidate, self.constants[None])
        correction = 10 ** ((last.level_db - level[0]) / 10)
        materials = self.model.materials(last.candidate, self.constants)
        paths = replace(self.model.paths, materials=materials, correction=correction)
        radio = problem.setup.radio
        return Replay(paths, problem.parameters, radio.combining, radio.bandwidth)


@dataclass(frozen=True, eq=False)
class RayMap:
    """A finished ray mapping.

    Attributes:
        engine: Replay that agrees with the engine at the last call.
        exports: The calls; the last one is at the minimum of the program that the others corrected.
        understanding: What explains the engine.
        gap_db: Root mean square over the links of the answered minus the predicted path loss at the last call [dB].
        changed: Number of paths of the last call that another call lacks.
        changed_db: Largest change of a link's path loss without them [dB].
    """

    engine: Replay
    exports: tuple[Export, ...]
    understanding: Understanding
    gap_db: float
    changed: int
    changed_db: float

    @property
    def understood(self) -> bool:
        """Whether the assumed constants explain all calls."""
        return self.understanding.misfit_db <= UNDERSTOOD_DB


def map_rays(
    problem: Problem,
    ask: Ask,
    *,
    antennas: Antennas = None,
    tolerance_db: float = 0.01,
    most_calls: int = MOST_CALLS,
    seed: int = 0,
) -> RayMap:
    """Call an engine until its path loss at the minimum is predicted.

    Args:
        problem: The problem; its engine is not called.
        ask: Calls the engine.
        antennas: The engine's antennas, if they are known.
        tolerance_db: Gap at which it ends [dB].
        most_calls: Calls after which it ends.
        seed: Seed of the random numbers.

    Returns:
        The replay that stands for the engine, and how well it does.
    """
    parameters = problem.parameters

    def call(candidate: NDArray[np.float64]) -> Export:
        return Export.of(problem, candidate, ask(candidate), antennas)

    exports = [call(parameters.start)]
    exports.append(call(_most_informative(problem, exports[0], np.random.default_rng(seed))))
    while True:
        understanding = _understand(problem, exports, antennas is not None, seed)
        replay = understanding.replay(problem, exports[-1])
        starts = parameters.to_search(np.array([export.candidate for export in exports]))
        minimum = least_squares(replace(problem, engine=replay), SEARCHES, starts).best.x
        exports.append(call(parameters.from_search(minimum)))
        predicted, answered = replay.path_loss(exports[-1].candidate[None])[0], exports[-1].path_loss_db
        reached = np.isfinite(answered) & np.isfinite(predicted)
        gap = float(np.sqrt(np.mean((answered - predicted)[reached] ** 2)))
        if gap <= tolerance_db or len(exports) >= most_calls:
            break
    model = RayModel.of(problem, exports[-1], understanding.model.assumption)
    final = _fit(model, exports, STARTS[1], seed, understanding.constants)
    changed, changed_db = _changes(exports)
    return RayMap(final.replay(problem, exports[-1]), tuple(exports), final, gap, changed, changed_db)


def _most_informative(problem: Problem, export: Export, random: np.random.Generator) -> NDArray[np.float64]:
    """The candidate whose ratios to the first call say most about the assumed constants [d]."""
    model = RayModel.of(problem, export, Assumption(_all_ports(export), half_space=False))
    probes = problem.parameters.from_unit(design("sobol", PROBES, model.count, random))
    assumed = model.parameters.from_unit(random.random((BATCH, len(model.parameters))))
    scale = model.parameters.search_slope(assumed)[:, None, model.count :]
    constants, weight = assumed[:, model.count :], np.sqrt(export.weight)[:, None] / SIGMA_DB
    _, first = model.level_and_slope(export.candidate, constants)
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


def _understand(problem: Problem, exports: list[Export], known: bool, seed: int) -> Understanding:
    """Fit every assumption with few searches, and the two best ones with many."""
    models = [RayModel.of(problem, exports[-1], item) for item in _assumptions(exports[-1], known)]
    first = [_fit(model, exports, STARTS[0], seed) for model in models]
    best = sorted(first, key=lambda fit: fit.misfit_db)[:2]
    refined = [_fit(fit.model, exports, STARTS[1], seed, fit.constants) for fit in best]
    return min(refined, key=lambda fit: fit.misfit_db)


class _Ratios(NamedTuple):
    """Paths that the last call shares with an earlier one: their indices in both, and their weights [m]."""

    export: Export
    last: NDArray[np.int64]
    earlier: NDArray[np.int64]
    weight: NDArray[np.float64]


def _fit(
    model: RayModel, exports: list[Export], starts: int, seed: int, x0: NDArray[np.float64] | None = None
) -> Understanding:
    """Least squares of the ratios to the last export, over the assumed constants."""
    last, count, parameters = exports[-1], model.count, model.parameters
    shared = [(export, *_common(last.paths, export.paths)) for export in exports[:-1]]
    total = sum(last.weight[here].sum() for _, here, _ in shared)
    ratios = [_Ratios(export, a, b, np.sqrt(last.weight[a] / total)) for export, a, b in shared]
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
    model: RayModel, ratios: list[_Ratios], last: Export, constants: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted errors of the ratios [n, m], [dB], and their derivatives by the constants [n, m, k]."""
    level, slope = model.level_and_slope(last.candidate, constants)
    residuals, slopes = [], []
    for export, here, there, weight in ratios:
        other, other_slope = model.level_and_slope(export.candidate, constants)
        observed = last.level_db[here] - export.level_db[there]
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


def _changes(exports: list[Export]) -> tuple[int, float]:
    """Paths of the last call that another one lacks, and the largest change of path loss without them [dB]."""
    last = exports[-1]
    kept = np.ones(last.paths.num_paths, dtype=bool)
    for export in exports[:-1]:
        kept &= np.isin(np.arange(len(kept)), _common(last.paths, export.paths)[0])
    power, link = 10 ** (last.level_db / 10), last.paths.link
    share = np.bincount(link, power * ~kept) / np.maximum(np.bincount(link, power), 1e-300)
    return int((~kept).sum()), float(-10 * np.log10(max(1 - share.max(initial=0.0), 1e-12)))


def _used(paths: Paths) -> dict[str, Material]:
    """The materials that a path meets, except metal."""
    met = np.unique(paths.material)
    return {
        name: item
        for index, (name, item) in enumerate(paths.materials.items())
        if index in met and item.conductivity < METAL
    }


def _with_assumed(parameters: Parameters, materials: dict[str, Material]) -> Parameters:
    """The parameters, and then the constants that the engine may assume otherwise."""
    calibrated = {f"{parameter.material}.{parameter.constant}" for parameter in parameters}
    assumed = []
    for name, field in product(materials, FACTOR):
        value, bound = getattr(materials[name], field), PARAMETER_BOUNDS[field]
        if f"{name}.{field}" not in calibrated and value > 0:
            lower, upper = max(value / FACTOR[field], bound.lower), min(value * FACTOR[field], bound.upper)
            assumed.append(Parameter(f"{name}.{field}", lower, upper, value, "log"))
    return replace(parameters, items=(*parameters.items, *assumed))
