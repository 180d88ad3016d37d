"""Chains of interactions unfolded: where a path through them must pass, known before any ray is traced for a receiver.

A chain names what a path meets in turn: planes that mirror, walls that it passes, an edge that diffracts. By the method
of images a path through mirrors is a straight line to the source's image (ITU-R P.1411, or any text on ray tracing); an
edge is mirrored in what follows it, and the point where it diffracts is the one that makes the unfolded path shortest
(Keller 1962). So the chains of a source serve all receivers, and most are told at once to lead nowhere: the line would
have to meet a plane where the scene has no surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from calibray.paths import Kind

FINE: Final = 2e-3
"""Planes whose normals differ by less than a fiftieth of this, and offsets by less than this [m], are one."""
WIDE: Final = 0.05
"""The same for planes of which the tracer may take one for the other."""
MARGIN: Final = 0.1
"""By how much a point may lie beside a surface, for single precision and rounded corners [m]."""


class Surfaces:
    """Triangles of a scene, by the planes that they lie in.

    Args:
        corner: Corners of the triangles [T, 3, 3], [m].
    """

    def __init__(self, corner: NDArray[np.float64]) -> None:
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        self.normal: NDArray[np.float64] = cross / np.where(length > 0, length, 1)
        self.offset: NDArray[np.float64] = np.einsum("ti,ti->t", self.normal, corner[:, 0])
        feature = np.c_[50 * self.normal, self.offset]
        # Either side of a surface is one plane.
        leading = np.argmax(np.abs(feature[:, :3]) > FINE, axis=1)
        feature *= np.where(feature[np.arange(len(feature)), leading] < 0, -1.0, 1.0)[:, None]
        grid, self.plane = np.unique(np.round(feature / FINE), axis=0, return_inverse=True)
        self.plane = self.plane.reshape(-1)
        self._feature = grid * FINE
        self._low, self._high = (np.full((len(grid), 3), sign * np.inf) for sign in (1, -1))
        np.minimum.at(self._low, self.plane, corner.min(axis=1))
        np.maximum.at(self._high, self.plane, corner.max(axis=1))
        self._tree = KDTree(np.vstack([self._feature, -self._feature])) if len(grid) else None

    def boxes(self, plane: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the scene has surfaces in some planes, or so near that the tracer takes them for it.

        Args:
            plane: Numbers of planes [n].

        Returns:
            Least and largest coordinates [n, 3] each, [m].
        """
        if self._tree is None:
            return np.zeros((0, 3)), np.zeros((0, 3))
        some, place = np.unique(plane, return_inverse=True)
        near = self._tree.query_ball_point(self._feature[some], WIDE)
        count = len(self._feature)
        low, high = (
            np.array([take(side[np.array(each) % count], axis=0) for each in near]).reshape(-1, 3)
            for take, side in ((np.min, self._low), (np.max, self._high))
        )
        return low[place.reshape(-1)] - MARGIN, high[place.reshape(-1)] + MARGIN


@dataclass(frozen=True)
class Unfolded:
    """Chains of one source, unfolded; C chains of at most D interactions.

    On its way back from the receiver a path is aimed, at every interaction, at `aim` + x `slide`, with x the place of
    the diffraction on its edge, [m] from the edge's origin.

    Attributes:
        kind: Kinds of interaction, 0 beyond the last one [C, D].
        normal: Normals of the planes [C, D, 3].
        offset: Their distances from the origin of coordinates [C, D], [m].
        low: Least coordinates of the surfaces in them [C, D, 3], [m].
        high: Largest coordinates of the surfaces in them [C, D, 3], [m].
        aim: Image of the source, or of the edge's origin after it [C, D, 3], [m].
        slide: Image of the edge's direction after it, 0 before [C, D, 3].
        image: The source's image in all planes [C, 3], [m].
        origin: The edge's origin in all planes after it [C, 3], [m].
        along: Its direction [C, 3].
        length: Its length [C], [m]; 0 without an edge.
    """

    kind: NDArray[np.int64]
    normal: NDArray[np.float64]
    offset: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    aim: NDArray[np.float64]
    slide: NDArray[np.float64]
    image: NDArray[np.float64]
    origin: NDArray[np.float64]
    along: NDArray[np.float64]
    length: NDArray[np.float64]


def unfold(
    source: NDArray[np.float64],
    kind: NDArray[np.int64],
    triangle: NDArray[np.int64],
    surfaces: Surfaces,
    edge: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
) -> Unfolded:
    """Unfold the chains of a source.

    Args:
        source: Its position [3], [m].
        kind: Kinds of interaction, 0 beyond the last one [C, D].
        triangle: Triangle that each interaction meets [C, D]; any number where none is met.
        surfaces: The triangles.
        edge: Origin [C, 3], direction [C, 3] and length [C] of the edge of each chain, [m]; length 0 without one.

    Returns:
        The unfolded chains.
    """
    mirrors = kind == Kind.SPECULAR
    met = np.where(mirrors, triangle, 0)
    normal, offset = surfaces.normal[met], surfaces.offset[met]
    low, high = (side.reshape(*kind.shape, 3) for side in surfaces.boxes(surfaces.plane[met].reshape(-1)))
    image = np.tile(source, (len(kind), 1))
    origin, along = np.zeros((len(kind), 3)), np.zeros((len(kind), 3))
    aim, slide = np.zeros((*kind.shape, 3)), np.zeros((*kind.shape, 3))
    behind = np.zeros((len(kind), 1), dtype=bool)
    for step in range(kind.shape[1]):
        n, d = normal[:, step] * mirrors[:, step, None], offset[:, step, None]
        image = image - 2 * (_dot(image, n) - d * mirrors[:, step, None]) * n
        origin = np.where(behind, origin - 2 * (_dot(origin, n) - d * mirrors[:, step, None]) * n, origin)
        along = along - 2 * _dot(along, n) * n
        here = kind[:, step, None] == Kind.DIFFRACTION
        origin, along, behind = np.where(here, edge[0], origin), np.where(here, edge[1], along), behind | here
        aim[:, step], slide[:, step] = np.where(behind, origin, image), along
    return Unfolded(kind, normal, offset, low, high, aim, slide, image, origin, along, edge[2])


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sum(a * b, axis=1, keepdims=True)
