"""Ground: which mesh it is, and how high it lies under places of a grid, whatever stands on it."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.meshes import Mesh
from calibray.scenes.triangles import Triangles

NEAR: Final = 1e-9
"""How far beyond a triangle's edge a place still lies over it, as a share of the triangle [1]."""


def ground_heights(
    triangles: Triangles, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Heights of the ground over a grid.

    Args:
        triangles: The scene.
        x: Eastings of the grid, ascending and equally spaced [nx], [m].
        y: Northings, likewise [ny], [m].

    Returns:
        Heights of the lowest sheet under the whole scene [ny, nx], [m]; where there is none, that of the scene's lowest
        point.
    """
    heights = np.full((len(y), len(x)), np.inf)
    corners = triangles.corners[triangles.ground]
    first = [_places(axis, corners[:, :, k].min(axis=1), "left") for k, axis in enumerate((x, y))]
    last = [_places(axis, corners[:, :, k].max(axis=1), "right") for k, axis in enumerate((x, y))]
    columns, rows = (end - start for start, end in zip(first, last, strict=True))
    owner = np.repeat(np.arange(len(corners)), columns * rows)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
    column = first[0][owner] + within % np.maximum(columns, 1)[owner]
    row = first[1][owner] + within // np.maximum(columns, 1)[owner]
    # Barycentric coordinates; a triangle that stands upright has none.
    origin, along, across = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    flat = np.where(area == 0, np.nan, area)[owner]
    east, north = x[column] - origin[owner, 0], y[row] - origin[owner, 1]
    u = (east * across[owner, 1] - north * across[owner, 0]) / flat
    v = (north * along[owner, 0] - east * along[owner, 1]) / flat
    over = (u >= -NEAR) & (v >= -NEAR) & (u + v <= 1 + NEAR)
    z = origin[owner, 2] + u * along[owner, 2] + v * across[owner, 2]
    np.minimum.at(heights, (row[over], column[over]), z[over])
    return np.where(np.isfinite(heights), heights, triangles.vertex[:, 2].min())


def _places(
    axis: NDArray[np.float64], value: NDArray[np.float64], side: Literal["left", "right"]
) -> NDArray[np.int64]:
    """Where values lie on an axis, a hair further out."""
    step = NEAR * max(float(np.ptp(axis)), 1.0) * (1 if side == "right" else -1)
    return np.searchsorted(axis, value + step, side=side)


def is_ground(mesh: Mesh, whole: NDArray[np.float64]) -> bool:
    """Whether a mesh is a sheet under the whole scene.

    Args:
        mesh: The mesh.
        whole: Extent of the scene to the east and to the north [2], [m].

    Returns:
        True if no face of it is steep, and it covers most of the scene.
    """
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    normal = np.cross(sides[:, 0], sides[:, 1])
    level = np.abs(normal[:, 2]) > 0.5 * np.linalg.norm(normal, axis=1)
    wide = (np.ptp(mesh.vertices[:, :2], axis=0) > 0.8 * whole).all()
    seen, extent = np.abs(normal[:, 2]).sum() / 2, float(np.prod(whole))
    return bool(level.all() and wide and seen > 0.5 * extent)
