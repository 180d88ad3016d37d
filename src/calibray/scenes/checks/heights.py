"""What lies above and below places of a scene: ground, floors, roofs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.scenes.checks.scene_check import read_meshes
from calibray.scenes.scene_file import find_scene
from calibray.support.extras import library

CLEARANCE: Final = 0.05
"""How far an antenna must be below a surface for this to count as above it [m]."""

_STEEP: Final = 0.1  # share of a face's normal that points upward; less is a wall


@dataclass(frozen=True, eq=False)
class Overhead:
    """The faces of a scene, those that are no walls apart.

    Attributes:
        corners: Their corners [faces, 3, 3], [m].
        walls: Corners of the faces that are walls, likewise.
        bounds: West, south, bottom, east, north and top of the whole scene [6], [m].
    """

    corners: NDArray[np.float64]
    walls: NDArray[np.float64]
    bounds: NDArray[np.float64]

    @classmethod
    def of(cls, source: str | Path) -> Overhead:
        """Read a scene.

        Args:
            source: Path of a Mitsuba XML file, or `sionna:NAME`.

        Returns:
            Its faces.

        Raises:
            InputError: The scene cannot be read, or trimesh is not installed.
        """
        path, root = find_scene(source)
        faces = [mesh.vertices[mesh.faces] for _, _, mesh in read_meshes(path, root)]
        corners = np.concatenate(faces)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        level = np.abs(normal[:, 2]) > _STEEP * np.linalg.norm(normal, axis=1)
        every = corners.reshape(-1, 3)
        return cls(corners[level], corners[~level], np.concatenate([every.min(axis=0), every.max(axis=0)]))

    def roofed(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which points have something above them.

        Args:
            points: Positions [n, 3], [m].

        Returns:
            The mask [n].

        Raises:
            InputError: shapely is not installed.

        Example:
            >>> roof = np.array([[[0, 0, 3], [4, 0, 3], [0, 4, 3]]], float)
            >>> roof = Overhead(roof, np.zeros((0, 3, 3)), np.array([0, 0, 3, 4, 4, 3.0]))
            >>> roof.roofed([[1, 1, 1.5], [1, 1, 5.0], [3, 3, 1.5]])
            array([ True, False, False])
        """
        place = np.asarray(points, dtype=float).reshape(-1, 3)
        index, height = self._surfaces(place)
        return np.bincount(index, height > place[index, 2] + CLEARANCE, len(place)) > 0

    def buried(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which points lie below every surface there is at their place: under the ground.

        Args:
            points: Positions [n, 3], [m].

        Returns:
            The mask [n].

        Raises:
            InputError: shapely is not installed.
        """
        place = np.asarray(points, dtype=float).reshape(-1, 3)
        index, height = self._surfaces(place)
        surfaces = np.bincount(index, minlength=len(place))
        above = np.bincount(index, height > place[index, 2] + CLEARANCE, len(place))
        return (surfaces > 0) & (above == surfaces)

    def outside(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which points lie beyond the scene, seen from above.

        Args:
            points: Positions [n, 3], [m].
            margin: How far beyond [m].

        Returns:
            The mask [n].
        """
        place = np.asarray(points, dtype=float).reshape(-1, 3)[:, :2]
        low, high = self.bounds[:2] - margin, self.bounds[3:5] + margin
        return np.asarray(((place < low) | (place > high)).any(axis=1))

    def ground(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """The height of the ground: of the lowest surface there is at a place.

        Args:
            x: Eastings [n], [m].
            y: Northings [n], [m].

        Returns:
            Heights [n], [m].

        Raises:
            InputError: The scene has no surface at a place, or shapely is not installed.

        Example:
            >>> slope = np.array([[[0, 0, 0], [4, 0, 2], [0, 4, 0]], [[0, 0, 9], [4, 0, 9], [0, 4, 9]]], float)
            >>> Overhead(slope, np.zeros((0, 3, 3)), np.zeros(6)).ground([1, 2], [1, 1])
            array([0.5, 1. ])
        """
        place = np.column_stack([np.asarray(x, dtype=float), np.asarray(y, dtype=float)])
        index, height = self._surfaces(place)
        lowest = np.full(len(place), np.inf)
        np.minimum.at(lowest, index, height)
        if (bare := np.isinf(lowest)).any():
            first = int(np.flatnonzero(bare)[0])
            raise InputError(
                f"heights above the ground: the scene has no ground at {int(bare.sum())} of {len(place)} places, the "
                f"first at ({place[first, 0]:.1f}, {place[first, 1]:.1f}) m; make the scene with a wider --margin, or "
                "leave those rows out"
            )
        return lowest

    def _surfaces(self, place: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The heights of the faces at places: number of the place, and height [m]."""
        shapely = library("shapely", "scenes")
        tree = shapely.STRtree(shapely.polygons(self.corners[:, :, :2]))
        index, face = tree.query(shapely.points(place[:, :2]), predicate="intersects")
        a, b, c = np.moveaxis(self.corners[face], 1, 0)
        normal = np.cross(b - a, c - a)
        away = place[index, :2] - a[:, :2]
        return index, a[:, 2] - (normal[:, :2] * away).sum(axis=1) / normal[:, 2]
