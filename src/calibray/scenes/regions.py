"""Regions of extra loss, such as trees: upright prisms over polygons, which rays pass undeflected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibray.support.lazy_imports import library


@dataclass(frozen=True, eq=False)
class Region:
    """Prisms over polygons in plan.

    Attributes:
        outline: Shapely polygons [n] in the scene's frame [m]; where they overlap, they count once.
        bottom: Height at which each begins [n], [m].
        top: Height at which each ends [n], [m].
    """

    outline: NDArray[Any]
    bottom: NDArray[np.float64]
    top: NDArray[np.float64]

    def length_inside(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Length of straight lines inside the region.

        Prisms of equal heights are united first; prisms of different heights must not overlap.

        Args:
            start: One end of each line [k, 3], [m].
            end: The other end [k, 3], [m].

        Returns:
            The lengths [k], [m].

        Raises:
            InputError: shapely is not installed.

        Example:
            >>> import shapely
            >>> belt = Region(np.array([shapely.box(10, -5, 30, 5)]), np.zeros(1), np.full(1, 8.0))
            >>> start, end = np.array([[0, 0, 2.0], [0, 0, 9.0]]), np.array([[40, 0, 2.0], [40, 0, 9.0]])
            >>> belt.length_inside(start, end).tolist()
            [20.0, 0.0]
        """
        shapely = library("shapely", "scenes")
        total = np.zeros(len(start))
        heights, of = np.unique(np.column_stack([self.bottom, self.top]), axis=0, return_inverse=True)
        for number, (bottom, top) in enumerate(heights.tolist()):
            area = shapely.union_all(self.outline[of.reshape(-1) == number])
            shapely.prepare(area)
            low, high = _between(start[:, 2], end[:, 2], bottom, top)
            first, last = (start + share[:, None] * (end - start) for share in (low, high))
            lines = shapely.linestrings(np.stack([first[:, :2], last[:, :2]], axis=1))
            near = np.flatnonzero((high > low) & shapely.intersects(area, lines))
            plan = shapely.length(lines[near])
            inside = shapely.length(shapely.intersection(lines[near], area))
            # An upright line has no length in plan: it is inside or not.
            upright = plan < 1e-6
            share = np.where(upright, 1.0, inside / np.where(upright, 1.0, plan))
            total[near] += share * np.linalg.norm(last[near] - first[near], axis=1)
        return total


def _between(
    first: NDArray[np.float64], last: NDArray[np.float64], bottom: float, top: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The part of lines between two heights, as shares of the line [k] each; empty where low exceeds high."""
    rise = last - first
    level = np.abs(rise) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.sort([(bottom - first) / rise, (top - first) / rise], axis=0)
    inside = (first > bottom) & (first < top)
    low = np.where(level, 0.0, np.clip(shares[0], 0.0, 1.0))
    high = np.where(level, np.where(inside, 1.0, 0.0), np.clip(shares[1], 0.0, 1.0))
    return low, high
