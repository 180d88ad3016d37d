"""The triangles of a scene and its ground, for use outside the tracer (checks, maps and drawings)."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.scenes.meshes import Mesh, MeshObject
from calibray.scenes.scene import Scene
from calibray.scenes.scene_file import find_scene
from calibray.scenes.shapes import place_mesh, read_surface

LEVEL: Final = 0.5
"""A face is level, like a roof or the ground, if the vertical component of its unit normal exceeds this value [1]."""

STEEP: Final = 0.1
"""A face is a wall if the vertical component of its unit normal is at most this value [1]."""

WITHOUT_GAPS: Final = 0.9
"""A level object that covers more than this fraction of its bounding box [1] counts as a sheet, such as a floor."""

BATCH: Final = 2_000_000
"""Maximum number of line-triangle pairs that are in memory at the same time; each pair needs about 100 bytes."""

_EDGE: Final = 1e-9
"""Distance in plan up to which points outside a triangle count as inside, relative to the triangle's size [1]."""


def read_meshes(source: str | Path) -> Iterator[MeshObject]:
    """Read the meshes of a scene in the scene frame, one at a time; faces are reversed if the file flips normals.

    Raises:
        InputError: The scene or a mesh cannot be read, or the scene has no mesh.
    """
    path, root = find_scene(source)
    count = 0
    for shape in root.findall("shape"):
        name = (shape.get("id") or "?").removeprefix("mesh-")
        mesh = place_mesh(shape, path)
        flip = shape.find("boolean[@name='flip_normals']")
        if flip is not None and flip.get("value") == "true":
            mesh = replace(mesh, faces=mesh.faces[:, ::-1])
        references = (shape.find("ref"), shape.find("bsdf"))
        material = next((reference.get("id", "") for reference in references if reference is not None), "")
        count += 1
        yield MeshObject(name, material.removeprefix("mat-"), mesh)
    if not count:
        raise InputError(f"{path}: the scene has no mesh; export the scene with its meshes")


@dataclass(frozen=True, eq=False)
class Triangles:
    """The triangles of all meshes of a scene.

    Attributes:
        vertex: Positions [V, 3], [m].
        face: Vertex indices [F, 3] of each triangle.
        material: Index [F] of each triangle's material in `Scene.materials`.
        ground: Mask [F] of the triangles that belong to a ground sheet, such as terrain, a floor or a ceiling.
        left_out: Names of the objects that could not be read.
    """

    vertex: NDArray[np.float64]
    face: NDArray[np.int64]
    material: NDArray[np.int64]
    ground: NDArray[np.bool_]
    left_out: tuple[str, ...] = ()

    @property
    def corners(self) -> NDArray[np.float64]:
        """Positions [F, 3, 3], [m], of the corners of each triangle."""
        return self.vertex[self.face]

    @property
    def normal(self) -> NDArray[np.float64]:
        """Normal vectors [F, 3], [m^2], whose lengths are the areas of the triangles."""
        corners = self.corners
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def read_triangles(scene: Scene) -> Triangles:
    """Read the triangles of a scene.

    Objects whose files can no longer be read are left out and listed in `left_out`.
    """
    materials = list(scene.materials)
    meshes: list[Mesh] = []
    material: list[int] = []
    left_out = []
    shapes = ElementTree.fromstring(scene.xml).findall("shape")
    for shape, item in zip(shapes, scene.objects, strict=True):
        try:
            meshes.append(read_surface(shape, scene.path))
        except InputError:
            left_out.append(item.name or "?")
        else:
            material.append(materials.index(item.material))
    count = [len(mesh.faces) for mesh in meshes]
    offset = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = Triangles(
        np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in meshes)]),
        np.concatenate(
            [
                np.zeros((0, 3), dtype=np.int64),
                *(mesh.faces + k for mesh, k in zip(meshes, offset, strict=False)),
            ]
        ),
        np.repeat(np.array(material, dtype=np.int64), count),
        np.zeros(sum(count), dtype=bool),
        tuple(left_out),
    )
    return replace(triangles, ground=_ground(triangles, np.repeat(np.arange(len(count)), count)))


def _ground(triangles: Triangles, owner: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask [F] of the triangles that belong to a level object which extends over most of the scene.

    A mesh that contains all roofs is also level and wide, but it has gaps and lies above the mean height of the walls.
    """
    ground = np.zeros(len(owner), dtype=bool)
    if not len(owner):
        return ground
    corners, normal = triangles.corners, triangles.normal
    area, height = np.linalg.norm(normal, axis=1), corners[:, :, 2].mean(axis=1)
    level = np.abs(normal[:, 2]) > LEVEL * area
    steep = area * ~level
    # Mean height of the walls, which lies below roofs that extend over most of the scene, and above the ground.
    walls = float(np.average(height, weights=steep)) if steep.any() else np.inf
    extent = np.ptp(triangles.vertex[:, :2], axis=0)
    for number in np.unique(owner):
        mask = owner == number
        own_extent = np.ptp(corners[mask][:, :, :2].reshape(-1, 2), axis=0)
        if (own_extent > LEVEL * extent).all() and area[mask & level].sum() > 0.95 * area[mask].sum():
            # Ratio of the area in plan to the area of the bounding box.
            covered = np.abs(normal[mask, 2]).sum() / own_extent.prod()
            below = np.average(height[mask], weights=area[mask]) < walls
            ground |= mask & bool(covered > WITHOUT_GAPS or (covered > LEVEL and below))
    return ground


def is_ground(mesh: Mesh, extent: NDArray[np.float64]) -> bool:
    """Whether a mesh is a level sheet over most of a scene; `extent` [2] is the extent of the scene in x and y [m].

    Unlike in `Triangles.ground`, every face must be level. The mesh must span 80 % of the scene in each direction and
    cover half of its area; its height does not matter.
    """
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    normal = np.cross(sides[:, 0], sides[:, 1])
    level = np.abs(normal[:, 2]) > LEVEL * np.linalg.norm(normal, axis=1)
    wide = (np.ptp(mesh.vertices[:, :2], axis=0) > 0.8 * extent).all()
    area_in_plan = np.abs(normal[:, 2]).sum() / 2
    return bool(level.all() and wide and area_in_plan > 0.5 * float(np.prod(extent)))


def ground_heights(
    triangles: Triangles, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Heights [ny, nx], [m], of the lowest ground on a grid of ascending, equally spaced x [nx] and y [ny], [m].

    Where there is no ground, the height of the scene's lowest point is used.
    """
    heights = np.full((len(y), len(x)), np.inf)
    corners = triangles.corners[triangles.ground]
    # Grid points within the bounding box of each triangle, as (triangle, row, column).
    first = [_grid_index(axis, corners[:, :, k].min(axis=1), "left") for k, axis in enumerate((x, y))]
    last = [_grid_index(axis, corners[:, :, k].max(axis=1), "right") for k, axis in enumerate((x, y))]
    columns, rows = (end - start for start, end in zip(first, last, strict=True))
    triangle = np.repeat(np.arange(len(corners)), columns * rows)
    within = np.arange(len(triangle)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
    column = first[0][triangle] + within % np.maximum(columns, 1)[triangle]
    row = first[1][triangle] + within // np.maximum(columns, 1)[triangle]
    # Barycentric coordinates u, v of the points; they are undefined for a vertical triangle.
    origin, along, across = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    area = np.where(area == 0, np.nan, area)[triangle]
    east, north = x[column] - origin[triangle, 0], y[row] - origin[triangle, 1]
    u = (east * across[triangle, 1] - north * across[triangle, 0]) / area
    v = (north * along[triangle, 0] - east * along[triangle, 1]) / area
    over = (u >= -_EDGE) & (v >= -_EDGE) & (u + v <= 1 + _EDGE)
    z = origin[triangle, 2] + u * along[triangle, 2] + v * across[triangle, 2]
    np.minimum.at(heights, (row[over], column[over]), z[over])
    return np.where(np.isfinite(heights), heights, triangles.vertex[:, 2].min())


def vertical_crossings(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
    """Find where vertical lines through points cross triangles. Yields batches of triangle, point and height [m].

    The points [n, 3], [m], must be sorted by x.
    """
    # The lines are shifted by less than a micrometre, because a line through an edge would cross both adjacent
    # triangles.
    x, y = points[:, 0] + 3.1e-7, points[:, 1] + 1.7e-7
    low, high = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    # As the points are sorted by x, the points within a triangle's width are contiguous.
    first = np.searchsorted(x, low[:, 0], "left")
    count = np.searchsorted(x, high[:, 0], "right") - first
    batch = np.cumsum(count) // BATCH
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


def _grid_index(
    axis: NDArray[np.float64], value: NDArray[np.float64], side: Literal["left", "right"]
) -> NDArray[np.int64]:
    """Indices of values on a grid axis, with a tolerance for points on the edges of triangles."""
    tolerance = _EDGE * max(float(np.ptp(axis)), 1.0) * (1 if side == "right" else -1)
    return np.searchsorted(axis, value + tolerance, side=side)
