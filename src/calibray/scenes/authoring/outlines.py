"""Outlines: what buildings cover of the ground, and positions led out of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.scenes.authoring.ground import is_ground
from calibray.scenes.checks.scene_check import read_meshes
from calibray.scenes.scene_file import find_scene
from calibray.support.extras import library


def outlines(source: str | Path, height: float = 2.0) -> Any:
    """What the bodies of a scene cover, seen from above.

    Args:
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        height: Faces below this [m] over the lowest of the scene cover nothing: kerbs, floors, the ground.

    Returns:
        A shapely Polygon or MultiPolygon [m], empty if there is nothing.

    Raises:
        InputError: The scene cannot be read, or shapely or trimesh is not installed.
    """
    shapely = library("shapely", "scenes")
    path, root = find_scene(source)
    meshes = [mesh for _, _, mesh in read_meshes(path, root)]
    whole = np.ptp(np.concatenate([mesh.vertices[:, :2] for mesh in meshes]), axis=0)
    lowest = min(mesh.vertices[:, 2].min() for mesh in meshes)
    triangles = [mesh.vertices[mesh.faces] for mesh in meshes if not is_ground(mesh, whole)]
    corners = np.concatenate([np.zeros((0, 3, 3)), *triangles])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    level = np.abs(normal[:, 2]) > 0.1 * np.linalg.norm(normal, axis=1)
    high = corners[:, :, 2].max(axis=1) >= lowest + height
    return shapely.union_all(shapely.polygons(corners[level & high][:, :, :2]), grid_size=0.001)


def led_outside(
    points: ArrayLike, covered: Any, clearance: float = 1.0, furthest: float = 20.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions within buildings led to the nearest place outside.

    Args:
        points: Positions [n, 3], [m]; heights stay.
        covered: What buildings cover, as `outlines` gives it.
        clearance: How far from the wall a position is put [m]; positions outside stay where they are.
        furthest: Positions that are further from the outside than this [m] are given up.

    Returns:
        The positions [n, 3], [m], NaN where given up; and how far each was moved [n], [m].

    Raises:
        InputError: The clearance is not greater than 0, or a position is not finite.

    Example:
        >>> import shapely
        >>> led_outside([[9.0, 5.0, 1.5], [12.0, 5.0, 1.5]], shapely.box(0, 0, 10, 10))
        (array([[11. ,  5. ,  1.5],
               [12. ,  5. ,  1.5]]), array([2., 0.]))
    """
    shapely = library("shapely", "scenes")
    places = np.array(points, dtype=float).reshape(-1, 3)
    if not clearance > 0:
        raise InputError(f"clearance = {clearance!r}: must be greater than 0 m")
    if not np.isfinite(places).all():
        raise InputError("positions must be finite numbers of metres")
    inside = np.flatnonzero(shapely.contains_xy(covered, places[:, 0], places[:, 1]))
    moved = np.zeros(len(places))
    if not len(inside):
        return places, moved
    # Mitred corners: a straight wall is left at a right angle.
    border = shapely.boundary(shapely.buffer(covered, clearance, join_style="mitre"))
    here = shapely.points(places[inside, :2])
    nearest = shapely.get_coordinates(shapely.shortest_line(here, border)).reshape(-1, 2, 2)[:, 1]
    moved[inside] = np.linalg.norm(nearest - places[inside, :2], axis=1)
    places[inside, :2] = nearest
    places[moved > furthest] = np.nan
    return places, moved
