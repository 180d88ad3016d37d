"""Remarks on places that predictions are asked for: beyond the scene, under the ground, inside a building."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.measurements import Measurements
from calibray.result.record import Record
from calibray.scenes import Triangles, read_triangles
from calibray.study import Setup

BEYOND: Final = "beyond the scene"
UNDER: Final = "under the ground"
INSIDE: Final = "inside a building"

CLEARANCE: Final = 0.05
"""How far an antenna must be below a surface for this to count as above it [m]."""

PLACES: Final = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")


def remarks(result: Record, setup: Setup) -> NDArray[np.str_]:
    """What is to be said of links that are predicted.

    Where most links of the calibration stand inside buildings themselves, as indoors, that is not worth saying.

    Args:
        result: The calibration.
        setup: Its study, opened for the links.

    Returns:
        A remark for each link [n]; empty where nothing is odd.
    """
    triangles = read_triangles(setup.scene)
    if not len(triangles.face):
        return np.full(len(setup.links), "")
    indoors = False
    if set(PLACES) <= set(result.links):
        measured = result.links[list(PLACES)].to_numpy(float)
        indoors = bool(np.mean(standing(triangles, measured[:, 3:]) == INSIDE) > 0.5)
    said = [
        [
            f"{end} {where}" if where and not (indoors and where == INSIDE) else ""
            for where in standing(triangles, points).tolist()
        ]
        for end, points in _ends(setup.links)
    ]
    return np.array([", ".join(filter(None, each)) for each in zip(*said, strict=True)], dtype=np.str_)


def standing(triangles: Triangles, points: NDArray[np.float64]) -> NDArray[np.str_]:
    """Where points stand, if not in the open.

    A point is inside a building if it has an odd number of surfaces above it, as inside any closed body; sheets under
    the whole scene are ground.

    Args:
        triangles: The scene.
        points: The points [n, 3], [m].

    Returns:
        What stands for it in words [n]; empty in the open.
    """
    place, back = np.unique(points, axis=0, return_inverse=True)
    corners = triangles.corners
    low, high = corners.min(axis=1), corners.max(axis=1)
    every_low, every_high = low.min(axis=0), high.max(axis=0)
    found = np.full(len(place), "", dtype="<U20")
    for index, point in enumerate(place):
        if (point[:2] < every_low[:2]).any() or (point[:2] > every_high[:2]).any():
            found[index] = BEYOND
            continue
        near = ((low[:, :2] <= point[:2]) & (point[:2] <= high[:, :2])).all(axis=1)
        over, height = _crossed(corners[near], point)
        ground = triangles.ground[near][over]
        above = height > point[2] + CLEARANCE
        if (ground.any() and above[ground].all()) or point[2] < every_low[2] - CLEARANCE:
            found[index] = UNDER
        elif np.count_nonzero(above & ~ground) % 2:
            found[index] = INSIDE
    return found[back.reshape(-1)]


def _crossed(
    corners: NDArray[np.float64], point: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Which triangles a vertical line through a point meets, and at what heights."""
    origin, along, across = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    lying = np.flatnonzero(np.abs(area) > 1e-12)
    origin, along, across, area = (each[lying] for each in (origin, along, across, area))
    # A hair aside, for a line through an edge that two triangles share would meet both.
    east, north = (point[:2] + np.array([3.1e-7, 1.7e-7]) - origin[:, :2]).T
    u = (east * across[:, 1] - north * across[:, 0]) / area
    v = (north * along[:, 0] - east * along[:, 1]) / area
    met = (u >= 0) & (v >= 0) & (u + v < 1)
    height = origin[:, 2] + u * along[:, 2] + v * across[:, 2]
    return lying[met], height[met]


def _ends(links: Measurements) -> tuple[tuple[str, NDArray[np.float64]], ...]:
    return ("transmitter", links.tx), ("receiver", links.rx)
