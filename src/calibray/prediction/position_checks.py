"""Remarks on positions of predicted links: beyond the scene, under the ground, inside a building."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.measurements.placement import POSITION_COLUMNS
from calibray.result.record import Record
from calibray.scenes import Triangles, read_triangles
from calibray.scenes.checks.positions import CLEARANCE
from calibray.study import Setup

BEYOND: Final = "beyond the scene"
UNDER: Final = "under the ground"
INSIDE: Final = "inside a building"

PAIRS: Final = 5_000_000
"""Number of triangle-point pairs that are compared at a time; each pair needs about 100 bytes."""


def remarks(result: Record, setup: Setup) -> NDArray[np.str_]:
    """A remark on the position of every link [links]; empty where the positions are plausible.

    Indoors, if most calibrated receivers are inside a building, that remark is omitted.
    """
    triangles, links = read_triangles(setup.scene), setup.links
    if not len(triangles.face):
        return np.full(len(links), "")
    indoors = is_indoors(result, triangles)
    by_end = []
    for end, points in (("transmitter", links.tx), ("receiver", links.rx)):
        locations = locate(triangles, points).tolist()
        by_end.append(
            [
                f"{end} {location}" if location and not (indoors and location == INSIDE) else ""
                for location in locations
            ]
        )
    joined = [", ".join(filter(None, ends)) for ends in zip(*by_end, strict=True)]
    return np.array(joined, dtype=np.str_)


def is_indoors(result: Record, triangles: Triangles) -> bool:
    """Whether most calibrated receivers are inside a building; False if their positions are unknown."""
    if not set(POSITION_COLUMNS) <= set(result.links):
        return False
    receivers = result.links[list(POSITION_COLUMNS[3:])].to_numpy(float)
    return bool(np.mean(locate(triangles, receivers) == INSIDE) > 0.5)


def locate(triangles: Triangles, points: NDArray[np.float64]) -> NDArray[np.str_]:
    """The location of every point [n, 3], [m]: `BEYOND`, `UNDER` or `INSIDE`; empty in the open.

    A point is inside a building if a vertical ray upwards crosses an odd number of surfaces, as in any closed body.
    Sheets under the whole scene are ground.
    """
    if not len(triangles.face):
        return np.full(len(points), "")
    # Sorted by x.
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    corners = triangles.corners
    scene_low, scene_high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    over_building, ground, ground_below = (np.zeros(len(unique), dtype=int) for _ in range(3))
    for batch, point, height in _crossed_triangles(corners, unique):
        above = height > unique[point, 2] + CLEARANCE
        is_ground = triangles.ground[batch]
        np.add.at(over_building, point, above & ~is_ground)
        np.add.at(ground, point, is_ground)
        np.add.at(ground_below, point, is_ground & ~above)
    beyond = ((unique[:, :2] < scene_low[:2]) | (unique[:, :2] > scene_high[:2])).any(axis=1)
    under = ((ground > 0) & (ground_below == 0)) | (unique[:, 2] < scene_low[2] - CLEARANCE)
    location = np.select([beyond, under, over_building % 2 == 1], [BEYOND, UNDER, INSIDE], "")
    return location[inverse.reshape(-1)]


def _crossed_triangles(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
    """Triangles that vertical lines through points cross, in batches: triangle, point and height [m] of each crossing.

    The points [n, 3] are sorted by x.
    """
    # The lines are moved by a fraction of a micrometre: through an edge shared by two triangles they would cross both.
    x, y = points[:, 0] + 3.1e-7, points[:, 1] + 1.7e-7
    low, high = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    first = np.searchsorted(x, low[:, 0], "left")
    count = np.searchsorted(x, high[:, 0], "right") - first
    batch = np.cumsum(count) // PAIRS
    for members in np.split(np.arange(len(corners)), np.flatnonzero(np.diff(batch)) + 1):
        triangle = np.repeat(members, count[members])
        start = np.cumsum(count[members]) - count[members]
        point = np.arange(len(triangle)) + np.repeat(first[members] - start, count[members])
        near = (low[triangle, 1] <= y[point]) & (y[point] <= high[triangle, 1])
        triangle, point = triangle[near], point[near]
        origin = corners[triangle, 0]
        side_u, side_v = corners[triangle, 1] - origin, corners[triangle, 2] - origin
        area = side_u[:, 0] * side_v[:, 1] - side_u[:, 1] * side_v[:, 0]
        vertical = np.abs(area) <= 1e-12
        area = np.where(vertical, 1.0, area)
        east, north = x[point] - origin[:, 0], y[point] - origin[:, 1]
        # Barycentric coordinates of the line in the plane z = 0.
        u = (east * side_v[:, 1] - north * side_v[:, 0]) / area
        v = (north * side_u[:, 0] - east * side_u[:, 1]) / area
        crossed = (u >= 0) & (v >= 0) & (u + v < 1) & ~vertical
        height = origin[:, 2] + u * side_u[:, 2] + v * side_v[:, 2]
        yield triangle[crossed], point[crossed], height[crossed]
