"""Search for the slants and tilts of linear polarizations, with the materials fixed.

An antenna receives almost nothing from a direction orthogonal to its polarization. Every path near such a null gives
the misfit a minimum, some 0.02 rad apart, so that a local search from upright antennas ends in a wrong one. With the
materials fixed, the gain of a path is bilinear in the polarizations of both ends. A scan therefore evaluates a grid of
one end's slant and tilts, for the other end as fitted and upright. Its best points start local searches of all angles.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibray.fitting.ray_model import ANGLES, TILT, ports, tilted_theta
from calibray.fitting.ray_scan import ROBUST_DB

STARTS: Final = 6
"""Points of each scan from which a local search starts; of the best six, four reached the truth in development."""

KEPT: Final = 3
"""Largest number of minima that are returned."""

TILTS: Final = np.linspace(-TILT, TILT, 15)
"""Tilts of a scan along x and along y: 0.04 rad apart, twice the distance of minima."""

SLANTS: Final = np.pi * (np.arange(80) / 80 - 0.5)
"""Slants of a scan [rad]; a linear polarization has the period pi."""


class Gains(NamedTuple):
    """Ratios of some paths [n] at two calls, with the gains between the ports V and H.

    Attributes:
        last: Gains at the last call [n, R, T].
        earlier: Gains at an earlier call.
        bases: Axes of the fields at both ends [n, 2, 3].
        weight: Weights of the paths [n].
        observed: Power at the last call over that at the earlier one [n], [dB].
    """

    last: NDArray[np.complex128]
    earlier: NDArray[np.complex128]
    bases: tuple[NDArray[np.float64], NDArray[np.float64]]
    weight: NDArray[np.float64]
    observed: NDArray[np.float64]


def antennas(parts: list[Gains], angles: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The best angles [6] of two linear polarizations, lowest misfit first, from a search around given angles [6]."""
    upright = angles.copy().reshape(2, ANGLES)
    upright[:, 0] = np.pi / 4 * np.round(upright[:, 0] / (np.pi / 4))
    upright[:, 1:] = 0.0
    starts = []
    for end in range(2):
        for other in (angles.reshape(2, ANGLES)[1 - end], upright[1 - end]):
            starts += [
                np.concatenate([own, other] if end == 0 else [other, own]) for own in _scan(parts, end, other)
            ]
    bound = np.tile([3 * np.pi, TILT, TILT], 2)
    found = []
    for start in starts:
        # The soft loss counts paths near a null less, as in the search for all values.
        fit = least_squares(
            lambda angles: errors(parts, angles), np.clip(start, 1e-9 - bound, bound - 1e-9), bounds=(-bound, bound),
            loss="soft_l1", f_scale=ROBUST_DB, x_scale=0.05, max_nfev=30,
        )  # fmt: skip
        found.append((fit.cost, fit.x))
    # Searches that end in the same minimum have the same cost.
    _, distinct = np.unique(np.round([cost for cost, _ in found], 6), return_index=True)
    lowest = [found[index][1] for index in distinct[:KEPT]]
    for each in lowest:
        each[[0, ANGLES]] = np.remainder(each[[0, ANGLES]] + np.pi / 2, np.pi) - np.pi / 2
    return lowest


def errors(parts: list[Gains], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors of the ratios [m], [dB], with weights of mean 1."""
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


def _scan(parts: list[Gains], end: int, other: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The angles [3] of one end with the least loss, for given angles of the other end."""
    x, y = (each.ravel() for each in np.meshgrid(TILTS, TILTS))
    axis, loss = np.stack([x, y, np.ones_like(x)], axis=1), 0.0
    cos, sin = np.cos(SLANTS)[:, None], np.sin(SLANTS)[:, None]
    for part in parts:
        weight, theta = ports(part.bases[1 - end], other)[:, 0], tilted_theta(part.bases[end], axis)
        levels = []
        for gain in (part.last, part.earlier):
            along = np.einsum("prt,pr->pt" if end == 0 else "prt,pt->pr", gain, weight)
            first = (theta * along).sum(axis=2)[:, None]
            second = (theta[..., 0] * along[:, 1] - theta[..., 1] * along[:, 0])[:, None]
            cross = (first * second.conj()).real
            levels.append(
                _level(cos**2 * np.abs(first) ** 2 + sin**2 * np.abs(second) ** 2 + 2 * cos * sin * cross)
            )
        error = (levels[0] - levels[1] - part.observed) ** 2
        loss = loss + (error / (1 + error / ROBUST_DB**2)) @ part.weight  # Geman and McClure's loss
    tilt, slant = np.unravel_index(np.argsort(np.ravel(loss))[:STARTS], (len(axis), len(SLANTS)))
    return [np.array([SLANTS[j], *axis[i, :2]]) for i, j in zip(tilt, slant, strict=True)]


def _level(power: NDArray[np.float64]) -> NDArray[np.float64]:
    return 10 * np.log10(np.maximum(power, 1e-30))
