"""Extrusion of buildings into walls, windows, roofs and undersides.

The ground is divided into adjacent cells. Each cell lists the buildings that cover it, with the heights of their
bottoms and tops. At heights where buildings overlap, the taller building is used. If the map contains parts of a
building, these parts replace the outline of the whole building. Adjacent cells have the same corners along their common
border, so walls and roofs that meet share their vertices.

A border has a wall at each height at which exactly one side of the border is inside a building. Between buildings of
different heights, the wall begins at the lower roof. Between buildings of equal height, there is no wall. All walls
that meet at an end of a border share one vertical column of corners, so the surface is closed and its wedges are
connected. Coordinates are whole millimetres, so corners are either identical or clearly different.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calibray.errors import InputError
from calibray.scenes.authoring.footprints import GRID, Footprints
from calibray.scenes.meshes import MILLIMETRE
from calibray.support.lazy_imports import library

Interval = tuple[float, float, int]
"""Bottom [m], top [m] and index of a building."""

Length = TypeVar("Length", int, float)

THINNEST: Final = GRID / 2
"""Minimum length of a height interval [m]; shorter intervals are rounding artefacts and are dropped."""


@dataclass(frozen=True, eq=False)
class Cell:
    """An area of ground (a shapely Polygon [m]) and its buildings' height intervals, sorted and without overlap."""

    polygon: Any
    stands: tuple[Interval, ...]


def split_overlaps(
    footprints: Footprints, bottom: NDArray[np.float64], top: NDArray[np.float64]
) -> tuple[list[Cell], int]:
    """Divide the area that buildings cover into cells; `bottom` and `top` [n] are their heights in the scene frame [m].

    Returns the cells and the number of footprints that overlap another footprint.
    """
    shapely = library("shapely", "scenes")
    tree = shapely.STRtree(footprints.polygon)
    first, second = tree.query(footprints.polygon, predicate="intersects")
    count = len(footprints)
    touching = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    _, cluster = connected_components(touching, directed=False)
    order = np.argsort(cluster, kind="stable")
    cells: list[Cell] = []
    overlapping = 0
    for members in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
        if len(members) == 1:
            single = int(members[0])
            stand = (float(bottom[single]), float(top[single]), single)
            cells += [Cell(part, (stand,)) for part in shapely.get_parts(footprints.polygon[single])]
            continue
        pieces, covers = _overlay(footprints.polygon[members])
        # Overlaps of at most 0.1 m^2 result from rounding to the grid.
        shared = (covers.sum(axis=0) > 1) & (shapely.area(pieces) > 0.1)
        overlapping += int(covers[:, shared].any(axis=1).sum())
        for piece, cover in zip(pieces, covers.T, strict=True):
            buildings = members[cover]
            if footprints.part[buildings].any():
                buildings = buildings[footprints.part[buildings]]
            stands = [(float(bottom[k]), float(top[k]), int(k)) for k in buildings]
            cells.append(Cell(piece, _stack(stands)))
    return cells, overlapping


def _overlay(polygons: NDArray[Any]) -> tuple[list[Any], NDArray[np.bool_]]:
    """Divide the ground along the borders of polygons; return the pieces and which polygons cover each [n, pieces]."""
    shapely = library("shapely", "scenes")
    borders = shapely.union_all(shapely.boundary(polygons), grid_size=GRID)
    pieces = shapely.get_parts(shapely.polygonize([borders]))
    inside = shapely.point_on_surface(pieces)
    covers = np.zeros((len(polygons), len(pieces)), dtype=bool)
    point, polygon = shapely.STRtree(polygons).query(inside, predicate="within")
    # Each piece is wholly inside or outside each polygon, so one point inside the piece is enough.
    covers[polygon, point] = True
    built = covers.any(axis=0)
    return list(pieces[built]), covers[:, built]


def _stack(stands: list[Interval]) -> tuple[Interval, ...]:
    """Assign every range of heights in which buildings overlap to the building with the highest top."""
    stack: list[Interval] = []
    for bottom, top, owner in sorted(stands, key=lambda stand: (-stand[1], stand[0], stand[2])):
        free = [(bottom, top, owner)]
        for taken_bottom, taken_top, _ in stack:
            free = [part for stand in free for part in subtract(stand, taken_bottom, taken_top)]
        stack += free
    return tuple(sorted(stack))


def subtract(
    interval: tuple[Length, Length, int], bottom: Length, top: Length
) -> list[tuple[Length, Length, int]]:
    """Subtract a range of heights from a building's interval; zero, one or two intervals of the building remain.

    Example:
        >>> subtract((0.0, 10.0, 7), 2.0, 4.0)
        [(0.0, 2.0, 7), (4.0, 10.0, 7)]
    """
    low, high, owner = interval
    parts = [(low, min(high, bottom), owner), (max(low, top), high, owner)]
    return [part for part in parts if part[1] - part[0] > THINNEST]


WALL, WINDOW, ROOF, UNDERSIDE = range(4)
"""Types of surface."""

Point = tuple[int, int]  # x, y [mm]
Edge = tuple[Point, Point]
Corner = tuple[int, int, int]  # x, y, z [mm]
Stand = tuple[int, int, int]  # bottom [mm], top [mm], index of the building
Strips = dict[Edge, list[tuple[Point, int]]]  # start and type of each strip of an edge


@dataclass(frozen=True)
class Windows:
    """Division of outer walls into alternating vertical strips of wall and window, with wall at both ends.

    The strips are as high as the wall, so windows cover the same fraction of the wall at every height. With a strip of
    wall at both ends, each wedge at a corner of the building consists of one material.

    Attributes:
        share: Fraction of each wall that is covered by windows, at least 0 and less than 1 [1].
        module: Approximate distance between the centres of adjacent windows [m].

    Raises:
        InputError: A number is out of bounds.
    """

    share: float
    module: float = 6.0

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise InputError(f"window share = {self.share!r}: must be at least 0 and less than 1")
        if not (np.isfinite(self.module) and self.module > 0):
            raise InputError(f"module = {self.module!r}: must be a finite number of metres greater than 0")

    def divide(self, edge: Edge) -> list[tuple[Point, int]]:
        """Divide the wall between two points [mm] into strips; return the start [mm] and type of each strip.

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
        # Drop strips whose ends coincide after rounding.
        return [
            strip
            for strip, following in zip(strips, [*strips[1:], (edge[1], WALL)], strict=True)
            if strip[0] != following[0]
        ]


@dataclass(frozen=True, eq=False)
class Shell:
    """The surfaces of buildings as triangles.

    Attributes:
        corners: Corners of each triangle [F, 3, 3], [mm], counter-clockwise when seen from outside.
        owner: Building index of each triangle [F].
        kind: Type of each triangle [F]: `WALL`, `WINDOW`, `ROOF` or `UNDERSIDE`.
    """

    corners: NDArray[np.int64]
    owner: NDArray[np.int64]
    kind: NDArray[np.int64]


def extrude(
    cells: Sequence[Cell], windows: Windows | None = None, ground: NDArray[np.float64] | None = None
) -> Shell:
    """Extrude the buildings of cells; all heights are in the scene's frame.

    Without `windows`, walls are not divided. `ground` [n] is the height of the ground under each building [m]. A body
    that stands on the ground is open at the bottom; any other body is closed. Without `ground`, all bodies are closed.
    """
    outlines = [_rings(cell.polygon) for cell in cells]
    standing = [
        tuple((to_millimetres(low), to_millimetres(high), owner) for low, high, owner in cell.stands)
        for cell in cells
    ]
    cell_of = {edge: index for index, rings in enumerate(outlines) for ring in rings for edge in _edges(ring)}
    walls = {edge: _wall_stands(standing, cell_of, edge) for edge in cell_of}
    strips = _strips(walls, windows)
    triangles: list[tuple[Corner, Corner, Corner]] = []
    owner: list[int] = []
    kind: list[int] = []
    levels = _columns(walls, strips)
    for (start, end), stands in walls.items():
        points = strips.get((start, end), [(start, WALL)])
        for (left, strip), (right, _) in pairwise([*points, (end, WALL)]):
            for low, high, building in stands:
                wall = list(wall_triangles(left, right, levels[left], levels[right], low, high))
                triangles += wall
                owner += [building] * len(wall)
                kind += [strip] * len(wall)
    lids = _lids(
        outlines, standing, strips, None if ground is None else [to_millimetres(height) for height in ground]
    )
    return Shell(
        np.concatenate([np.array(triangles, dtype=np.int64).reshape(-1, 3, 3), lids.corners]),
        np.concatenate([np.array(owner, dtype=np.int64), lids.owner]),
        np.concatenate([np.array(kind, dtype=np.int64), lids.kind]),
    )


def to_millimetres(length: float) -> int:
    """Round a length [m] to whole millimetres."""
    return round(length / MILLIMETRE)


def _rings(polygon: Any) -> list[list[Point]]:
    """Corners of each ring of a polygon, ordered with the interior to the left; the first corner is not repeated."""
    oriented = library("shapely", "scenes").orient_polygons(polygon)
    rings = (oriented.exterior, *oriented.interiors)
    return [[(to_millimetres(x), to_millimetres(y)) for x, y in ring.coords[:-1]] for ring in rings]


def _edges(ring: Sequence[Point]) -> Iterator[Edge]:
    return pairwise([*ring, ring[0]])


def _wall_stands(standing: Sequence[tuple[Stand, ...]], cell_of: dict[Edge, int], edge: Edge) -> list[Stand]:
    """The buildings to the left of an edge, limited to heights [mm] at which no building is to the right."""
    opposite = cell_of.get((edge[1], edge[0]))
    free = list(standing[cell_of[edge]])
    for low, high, _ in standing[opposite] if opposite is not None else ():
        free = [part for stand in free for part in subtract(stand, low, high)]
    return free


def _strips(walls: dict[Edge, list[Stand]], windows: Windows | None) -> Strips:
    """The strips of each edge that has a wall; both directions of an edge have the same corners."""
    if windows is None or windows.share == 0:
        return {}
    strips: Strips = {}
    for edge, stands in walls.items():
        if stands:
            # Each edge is divided in one direction only, because rounding from the other end could differ by a
            # millimetre.
            start, end = min(edge), max(edge)
            forward = windows.divide((start, end))
            ends = [*(point for point, _ in forward[1:]), end]
            strips[start, end] = forward
            strips[end, start] = [(point, kind) for point, (_, kind) in zip(ends, forward, strict=True)][::-1]
    return strips


def _columns(walls: dict[Edge, list[Stand]], strips: Strips) -> dict[Point, list[int]]:
    """For each corner, the heights [mm] at which the walls that meet there begin or end, in ascending order."""
    levels: dict[Point, set[int]] = defaultdict(set)
    for (start, end), stands in walls.items():
        heights = {height for low, high, _ in stands for height in (low, high)}
        for point in (end, *(point for point, _ in strips.get((start, end), [(start, WALL)]))):
            levels[point] |= heights
    return {point: sorted(heights) for point, heights in levels.items()}


def wall_triangles(
    left: Point, right: Point, left_levels: Iterable[int], right_levels: Iterable[int], low: int, high: int
) -> Iterator[tuple[Corner, Corner, Corner]]:
    """Divide a vertical rectangle into triangles, counter-clockwise for an observer to the right of its base line.

    The base line runs from `left` to `right`, which are the x and y coordinates of the two vertical sides.
    `left_levels` and `right_levels` are the heights of the corners on these sides, in ascending order and including
    both ends. Yields the corners of each triangle [mm].
    """
    left_column = [(*left, level) for level in left_levels if low <= level <= high]
    right_column = [(*right, level) for level in right_levels if low <= level <= high]
    # Both sides are followed upwards: a step up one side forms a triangle with the current corner on the other side.
    i = j = 0
    while i < len(left_column) - 1 or j < len(right_column) - 1:
        left_done, right_done = i == len(left_column) - 1, j == len(right_column) - 1
        if not right_done and (left_done or right_column[j + 1][2] <= left_column[i + 1][2]):
            yield left_column[i], right_column[j], right_column[j + 1]
            j += 1
        else:
            yield left_column[i], right_column[j], left_column[i + 1]
            i += 1


def _lids(
    outlines: Sequence[list[list[Point]]],
    standing: Sequence[tuple[Stand, ...]],
    strips: Strips,
    ground: Sequence[int] | None,
) -> Shell:
    """Roofs, and undersides of bodies that do not stand on the ground."""
    shapely = library("shapely", "scenes")
    rings = [[_with_strips(ring, strips) for ring in cell_rings] for cell_rings in outlines]
    polygons = np.array([shapely.Polygon(outer, holes) for outer, *holes in rings], dtype=object)
    triangles, cell = triangulate(polygons)
    first = np.searchsorted(cell, np.arange(len(polygons) + 1))
    corners, owner, kind = [np.zeros((0, 3, 3), dtype=np.int64)], [], []
    for index, stands in enumerate(standing):
        flat = triangles[first[index] : first[index + 1]]
        # Where two bodies touch, one above the other, there is no roof or underside.
        bottoms, tops = {low for low, _, _ in stands}, {high for _, high, _ in stands}
        lids = [(high, building, ROOF) for _, high, building in stands if high not in bottoms]
        lids += [
            (low, building, UNDERSIDE)
            for low, _, building in stands
            if low not in tops and (ground is None or low > ground[building])
        ]
        for height, building, face in lids:
            lid = np.concatenate([flat, np.full((len(flat), 3, 1), height)], axis=2)
            corners.append(lid if face == ROOF else lid[:, ::-1])
            owner += [building] * len(flat)
            kind += [face] * len(flat)
    return Shell(np.concatenate(corners), np.array(owner, dtype=np.int64), np.array(kind, dtype=np.int64))


def _with_strips(ring: Sequence[Point], strips: Strips) -> list[Point]:
    return [point for edge in _edges(ring) for point, _ in strips.get(edge, [(edge[0], WALL)])]


def triangulate(polygons: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangulate polygons [n], [mm], without adding corners; polygons may have holes.

    Returns the corners [F, 3, 2], [mm], of the triangles, in counter-clockwise order, and the polygon index of each
    triangle [F], in ascending order.
    """
    shapely = library("shapely", "scenes")
    parts, polygon = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    rings = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    triangles = np.rint(rings).astype(np.int64)
    (ax, ay), (bx, by) = (triangles[:, 1] - triangles[:, 0]).T, (triangles[:, 2] - triangles[:, 0]).T
    clockwise = ax * by - ay * bx < 0
    triangles[clockwise] = triangles[clockwise, ::-1]
    return triangles, polygon
