"""Cells: buildings that touch or overlap, taken apart into pieces of ground that lie side by side.

Over each cell every building that covers it stands once, between its bottom and its top. Where buildings overlap the
taller one owns the ground; where parts of a building are drawn, they tell more than its outline, which then counts
only where no part is. Two neighbouring cells have the same corners along their common border, whoever drew them, so
walls and roofs that meet share their vertices.
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
"""Bottom [m], top [m] and number of the building that stands between them."""

Length = TypeVar("Length", int, float)

SLIVER: Final = 0.1
"""Overlaps of less area [m^2] come from the grid and are not counted."""

THINNEST: Final = 0.005  # [m], half of the grid: what is thinner is an artefact of it


@dataclass(frozen=True, eq=False)
class Cell:
    """A piece of ground, and what stands on it.

    Attributes:
        polygon: Its outline, a shapely Polygon [m].
        stands: The buildings on it, from below, not overlapping.
    """

    polygon: Any
    stands: tuple[Interval, ...]


def take_apart(
    footprints: Footprints, bottom: NDArray[np.float64], top: NDArray[np.float64]
) -> tuple[list[Cell], int]:
    """Take buildings apart into cells.

    Args:
        footprints: The buildings.
        bottom: Where each begins [n], [m], in the scene's frame.
        top: Where each ends [n], [m].

    Returns:
        The cells, and how many footprints share ground with another one.
    """
    shapely = library("shapely", "scenes")
    tree = shapely.STRtree(footprints.polygon)
    first, second = tree.query(footprints.polygon, predicate="intersects")
    count = len(footprints)
    touching = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    _, cluster = connected_components(touching, directed=False)
    order = np.argsort(cluster, kind="stable")
    cells: list[Cell] = []
    cut = 0
    for members in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
        if len(members) == 1:
            alone = int(members[0])
            stand = (float(bottom[alone]), float(top[alone]), alone)
            cells += [Cell(part, (stand,)) for part in shapely.get_parts(footprints.polygon[alone])]
            continue
        pieces, covers = _overlay(footprints.polygon[members])
        twice = (covers.sum(axis=0) > 1) & (shapely.area(pieces) > SLIVER)
        cut += int(covers[:, twice].any(axis=1).sum())
        for piece, cover in zip(pieces, covers.T, strict=True):
            here = members[cover]
            if footprints.part[here].any():
                here = here[footprints.part[here]]
            cells.append(
                Cell(piece, _stacked([(float(bottom[one]), float(top[one]), int(one)) for one in here]))
            )
    return cells, cut


def _overlay(polygons: NDArray[Any]) -> tuple[list[Any], NDArray[np.bool_]]:
    """The pieces that all borders together cut the ground into, and which polygon covers which [n, pieces]."""
    shapely = library("shapely", "scenes")
    borders = shapely.union_all(shapely.boundary(polygons), grid_size=GRID)
    pieces = shapely.get_parts(shapely.polygonize([borders]))
    inside = shapely.point_on_surface(pieces)
    covers = np.zeros((len(polygons), len(pieces)), dtype=bool)
    point, polygon = shapely.STRtree(polygons).query(inside, predicate="within")
    covers[polygon, point] = True
    built = covers.any(axis=0)
    return list(pieces[built]), covers[:, built]


def _stacked(stands: list[Interval]) -> tuple[Interval, ...]:
    """Intervals without overlaps: what is covered twice belongs to the one with the higher top."""
    free: list[Interval] = []
    for bottom, top, owner in sorted(stands, key=lambda stand: (-stand[1], stand[0], stand[2])):
        remains = [(bottom, top, owner)]
        for taken_bottom, taken_top, _ in free:
            remains = [rest for one in remains for rest in outside(one, taken_bottom, taken_top)]
        free += remains
    return tuple(sorted(free))


def outside(
    interval: tuple[Length, Length, int], bottom: Length, top: Length
) -> list[tuple[Length, Length, int]]:
    """What is left of an interval outside another.

    Args:
        interval: The interval.
        bottom: Where the other begins [m].
        top: Where it ends [m].

    Returns:
        None, one or two intervals of the same owner.

    Example:
        >>> outside((0.0, 10.0, 7), 2.0, 4.0)
        [(0.0, 2.0, 7), (4.0, 10.0, 7)]
    """
    low, high, owner = interval
    parts = [(low, min(high, bottom), owner), (max(low, top), high, owner)]
    return [part for part in parts if part[1] - part[0] > THINNEST]
