"""Checks of positions against a scene (roofs, ground, bounds, walls), and relocation of positions inside buildings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.scenes.meshes import Mesh
from calibray.scenes.obstruction import SAME_CROSSING, crossing
from calibray.scenes.scene_file import find_scene
from calibray.scenes.shapes import read_surface
from calibray.scenes.triangles import BATCH, STEEP, Triangles, is_ground, vertical_crossings
from calibray.support.lazy_imports import library

KERB: Final = 2.0
"""Height above the lowest point of a scene up to which objects, such as kerbs, do not count as buildings [m]."""

CLEARANCE: Final = 0.05
"""A surface counts as above an antenna if it is higher than the antenna by more than this distance [m]."""

CONTACT: Final = 0.01
"""Distance from a level surface below which an antenna counts as touching the surface [m]. At a distance of 1 mm,
Sionna RT misses reflections from the surface on all links; at 3 mm, on most links; at 10 mm, on none."""

BEYOND: Final = "outside the scene"
UNDER: Final = "under the ground"
INSIDE: Final = "inside a building"


def _surfaces(source: str | Path) -> list[Mesh]:
    """Read the surfaces of all shapes of a scene, including rectangles and cubes, in the scene frame.

    Raises:
        InputError: The scene or a shape cannot be read, or the scene has no shape.
    """
    path, root = find_scene(source)
    if shapes := root.findall("shape"):
        return [read_surface(shape, path) for shape in shapes]
    raise InputError(f"{path}: the scene has no <shape>; export the scene with its meshes")


def _is_wall(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.abs(normal[:, 2]) <= STEEP * np.linalg.norm(normal, axis=1)


@dataclass(frozen=True, eq=False)
class SceneSurfaces:
    """The faces of a scene, with walls separate from ground, floors and roofs.

    Attributes:
        level: Corners [F, 3, 3], [m], of the faces that are not walls.
        walls: Corners [W, 3, 3], [m], of the walls.
        bounds: West, south, bottom, east, north and top of the scene [6], [m].
    """

    level: NDArray[np.float64]
    walls: NDArray[np.float64]
    bounds: NDArray[np.float64]

    @classmethod
    def read(cls, source: str | Path) -> SceneSurfaces:
        """Read the faces of a scene in the scene frame; `source` is the path of a Mitsuba XML file, or `sionna:NAME`.

        Raises:
            InputError: The scene cannot be read.
        """
        corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in _surfaces(source)])
        wall = _is_wall(corners)
        bounds = np.concatenate([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])
        return cls(corners[~wall], corners[wall], bounds)

    def under_roof(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Mask [n] of the points [n, 3], [m], that have a surface above them.

        Raises:
            InputError: shapely is not installed.

        Example:
            >>> roof = np.array([[[0, 0, 3], [4, 0, 3], [0, 4, 3]]], float)
            >>> surfaces = SceneSurfaces(roof, np.zeros((0, 3, 3)), np.array([0, 0, 3, 4, 4, 3.0]))
            >>> surfaces.under_roof([[1, 1, 1.5], [1, 1, 5.0], [3, 3, 1.5]])
            array([ True, False, False])
        """
        position = np.asarray(points, dtype=float).reshape(-1, 3)
        _, above = self._count_surfaces(position)
        return above > 0

    def underground(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Mask [n] of the points [n, 3], [m], that are below all surfaces at their position in plan.

        Raises:
            InputError: shapely is not installed.
        """
        position = np.asarray(points, dtype=float).reshape(-1, 3)
        count, above = self._count_surfaces(position)
        return (count > 0) & (above == count)

    def touching(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Mask [n] of the points [n, 3], [m], that are nearer than `CONTACT` to a surface that is not a wall.

        Raises:
            InputError: shapely is not installed.
        """
        position = np.asarray(points, dtype=float).reshape(-1, 3)
        index, height = self._surfaces(position)
        near = np.abs(height - position[index, 2]) < CONTACT
        return np.bincount(index[near], minlength=len(position)) > 0

    def outside(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Mask [n] of the points [n, 3], [m], that are outside the scene's bounds in plan by more than a margin [m]."""
        position = np.asarray(points, dtype=float).reshape(-1, 3)[:, :2]
        low, high = self.bounds[:2] - margin, self.bounds[3:5] + margin
        return np.asarray(((position < low) | (position > high)).any(axis=1))

    def ground_height(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Height [n], [m], of the lowest surface at the given eastings and northings [n], [m].

        Raises:
            InputError: The scene has no surface at a position, or shapely is not installed.

        Example:
            >>> slope = np.array([[[0, 0, 0], [4, 0, 2], [0, 4, 0]], [[0, 0, 9], [4, 0, 9], [0, 4, 9]]], float)
            >>> SceneSurfaces(slope, np.zeros((0, 3, 3)), np.zeros(6)).ground_height([1, 2], [1, 1])
            array([0.5, 1. ])
        """
        lowest = self.lowest_surface(x, y)
        if (missing := np.flatnonzero(np.isinf(lowest))).size:
            east, north = np.ravel(x)[missing[0]], np.ravel(y)[missing[0]]
            raise InputError(
                f"heights above the ground: the scene has no ground at {len(missing)} of {len(lowest)} positions, "
                f"the first at ({east:.1f}, {north:.1f}) m; make the scene with a larger --margin, or omit these "
                "rows"
            )
        return lowest

    def lowest_surface(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Height of the lowest surface, as in `ground_height`, but +inf where the scene has no surface."""
        position = np.column_stack([np.asarray(x, dtype=float), np.asarray(y, dtype=float)])
        index, height = self._surfaces(position)
        lowest = np.full(len(position), np.inf)
        np.minimum.at(lowest, index, height)
        return lowest

    def _count_surfaces(self, position: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Number [n] of surfaces at each position in plan, and number [n] of these surfaces above the position."""
        index, height = self._surfaces(position)
        above = height > position[index, 2] + CLEARANCE
        return np.bincount(index, minlength=len(position)), np.bincount(index[above], minlength=len(position))

    @cached_property
    def _tree(self) -> Any:
        """Spatial index, in plan, of the faces that are not walls."""
        shapely = library("shapely", "scenes")
        return shapely.STRtree(shapely.polygons(self.level[:, :, :2]))

    def _surfaces(self, position: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """All surfaces at the given positions: index of the position, and height of the surface [m]."""
        shapely = library("shapely", "scenes")
        # A point on an edge belongs to both faces, so callers compare the number of surfaces with zero or with other
        # counts, not with one.
        index, face = self._tree.query(shapely.points(position[:, :2]), predicate="intersects")
        a, b, c = np.moveaxis(self.level[face], 1, 0)
        normal = np.cross(b - a, c - a)
        offset = position[index, :2] - a[:, :2]
        return index, a[:, 2] - (normal[:, :2] * offset).sum(axis=1) / normal[:, 2]


def count_crossings(corners: NDArray[np.float64], start: ArrayLike, end: ArrayLike) -> NDArray[np.int64]:
    """Count the triangles [F, 3, 3] that each straight line crosses; the ends of the lines are [n, 3], [m].

    Crossings closer to each other than `SAME_CROSSING` count as one crossing.

    Example:
        >>> sheet = np.array([[[1, -9, -9], [1, 9, -9], [1, 0, 9]]], float)
        >>> count_crossings(sheet, [[0, 0, 0], [0, 0, 0]], [[2, 0, 0], [0.5, 0, 0]])
        array([1, 0])
    """
    first, last = (np.asarray(ends, dtype=float).reshape(-1, 3) for ends in (start, end))
    batch = max(1, BATCH // max(len(corners), 1))
    counts = [np.zeros(0, dtype=np.int64)]
    for number in range(0, len(first), batch):
        part = slice(number, number + batch)
        # The distance is NaN for a triangle that a line misses; NaN values sort last and do not count as crossings.
        distance = np.sort(crossing(first[part, None], last[part, None], corners), axis=1)
        counts.append((np.diff(distance, axis=1, prepend=-np.inf) > SAME_CROSSING).sum(axis=1))
    return np.concatenate(counts)


def building_outlines(source: str | Path) -> Any:
    """The area that buildings and other bodies of a scene cover in plan, as a shapely geometry [m], which may be empty.

    Faces less than `KERB` above the scene's lowest point, such as kerbs, floors and the ground, are ignored.

    Raises:
        InputError: The scene cannot be read, or shapely is not installed.
    """
    shapely = library("shapely", "scenes")
    meshes = _surfaces(source)
    extent = np.ptp(np.concatenate([mesh.vertices[:, :2] for mesh in meshes]), axis=0)
    lowest = min(mesh.vertices[:, 2].min() for mesh in meshes)
    bodies = [mesh.vertices[mesh.faces] for mesh in meshes if not is_ground(mesh, extent)]
    corners = np.concatenate([np.zeros((0, 3, 3)), *bodies])
    high = corners[:, :, 2].max(axis=1) >= lowest + KERB
    return shapely.union_all(shapely.polygons(corners[~_is_wall(corners) & high][:, :, :2]), grid_size=0.001)


def move_outside(
    points: ArrayLike, outlines: Any, clearance: float = 1.0, furthest: float = 20.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Move positions inside buildings to the nearest positions outside the buildings.

    Args:
        points: Positions [n, 3], [m]; heights do not change.
        outlines: The area that buildings cover, as returned by `building_outlines`.
        clearance: Distance of a moved position from the wall [m].
        furthest: Maximum distance by which a position is moved [m]; positions that would have to be moved farther
            become NaN.

    Returns:
        The positions [n, 3], [m], which are NaN where the distance exceeds `furthest`, and the distance moved [n], [m].

    Raises:
        InputError: The clearance is not greater than 0, or a position is not finite.

    Example:
        >>> import shapely
        >>> move_outside([[9.0, 5.0, 1.5], [12.0, 5.0, 1.5]], shapely.box(0, 0, 10, 10))
        (array([[11. ,  5. ,  1.5],
               [12. ,  5. ,  1.5]]), array([2., 0.]))
    """
    shapely = library("shapely", "scenes")
    moved = np.array(points, dtype=float).reshape(-1, 3)
    if not clearance > 0:
        raise InputError(f"clearance = {clearance!r}: must be greater than 0 m")
    if not np.isfinite(moved).all():
        raise InputError("positions must be finite numbers, in metres; correct or remove the other positions")
    inside = np.flatnonzero(shapely.contains_xy(outlines, moved[:, 0], moved[:, 1]))
    distance = np.zeros(len(moved))
    if not len(inside):
        return moved, distance
    # With mitred corners, positions move away from a straight wall at a right angle.
    border = shapely.boundary(shapely.buffer(outlines, clearance, join_style="mitre"))
    lines = shapely.shortest_line(shapely.points(moved[inside, :2]), border)
    nearest = shapely.get_coordinates(lines).reshape(-1, 2, 2)[:, 1]
    distance[inside] = np.linalg.norm(nearest - moved[inside, :2], axis=1)
    moved[inside, :2] = nearest
    moved[distance > furthest] = np.nan
    return moved, distance


def locate(triangles: Triangles, points: NDArray[np.float64]) -> NDArray[np.str_]:
    """The location of each point [n, 3], [m]: `BEYOND`, `UNDER`, `INSIDE`, or an empty string for a point in the open.

    A point is inside a building if an upward vertical ray from the point crosses an odd number of surfaces, as it does
    from inside any closed body. The ground consists of the triangles marked in `Triangles.ground`.
    """
    if not len(triangles.face):
        return np.full(len(points), "")
    # `unique` sorts the points by x, as `vertical_crossings` requires.
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    corners = triangles.corners
    scene_low, scene_high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    over_building, ground, ground_below = (np.zeros(len(unique), dtype=int) for _ in range(3))
    for batch, point, height in vertical_crossings(corners, unique):
        above = height > unique[point, 2] + CLEARANCE
        is_ground = triangles.ground[batch]
        np.add.at(over_building, point, above & ~is_ground)
        np.add.at(ground, point, is_ground)
        np.add.at(ground_below, point, is_ground & ~above)
    beyond = ((unique[:, :2] < scene_low[:2]) | (unique[:, :2] > scene_high[:2])).any(axis=1)
    under = ((ground > 0) & (ground_below == 0)) | (unique[:, 2] < scene_low[2] - CLEARANCE)
    location = np.select([beyond, under, over_building % 2 == 1], [BEYOND, UNDER, INSIDE], "")
    return location[inverse.reshape(-1)]
