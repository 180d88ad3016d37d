"""Which building a position belongs to: all objects that touch in plan are one building.

The edges of all triangles except the ground's are drawn on a raster of the plan. Cells that touch, corners included,
form one building. Streets separate buildings; a wall with its windows, or a row of houses, is one building.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.triangles import Triangles

CELL: Final = 1.0
"""Width of a raster cell [m]; objects less than one or two cells apart touch."""

MAX_CELLS: Final = 8_000_000
"""Largest number of raster cells, which bounds memory; larger scenes get wider cells."""

MAX_POINTS: Final = 2_000_000
"""Largest number of points on edges that are held in memory at once."""


def building_numbers(triangles: Triangles, position: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number of the building [n], from 0, that each position [n, 3], [m], lies on or is nearest to in plan.

    It is -1 everywhere if the scene is ground alone.
    """
    # SciPy's spatial modules are slow to import, and few callers of this package need them.
    from scipy import ndimage
    from scipy.spatial import KDTree

    corners = triangles.corners[~triangles.ground][:, :, :2]
    if not len(corners) or not len(position):
        return np.full(len(position), -1)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    cell = max(CELL, float(np.sqrt(np.prod(np.maximum(high - low, CELL)) / MAX_CELLS)))
    built = np.zeros(tuple(((high - low) / cell).astype(np.int64) + 1), dtype=bool)
    for point in _edge_cells((corners - low) / cell):
        built[point[:, 0], point[:, 1]] = True
    label = np.zeros(built.shape, dtype=np.int32)
    ndimage.label(built, structure=np.ones((3, 3)), output=label)
    tree = KDTree(np.argwhere(built), compact_nodes=False, balanced_tree=False)
    _, nearest = tree.query((position[:, :2] - low) / cell - 0.5)
    return np.asarray(label[built][nearest] - 1, dtype=np.int64)


def _edge_cells(corners: NDArray[np.float64]) -> Iterator[NDArray[np.int64]]:
    """Raster cells along the edges of triangles [F, 3, 2], in batches; successive cells of an edge are neighbours."""
    start = corners.reshape(-1, 2)
    step = np.roll(corners, -1, axis=1).reshape(-1, 2) - start
    count = np.ceil(np.abs(step).max(axis=1)).astype(np.int64) + 1
    ends = np.cumsum(count)
    first = 0
    while first < len(count):
        last = max(first + 1, int(np.searchsorted(ends, ends[first] - count[first] + MAX_POINTS)))
        number = count[first:last]
        edge = np.repeat(np.arange(first, last), number)
        within = np.arange(len(edge)) - np.repeat(np.cumsum(number) - number, number)
        share = within / np.maximum(count[edge] - 1, 1)
        yield (start[edge] + share[:, None] * step[edge]).astype(np.int64)
        first = last
