"""Regions of extra loss, such as trees: upright prisms over polygons, through which rays pass undeflected."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibray.support.lazy_imports import library

UPRIGHT = 1e-6
"""Length in plan below which a line counts as upright [m]."""


@dataclass(frozen=True, eq=False)
class Region:
    """Prisms over polygons in plan; where they overlap, they count once.

    Attributes:
        outline: Shapely polygons [n] in the scene's frame [m].
        bottom: Height at which each begins [n], [m].
        top: Height at which each ends [n], [m].
    """

    outline: NDArray[Any]
    bottom: NDArray[np.float64]
    top: NDArray[np.float64]

    def length_inside(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Length inside the region [k], [m], of straight lines from `start` to `end` [k, 3], [m].

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

        lines = shapely.linestrings(np.stack([start[:, :2], end[:, :2]], axis=1))
        line, prism = shapely.STRtree(self.outline).query(lines, predicate="intersects")
        low, high = _between(start[line, 2], end[line, 2], self.bottom[prism], self.top[prism])
        near = high > low
        line, prism, low, high = line[near], prism[near], low[near], high[near]
        step = (end - start)[line]
        plan = np.hypot(step[:, 0], step[:, 1])
        upright = plan < UPRIGHT
        spans = [np.column_stack([line, low, high])[upright]]
        sloping = np.flatnonzero(~upright)
        parts, of = shapely.get_parts(
            shapely.intersection(lines[line[sloping]], self.outline[prism[sloping]]), return_index=True
        )
        piece = shapely.get_type_id(parts) == 1  # a touched corner is a point
        parts, of = parts[piece], sloping[of[piece]]
        ends = np.stack([shapely.get_coordinates(shapely.get_point(parts, k)) for k in (0, -1)], axis=1)
        away = ((ends - start[line[of], None, :2]) * step[of, None, :2]).sum(axis=2) / plan[of, None] ** 2
        away = np.clip(np.sort(away, axis=1), low[of, None], high[of, None])
        spans.append(np.column_stack([line[of], away])[away[:, 1] > away[:, 0]])
        for number, lower, upper in united(np.concatenate(spans)):
            np.add.at(total, number, upper - lower)
        return total * np.linalg.norm(end - start, axis=1)


def united(
    spans: NDArray[np.float64],
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
    """The union of spans (line, lower, upper) that may overlap: line, lower and upper end of each piece."""
    count = len(spans)
    if not count:
        return
    event = np.concatenate([spans[:, [0, 1]], spans[:, [0, 2]]])
    change = np.repeat([1, -1], count)
    order = np.lexsort((-change, event[:, 1], event[:, 0]))
    depth = np.cumsum(change[order])
    begins = (depth == 1) & (change[order] == 1)
    ends = depth == 0
    line = event[order][begins, 0].astype(np.int64)
    yield line, event[order][begins, 1], event[order][ends, 1]


def _between(
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    bottom: NDArray[np.float64],
    top: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The part of lines between two heights, as shares of the line [k] each; empty if low exceeds high."""
    rise = last - first
    level = np.abs(rise) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.sort([(bottom - first) / rise, (top - first) / rise], axis=0)
    inside = (first > bottom) & (first < top)
    low = np.where(level, 0.0, np.clip(shares[0], 0.0, 1.0))
    high = np.where(level, np.where(inside, 1.0, 0.0), np.clip(shares[1], 0.0, 1.0))
    return low, high
