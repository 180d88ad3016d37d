"""How many surfaces straight lines between antennas pass through."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

SAME: Final = 1e-3
"""Crossings nearer to each other than this are one, on an edge that two triangles share [m]."""

_BLOCK: Final = 2_000_000  # pairs of a line and a triangle at once


def crossings(corners: NDArray[np.float64], start: ArrayLike, end: ArrayLike) -> NDArray[np.int64]:
    """Count the surfaces that lines cross (Moeller and Trumbore, J. Graphics Tools 2(1), 1997).

    Args:
        corners: Corners of the scene's triangles [faces, 3, 3], [m].
        start: One end of every line [n, 3], [m].
        end: The other [n, 3], [m].

    Returns:
        How many surfaces each line crosses [n].

    Example:
        >>> sheet = np.array([[[1, -9, -9], [1, 9, -9], [1, 0, 9]]], float)
        >>> crossings(sheet, [[0, 0, 0], [0, 0, 0]], [[2, 0, 0], [0.5, 0, 0]])
        array([1, 0])
    """
    origin = np.asarray(start, dtype=float).reshape(-1, 3)
    way = np.asarray(end, dtype=float).reshape(-1, 3) - origin
    found = np.zeros(len(origin), dtype=np.int64)
    step = max(1, _BLOCK // max(len(corners), 1))
    for first in range(0, len(origin), step):
        part = slice(first, first + step)
        found[part] = _crossings(corners, origin[part], way[part])
    return found


def _crossings(
    corners: NDArray[np.float64], origin: NDArray[np.float64], way: NDArray[np.float64]
) -> NDArray[np.int64]:
    base, one, other = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(way[:, None], other)
    volume = (across * one).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / volume
        away = origin[:, None] - base
        u = (away * across).sum(axis=2) * inverse
        beyond = np.cross(away, one)
        v = (way[:, None] * beyond).sum(axis=2) * inverse
        share = (other * beyond).sum(axis=2) * inverse
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (share > 0) & (share < 1)
    length = np.linalg.norm(way, axis=1)
    place = np.sort(np.where(hit, share * length[:, None], np.inf), axis=1)
    # Misses sort last; the difference of two of them is no number, which is not greater than anything.
    with np.errstate(invalid="ignore"):
        apart = np.diff(place, axis=1, prepend=-np.inf) > SAME
    return (np.isfinite(place) & apart).sum(axis=1)
