"""Scans of a material's constants and of antenna angles, which give starting points for a fit to ratios of path powers.

A slab resonates: the power of a ray varies periodically with the thickness, and the period is half a wavelength. A
local search can end in a wrong minimum. A scan therefore evaluates a fine grid of thicknesses, up to the depth at which
the wave has decayed. The grid is evaluated for several conductivities and for several polarizations at both ends. A
scan uses only paths that consist of reflections and transmissions.

An antenna receives almost no power from a direction where the wave is orthogonal to its polarization. Every path
near such a null adds a minimum of the misfit. These minima are about 0.02 rad apart, so a local search from upright
antennas ends in a wrong minimum. With the materials fixed, the gain of a path is bilinear in the polarizations of both
ends. A scan therefore evaluates a grid of slants and tilts at one end, with the other antenna first as fitted and then
upright. Local searches over all angles start from the best points of this grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light
from scipy.optimize import least_squares

from calibray.fields import jax_settings
from calibray.fields.arithmetic import materialize
from calibray.fields.slab import coefficients, loss_term
from calibray.fitting.ray_model import ANGLES, DECAYED, HALF_SPACE, TILT, ports, tilted_theta
from calibray.materials import Material
from calibray.paths import Kind, Paths

CONDUCTIVITIES: Final = 10.0 ** np.arange(-3.5, 1.1, 0.5)
"""Conductivities of a scan [S/m]; a local search covers the half decade between adjacent values."""

THINNEST: Final = 1e-3
"""Minimum thickness in a scan [m]."""

THICKEST: Final = 0.6
"""Maximum thickness in a scan [m], unless twice the study's thickness is larger."""

RESOLUTION: Final = 20.0
"""Number of scanned thicknesses per wavelength in the slab; a slab has two resonances per wavelength of thickness."""

ROBUST_DB: Final = 1.5
"""Error of a ratio above which its weight decreases [dB]: near a resonance that leaves a ray almost no power, one step
of a scan changes the ratio by tens of dB."""

SCANNED: Final = 48
"""Maximum number of paths evaluated in a scan."""

KEPT: Final = 3
"""Number of local minima that are kept from each scan of a material and from each search over antennas."""

BATCH: Final = 512
"""Number of points that are evaluated together."""

_COLUMNS: Final = ("relative_permittivity", "conductivity", "thickness")

SLANTS: Final = (0.0, np.pi / 2, np.pi / 4, -np.pi / 4)
"""Slants of a linear polarization [rad]: vertical, horizontal, and both diagonals."""

POLARIZATIONS: Final = [(tx, rx) for tx in (None, *SLANTS) for rx in (None, *SLANTS)]
"""Pairs of slants at the transmitter and the receiver; None for an unpolarized antenna."""

STARTS: Final = 6
"""Number of points of each scan from which local searches start. In a test, four of the six best points led to the true
angles."""

TILTS: Final = np.linspace(-TILT, TILT, 15)
"""Tilts in a scan, along x and along y: the step of 0.04 rad is twice the distance between minima."""

FINE_SLANTS: Final = np.pi * (np.arange(80) / 80 - 0.5)
"""Slants in a scan of antenna angles [rad]; a linear polarization has a period of pi in the slant."""


def robust(square: Any) -> Any:
    """Geman-McClure loss [...], [dB^2], of squared errors of ratios [...], [dB^2], as a NumPy or JAX array."""
    return square / (1 + square / ROBUST_DB**2)


class Observed(NamedTuple):
    """Power ratios of n paths between the last call and an earlier call.

    Attributes:
        materials: The materials of the earlier call; the scan replaces the scanned constants.
        weight: Weights of the paths [n].
        change_db: Power at the last call relative to that at the earlier one [n], [dB].
    """

    materials: dict[str, Material]
    weight: NDArray[np.float64]
    change_db: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scan:
    """The best points of a scan for every pair of polarizations, lowest misfit first.

    Attributes:
        values: Logarithms of the scanned constants [H, K, c].
        misfit: Mean loss [H, K] of the ratios; infinite if a pair of polarizations has fewer than K minima.
    """

    values: NDArray[np.float64]
    misfit: NDArray[np.float64]

    def lowest(self, pair: int) -> NDArray[np.float64]:
        """The constants of a pair's minima [k, c]."""
        return self.values[pair, np.isfinite(self.misfit[pair])]


def scan(
    paths: Paths, name: str, fields: list[str], last: dict[str, Material], calls: list[Observed], known: bool
) -> Scan:
    """Scan the constants of one material.

    Args:
        paths: Paths with only reflections and transmissions; their antennas have the ports V and H unless the antennas
            are known.
        name: The material.
        fields: The scanned constants: thickness, conductivity, or both.
        last: The materials of the last call.
        calls: The ratios to earlier calls.
        known: Whether the antennas are known; if so, there is only one pair of polarizations.
    """
    everything = [materials[name] for materials in (last, *(call.materials for call in calls))]
    grid = _grid(fields, everything, paths.materials[name].thickness, paths.frequency)
    pairs = 1 if known else len(POLARIZATIONS)
    columns, parts = tuple(_COLUMNS.index(field) for field in fields), [np.zeros((0, pairs))]
    with jax_settings():
        program = _scanned(paths, name, last, calls)
        for start in range(0, len(grid), BATCH):
            points = np.exp(grid[start : start + BATCH])
            padded = np.concatenate([points, np.repeat(points[:1], BATCH - len(points), axis=0)])
            parts.append(np.asarray(_losses(program, padded, columns, known))[: len(points)])
    return Scan(*_minima(grid, np.concatenate(parts), fields))


def chosen(paths: Paths, subset: NDArray[np.int64]) -> NDArray[np.int64]:
    """The paths that a scan evaluates: the simplest and shortest paths with only reflections and transmissions."""
    other = ~np.isin(paths.kind, (Kind.SPECULAR, Kind.REFRACTION))
    path = np.repeat(np.arange(paths.num_paths), np.diff(paths.first))
    subset = np.setdiff1d(subset, path[other])
    depth = np.diff(paths.first)[subset]
    return np.sort(subset[np.lexsort((-paths.spreading[subset], depth))[:SCANNED]])


def _grid(
    fields: list[str], materials: list[Material], declared: float, frequency: float
) -> NDArray[np.float64]:
    """Logarithms of the scanned constants [n, c]; `declared` is the study's thickness [m]."""
    root = np.sqrt(max(item.relative_permittivity for item in materials))
    conductivities = CONDUCTIVITIES
    if "conductivity" not in fields:
        conductivities = np.array([max(min(item.conductivity for item in materials), CONDUCTIVITIES[0])])
    step, rows = speed_of_light / frequency / (RESOLUTION * root), []
    for conductivity in conductivities.tolist():
        # Attenuation of a plane wave in a dielectric [Np/m], alpha = sigma / (2 c eps_0 sqrt(eps_r)).
        attenuation = conductivity / (2 * speed_of_light * epsilon_0 * root)
        deepest = min(max(THICKEST, 2 * declared), max(DECAYED / attenuation, 2 * THINNEST))
        thickness = np.append(np.arange(THINNEST, deepest, step), HALF_SPACE)
        if "thickness" not in fields:
            thickness = np.array([materials[0].thickness])
        rows.append(np.stack([thickness, np.full(len(thickness), conductivity)], axis=1))
    return np.log(np.concatenate(rows))[:, [("thickness", "conductivity").index(field) for field in fields]]


def _minima(
    grid: NDArray[np.float64], square: NDArray[np.float64], fields: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The lowest local minima [H, K, c] over thickness, each at the best conductivity, and their losses [H, K]."""
    pairs = square.shape[1]
    values, misfit = np.zeros((pairs, KEPT, grid.shape[1])), np.full((pairs, KEPT), np.inf)
    _, group = np.unique(
        np.round(grid[:, 0] if "thickness" in fields else 0 * grid[:, 0], 6), return_inverse=True
    )
    for pair in range(pairs):
        order = np.lexsort((square[:, pair], group))
        # The best conductivity for every thickness.
        first = order[np.flatnonzero(np.diff(group[order], prepend=-1))]
        lowest = square[first, pair]
        # Either end of the range can be a minimum.
        around = np.minimum(np.append(np.inf, lowest[:-1]), np.append(lowest[1:], np.inf))
        found = first[lowest <= around]
        found = found[np.argsort(square[found, pair], kind="stable")[:KEPT]]
        values[pair, : len(found)], misfit[pair, : len(found)] = grid[found], square[found, pair]
    return values, misfit


class _Scanned(NamedTuple):
    """The P paths of a scan, each with at most D interactions, at the last call and at C earlier calls.

    P is always `SCANNED`, so that few functions have to be compiled. Missing paths have weight 0.

    Attributes:
        exists: Whether a path has an interaction at this index [D, P].
        here: Whether an interaction is on the scanned material [D, P].
        cosine: Cosine of the angle of incidence [D, P].
        through: Whether the interaction is a transmission [D, P].
        rotation: Cosine and sine [D, 2, P] of the rotation into the frame of incidence.
        constants: Permittivity, conductivity and thickness at every call, last call first [C + 1, 3, D, P].
        tx: Fields at the transmitter [T, 2, P].
        rx: Conjugate fields at the receiver [R, 2, P].
        wavelength: Wavelength [m].
        weight: Weights of the ratios [C, P]; their sum is 1.
        change_db: The ratios [C, P], [dB].
    """

    exists: jax.Array
    here: jax.Array
    cosine: jax.Array
    through: jax.Array
    rotation: jax.Array
    constants: jax.Array
    tx: jax.Array
    rx: jax.Array
    wavelength: jax.Array
    weight: jax.Array
    change_db: jax.Array


def _scanned(paths: Paths, name: str, last: dict[str, Material], calls: list[Observed]) -> _Scanned:
    depth, index = np.diff(paths.first), np.arange(SCANNED) % paths.num_paths
    steps = np.arange(int(depth.max(initial=0)))[:, None]
    exists = steps < depth[index]
    at = np.where(exists, paths.first[index] + steps, 0)
    tables = [
        np.array([[getattr(item, field) for item in materials.values()] for field in _COLUMNS])
        for materials in (last, *(call.materials for call in calls))
    ]
    present = np.arange(SCANNED) < paths.num_paths
    weight = np.stack([np.where(present, call.weight[index], 0.0) for call in calls])
    arrays = (
        exists,
        exists & (paths.material[at] == list(last).index(name)),
        paths.cos_incidence[at],
        paths.kind[at] == Kind.REFRACTION,
        np.moveaxis(paths.rotation[at], -1, 1),
        np.stack([table[:, paths.material[at]] for table in tables]),
        np.moveaxis(paths.tx_field[index], 0, -1),
        np.moveaxis(paths.rx_field[index].conj(), 0, -1),
        speed_of_light / paths.frequency,
        weight / weight.sum(),
        np.stack([call.change_db[index] for call in calls]),
    )
    return _Scanned(*jax.device_put(arrays))


@partial(jax.jit, static_argnums=(2, 3))
def _losses(program: _Scanned, points: jax.Array, columns: tuple[int, ...], known: bool) -> jax.Array:
    """Mean loss of the ratios [n, H] for values [n, c] of the constants `columns` of one material."""
    last, *earlier = (_powers(program, each, points, columns, known) for each in program.constants)
    total = jnp.zeros(last.shape[:2])
    for power, weight, change_db in zip(earlier, program.weight, program.change_db, strict=True):
        # Single precision suffices for a logarithm.
        ratio = (jnp.maximum(last, 1e-30) / jnp.maximum(power, 1e-30)).astype(jnp.float32)
        square = (10 * jnp.log10(ratio) - change_db.astype(jnp.float32)) ** 2
        total += (robust(square) * weight.astype(jnp.float32)).sum(axis=-1)
    return total


def _powers(
    program: _Scanned, constants: jax.Array, points: jax.Array, columns: tuple[int, ...], known: bool
) -> jax.Array:
    """Powers [n, H, P], up to a factor per path, with the constants [3, D, P] of one call."""
    values = list(jnp.broadcast_to(constants[:, None], (3, len(points), *constants.shape[1:])))
    for index, column in enumerate(columns):
        values[column] = jnp.where(program.here, points[:, index, None, None], values[column])
    te, tm = (
        jnp.where(program.exists, real + 1j * imaginary, 1.0)
        for real, imaginary in coefficients(
            program.cosine, values[0], loss_term(values[1], program.wavelength), values[2], program.wavelength,
            program.through,
        )
    )  # fmt: skip
    # The gain is E_rx^H J_K ... J_1 E_tx, up to a real factor.
    first, second = program.tx[:, 0], program.tx[:, 1]  # [n, T, P]
    for step, (cos, sin) in enumerate(program.rotation):
        cos, sin = jnp.where(program.exists[step], cos, 1.0), jnp.where(program.exists[step], sin, 0.0)
        first, second = (
            te[:, None, step] * (cos * first + sin * second),
            tm[:, None, step] * (cos * second - sin * first),
        )
    shape = (len(points), program.tx.shape[0], program.tx.shape[2])
    first, second = jnp.broadcast_to(first, shape)[:, None], jnp.broadcast_to(second, shape)[:, None]
    gain = program.rx[:, None, 0] * first + program.rx[:, None, 1] * second  # [n, R, T, P]
    if known:
        return _square(gain).sum(axis=(1, 2))[:, None]
    gain = materialize(gain, program.wavelength)
    ends = [(np.cos(slant), np.sin(slant)) for slant in SLANTS]
    received = jnp.stack([cos * gain[:, 0] + sin * gain[:, 1] for cos, sin in ends], axis=1)  # [n, 4, T, P]
    square = _square(
        jnp.stack([cos * received[:, :, 0] + sin * received[:, :, 1] for cos, sin in ends], axis=1)
    )
    # An unpolarized antenna receives both components of the wave.
    square = jnp.concatenate([square[:, :2].sum(axis=1, keepdims=True), square], axis=1)
    square = jnp.concatenate([square[:, :, :2].sum(axis=2, keepdims=True), square], axis=2)
    return materialize(square.reshape(len(points), -1, square.shape[-1]), program.wavelength)


def _square(gain: jax.Array) -> jax.Array:
    return gain.real**2 + gain.imag**2


class Gains(NamedTuple):
    """Power ratios of n paths between two calls, with the gains between the ports V and H.

    Attributes:
        last: Gains at the last call [n, R, T].
        earlier: Gains at an earlier call [n, R, T].
        bases: Unit vectors theta and phi [n, 2, 3] of the fields at both ends.
        weight: Weights of the paths [n].
        observed: Power at the last call relative to that at the earlier one [n], [dB].
    """

    last: NDArray[np.complex128]
    earlier: NDArray[np.complex128]
    bases: tuple[NDArray[np.float64], NDArray[np.float64]]
    weight: NDArray[np.float64]
    observed: NDArray[np.float64]


def antennas(parts: list[Gains], angles: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The best angles [6] of two linearly polarized antennas, lowest misfit first, from a search near `angles` [6]."""
    upright = angles.copy().reshape(2, ANGLES)
    upright[:, 0] = np.pi / 4 * np.round(upright[:, 0] / (np.pi / 4))
    upright[:, 1:] = 0.0
    starts = []
    for end in range(2):
        for other in (angles.reshape(2, ANGLES)[1 - end], upright[1 - end]):
            starts += [
                np.concatenate([own, other] if end == 0 else [other, own])
                for own in _scan_angles(parts, end, other)
            ]
    bound = np.tile([3 * np.pi, TILT, TILT], 2)
    found = []
    for start in starts:
        # As in the search for all values, the soft loss reduces the weight of paths near a null.
        fit = least_squares(
            lambda angles: errors(parts, angles), np.clip(start, 1e-9 - bound, bound - 1e-9), bounds=(-bound, bound),
            loss="soft_l1", f_scale=ROBUST_DB, x_scale=0.05, max_nfev=30,
        )  # fmt: skip
        found.append((fit.cost, fit.x))
    # Searches that end in the same minimum have the same cost.
    _, distinct = np.unique(np.round([cost for cost, _ in found], 6), return_index=True)
    lowest = [found[index][1] for index in distinct[:KEPT]]
    for each in lowest:
        # A linear polarization has a period of pi in the slant.
        each[[0, ANGLES]] = np.remainder(each[[0, ANGLES]] + np.pi / 2, np.pi) - np.pi / 2
    return lowest


def errors(parts: list[Gains], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors of the ratios [m], [dB], times the square roots of the weights, which are scaled to a mean of 1."""
    errors, weights = [], np.concatenate([part.weight for part in parts])
    for part in parts:
        tx, rx = (
            ports(basis, each)[:, 0] for basis, each in zip(part.bases, angles.reshape(2, -1), strict=True)
        )
        last, earlier = (
            _level(np.abs(np.einsum("pr,prt,pt->p", rx, gain, tx)) ** 2) for gain in (part.last, part.earlier)
        )
        errors.append(np.sqrt(part.weight / weights.mean()) * (last - earlier - part.observed))
    return np.concatenate(errors)


def _scan_angles(parts: list[Gains], end: int, other: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Sets of angles [3] with the smallest losses at one end, for given angles at the other end."""
    x, y = (each.ravel() for each in np.meshgrid(TILTS, TILTS))
    axis, loss = np.stack([x, y, np.ones_like(x)], axis=1), 0.0
    cos, sin = np.cos(FINE_SLANTS)[:, None], np.sin(FINE_SLANTS)[:, None]
    for part in parts:
        weight, theta = ports(part.bases[1 - end], other)[:, 0], tilted_theta(part.bases[end], axis)
        levels = []
        for gain in (part.last, part.earlier):
            along = np.einsum("prt,pr->pt" if end == 0 else "prt,pt->pr", gain, weight)
            first = (theta * along).sum(axis=2)[:, None]
            second = (theta[..., 0] * along[:, 1] - theta[..., 1] * along[:, 0])[:, None]
            # |cos x first + sin x second|^2, from three products for all slants.
            cross = (first * second.conj()).real
            levels.append(
                _level(cos**2 * np.abs(first) ** 2 + sin**2 * np.abs(second) ** 2 + 2 * cos * sin * cross)
            )
        loss = loss + robust((levels[0] - levels[1] - part.observed) ** 2) @ part.weight
    tilt, slant = np.unravel_index(np.argsort(np.ravel(loss))[:STARTS], (len(axis), len(FINE_SLANTS)))
    return [np.array([FINE_SLANTS[j], *axis[i, :2]]) for i, j in zip(tilt, slant, strict=True)]


def _level(power: NDArray[np.float64]) -> NDArray[np.float64]:
    return 10 * np.log10(np.maximum(power, 1e-30))
