"""Assignment of positions to buildings: objects that touch in plan form one building.

The edges of all triangles except those of the ground are rasterized in plan. Cells that touch, even if only at corners,
form one building. Streets therefore separate buildings, but a row of houses, or a wall with its windows, counts as one
building.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.triangles import LEVEL, Triangles

CELL: Final = 1.0
"""Width of a raster cell [m]; objects count as touching if the gap between them is less than one or two cells,
depending on their position."""

MAX_CELLS: Final = 8_000_000
"""Maximum number of raster cells, to limit memory use; larger scenes have wider cells."""

MAX_POINTS: Final = 2_000_000
"""Maximum number of points along edges that are in memory at the same time."""


def building_numbers(triangles: Triangles, position: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each position [n, 3], [m], index [n] of the building that contains it or is nearest to it in plan.

    All indices are -1 if the scene consists only of ground.
    """
    # This import is local, because SciPy's spatial modules load slowly and few users of this package need them.
    from scipy import ndimage
    from scipy.spatial import KDTree

    corners = triangles.corners[~triangles.ground][:, :, :2]
    if not len(corners) or not len(position):
        return np.full(len(position), -1)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    cell = max(CELL, float(np.sqrt(np.prod(np.maximum(high - low, CELL)) / MAX_CELLS)))
    # Corners at the upper bounds require one additional cell.
    built = np.zeros(tuple(((high - low) / cell).astype(np.int64) + 1), dtype=bool)
    for point in _edge_cells((corners - low) / cell):
        built[point[:, 0], point[:, 1]] = True
    label = np.zeros(built.shape, dtype=np.int32)
    ndimage.label(built, structure=np.ones((3, 3)), output=label)
    tree = KDTree(np.argwhere(built), compact_nodes=False, balanced_tree=False)
    # Cell k extends from k to k + 1; distances are measured from its centre, not its lower corner.
    _, nearest = tree.query((position[:, :2] - low) / cell - 0.5)
    return np.asarray(label[built][nearest] - 1, dtype=np.int64)


def _edge_cells(corners: NDArray[np.float64]) -> Iterator[NDArray[np.int64]]:
    """Raster cells along the edges of triangles [F, 3, 2], in batches; successive cells of an edge are adjacent."""
    start = corners.reshape(-1, 2)
    step = np.roll(corners, -1, axis=1).reshape(-1, 2) - start
    # Steps are at most one cell along each axis, so an edge has no gaps.
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


def footprints(
    triangles: Triangles, west: float, south: float, east: float, north: float
) -> list[NDArray[np.float64]]:
    """Outlines of the level surfaces, other than the ground, that lie wholly or partly within the given bounds [m].

    The outlines are closed lines [n, 2], [m]; the first corner is not repeated.
    """
    normal = triangles.normal
    area = np.linalg.norm(normal, axis=1)
    corners = triangles.corners
    low, high = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    least, most = np.array([west, south]), np.array([east, north])
    # Faces near the area are also included, because a roof cut off at the bounds would have a wrong outline.
    around = (most - least) / 2
    inside = (high > least - around).all(axis=1) & (low < most + around).all(axis=1)
    lying = (np.abs(normal[:, 2]) > LEVEL * area) & (area > 0)
    chosen = np.flatnonzero(lying & inside & ~triangles.ground)
    # With all faces counter-clockwise as seen from above, a shared edge occurs once in each direction.
    turned = normal[chosen, 2] < 0
    face = np.where(turned[:, None, None], corners[chosen][:, ::-1], corners[chosen])
    points = face.reshape(-1, 3)
    _, first, index = np.unique(points.round(3), axis=0, return_index=True, return_inverse=True)
    place = points[first, :2]
    if not (loops := _loops(index.reshape(-1, 3))):
        return []
    corner = place[np.concatenate(loops)]
    start = np.cumsum([0, *map(len, loops[:-1])])
    reached = np.all(
        (np.maximum.reduceat(corner, start) > least) & (np.minimum.reduceat(corner, start) < most), axis=1
    )
    lines = np.split(corner, start[1:])
    return [lines[number] for number in np.flatnonzero(reached)]


def _loops(faces: NDArray[np.int64]) -> list[list[int]]:
    """Closed lines around groups of faces that share edges; an edge shared by two faces is inside a group."""
    size = int(faces.max(initial=0)) + 1
    # Each edge is encoded as one number, because numbers are sorted faster than pairs.
    edges = np.unique(faces * size + np.roll(faces, -1, axis=1))
    starts, ends = np.divmod(edges, size)
    alone = ~np.isin(ends * size + starts, edges) & (starts != ends)
    following: dict[int, list[int]] = defaultdict(list)
    for start, end in zip(starts[alone].tolist(), ends[alone].tolist(), strict=True):
        following[start].append(end)
    loops = []
    for start in list(following):
        while following[start]:
            loop = [start]
            while following[loop[-1]]:
                loop.append(following[loop[-1]].pop())
                if loop[-1] == start:
                    break
            if len(loop) > 3:
                loops.append(loop[:-1] if loop[-1] == start else loop)
    return loops
