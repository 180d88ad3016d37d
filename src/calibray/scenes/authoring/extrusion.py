"""Extrusion: the walls, windows, roofs and undersides of buildings, from the cells that they stand on.

A wall stands where one side of a border is built and the other is not, at any height: between neighbours of different
heights it begins at the lower one's roof, and between equals there is none. A column of corners rises from each end
of a border; all walls that meet there use the same corners, so the surface is closed and its wedges are connected.
Lengths are whole millimetres while surfaces are made: corners are equal or they are not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.scenes.authoring.building_parts import Cell, outside
from calibray.support.extras import library

MILLIMETRE: Final = 0.001
WALL, WINDOW, ROOF, UNDERSIDE = range(4)
"""Kinds of surfaces."""

Point = tuple[int, int]
Edge = tuple[Point, Point]
Corner = tuple[int, int, int]
Stand = tuple[int, int, int]  # bottom [mm], top [mm], number of the building


@dataclass(frozen=True)
class Windows:
    """How outer walls are divided into wall and window: upright strips, by turns, a wall at both ends.

    The strips are as high as the wall, so the share holds at the height of every antenna, and the wall at the ends
    keeps the wedges at the corners of the building.

    Attributes:
        share: Share of window in every wall [1], from 0 to below 1.
        module: About how far the middles of two windows are apart [m].

    Raises:
        InputError: A number is out of its bounds.
    """

    share: float
    module: float = 6.0

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise InputError(f"window share = {self.share!r}: must be from 0 to below 1")
        if not (np.isfinite(self.module) and self.module > 0):
            raise InputError(f"module = {self.module!r}: must be a finite number of metres greater than 0")

    def divide(self, edge: Edge) -> list[tuple[Point, int]]:
        """Divide a wall.

        Args:
            edge: Its two ends [mm].

        Returns:
            Where the strips begin, from the first end, and whether each is `WALL` or `WINDOW`.

        Example:
            >>> Windows(0.5, module=2.0).divide(((0, 0), (2000, 0)))
            [((0, 0), 0), ((500, 0), 1), ((1500, 0), 0)]
        """
        start, end = (np.array(point, dtype=float) for point in edge)
        count = max(1, round(float(np.hypot(*(end - start))) * MILLIMETRE / self.module))
        wall, window = (1.0 - self.share) / (count + 1), self.share / count
        shares = np.cumsum([0.0, *([wall, window] * count)])
        points = np.rint(start + (end - start) * shares[:, None]).astype(int)
        strips = [((int(x), int(y)), (WALL, WINDOW)[index % 2]) for index, (x, y) in enumerate(points)]
        # A strip that is thinner than the rounding is none.
        return [
            strip
            for strip, after in zip(strips, [*strips[1:], (edge[1], WALL)], strict=True)
            if strip[0] != after[0]
        ]


@dataclass(frozen=True, eq=False)
class Shell:
    """Triangles of buildings.

    Attributes:
        corners: Corners, counter-clockwise seen from outside [F, 3, 3], [mm].
        owner: Number of the building that each belongs to [F].
        kind: `WALL`, `WINDOW`, `ROOF` or `UNDERSIDE` [F].
    """

    corners: NDArray[np.int64]
    owner: NDArray[np.int64]
    kind: NDArray[np.int64]


def extrude(
    cells: Sequence[Cell], windows: Windows | None = None, ground: NDArray[np.float64] | None = None
) -> Shell:
    """Raise buildings on their cells.

    Args:
        cells: The cells, their stands in the scene's frame.
        windows: How walls are divided; None for walls without windows.
        ground: Height of the ground under every building [n], [m]: what stands on it stays open below. None closes all.

    Returns:
        The shell: closed, but for the bottoms that were to stay open.
    """
    outlines = [_rings(cell.polygon) for cell in cells]
    standing = [
        tuple((_whole(low), _whole(high), owner) for low, high, owner in cell.stands) for cell in cells
    ]
    cell_of = {edge: index for index, rings in enumerate(outlines) for ring in rings for edge in _edges(ring)}
    walls = {edge: _walls(standing, cell_of, edge) for edge in cell_of}
    strips = _strips(walls, windows)
    triangles: list[tuple[Corner, Corner, Corner]] = []
    owner: list[int] = []
    kind: list[int] = []
    levels = _columns(walls, strips)
    for (start, end), stands in walls.items():
        points = strips.get((start, end), [(start, WALL)])
        for (left, strip), (right, _) in pairwise([*points, (end, WALL)]):
            for low, high, building in stands:
                made = list(upright(left, right, levels[left], levels[right], low, high))
                triangles += made
                owner += [building] * len(made)
                kind += [strip] * len(made)
    lids = _lids(
        outlines, standing, strips, None if ground is None else [_whole(height) for height in ground]
    )
    return Shell(
        np.concatenate([np.array(triangles, dtype=np.int64).reshape(-1, 3, 3), lids.corners]),
        np.concatenate([np.array(owner, dtype=np.int64), lids.owner]),
        np.concatenate([np.array(kind, dtype=np.int64), lids.kind]),
    )


def _whole(length: float) -> int:
    return round(length / MILLIMETRE)


def _rings(polygon: Any) -> list[list[Point]]:
    """Corners of the rings of a polygon, its inside to their left, the first corner not repeated."""
    oriented = library("shapely", "scenes").orient_polygons(polygon)
    rings = (oriented.exterior, *oriented.interiors)
    return [[(_whole(x), _whole(y)) for x, y in ring.coords[:-1]] for ring in rings]


def _edges(ring: Sequence[Point]) -> Iterator[Edge]:
    return pairwise([*ring, ring[0]])


def _walls(standing: Sequence[tuple[Stand, ...]], cell_of: dict[Edge, int], edge: Edge) -> list[Stand]:
    """What stands to the left of an edge and not to its right [mm]."""
    twin = cell_of.get((edge[1], edge[0]))
    rest = list(standing[cell_of[edge]])
    for low, high, _ in standing[twin] if twin is not None else ():
        rest = [part for one in rest for part in outside(one, low, high)]
    return rest


def _strips(walls: dict[Edge, list[Stand]], windows: Windows | None) -> dict[Edge, list[tuple[Point, int]]]:
    """Where the strips of every edge with a wall begin; both directions of an edge have the same corners."""
    if windows is None or windows.share == 0:
        return {}
    strips: dict[Edge, list[tuple[Point, int]]] = {}
    for edge, stands in walls.items():
        if stands:
            start, end = min(edge), max(edge)
            strips[start, end] = forth = windows.divide((start, end))
            ends = [*(point for point, _ in forth[1:]), end]
            strips[end, start] = [(point, strip) for point, (_, strip) in zip(ends, forth, strict=True)][::-1]
    return strips


def _columns(
    walls: dict[Edge, list[Stand]], strips: dict[Edge, list[tuple[Point, int]]]
) -> dict[Point, list[int]]:
    """The heights at which some wall that meets a corner begins or ends [mm], ascending."""
    levels: dict[Point, set[int]] = defaultdict(set)
    for (start, end), stands in walls.items():
        heights = {height for low, high, _ in stands for height in (low, high)}
        for point in (end, *(point for point, _ in strips.get((start, end), [(start, WALL)]))):
            levels[point] |= heights
    return {point: sorted(heights) for point, heights in levels.items()}


def upright(
    left: Point, right: Point, left_levels: Iterable[int], right_levels: Iterable[int], low: int, high: int
) -> Iterator[tuple[Corner, Corner, Corner]]:
    """An upright rectangle as triangles, counter-clockwise seen from the right of the way from left to right.

    Args:
        left: x and y of one side [mm].
        right: x and y of the other [mm].
        left_levels: Heights of corners on the column over `left` [mm], ascending, both ends among them.
        right_levels: Those over `right`.
        low: Where it begins [mm].
        high: Where it ends [mm].

    Yields:
        Three corners of every triangle [mm].
    """
    here = [(*left, level) for level in left_levels if low <= level <= high]
    there = [(*right, level) for level in right_levels if low <= level <= high]
    i = j = 0
    while i < len(here) - 1 or j < len(there) - 1:
        if j < len(there) - 1 and (i == len(here) - 1 or there[j + 1][2] <= here[i + 1][2]):
            yield here[i], there[j], there[j + 1]
            j += 1
        else:
            yield here[i], there[j], here[i + 1]
            i += 1


def _lids(
    outlines: Sequence[list[list[Point]]],
    standing: Sequence[tuple[Stand, ...]],
    strips: dict[Edge, list[tuple[Point, int]]],
    ground: Sequence[int] | None,
) -> Shell:
    """Roofs, and undersides of what does not stand on the ground."""
    shapely = library("shapely", "scenes")
    rings = [[_with_strips(ring, strips) for ring in of_cell] for of_cell in outlines]
    polygons = np.array([shapely.Polygon(outer, holes) for outer, *holes in rings], dtype=object)
    triangles, cell = flat_triangles(polygons)
    first = np.searchsorted(cell, np.arange(len(polygons) + 1))
    corners, owner, kind = [np.zeros((0, 3, 3), dtype=np.int64)], [], []
    for index, stands in enumerate(standing):
        flat = triangles[first[index] : first[index + 1]]
        faces = [
            (high, building, ROOF)
            for low, high, building in stands
            if all(high != other[0] for other in stands)
        ]
        for low, _, building in stands:
            if all(low != other[1] for other in stands) and (ground is None or low > ground[building]):
                faces.append((low, building, UNDERSIDE))
        for height, building, face in faces:
            lid = np.concatenate([flat, np.full((len(flat), 3, 1), height)], axis=2)
            corners.append(lid if face == ROOF else lid[:, ::-1])
            owner += [building] * len(flat)
            kind += [face] * len(flat)
    return Shell(np.concatenate(corners), np.array(owner, dtype=np.int64), np.array(kind, dtype=np.int64))


def _with_strips(ring: Sequence[Point], strips: dict[Edge, list[tuple[Point, int]]]) -> list[Point]:
    return [point for edge in _edges(ring) for point, _ in strips.get(edge, [(edge[0], WALL)])]


def flat_triangles(polygons: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangulate polygons over their own corners.

    Args:
        polygons: Polygons, holes allowed [n], [mm].

    Returns:
        Corners of the triangles, counter-clockwise [F, 3, 2], [mm], and the polygon of each [F], ascending.
    """
    shapely = library("shapely", "scenes")
    parts, polygon = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    rings = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    triangles = np.rint(rings).astype(np.int64)
    (ax, ay), (bx, by) = (triangles[:, 1] - triangles[:, 0]).T, (triangles[:, 2] - triangles[:, 0]).T
    clockwise = ax * by - ay * bx < 0
    triangles[clockwise] = triangles[clockwise, ::-1]
    return triangles, polygon
