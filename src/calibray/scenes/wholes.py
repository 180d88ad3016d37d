"""Which building a place belongs to: parts of a scene that touch in plan are one whole, whatever objects they are of.

The edges of all triangles but the ground's are drawn on a raster of the plan, and cells that touch, corners included,
make a whole. Streets part buildings; a wall and the panes in it, or a row of houses, are one.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.triangles import Triangles

CELL: Final = 0.5
"""Width of a cell [m]: what is less than one or two of them apart touches."""

CELLS: Final = 8_000_000
"""Cells of the raster, at most; over larger scenes they are wider."""

PIECES: Final = 2_000_000
"""Places on edges that are drawn at once."""


def wholes(triangles: Triangles, place: NDArray[np.float64]) -> NDArray[np.int64]:
    """The whole that each of some places lies on, or is nearest to in plan.

    Args:
        triangles: The scene.
        place: The places [n, 3], [m].

    Returns:
        Number of the whole, from 0 [n]; -1 everywhere if there is none but the ground.
    """
    # Images are looked at where it is asked which building is which, and nowhere else.
    from scipy import ndimage

    corners = triangles.corners[~triangles.ground][:, :, :2]
    if not len(corners) or not len(place):
        return np.full(len(place), -1)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    cell = max(CELL, float(np.sqrt(np.prod(np.maximum(high - low, CELL)) / CELLS)))
    drawn = np.zeros(tuple(((high - low) / cell).astype(np.int64) + 1), dtype=bool)
    start = corners.reshape(-1, 2)
    along = np.roll(corners, -1, axis=1).reshape(-1, 2) - start
    steps = np.ceil(np.linalg.norm(along, axis=1) / (0.5 * cell)).astype(np.int64) + 1
    ends = np.cumsum(steps)
    first = 0
    while first < len(steps):
        last = max(first + 1, int(np.searchsorted(ends, ends[first] - steps[first] + PIECES)))
        count = steps[first:last]
        edge = np.repeat(np.arange(first, last), count)
        within = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
        share = within / np.maximum(steps[edge] - 1, 1)
        at = ((start[edge] + share[:, None] * along[edge] - low) / cell).astype(np.int64)
        drawn[tuple(at.T)] = True
        first = last
    label, _ = ndimage.label(drawn, structure=np.ones((3, 3)))
    nearest = ndimage.distance_transform_edt(~drawn, return_distances=False, return_indices=True)
    at = np.clip((place[:, :2] - low) / cell, 0, np.array(drawn.shape) - 1).astype(np.int64)
    return np.asarray(label[tuple(nearest[:, at[:, 0], at[:, 1]])] - 1, dtype=np.int64)
