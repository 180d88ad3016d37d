"""Overlapping buildings, divided into cells: pieces of ground that lie side by side.

In each cell every building that covers it stands once, between its bottom and its top. Where buildings overlap, the
taller one owns the ground. Where parts of a building are mapped, they replace the building's outline. Neighbouring
cells have the same corners along their common border, so walls and roofs that meet share their vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calibray.scenes.authoring.footprints import GRID, Footprints
from calibray.support.extras import library

Interval = tuple[float, float, int]
"""Bottom [m] and top [m] of a building, and its number."""

Length = TypeVar("Length", int, float)

SLIVER: Final = 0.1
"""Overlaps of less area come from rounding to the grid and are not counted [m^2]."""

THINNEST: Final = GRID / 2
"""Intervals thinner than this come from rounding and are dropped [m]."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A piece of ground and the buildings on it.

    Attributes:
        polygon: Its outline, a shapely Polygon [m].
        stands: The buildings on it, from below, not overlapping.
    """

    polygon: Any
    stands: tuple[Interval, ...]


def split_overlaps(
    footprints: Footprints, bottom: NDArray[np.float64], top: NDArray[np.float64]
) -> tuple[list[Cell], int]:
    """Divide buildings into cells, given the heights [m] at which each begins and ends in the scene's frame [n].

    Returns the cells, and the number of footprints that share ground with another one.
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
        shared = (covers.sum(axis=0) > 1) & (shapely.area(pieces) > SLIVER)
        overlapping += int(covers[:, shared].any(axis=1).sum())
        for piece, cover in zip(pieces, covers.T, strict=True):
            buildings = members[cover]
            if footprints.part[buildings].any():
                buildings = buildings[footprints.part[buildings]]
            stands = [(float(bottom[k]), float(top[k]), int(k)) for k in buildings]
            cells.append(Cell(piece, _stack(stands)))
    return cells, overlapping


def _overlay(polygons: NDArray[Any]) -> tuple[list[Any], NDArray[np.bool_]]:
    """The pieces into which all borders cut the ground, and which polygon covers which piece [n, pieces]."""
    shapely = library("shapely", "scenes")
    borders = shapely.union_all(shapely.boundary(polygons), grid_size=GRID)
    pieces = shapely.get_parts(shapely.polygonize([borders]))
    inside = shapely.point_on_surface(pieces)
    covers = np.zeros((len(polygons), len(pieces)), dtype=bool)
    point, polygon = shapely.STRtree(polygons).query(inside, predicate="within")
    covers[polygon, point] = True
    built = covers.any(axis=0)
    return list(pieces[built]), covers[:, built]


def _stack(stands: list[Interval]) -> tuple[Interval, ...]:
    """Resolve overlaps in height: what two buildings share belongs to the one with the higher top."""
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
    """Subtract a range of heights from an interval: none, one or two intervals of the same owner.

    Example:
        >>> subtract((0.0, 10.0, 7), 2.0, 4.0)
        [(0.0, 2.0, 7), (4.0, 10.0, 7)]
    """
    low, high, owner = interval
    parts = [(low, min(high, bottom), owner), (max(low, top), high, owner)]
    return [part for part in parts if part[1] - part[0] > THINNEST]
