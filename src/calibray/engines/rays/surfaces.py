"""The surface, with normal and material, of every interaction in a ray table, and the edge of every diffraction."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.scenes import Scene
from calibray.scenes.shapes import read_surface

TOLERANCE: Final = 0.02
"""Maximum distance [m] of an interaction from its surface; rounding to centimetres moves a point by at most 0.009 m."""

SAME: Final = 1e-3
"""Faces count as coincident at a point if their distances from this point differ by less than this value [m]."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The triangles of a scene.

    Attributes:
        corners: Corners of every triangle [F, 3, 3], [m].
        normal: Unit normals [F, 3], which may point to either side.
        material: Index of each face's material in `Scene.materials` [F].
    """

    corners: NDArray[np.float64]
    normal: NDArray[np.float64]
    material: NDArray[np.int64]

    @classmethod
    def of(cls, scene: Scene) -> Surfaces:
        """Read the triangles of a scene.

        Raises:
            InputError: A mesh cannot be read.
        """
        names, corners, material = list(scene.materials), [], []
        shapes = ElementTree.fromstring(scene.xml).findall("shape")
        for shape, item in zip(shapes, scene.objects, strict=True):
            mesh = read_surface(shape, scene.path)
            corners.append(mesh.vertices[mesh.faces])
            material += [names.index(item.material)] * len(mesh.faces)
        triangle = np.concatenate(corners)
        normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        size = np.linalg.norm(normal, axis=1)
        kept = size > 0
        return cls(triangle[kept], normal[kept] / size[kept, None], np.array(material)[kept])

    def near(
        self, point: NDArray[np.float64], within: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Find the pairs of a point [n, 3] and a face at most `within` [m] apart; return indices and distances [k]."""
        pairs = list(self._box_pairs(point, within))
        index, face = (
            (np.concatenate(part) for part in zip(*pairs, strict=True)) if pairs else np.zeros((2, 0), int)
        )
        if not len(index):
            return index, face, np.zeros(0)
        distance = np.linalg.norm(_nearest(self.corners[face], point[index]) - point[index], axis=1)
        close = distance <= within
        return index[close], face[close], distance[close]

    def distance(self, point: NDArray[np.float64], faces: NDArray[np.bool_]) -> float:
        """Distance [m] of a point [3] from the nearest of the faces that the mask `faces` [F] selects."""
        corners = self.corners[faces]
        nearest = _nearest(corners, np.broadcast_to(point, (len(corners), 3)))
        return float(np.linalg.norm(nearest - point, axis=1).min(initial=np.inf))

    def _box_pairs(self, point: NDArray[np.float64], within: float) -> Iterator[tuple[NDArray, NDArray]]:
        low, high = self.corners.min(axis=1) - within, self.corners.max(axis=1) + within
        # The points are tested in batches, each of which needs about 0.5 GB.
        size = max(20_000_000 // max(len(low), 1), 1)
        for start in range(0, len(point), size):
            part = point[start : start + size, None]
            inside = np.ones((len(part), len(low)), dtype=bool)
            for axis in range(3):
                inside &= (part[..., axis] >= low[:, axis]) & (part[..., axis] <= high[:, axis])
            index, face = np.nonzero(inside)
            yield index + start, face


@dataclass(frozen=True, eq=False)
class Hits:
    """Interactions with their directions and, if the table states them, their materials.

    Attributes:
        point: Positions [n, 3], [m].
        incident: Unit vectors of propagation before the interaction [n, 3].
        leaving: Unit vectors of propagation after the interaction [n, 3].
        length: Length [n], [m], of the shorter of the two adjacent segments.
        reflects: Whether each interaction must obey the law of reflection [n].
        diffracts: Whether each interaction is a diffraction [n], at an edge whose two faces can have different
            materials.
        material: Index of each interaction's stated material [n]; -1 if none is stated.
        preferred: Index of the material that each interaction prefers where surfaces coincide [n]; -1 if none.
        label: Names of the interactions in messages [n].
    """

    point: NDArray[np.float64]
    incident: NDArray[np.float64]
    leaving: NDArray[np.float64]
    length: NDArray[np.float64]
    reflects: NDArray[np.bool_]
    diffracts: NDArray[np.bool_]
    material: NDArray[np.int64]
    preferred: NDArray[np.int64]
    label: NDArray[np.str_]

    def mirror_error(self, index: NDArray[np.int64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance [k], [m], of the path from a ray reflected at normals [k, 3], at the shorter segment's end."""
        incident = self.incident[index]
        mirrored = incident - 2 * np.sum(incident * normal, axis=1)[:, None] * normal
        return np.linalg.norm(mirrored - self.leaving[index], axis=1) * self.length[index]


def match(surfaces: Surfaces, hits: Hits, names: list[str]) -> tuple[NDArray[np.int64], float]:
    """Index of every interaction's face [n], and the largest distance [m] of an interaction from its face.

    A reflection is assigned to the nearest face at which the path obeys the law of reflection, and any other
    interaction to the nearest face. Except for diffractions, this face must have the stated material. `names` contains
    the names of the materials.

    Raises:
        InputError: A point is not on a surface or not on one of the stated material, faces of different materials
            coincide at a point, or no surface reflects the wave in the direction of the path.
    """
    index, face, distance = surfaces.near(hits.point, TOLERANCE)
    free = (hits.material < 0) | hits.diffracts
    right = free[index] | (hits.material[index] == surfaces.material[face])
    index, face, distance = index[right], face[right], distance[right]
    error = hits.mirror_error(index, surfaces.normal[face])
    # Displacing a point by the tolerance changes the directions of both segments.
    bent = hits.reflects[index] & (error > 4 * TOLERANCE)
    # For each point, faces at which the law of reflection is satisfied come first, in order of distance. Among
    # coincident faces, faces of the preferred material come first.
    preferred = surfaces.material[face] == hits.preferred[index]
    order = np.lexsort((distance - SAME * preferred, bent, index))
    index, face, distance, bent = index[order], face[order], distance[order], bent[order]
    matched, first = np.unique(index, return_index=True)
    if len(matched) < len(hits.point):
        lost = np.setdiff1d(np.arange(len(hits.point)), matched)
        refusal = _off_surface(surfaces, hits, lost, names)
        raise refusal
    if bent[first].any():
        worst = int(np.argmax(np.where(bent[first], error[order][first], 0)))
        raise InputError(
            f"{hits.label[worst]}: cannot be a reflection from the surface of "
            f"{names[surfaces.material[face[first[worst]]]]!r}, because the path violates the law of reflection by "
            f"{error[order][first[worst]]:.3g} m; export the vertices with more digits, or correct the type"
        )
    _refuse_ambiguous(surfaces, hits, (index, face, distance, bent), first, names)
    return face[first], float(distance[first].max(initial=0.0))


def _off_surface(surfaces: Surfaces, hits: Hits, lost: NDArray[np.int64], names: list[str]) -> InputError:
    """The error for points that are not on a surface."""
    number = lost[0]
    stated = hits.material[number]
    faces = np.ones(len(surfaces.material), bool) if stated < 0 else surfaces.material == stated
    surface = "surface of the scene" if stated < 0 else f"surface of {names[stated]!r}"
    return InputError(
        f"{hits.label[number]}: lies {surfaces.distance(hits.point[number], faces):.3g} m from the nearest {surface} "
        f"but must lie within {TOLERANCE} m (too far away: {len(lost)} of {len(hits.point)} interactions); check the "
        "units [m], the order and signs of x, y and z, the scene and the material"
    )


def _refuse_ambiguous(
    surfaces: Surfaces, hits: Hits, pairs: tuple[NDArray, ...], first: NDArray[np.int64], names: list[str]
) -> None:
    index, face, distance, bent = pairs
    best = first[np.searchsorted(index[first], index)]
    material = surfaces.material[face]
    parallel = np.abs(np.sum(surfaces.normal[face] * surfaces.normal[face[best]], axis=1)) > 0.999
    unstated = (hits.material[index] < 0) & (hits.preferred[index] != material[best])
    rival = unstated & (material != material[best]) & (distance - distance[best] < SAME) & parallel & ~bent
    if rival.any():
        pair = int(np.argmax(rival))
        raise InputError(
            f"{hits.label[index[pair]]}: surfaces of {names[material[best[pair]]]!r} and {names[material[pair]]!r} "
            "coincide at this point; state the material in the column material of the table (paths of Sionna RT state "
            "the material while their scene is in memory)"
        )


@dataclass(frozen=True)
class Edge:
    """The wedge of a diffraction.

    Attributes:
        face: Index of the 0-face, which the wave illuminates.
        normal_0: Outward normal of the 0-face [3].
        normal_n: Outward normal of the n-face, the other face [3].
        direction: Unit vector e along the edge [3]; the cross product normal_0 x e points into the 0-face.
        error: Deviation of the path from Keller's law, as a displacement [m].
    """

    face: int
    normal_0: NDArray[np.float64]
    normal_n: NDArray[np.float64]
    direction: NDArray[np.float64]
    error: float


def find_edge(surfaces: Surfaces, hits: Hits, number: int) -> Edge:
    """The edge of a diffraction, formed by the two faces at the point that best satisfy Keller's law.

    Raises:
        InputError: No two faces at the point form an edge that diffracts the wave in the direction of the path.
    """
    _, faces, _ = surfaces.near(hits.point[[number]], TOLERANCE)
    edges = [_edge(surfaces, hits, number, (a, b)) for a in faces.tolist() for b in faces.tolist() if a != b]
    usable = [edge for edge in edges if edge is not None and edge.error <= 4 * TOLERANCE]
    if not usable:
        raise InputError(
            f"{hits.label[number]}: no edge of the scene diffracts the wave in the direction of the path at this "
            "point; check the vertex, or remove the path"
        )
    # Of several pairs with equal errors, the one is used whose 0-face the wave meets closest to normal incidence.
    return min(usable, key=lambda edge: (round(edge.error, 6), np.dot(hits.incident[number], edge.normal_0)))


def _edge(surfaces: Surfaces, hits: Hits, number: int, faces: tuple[int, int]) -> Edge | None:
    """The wedge formed by a 0-face and an n-face; None if the path does not bend around such a wedge."""
    point, incident, leaving = hits.point[number], hits.incident[number], hits.leaving[number]
    normal_0, normal_n = surfaces.normal[list(faces)]
    direction = np.cross(normal_0, normal_n)
    # The norm of this vector is the sine of the angle between the normals; nearly coplanar faces form no edge.
    if hits.material[number] not in (-1, surfaces.material[faces[0]]) or np.linalg.norm(direction) < 0.05:
        return None
    into_0, into_n = surfaces.corners[list(faces)].mean(axis=1) - point
    # An outward normal points away from the other face.
    normal_0 = -normal_0 * np.sign(np.dot(into_n, normal_0))
    normal_n = -normal_n * np.sign(np.dot(into_0, normal_n))
    direction /= np.linalg.norm(direction)
    # Sionna RT measures azimuths from the tangent n_0 x e, which points into the 0-face.
    direction *= np.sign(np.dot(np.cross(normal_0, direction), into_0))
    # A ray behind both faces would run inside the wedge. The wave must also meet the 0-face from outside.
    inside = [np.dot(end, normal_0) < 0 and np.dot(end, normal_n) < 0 for end in (-incident, leaving)]
    if any(inside) or np.dot(incident, normal_0) > 0 or not direction.any():
        return None
    # Keller's law: the incident and the diffracted ray make the same angle with the edge.
    error = abs(np.dot(incident - leaving, direction)) * hits.length[number]
    return Edge(faces[0], normal_0, normal_n, direction, float(error))


def _nearest(corners: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """For each point [k, 3], [m], the nearest point [k, 3] on the triangle with the given corners [k, 3, 3]."""
    from trimesh.triangles import (
        closest_point,
    )  # the import takes 0.2 s, and only rays of other programs need it

    return closest_point(corners, point)
