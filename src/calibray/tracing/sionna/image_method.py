"""The method of images for all receivers of one source.

Sionna keeps an interaction sequence (the surfaces and edges with which a path interacts, in order) only if a receiver
is visible from the point that a ray hit. Sionna therefore tests every hit of every ray against every receiver. Here,
rays are launched in a scene in which nothing obstructs a receiver (`Unobstructed`). The sequences therefore depend only
on the source and apply to all receivers.

Unfolding a sequence yields the points at which its paths must aim. By the method of images, a path with reflections is
a straight line to the image of the source (ITU-R P.1411). An edge is mirrored in the planes that follow it; the
diffraction point minimizes the length of the unfolded path (Keller, J. Opt. Soc. Am. 52(2), 1962). Most
sequence-receiver pairs can be excluded immediately, because the line would cross a plane where the scene has no
surface. Sionna's own image method computes the paths of the remaining pairs.
"""

# Mitsuba defines its types only when a variant is chosen, so its stubs declare these types as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from sionna.rt.path_solvers.paths_buffer import PathsBuffer
from sionna.rt.utils import first_order_diffraction_point

from calibray.errors import InputError
from calibray.paths import Kind
from calibray.tracing.sionna.buffers import aligned, per_interaction, to_numpy
from calibray.tracing.sionna.scene import shape_ids

SAME_PLANE: Final = 2e-3
"""Maximum difference between the offsets of planes that count as equal [m]; their normals differ by at most a fiftieth
of this number."""
CONFUSABLE_PLANE: Final = 0.05
"""Maximum difference between the offsets of planes that the tracer can confuse in single precision [m]."""
MARGIN: Final = 0.1
"""Maximum distance by which a valid point may lie outside a surface [m], to allow for single precision and rounded
corners.
"""
NEAR_PLANE: Final = 0.01
"""Distance from a plane below which a point can be on either side of the plane [m]."""
PAIRS_PER_BATCH: Final = 8_000_000
"""Maximum number of sequence-receiver pairs that are tested at the same time, to limit memory use."""


class Surfaces:
    """Triangles of a scene, grouped by their planes; corners are [T, 3, 3], [m]."""

    def __init__(self, corner: NDArray[np.float64]) -> None:
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        self.normal: NDArray[np.float64] = cross / np.where(length > 0, length, 1)
        self.offset: NDArray[np.float64] = np.einsum("ti,ti->t", self.normal, corner[:, 0])
        # Offsets and normals are brought to a common scale; planes are equal if both agree within `SAME_PLANE`.
        feature = np.c_[50 * self.normal, self.offset]
        # Both sides of a surface are one plane: the first component of the normal that is not 0 is made positive.
        leading = np.argmax(np.abs(feature[:, :3]) > SAME_PLANE, axis=1)
        feature *= np.where(feature[np.arange(len(feature)), leading] < 0, -1.0, 1.0)[:, None]
        grid, self.plane = np.unique(np.round(feature / SAME_PLANE), axis=0, return_inverse=True)
        self.plane = self.plane.reshape(-1)
        self._feature = grid * SAME_PLANE
        self._low = np.full((len(grid), 3), np.inf)
        self._high = np.full((len(grid), 3), -np.inf)
        np.minimum.at(self._low, self.plane, corner.min(axis=1))
        np.maximum.at(self._high, self.plane, corner.max(axis=1))
        # Planes that nearly coincide may have normals of opposite signs.
        self._tree = KDTree(np.vstack([self._feature, -self._feature])) if len(grid) else None

    def bounding_boxes(self, plane: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Smallest and largest coordinates [n, 3], [m], of boxes around all surfaces in, or very close to, planes [n].

        The tracer can confuse surfaces that are this close together.
        """
        if self._tree is None:
            return np.zeros((0, 3)), np.zeros((0, 3))
        distinct, position = np.unique(plane, return_inverse=True)
        neighbours = [
            np.array(indices) % len(self._feature)
            for indices in self._tree.query_ball_point(self._feature[distinct], CONFUSABLE_PLANE)
        ]
        low = np.array([self._low[planes].min(axis=0) for planes in neighbours]).reshape(-1, 3)
        high = np.array([self._high[planes].max(axis=0) for planes in neighbours]).reshape(-1, 3)
        return low[position.reshape(-1)] - MARGIN, high[position.reshape(-1)] + MARGIN


@dataclass(frozen=True)
class Edges:
    """Diffracting edges of C sequences.

    Attributes:
        origin: One end of each edge [C, 3], [m].
        direction: Unit vectors along the edges [C, 3].
        length: Lengths [C], [m]; 0 for a sequence without an edge.
    """

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    length: NDArray[np.float64]


@dataclass(frozen=True)
class Unfolded:
    """Unfolded sequences of one source; C sequences of at most D interactions.

    A path that is traced back from the receiver aims, at every interaction, at `aim` + x `slide`, where x is the
    distance [m] of the diffraction point from the edge's origin.

    Attributes:
        kind: Kinds of interaction, 0 after the last interaction [C, D].
        normal: Normals of the planes [C, D, 3].
        offset: Distances of the planes from the origin of coordinates [C, D], [m].
        low: Smallest coordinates of the surfaces in the planes [C, D, 3], [m].
        high: Largest coordinates of the surfaces in the planes [C, D, 3], [m].
        aim: Image of the source; after the edge, image of the edge's origin [C, D, 3], [m].
        slide: Image of the edge's direction after the edge, 0 before the edge [C, D, 3].
        image: Image of the source in all planes [C, 3], [m].
        edges: Images of the edges in all planes that follow the edges.
    """

    kind: NDArray[np.int64]
    normal: NDArray[np.float64]
    offset: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    aim: NDArray[np.float64]
    slide: NDArray[np.float64]
    image: NDArray[np.float64]
    edges: Edges


def unfold(
    source: NDArray[np.float64],
    kind: NDArray[np.int64],
    triangle: NDArray[np.int64],
    surfaces: Surfaces,
    edges: Edges,
) -> Unfolded:
    """Unfold the interaction sequences of a source at `source` [3], [m].

    Kinds of interaction [C, D] are 0 after the last interaction; `triangle` [C, D] is arbitrary for an interaction
    without a triangle.
    """
    mirrors = kind == Kind.SPECULAR
    met = np.where(mirrors, triangle, 0)
    normal, offset = surfaces.normal[met], surfaces.offset[met]
    low, high = (
        side.reshape(*kind.shape, 3) for side in surfaces.bounding_boxes(surfaces.plane[met].reshape(-1))
    )
    image = np.tile(source, (len(kind), 1))
    origin, direction = np.zeros((len(kind), 3)), np.zeros((len(kind), 3))
    aim, slide = np.zeros((*kind.shape, 3)), np.zeros((*kind.shape, 3))
    after_edge = np.zeros((len(kind), 1), dtype=bool)
    for step in range(kind.shape[1]):
        # Mirror image of a point p in the plane n . x = d: p - 2 (n . p - d) n; n = 0 leaves p unchanged.
        n = normal[:, step] * mirrors[:, step, None]
        d = offset[:, step, None] * mirrors[:, step, None]
        image = image - 2 * (_dot(image, n) - d) * n
        origin = np.where(after_edge, origin - 2 * (_dot(origin, n) - d) * n, origin)
        direction = direction - 2 * _dot(direction, n) * n
        at_edge = kind[:, step, None] == Kind.DIFFRACTION
        origin = np.where(at_edge, edges.origin, origin)
        direction = np.where(at_edge, edges.direction, direction)
        after_edge = after_edge | at_edge
        aim[:, step], slide[:, step] = np.where(after_edge, origin, image), direction
    return Unfolded(
        kind, normal, offset, low, high, aim, slide, image, Edges(origin, direction, edges.length)
    )


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sum(a * b, axis=1, keepdims=True)


class Unobstructed:
    """A Mitsuba scene in which every receiver is visible from every point that rays hit."""

    def __init__(self, scene: Any) -> None:
        self.ray_intersect = scene.ray_intersect

    def ray_test(self, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Report that no ray is blocked."""
        return mi.Bool(False) & active


class Meshes:
    """The triangles of a scene in Mitsuba's memory.

    Raises:
        InputError: A shape does not consist of triangles.
    """

    def __init__(self, scene: Any) -> None:
        corners: list[NDArray[np.float64]] = []
        self._first: dict[int, int] = {}
        count = 0
        for key, shape in shape_ids(scene).items():
            if not shape.is_mesh():
                raise InputError(
                    f"trace.samples = 'auto': the shape {shape.id()!r} is not made of triangles; give a number of "
                    "rays, or export the scene with meshes only"
                )
            values = mi.traverse(shape)
            vertex = np.array(values["vertex_positions"], dtype=float).reshape(-1, 3)
            face = np.array(values["faces"], dtype=np.int64).reshape(-1, 3)
            self._first[key] = count
            corners.append(vertex[face])
            count += len(face)
        self.surfaces = Surfaces(np.concatenate(corners) if corners else np.zeros((0, 3, 3)))

    def triangles(self, shape: NDArray[np.int64], primitive: NDArray[np.int64]) -> NDArray[np.int64]:
        """Indices [...] of triangles in the scene, given shapes and indices within these shapes; 0 without a shape."""
        distinct, position = np.unique(shape, return_inverse=True)
        starts = np.array([self._first.get(key, -1) for key in distinct.tolist()], dtype=np.int64)
        first = starts[position.reshape(shape.shape)]
        return np.where(first >= 0, first + primitive, 0)

    def triangles_of(self, sequences: PathsBuffer) -> NDArray[np.int64]:
        """Indices [C, D], in the scene, of the triangles at which sequences interact; 0 without a triangle."""
        return self.triangles(per_interaction(sequences, "shapes"), per_interaction(sequences, "primitives"))


def sequence_keys(sequences: PathsBuffer, meshes: Meshes) -> NDArray[np.int64]:
    """Keys of interaction sequences: integers [C, k] that are equal for equal sequences.

    A key contains the types of interaction, the reflecting planes and the faces of a diffracting edge. The key omits
    walls through which a ray passes, because these walls do not change the direction of the path.
    """
    kind = per_interaction(sequences, "interaction_types")
    plane = np.where(kind == Kind.SPECULAR, meshes.surfaces.plane[meshes.triangles_of(sequences)], 0)
    wedges: Any = sequences.diffracting_wedges
    faces = np.zeros((len(kind), 2), dtype=np.int64)
    if wedges is not None:
        at_edge = kind == Kind.DIFFRACTION
        shape = (per_interaction(sequences, "shapes") * at_edge).sum(axis=1)
        primitives = np.stack(
            [np.array(numbers, dtype=np.int64) for numbers in (wedges.prim0, wedges.primn)], axis=1
        )
        faces = np.sort(meshes.triangles(np.repeat(shape[:, None], 2, 1), primitives), axis=1)
        faces *= at_edge.any(axis=1)[:, None]
    return np.hstack([kind, plane, faces])


def unfold_sequences(sequences: PathsBuffer, source: NDArray[np.float64], meshes: Meshes) -> Unfolded:
    """Unfold the interaction sequences of a source [3], [m], in one of Sionna's buffers; see `unfold`."""
    kind = per_interaction(sequences, "interaction_types")
    edges = Edges(np.zeros((len(kind), 3)), np.zeros((len(kind), 3)), np.zeros(len(kind)))
    wedges: Any = sequences.diffracting_wedges
    if wedges is not None:
        has_edge = (kind == Kind.DIFFRACTION).any(axis=1)
        origin, direction = (to_numpy(part) * has_edge[:, None] for part in (wedges.o, wedges.e_hat))
        edges = Edges(origin, direction, np.array(wedges.length, dtype=float) * has_edge)
    return unfold(source, kind, meshes.triangles_of(sequences), meshes.surfaces, edges)


def possible_pairs(
    unfolded: Unfolded, targets: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Find the sequences that can connect the source to each receiver [R, 3], [m].

    Yields the indices of the sequence and the receiver of each pair, each [n]; pairs that are not yielded have no path.
    """
    count, depth = unfolded.kind.shape
    kinds = mi.UInt(aligned(unfolded.kind.reshape(-1), np.uint32))
    edges = unfolded.edges
    origin, direction, length = _flat(edges.origin), _flat(edges.direction), _flat(edges.length)
    normal, offset = _flat(unfolded.normal), _flat(unfolded.offset)
    low, high = _flat(unfolded.low), _flat(unfolded.high)
    aim, slide, image = _flat(unfolded.aim), _flat(unfolded.slide), _flat(unfolded.image)
    receiver = _flat(targets)
    batch = max(1, PAIRS_PER_BATCH // len(targets))
    num_receivers = dr.opaque(mi.UInt, len(targets))
    for start in range(0, count, batch):
        lane = dr.arange(mi.UInt, min(batch, count - start) * len(targets))
        sequence = lane // num_receivers + dr.opaque(mi.UInt, start)
        vertex = dr.gather(mi.Point3f, receiver, lane % num_receivers)
        edge_length = dr.gather(mi.Float, length, sequence)
        # Distance of the diffraction point from the edge's origin.
        along_edge = first_order_diffraction_point(
            dr.gather(mi.Point3f, image, sequence),
            vertex,
            dr.gather(mi.Point3f, origin, sequence),
            dr.gather(mi.Vector3f, direction, sequence),
        )
        good = (edge_length == 0) | ((along_edge > -MARGIN) & (along_edge < edge_length + MARGIN))
        along_edge = dr.select(edge_length > 0, along_edge, 0)
        # Traced back from the receiver, the line must cross each plane at a point where the scene has a surface.
        for step in reversed(range(depth)):
            at = sequence * depth + step
            kind = dr.gather(mi.UInt, kinds, at)
            goal = dr.gather(mi.Point3f, aim, at) + dr.gather(mi.Point3f, slide, at) * mi.Point3f(along_edge)
            n, d = dr.gather(mi.Point3f, normal, at), dr.gather(mi.Float, offset, at)
            # Signed distances of both points from the plane; the line crosses the plane between the points if the signs
            # differ.
            near, far = dr.dot(n, vertex) - d, dr.dot(n, goal) - d
            crossing = vertex + (goal - vertex) * mi.Point3f(near / (near - far))
            inside = dr.all(crossing >= dr.gather(mi.Point3f, low, at)) & dr.all(
                crossing <= dr.gather(mi.Point3f, high, at)
            )
            mirrors = kind == int(Kind.SPECULAR)
            good &= ~mirrors | (inside & ((near * far <= 0) | (dr.abs(near) < NEAR_PLANE)))
            at_edge = kind == int(Kind.DIFFRACTION)
            vertex = dr.select(mirrors, crossing, dr.select(at_edge, goal, vertex))
        pair = np.array(dr.compress(good), dtype=np.int64)
        yield start + pair // len(targets), pair % len(targets)


def _flat(values: NDArray[np.float64]) -> mi.Float:
    return mi.Float(aligned(values.reshape(-1), np.float32))
