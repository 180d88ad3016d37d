"""Remarks on positions of predicted links: beyond the scene, under the ground, inside a building."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.result.record import Record
from calibray.scenes import Triangles, read_triangles
from calibray.study import Setup

BEYOND: Final = "beyond the scene"
UNDER: Final = "under the ground"
INSIDE: Final = "inside a building"

CLEARANCE: Final = 0.05
"""Height above an antenna from which a surface counts as above it [m]."""

POSITION_COLUMNS: Final = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
"""Columns of a table of links with the positions of both ends [m]."""


def remarks(result: Record, setup: Setup) -> NDArray[np.str_]:
    """Remarks on the positions of links.

    Indoors, where most calibrated receivers are inside a building, that remark is omitted.

    Args:
        result: The calibration.
        setup: Its study, opened for the links.

    Returns:
        A remark for every link [links]; empty where the positions are plausible.
    """
    triangles, links = read_triangles(setup.scene), setup.links
    if not len(triangles.face):
        return np.full(len(links), "")
    indoors = False
    if set(POSITION_COLUMNS) <= set(result.links):
        measured = result.links[list(POSITION_COLUMNS)].to_numpy(float)
        indoors = bool(np.mean(locate(triangles, measured[:, 3:]) == INSIDE) > 0.5)
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


def locate(triangles: Triangles, points: NDArray[np.float64]) -> NDArray[np.str_]:
    """Find points that are beyond the scene, under the ground or inside a building.

    A point is inside a building if a vertical ray upwards crosses an odd number of surfaces, as in any closed body.
    Sheets under the whole scene are ground.

    Args:
        triangles: The scene.
        points: The points [n, 3], [m].

    Returns:
        The location of every point [n], one of `BEYOND`, `UNDER` and `INSIDE`; empty in the open.
    """
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    corners = triangles.corners
    low, high = corners.min(axis=1), corners.max(axis=1)
    scene_low, scene_high = low.min(axis=0), high.max(axis=0)
    location = np.full(len(unique), "", dtype="<U20")
    for index, point in enumerate(unique):
        if (point[:2] < scene_low[:2]).any() or (point[:2] > scene_high[:2]).any():
            location[index] = BEYOND
            continue
        near = ((low[:, :2] <= point[:2]) & (point[:2] <= high[:, :2])).all(axis=1)
        crossed, height = _crossed_triangles(corners[near], point)
        ground = triangles.ground[near][crossed]
        above = height > point[2] + CLEARANCE
        if (ground.any() and above[ground].all()) or point[2] < scene_low[2] - CLEARANCE:
            location[index] = UNDER
        elif np.count_nonzero(above & ~ground) % 2:
            location[index] = INSIDE
    return location[inverse.reshape(-1)]


def _crossed_triangles(
    corners: NDArray[np.float64], point: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices of the triangles that a vertical line through a point crosses, and the heights [m]."""
    origin, side_u, side_v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = side_u[:, 0] * side_v[:, 1] - side_u[:, 1] * side_v[:, 0]
    not_vertical = np.flatnonzero(np.abs(area) > 1e-12)
    origin, side_u, side_v, area = (
        origin[not_vertical], side_u[not_vertical], side_v[not_vertical], area[not_vertical],
    )  # fmt: skip
    # The line is moved by a fraction of a micrometre: through an edge shared by two triangles it would cross both.
    east, north = (point[:2] + np.array([3.1e-7, 1.7e-7]) - origin[:, :2]).T
    # Barycentric coordinates of the line in the plane z = 0.
    u = (east * side_v[:, 1] - north * side_v[:, 0]) / area
    v = (north * side_u[:, 0] - east * side_u[:, 1]) / area
    crossed = (u >= 0) & (v >= 0) & (u + v < 1)
    height = origin[:, 2] + u * side_u[:, 2] + v * side_v[:, 2]
    return not_vertical[crossed], height[crossed]
