"""Which building a place belongs to: parts of a scene that touch in plan are one whole, whatever objects they are of.

The edges of all triangles but the ground's are drawn on a raster of the plan, and cells that touch, corners included,
make a whole. Streets part buildings; a wall and the panes in it, or a row of houses, are one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.triangles import Triangles

CELL: Final = 1.0
"""Width of a cell [m]: what is less than one or two of them apart touches."""

CELLS: Final = 8_000_000
"""Cells of the raster, at most; over larger scenes they are wider."""

PLACES: Final = 2_000_000
"""Places on edges that are drawn at once."""


def wholes(triangles: Triangles, place: NDArray[np.float64]) -> NDArray[np.int64]:
    """The whole that each of some places lies on, or is nearest to in plan.

    Args:
        triangles: The scene.
        place: The places [n, 3], [m].

    Returns:
        Number of the whole, from 0 [n]; -1 everywhere if there is none but the ground.
    """
    # Both are for who asks which building is which, and nobody else.
    from scipy import ndimage
    from scipy.spatial import KDTree

    corners = triangles.corners[~triangles.ground][:, :, :2]
    if not len(corners) or not len(place):
        return np.full(len(place), -1)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    cell = max(CELL, float(np.sqrt(np.prod(np.maximum(high - low, CELL)) / CELLS)))
    drawn = np.zeros(tuple(((high - low) / cell).astype(np.int64) + 1), dtype=bool)
    for at in _along((corners - low) / cell):
        drawn[at[:, 0], at[:, 1]] = True
    label = np.zeros(drawn.shape, dtype=np.int32)
    ndimage.label(drawn, structure=np.ones((3, 3)), output=label)
    there = np.argwhere(drawn)
    _, nearest = KDTree(there, compact_nodes=False, balanced_tree=False).query(
        (place[:, :2] - low) / cell - 0.5
    )
    return np.asarray(label[drawn][nearest] - 1, dtype=np.int64)


def _along(corners: NDArray[np.float64]) -> Iterator[NDArray[np.int64]]:
    """Cells along the edges of triangles [F, 3, 2], no two of an edge further apart than neighbours."""
    start = corners.reshape(-1, 2)
    way = np.roll(corners, -1, axis=1).reshape(-1, 2) - start
    count = np.ceil(np.abs(way).max(axis=1)).astype(np.int64) + 1
    ends = np.cumsum(count)
    first = 0
    while first < len(count):
        last = max(first + 1, int(np.searchsorted(ends, ends[first] - count[first] + PLACES)))
        number = count[first:last]
        edge = np.repeat(np.arange(first, last), number)
        within = np.arange(len(edge)) - np.repeat(np.cumsum(number) - number, number)
        share = within / np.maximum(count[edge] - 1, 1)
        yield (start[edge] + share[:, None] * way[edge]).astype(np.int64)
        first = last
