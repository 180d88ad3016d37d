"""What an engine assumes, from ratios of its rays' powers: a global search over constants and polarizations.

A slab resonates: the power of a ray has a minimum for every half wavelength that the thickness grows by, so a local
search ends in a wrong one. We first scan each material apart, on paths that meet no other one: a fine grid of
thicknesses up to the depth where the wave has decayed, for some conductivities and polarizations of both ends. The best
combinations are then refined together by least squares with exact derivatives, and if a misfit remains, each material
is scanned again on all its paths.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light
from scipy.optimize import least_squares

from calibray.engines.rays.surfaces import TOLERANCE
from calibray.engines.replay import Replay
from calibray.fitting.ray_model import HALF_SPACE, Call, RayModel
from calibray.parameters import Parameters
from calibray.paths import Paths

CONDUCTIVITIES: Final = 10.0 ** np.arange(-3.5, 1.1, 0.5)
"""Conductivities of a scan [S/m]; a refinement bridges half a decade."""

THINNEST: Final = 1e-3
"""Least thickness of a scan [m]."""

THICKEST: Final = 0.6
"""Largest thickness of a scan [m], unless the study's is more than half of it."""

DECAYED: Final = 4.0
"""Attenuation within a slab [Np] beyond which it acts as a half-space: what returns has e^-8 of its amplitude."""

RESOLUTION: Final = 10.0
"""Points of a scan for a wavelength in the slab, which has two resonances."""

SCANNED: Final = 48
"""Paths of a scan."""

KEPT: Final = 4
"""Local minima of each scan that are refined."""

EXACT_DB: Final = 0.005
"""Misfit at which a search ends [dB]."""

EVALUATIONS: Final = (12, 30)
"""Evaluations of a first and of a longer refinement."""


@dataclass(frozen=True, eq=False)
class Understanding:
    """The assumed values that explain an engine's ratios best.

    Attributes:
        model: The model of the last export's paths.
        values: The assumed values [k], as in `RayModel`.
        misfit_db: Weighted root mean square of the errors of the ratios [dB].
    """

    model: RayModel
    values: NDArray[np.float64]
    misfit_db: float

    def replay(self, parameters: Parameters, last: Call) -> Replay:
        """The replay of a call's paths, corrected so that it agrees with it."""
        level, _ = self.model.level_and_slope(last.candidate, self.values)
        correction = 10 ** ((last.export.level_db - level) / 10)
        paths = replace(self.model.replay_paths(last.candidate, self.values), correction=correction)
        return Replay(paths, parameters)


class Ratio(NamedTuple):
    """Paths that the last call shares with an earlier one.

    Attributes:
        call: The earlier call.
        here: Their indices in the last call [n].
        weight: Root of their weights, relative to all ratios [n].
        observed: Power in the last call over that in the earlier one [n], [dB].
    """

    call: Call
    here: NDArray[np.int64]
    weight: NDArray[np.float64]
    observed: NDArray[np.float64]


def understand(
    parameters: Parameters, calls: list[Call], known: bool, before: Understanding | None = None
) -> Understanding:
    """Find what explains the ratios of all calls.

    Args:
        parameters: The study's parameters.
        calls: The calls, the last one is modelled.
        known: Whether the program's antennas are those of the engine.
        before: What explained the calls before the last one, if any.
    """
    last, ratios = calls[-1], _ratios(calls)
    model = RayModel.of(parameters, last.export.paths)
    if not ratios or not len(model.start):
        misfit = _misfit(model, ratios, last, model.start) if ratios else np.inf
        return Understanding(model, model.start, misfit)
    best = None
    if before is not None and before.model.assumed == model.assumed:
        best = _refined(model.with_single(before.model.single), ratios, last, before.values, EVALUATIONS[1])
        if best.misfit_db <= EXACT_DB:
            return best
    return _search(model, ratios, last, known, best)


def _search(
    model: RayModel, ratios: list[Ratio], last: Call, known: bool, best: Understanding | None
) -> Understanding:
    """Scan, refine, and scan again with all paths."""
    scans = _scans(model, ratios, last, model.start, apart=True)
    fits: list[Understanding] = [] if best is None else [best]
    pairs = _ranked(model, scans)[:1] if known else _ranked(model, scans)[:3]
    for pair in pairs:
        values = model.start.copy()
        for scan in scans:
            scan.put(values, pair, 0)
        fits.append(_polarized(model, ratios, last, values, model.polarizations[pair], EVALUATIONS[0]))
    for again in (False, True):
        best = min(fits, key=lambda fit: fit.misfit_db)
        if best.misfit_db <= EXACT_DB:
            return best
        if again:
            scans = _scans(model, ratios, last, best.values, apart=False)
        for scan in scans:
            best = min(fits, key=lambda fit: fit.misfit_db)
            pair = int(np.argmin(scan.misfit[:, 0]))
            for number in range(0 if again else 1, KEPT):
                if scan.put(values := best.values.copy(), pair, number):
                    fits.append(_refined(best.model, ratios, last, values, EVALUATIONS[0]))
                if fits[-1].misfit_db <= EXACT_DB:
                    return fits[-1]
    best = min(fits, key=lambda fit: fit.misfit_db)
    return min(
        (best, _refined(best.model, ratios, last, best.values, EVALUATIONS[1])), key=lambda fit: fit.misfit_db
    )


def _polarized(
    model: RayModel,
    ratios: list[Ratio],
    last: Call,
    values: NDArray[np.float64],
    slants: tuple[float | None, float | None],
    evaluations: int,
) -> Understanding:
    """Refine with the polarizations of both ends."""
    single = model.with_single((slants[0] is not None, slants[1] is not None))
    angles = [[slant, 0.0, 0.0] for slant in slants if slant is not None]
    start = np.concatenate([values, *angles])
    return _refined(single, ratios, last, start, evaluations)


@dataclass(frozen=True, eq=False)
class _Scan:
    """The best thicknesses and conductivities of one material, for every pair of polarizations.

    Attributes:
        where: Indices of the material's constants in the values of the whole model [c].
        values: Their values in each local minimum [H, K, c].
        misfit: Weighted mean square of the ratios' errors [H, K]; inf where there are fewer minima.
        weight: Weight of the paths scanned.
    """

    where: NDArray[np.int64]
    values: NDArray[np.float64]
    misfit: NDArray[np.float64]
    weight: float

    def put(self, values: NDArray[np.float64], pair: int, number: int) -> bool:
        """Put a local minimum into values; says whether there is one."""
        if not np.isfinite(self.misfit[pair, number]):
            return False
        values[self.where] = self.values[pair, number]
        return True


def _ranked(model: RayModel, scans: list[_Scan]) -> list[int]:
    """Pairs of polarizations, that of the least misfit first."""
    total = np.zeros(len(model.polarizations))
    for scan in scans:
        total += scan.weight * scan.misfit[:, 0]
    return np.argsort(total, kind="stable").tolist()


def _scans(
    model: RayModel, ratios: list[Ratio], last: Call, values: NDArray[np.float64], apart: bool
) -> list[_Scan]:
    """Scan every material that has a parameter: on paths that meet it alone, or on all its paths."""
    paths, parameters = model.paths, model.parameters
    names = list(paths.materials)
    meets = np.zeros((paths.num_paths, len(names)), dtype=bool)
    meets[np.repeat(np.arange(paths.num_paths), np.diff(paths.first)), paths.material] = True
    shared = np.isin(np.arange(paths.num_paths), ratios[0].here)
    moved = {names.index(item.material) for item in parameters if item.material in names}
    scans, present, done = [], values.copy(), np.zeros(len(names), dtype=bool)
    count = meets[meets.sum(axis=1) == 1].sum(axis=0)
    for material in sorted(moved, key=lambda index: -count[index]):
        done[material] = True
        others = meets & ~done if apart else np.zeros_like(meets)
        subset = np.flatnonzero(shared & meets[:, material] & ~others.any(axis=1))
        where = [
            k for k, (name, field) in enumerate(model.assumed)
            if name == names[material] and field in ("thickness", "conductivity")
        ]  # fmt: skip
        if not len(subset) or not where:
            continue
        depth = np.diff(paths.first)[subset]
        subset = subset[np.lexsort((-paths.spreading[subset], depth))[:SCANNED]]
        scan = _scan(model, ratios, last, present, (names[material], np.array(where)), np.sort(subset))
        scans.append(scan)
        scan.put(present, _ranked(model, scans)[0], 0)
    return scans


def _scan(
    model: RayModel,
    ratios: list[Ratio],
    last: Call,
    values: NDArray[np.float64],
    material: tuple[str, NDArray[np.int64]],
    subset: NDArray[np.int64],
) -> _Scan:
    """Scan one material, given its name and where its constants are, on some paths of the last call [n]."""
    name, where = material
    calls = [last, *(ratio.call for ratio in ratios)]
    fields = [model.assumed[k][1] for k in where.tolist()]
    grid = _grid(model, name, fields, calls)
    part = RayModel.of(model.parameters, model.paths, subset)
    index = {item: k for k, item in enumerate(model.assumed)}
    points = np.tile(values[[index[item] for item in part.assumed]], (len(grid), 1))
    points[:, [part.assumed.index((name, field)) for field in fields]] = grid
    level = part.levels(last.candidate, points)
    square, weight = np.zeros(level.shape[:2]), 0.0
    for ratio in ratios:
        at = np.searchsorted(ratio.here, subset)
        at[at == len(ratio.here)] = 0
        mine = ratio.here[at] == subset
        change = level - part.levels(ratio.call.candidate, points)
        square += np.sum((ratio.weight[at] * mine * (change - ratio.observed[at])) ** 2, axis=2)
        weight += float(np.sum((ratio.weight[at] * mine) ** 2))
    return _Scan(where, *_minima(grid, square / weight), weight)


def _grid(model: RayModel, name: str, fields: list[str], calls: list[Call]) -> NDArray[np.float64]:
    """Logarithms of thickness and conductivity, or of the one that is assumed [n, c]."""
    materials = [model.parameters.materials(call.candidate, model.paths.materials)[name] for call in calls]
    root = np.sqrt(max(item.relative_permittivity for item in materials))
    declared = model.paths.materials[name].thickness
    conductivities = CONDUCTIVITIES
    if "conductivity" not in fields:
        conductivities = np.array([max(min(item.conductivity for item in materials), CONDUCTIVITIES[0])])
    rows = []
    for conductivity in conductivities.tolist():
        # Attenuation of a plane wave in a dielectric [Np/m], alpha = sigma / (2 c eps_0 sqrt(eps_r)).
        attenuation = conductivity / (2 * speed_of_light * epsilon_0 * root)
        deepest = min(max(THICKEST, 2 * declared), max(DECAYED / attenuation, 2 * THINNEST))
        step = speed_of_light / model.paths.frequency / (RESOLUTION * root)
        thickness = np.append(np.arange(THINNEST, deepest, step), HALF_SPACE)
        if "thickness" not in fields:
            thickness = np.array([declared])
        rows.append(np.stack([thickness, np.full(len(thickness), conductivity)], axis=1))
    return np.log(np.concatenate(rows))[:, [("thickness", "conductivity").index(field) for field in fields]]


def _minima(
    grid: NDArray[np.float64], square: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The lowest points of a scan that are not next to a lower one: [H, K, c], and their misfits [H, K]."""
    pairs = square.shape[1]
    values, misfit = np.zeros((pairs, KEPT, grid.shape[1])), np.full((pairs, KEPT), np.inf)
    lowest = np.minimum(np.append(np.inf, square.T.ravel()[:-1]), np.append(square.T.ravel()[1:], np.inf))
    lowest = square <= lowest.reshape(pairs, -1).T
    for pair in range(pairs):
        chosen = np.flatnonzero(lowest[:, pair])
        chosen = chosen[np.argsort(square[chosen, pair], kind="stable")[:KEPT]]
        values[pair, : len(chosen)], misfit[pair, : len(chosen)] = grid[chosen], square[chosen, pair]
    return values, misfit


def _refined(
    model: RayModel, ratios: list[Ratio], last: Call, start: NDArray[np.float64], evaluations: int
) -> Understanding:
    """Least squares of all ratios from a start."""
    lower, upper = model.bounds
    kept: dict[bytes, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}

    def evaluate(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if (key := values.tobytes()) not in kept:
            kept.clear()
            kept[key] = _errors(model, ratios, last, values)
        return kept[key]

    # SciPy's stubs know no function as Jacobian.
    slopes = cast(Any, lambda values: evaluate(values)[1])
    ended = least_squares(
        lambda values: evaluate(values)[0], np.clip(start, lower, upper), slopes,
        bounds=(lower - 1e-9, upper + 1e-9), x_scale="jac", max_nfev=evaluations, xtol=1e-10, ftol=1e-8,
    )  # fmt: skip
    return Understanding(model, ended.x, float(np.sqrt(2 * ended.cost)))


def _misfit(model: RayModel, ratios: list[Ratio], last: Call, values: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(_errors(model, ratios, last, values)[0]))


def _errors(
    model: RayModel, ratios: list[Ratio], last: Call, values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted errors of the ratios [m], [dB], and their derivatives by the values [m, k]."""
    level, slope = model.level_and_slope(last.candidate, values)
    residuals, slopes = [], []
    for ratio in ratios:
        # The earlier call is replayed on the paths of the last one.
        other, other_slope = model.level_and_slope(ratio.call.candidate, values)
        residuals.append(ratio.weight * ((level - other)[ratio.here] - ratio.observed))
        slopes.append(ratio.weight[:, None] * (slope - other_slope)[ratio.here])
    return np.concatenate(residuals), np.concatenate(slopes)


def _ratios(calls: list[Call]) -> list[Ratio]:
    """The ratios of the last call to every earlier one that shares a path with it."""
    last = calls[-1].export
    pairs = [(call, *common(last.paths, call.export.paths)) for call in calls[:-1]]
    total = sum(last.weight[here].sum() for _, here, _ in pairs)
    return [
        Ratio(
            call, here, np.sqrt(last.weight[here] / total), last.level_db[here] - call.export.level_db[there]
        )
        for call, here, there in pairs
        if len(here)
    ]


def common(one: Paths, other: Paths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the paths that two programs share, in each of them: same link, kinds and points."""
    rows, pairs = _by_kinds(other), []
    for key, members in _by_kinds(one).items():
        for index, points in members:
            same = (
                k for k, others in rows.get(key, ()) if np.abs(points - others).max(initial=0) <= TOLERANCE
            )
            if (match := next(same, None)) is not None:
                pairs.append((index, match))
    here, there = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2).T
    return here, there


def _by_kinds(paths: Paths) -> dict[tuple[int, ...], list[tuple[int, Any]]]:
    """Indices and points of paths by their link and kinds of interaction."""
    groups: dict[tuple[int, ...], list[tuple[int, Any]]] = {}
    for index, (start, stop) in enumerate(pairwise(paths.first.tolist())):
        key = (int(paths.link[index]), *paths.kind[start:stop].tolist())
        groups.setdefault(key, []).append((index, paths.vertex[start:stop]))
    return groups


def described(understanding: Understanding) -> Iterable[tuple[str, float]]:
    """Names and values of the assumed constants; half-spaces have no thickness."""
    for name, value in understanding.model.materials(understanding.values):
        if not (name.endswith(".thickness") and value > HALF_SPACE / 2):
            yield name, value
