"""Find an engine's assumptions from ratios of ray powers by a global search over constants and polarizations.

Materials are added one at a time. Each material is scanned (`ray_scan.py`) on the paths that do not meet any material
added later. A least-squares fit to all these paths, with exact derivatives and several polarizations, then refines the
best points jointly with the values already found. The best few explanations are kept. A further starting point combines
the study's constants with the polarizations that fit best. If a misfit remains, linear polarizations are searched with
the materials fixed, and then each material is scanned again on all its paths. The last step is basin hopping (Wales and
Doye, 1997): each trial moves one or two materials to other resonances and refines the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.optimize import least_squares

from calibray.engines.rays.compile import powers
from calibray.engines.rays.surfaces import TOLERANCE
from calibray.engines.replay import Replay
from calibray.fitting import ray_scan
from calibray.fitting.ray_model import ANGLES, HALF_SPACE, LEAST_DB, RANGES, TILT, Call, Ends, RayModel
from calibray.parameters import Parameters
from calibray.paths import Paths, take

KEPT: Final = 3
"""Number of explanations that are kept from one material to the next."""

EXACT_DB: Final = 0.005
"""Misfit at which a search ends [dB]; smaller misfits do not distinguish between explanations."""

KNOWN_DB: Final = 0.02
"""Misfit below which the explanation of earlier calls is kept for the next call [dB]; misfits at wrong minima were at
least 0.1 dB."""

EVALUATIONS: Final = (6, 12, 30)
"""Maximum number of evaluations for each loss function, in three cases: in a trial, between scans, and in the last
refinement."""

TRIALS: Final = 300
"""Maximum number of basin-hopping trials. Stopping after 150 trials without improvement gave about the same
misfits."""

TRIED_PATHS: Final = 500_000
"""Maximum of the number of trials times the number of paths, to limit the time spent on basin hopping."""

PROMISING: Final = 3.0
"""A trial is refined further if its misfit is less than this multiple of the largest misfit among the explanations that
are kept."""

MOST_HOPS: Final = 30
"""Maximum change in thickness [half wavelengths in the slab] in a trial."""


@dataclass(frozen=True, eq=False)
class Understanding:
    """The assumed values that best explain the ratios of an engine's ray powers.

    Attributes:
        model: The model of the last export's paths.
        values: The assumed values [k], as in `RayModel`.
        linear: Whether the antennas are linearly polarized.
        misfit_db: Weighted root mean square of the errors of the ratios [dB].
    """

    model: RayModel
    values: NDArray[np.float64]
    linear: Ends
    misfit_db: float

    def replay(self, parameters: Parameters, last: Call) -> Replay:
        """The replay of a call's paths, corrected to agree with the powers of the call."""
        paths = self.model.replay_paths(last.candidate, self.values, self.linear)
        # Power of every path according to the engine, relative to the power in the replay.
        correction = 10 ** (last.export.level_db / 10) / np.maximum(powers(paths), 1e-300)
        return Replay(replace(paths, correction=correction), parameters)


class Ratio(NamedTuple):
    """Power ratios of the n paths that the last call shares with an earlier call.

    Attributes:
        call: The earlier call.
        here: Indices [n] of the paths in the last call, in ascending order.
        weight: Weights of the paths [n]; the sum over all ratios is 1.
        level_db: Power in the last call [n], [dB].
        observed: Power in the last call relative to the power in the earlier call [n], [dB].
    """

    call: Call
    here: NDArray[np.int64]
    weight: NDArray[np.float64]
    level_db: NDArray[np.float64]
    observed: NDArray[np.float64]

    def on(self, kept: NDArray[np.bool_]) -> Ratio:
        """The ratios of the paths selected by the mask `kept` [P] of the last call's paths."""
        mine = kept[self.here]
        return Ratio(self.call, self.here[mine], self.weight[mine], self.level_db[mine], self.observed[mine])


def understand(
    parameters: Parameters,
    calls: list[Call],
    known: bool,
    before: Understanding | None = None,
    *,
    search: bool = True,
) -> Understanding:
    """Find the assumptions that explain the ratios of all calls.

    If `before` is given (the assumptions found from the earlier calls), the search starts from it. If `search` is
    false, `before` is only refined. The model contains the paths of the last call. `known` is true if the program's
    antennas are those of the engine.
    """
    last, ratios = calls[-1], ratios_of(calls)
    model = RayModel.of(parameters, last.export.paths, known)
    first = Understanding(model, model.start, (False, False), np.inf)
    if not ratios:
        return first
    if not len(model.start):
        return replace(
            first, misfit_db=float(np.linalg.norm(_errors(first, ratios, _tables(model, ratios, last))[0]))
        )
    if before is not None and before.model.assumed == model.assumed:
        before = refined(replace(before, model=model), ratios, last, EVALUATIONS[2])
        if before.misfit_db <= KNOWN_DB or not search:
            return before
    return _search(first, ratios, last, before)


def half_spaces(fit: Understanding, calls: list[Call]) -> tuple[str, ...]:
    """Materials whose assumed thickness the ratios do not determine, as for a half-space.

    If the slab of such a material is replaced by a half-space, the misfit increases by at most `EXACT_DB`.
    """
    last, ratios = calls[-1], ratios_of(calls)
    if not ratios:
        return ()
    tables, weight = _tables(fit.model, ratios, last), sum(ratio.weight.sum() for ratio in ratios)

    def misfit_db(values: NDArray[np.float64]) -> float:
        return float(
            np.linalg.norm(_errors(replace(fit, values=values), ratios, tables)[0]) / np.sqrt(weight)
        )

    most_db = misfit_db(fit.values) + EXACT_DB
    thick = {
        name: np.where(np.arange(len(fit.values)) == at, np.log(HALF_SPACE), fit.values)
        for at, (name, field) in enumerate(fit.model.assumed)
        if field == "thickness"
    }
    return tuple(name for name, values in thick.items() if misfit_db(values) <= most_db)


def _search(
    first: Understanding, ratios: list[Ratio], last: Call, before: Understanding | None
) -> Understanding:
    """Add the materials one at a time, and then scan all materials again."""
    meets, order = _meetings(first.model)
    fits, done = [first, *_with_the_constants_of(first, ratios, last)], np.zeros(meets.shape[1], dtype=bool)
    for material in order:
        done[material] = True
        shown = np.logical_not((meets & ~done).any(axis=1))
        part = [ratio for each in ratios if len((ratio := each.on(shown)).here)]
        new = _scanned(fits, part, last, material, meets[:, material] & shown)
        if part:
            fits = _best([refined(fit, part, last, EVALUATIONS[1]) for fit in [*fits, *new]])
    fits = _best([refined(fit, ratios, last, EVALUATIONS[2]) for fit in fits] + ([before] if before else []))
    if fits[0].misfit_db > EXACT_DB and all(fits[0].linear) and not fits[0].model.known:
        new = _turned(fits[0], ratios, last)
        fits = _best([*fits, *(refined(fit, ratios, last, EVALUATIONS[2]) for fit in new)])
    for material in order:
        if fits[0].misfit_db <= EXACT_DB:
            break
        new = _scanned(fits[:1], ratios, last, material, meets[:, material])
        fits = _best([*fits, *(refined(fit, ratios, last, EVALUATIONS[2]) for fit in new)])
    return _hopped(fits, ratios, last)


def _hopped(fits: list[Understanding], ratios: list[Ratio], last: Call) -> Understanding:
    """The best explanation from basin hopping, which perturbs and refines explanations until one is exact."""
    random, model = np.random.default_rng(len(ratios)), fits[0].model
    for _ in range(min(TRIALS, TRIED_PATHS // model.paths.num_paths) if model.assumed else 0):
        if fits[0].misfit_db <= EXACT_DB:
            break
        start = _perturbed(fits[random.integers(len(fits))], last, random)
        trial = refined(start, ratios, last, EVALUATIONS[0])
        if trial.misfit_db < PROMISING * fits[-1].misfit_db:
            trial = refined(trial, ratios, last, EVALUATIONS[2])
        if not np.isclose(trial.misfit_db, [fit.misfit_db for fit in fits], rtol=1e-3).any():
            fits = _best([*fits, trial])
    return fits[0]


def _perturbed(fit: Understanding, last: Call, random: np.random.Generator) -> Understanding:
    """An explanation with different constants of one or two materials.

    A thickness changes by a whole number of half wavelengths in the slab, which leads to another resonance. The
    conductivity stays the same, changes so that the attenuation through the slab is preserved, or changes at random.
    One trial in three also changes the tilts of the antennas if they are unknown.
    """
    model, values = fit.model, fit.values.copy()
    materials = model.materials(last.candidate, fit.values)
    position = {key: number for number, key in enumerate(model.assumed)}
    names = sorted({name for name, _ in model.assumed})
    for name in random.choice(names, min(len(names), random.integers(1, 3)), replace=False).tolist():
        longer = 0.0
        if (at := position.get((name, "thickness"))) is not None:
            root = np.sqrt(materials[name].relative_permittivity)
            step = speed_of_light / model.paths.frequency / (2 * root)
            change = random.choice([-1, 1]) * round(np.exp(random.uniform(0, np.log(MOST_HOPS)))) * step
            longer = np.log(np.clip(abs(np.exp(values[at]) + change), *RANGES["thickness"])) - values[at]
            values[at] += longer
        if (at := position.get((name, "conductivity"))) is not None:
            values[at] += random.choice([0.0, -longer, random.normal()])
    if not model.known and random.integers(3) == 0:
        slant = np.pi / 2 * np.round(values[len(position) :: ANGLES] / (np.pi / 2))
        values[len(position) :] = np.stack([slant, *random.uniform(-TILT, TILT, (2, 2))], axis=1).ravel()
    return replace(fit, values=values)


def _with_the_constants_of(fit: Understanding, ratios: list[Ratio], last: Call) -> list[Understanding]:
    """Explanations with the same constants and the best upright antennas; none if the antennas are known.

    Many engines differ from the study only in their antennas.
    """
    if fit.model.known:
        return []
    tables, weight = _tables(fit.model, ratios, last), np.concatenate([ratio.weight for ratio in ratios])
    turned = [_polarized(fit, slants) for slants in ray_scan.POLARIZATIONS]
    squares = [_errors(each, ratios, tables)[0] ** 2 / weight for each in turned]
    loss = [float(weight @ ray_scan.robust(square)) for square in squares]
    return [turned[index] for index in np.argsort(loss, kind="stable")[:KEPT].tolist()]


def _best(fits: list[Understanding]) -> list[Understanding]:
    return sorted(fits, key=lambda fit: fit.misfit_db)[:KEPT]


def _meetings(model: RayModel) -> tuple[NDArray[np.bool_], list[int]]:
    """Mask of the materials on each path [P, M], and the calibrated materials in the order in which they are scanned.

    Materials that are the only material on many paths come first.
    """
    paths, names = model.paths, list(model.paths.materials)
    meets = np.zeros((paths.num_paths, len(names)), dtype=bool)
    meets[np.repeat(np.arange(paths.num_paths), np.diff(paths.first)), paths.material] = True
    moved = {names.index(item.material) for item in model.parameters if item.material in names}
    alone = meets[meets.sum(axis=1) == 1].sum(axis=0)
    return meets, sorted(moved, key=lambda index: -alone[index])


def _scanned(
    fits: list[Understanding], ratios: list[Ratio], last: Call, material: int, wanted: NDArray[np.bool_]
) -> list[Understanding]:
    """Explanations with different constants of one material, from scans on the paths selected by the mask `wanted` [P].

    One scan starts from the first explanation and uses upright antennas with all polarizations. Other scans use the
    antennas of each explanation, to account for tilts.
    """
    model, first = fits[0].model, np.isinf(fits[0].misfit_db)
    name = list(model.paths.materials)[material]
    fields = [
        field for owner, field in model.assumed if owner == name and field in ("thickness", "conductivity")
    ]
    where = [model.assumed.index((name, field)) for field in fields]
    index = np.flatnonzero(wanted)
    for ratio in ratios:
        index = np.intersect1d(index, ratio.here)
    index = ray_scan.chosen(model.paths, index)
    if not len(index) or not where:
        return []

    def scan(fit: Understanding, paths: Paths, known: bool) -> ray_scan.Scan:
        calls = []
        for ratio in ratios:
            at = np.searchsorted(ratio.here, index)
            materials = model.materials(ratio.call.candidate, fit.values)
            calls.append(ray_scan.Observed(materials, ratio.weight[at], ratio.observed[at]))
        materials = model.materials(last.candidate, fit.values)
        return ray_scan.scan(take(paths, index), name, fields, materials, calls, known)

    def moved(fit: Understanding, constants: NDArray[np.float64]) -> Understanding:
        values = fit.values.copy()
        values[where] = constants
        return replace(fit, values=values)

    new = []
    if not model.known:
        found = scan(fits[0], model.paths, False)
        for pair in np.argsort(found.misfit[:, 0], kind="stable")[:KEPT].tolist():
            for constants in found.lowest(pair)[: None if first else 1]:
                new.append(_polarized(moved(fits[0], constants), ray_scan.POLARIZATIONS[pair]))
    for fit in fits if model.known or not first else []:
        paths = model.replay_paths(last.candidate, fit.values, fit.linear)
        found = scan(fit, replace(paths, materials=model.paths.materials), True)
        new += [moved(fit, constants) for constants in found.lowest(0)]
    return new


def _turned(fit: Understanding, ratios: list[Ratio], last: Call) -> list[Understanding]:
    """Explanations with the same materials and different antenna angles."""
    model, count = fit.model, len(fit.model.assumed)
    gains = model.gains(last.candidate, fit.values)
    parts = [
        ray_scan.Gains(
            gains[each.here], model.gains(each.call.candidate, fit.values)[each.here],
            (model.bases[0][each.here], model.bases[1][each.here]), each.weight, each.observed,
        )
        for each in ratios
    ]  # fmt: skip
    found = ray_scan.antennas(parts, fit.values[count:])
    return [replace(fit, values=np.concatenate([fit.values[:count], angles])) for angles in found]


def _polarized(fit: Understanding, slants: tuple[float | None, float | None]) -> Understanding:
    """The same explanation with upright antennas at the given slants."""
    angles = [part for slant in slants for part in (slant or 0.0, 0.0, 0.0)]
    values = np.concatenate([fit.values[: len(fit.model.assumed)], angles])
    return replace(fit, values=values, linear=(slants[0] is not None, slants[1] is not None))


def refined(fit: Understanding, ratios: list[Ratio], last: Call, evaluations: int) -> Understanding:
    """Least-squares fit to all ratios, starting from an explanation; values that change no ratio stay fixed."""
    lower, upper = fit.model.bounds
    start, tables = np.clip(fit.values, lower, upper), _tables(fit.model, ratios, last)
    size = np.linalg.norm(_errors(replace(fit, values=start), ratios, tables)[1], axis=0)
    # A value that changes no ratio would make the normal equations singular.
    free = np.flatnonzero(size > 1e-9 * size.max(initial=1e-9))
    lower, upper, values = lower[free] - 1e-9, upper[free] + 1e-9, start[free]
    kept: dict[bytes, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}

    def complete(values: NDArray[np.float64]) -> NDArray[np.float64]:
        everything = start.copy()
        everything[free] = values
        return everything

    def evaluate(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if (key := values.tobytes()) not in kept:
            kept.clear()
            errors, slopes = _errors(replace(fit, values=complete(values)), ratios, tables)
            kept[key] = errors, slopes[:, free]
        return kept[key]

    # SciPy's stubs do not accept a function as a Jacobian.
    slopes = cast(Any, lambda values: evaluate(values)[1])
    weights = np.concatenate([ratio.weight for ratio in ratios])
    scale = ray_scan.ROBUST_DB * float(np.sqrt(weights.mean()))
    for loss in ("soft_l1", "linear"):  # the first loss gives less weight to paths near a resonance
        with np.errstate(divide="ignore"):  # SciPy divides by zero if the Jacobian is rank-deficient
            values = least_squares(
                lambda values: evaluate(values)[0], values, slopes, bounds=(lower, upper), x_scale="jac",
                loss=loss, f_scale=scale, max_nfev=evaluations, xtol=1e-10, ftol=1e-8,
            ).x  # fmt: skip
    misfit = float(np.linalg.norm(evaluate(values)[0]) / np.sqrt(weights.sum()))
    return replace(fit, values=np.clip(complete(values), *fit.model.bounds), misfit_db=misfit)


def _tables(model: RayModel, ratios: list[Ratio], last: Call) -> NDArray[np.float64]:
    """Constants at the last call and at the earlier calls, for the paths of the last call."""
    return model.tables([last.candidate, *(ratio.call.candidate for ratio in ratios)])


def _errors(
    fit: Understanding, ratios: list[Ratio], tables: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted errors [m], [dB], of the ratios, and their derivatives [m, k] with respect to the values.

    If a path has power in the engine but not in the model, no correction can restore this power. Its error is then
    `LEAST_DB` minus the power in the engine.

    `tables` contains the constants of the last call and of each ratio's call; see `_tables`.
    """
    (level, *others), (slope, *other_slopes) = fit.model.levels_and_slopes(tables, fit.values, fit.linear)
    residuals, slopes = [], []
    for ratio, other, other_slope in zip(ratios, others, other_slopes, strict=True):
        root = np.sqrt(ratio.weight)
        missing = (np.minimum(level, other)[ratio.here] <= LEAST_DB) & (ratio.level_db > LEAST_DB)
        error = np.where(missing, LEAST_DB - ratio.level_db, (level - other)[ratio.here] - ratio.observed)
        residuals.append(root * error)
        slopes.append(np.where(missing, 0.0, root)[:, None] * (slope - other_slope)[ratio.here])
    return np.concatenate(residuals), np.concatenate(slopes)


def ratios_of(calls: list[Call]) -> list[Ratio]:
    """The ratios of path powers between the last call and every earlier call with at least one common path."""
    last = calls[-1].export
    pairs = [(call, *common(last.paths, call.export.paths)) for call in calls[:-1]]
    total = sum(last.weight[here].sum() for _, here, _ in pairs)
    return [
        Ratio(
            call,
            here,
            last.weight[here] / total,
            last.level_db[here],
            last.level_db[here] - call.export.level_db[there],
        )
        for call, here, there in pairs
        if len(here)
    ]


def common(one: Paths, other: Paths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices, in each of two programs, of the paths with the same link, kinds and points."""
    rows, partner = _by_kinds(other), {}
    for key, members in _by_kinds(one).items():
        near = [
            (gap, index, k)
            for index, points in members
            for k, others in rows.get(key, ())
            if (gap := float(np.abs(points - others).max(initial=0))) <= TOLERANCE
        ]
        taken = set()
        # The nearest pairs come first, because the two edges of a thin wall lie within the tolerance of each other.
        for _, index, k in sorted(near):
            if index not in partner and k not in taken:
                partner[index] = k
                taken.add(k)
    here, there = np.array(sorted(partner.items()), dtype=np.int64).reshape(-1, 2).T
    return here, there


def _by_kinds(paths: Paths) -> dict[tuple[int, ...], list[tuple[int, Any]]]:
    """Indices and points of the paths, grouped by link and kinds of interaction."""
    groups: dict[tuple[int, ...], list[tuple[int, Any]]] = {}
    for index, (start, stop) in enumerate(pairwise(paths.first.tolist())):
        key = (int(paths.link[index]), *paths.kind[start:stop].tolist())
        groups.setdefault(key, []).append((index, paths.vertex[start:stop]))
    return groups
