"""Chains of interactions that the rays of one source meet, found once for all receivers, and which may lead to which.

Sionna keeps a chain only where a receiver sees the point that a ray hit, and looks from every hit of every ray to every
receiver. Here nothing hides a receiver while rays are sent out, so that the chains are those of the source alone; what
the method of images then makes of them for each receiver is Sionna's own.
"""

# Mitsuba makes its types when its variant is chosen: its stubs know them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer
from sionna.rt.utils import first_order_diffraction_point

from calibray.errors import InputError
from calibray.paths import Kind
from calibray.tracing.sionna.arrays import aligned, per_interaction
from calibray.tracing.unfolding import MARGIN, Surfaces, Unfolded, unfold

PAIRS: Final = 8_000_000
"""Chains x receivers that are looked at together."""
CLOSE: Final = 0.01
"""A point nearer to a plane than this may lie on either side of it [m]."""


class Unhidden:
    """A scene in which nothing hides a receiver from a ray's hit.

    Args:
        scene: Mitsuba's scene.
    """

    def __init__(self, scene: Any) -> None:
        self.ray_intersect = scene.ray_intersect

    def ray_test(self, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Whether something is in the way: never."""
        return mi.Bool(False) & active


class Meshes:
    """The triangles of a scene in Mitsuba's memory.

    Args:
        scene: Mitsuba's scene.

    Raises:
        InputError: A shape is not made of triangles.
    """

    def __init__(self, scene: Any) -> None:
        corners, self._first, count = [], {}, 0
        for shape in scene.shapes():
            if not shape.is_mesh():
                raise InputError(
                    f"trace.samples = 'auto': the shape {shape.id()!r} is not made of triangles; give a number, or "
                    "export the scene with meshes alone"
                )
            values = mi.traverse(shape)
            vertex = np.array(values["vertex_positions"], dtype=float).reshape(-1, 3)
            face = np.array(values["faces"], dtype=np.int64).reshape(-1, 3)
            self._first[int(np.array(dr.reinterpret_array(mi.UInt, mi.ShapePtr(shape))).item())] = count
            corners.append(vertex[face])
            count += len(face)
        self.surfaces = Surfaces(np.concatenate(corners) if corners else np.zeros((0, 3, 3)))

    def triangles(self, shape: NDArray[np.int64], primitive: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of triangles.

        Args:
            shape: The ids under which Dr.Jit knows their shapes [...].
            primitive: Their numbers within these [...].

        Returns:
            Their numbers within the scene [...]; anything where there is no such shape.
        """
        known, place = np.unique(shape, return_inverse=True)
        first = np.array([self._first.get(key, -1) for key in known.tolist()])[place.reshape(shape.shape)]
        return np.where(first >= 0, first + primitive, 0)


def keys(buffer: PathsBuffer, meshes: Meshes) -> NDArray[np.int64]:
    """What tells chains apart: their kinds, the planes that mirror, the faces of the edge.

    Through which wall a ray passed does not count: a path passes straight on, whichever it is.

    Args:
        buffer: Chains.
        meshes: The scene's triangles.

    Returns:
        Whole numbers [C, k], equal for equal chains.
    """
    kind = per_interaction(buffer, "interaction_types")
    triangle = meshes.triangles(per_interaction(buffer, "shapes"), per_interaction(buffer, "primitives"))
    plane = np.where(kind == Kind.SPECULAR, meshes.surfaces.plane[triangle], 0)
    wedges: Any = buffer.diffracting_wedges
    faces = np.zeros((len(kind), 2), dtype=np.int64)
    if wedges is not None:
        edge = kind == Kind.DIFFRACTION
        shape = (per_interaction(buffer, "shapes") * edge).sum(axis=1)
        prims = np.stack([np.array(each, dtype=np.int64) for each in (wedges.prim0, wedges.primn)], axis=1)
        faces = np.sort(meshes.triangles(np.repeat(shape[:, None], 2, 1), prims), axis=1)
        faces *= edge.any(axis=1)[:, None]
    return np.hstack([kind, plane, faces])


def unfolded(buffer: PathsBuffer, source: NDArray[np.float64], meshes: Meshes) -> Unfolded:
    """Unfold the chains of a source.

    Args:
        buffer: The chains.
        source: The source [3], [m].
        meshes: The scene's triangles.

    Returns:
        The unfolded chains.
    """
    kind = per_interaction(buffer, "interaction_types")
    triangle = meshes.triangles(per_interaction(buffer, "shapes"), per_interaction(buffer, "primitives"))
    edge = np.zeros((len(kind), 3)), np.zeros((len(kind), 3)), np.zeros(len(kind))
    wedges: Any = buffer.diffracting_wedges
    if wedges is not None:
        has = (kind == Kind.DIFFRACTION).any(axis=1)
        origin, along = (np.array(part, dtype=float).T * has[:, None] for part in (wedges.o, wedges.e_hat))
        edge = origin, along, np.array(wedges.length, dtype=float) * has
    return unfold(source, kind, triangle, meshes.surfaces, edge)


def possible(
    chains: Unfolded, targets: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Which chains may lead to which receivers.

    Args:
        chains: Unfolded chains.
        targets: The receivers [R, 3], [m].

    Yields:
        Chain and receiver of each pair; pairs that are left out hold no path.
    """
    count, depth = chains.kind.shape
    kinds = mi.UInt(aligned(chains.kind.reshape(-1), np.uint32))
    length = _flat(chains.length)
    normal, offset, low, high, aim, slide, image, origin, along, target = (
        _flat(part)
        for part in (
            chains.normal, chains.offset, chains.low, chains.high, chains.aim, chains.slide, chains.image,
            chains.origin, chains.along, targets,
        )
    )  # fmt: skip
    together = max(1, PAIRS // len(targets))
    receivers = dr.opaque(mi.UInt, len(targets))
    for start in range(0, count, together):
        lane = dr.arange(mi.UInt, min(together, count - start) * len(targets))
        chain = lane // receivers + dr.opaque(mi.UInt, start)
        vertex = dr.gather(mi.Point3f, target, lane % receivers)
        edge = dr.gather(mi.Float, length, chain)
        place = first_order_diffraction_point(
            dr.gather(mi.Point3f, image, chain),
            vertex,
            dr.gather(mi.Point3f, origin, chain),
            dr.gather(mi.Vector3f, along, chain),
        )
        good = (edge == 0) | ((place > -MARGIN) & (place < edge + MARGIN))
        place = dr.select(edge > 0, place, 0)
        for step in reversed(range(depth)):
            at = chain * depth + step
            kind = dr.gather(mi.UInt, kinds, at)
            goal = dr.gather(mi.Point3f, aim, at) + dr.gather(mi.Point3f, slide, at) * mi.Point3f(place)
            n, d = dr.gather(mi.Point3f, normal, at), dr.gather(mi.Float, offset, at)
            near, far = dr.dot(n, vertex) - d, dr.dot(n, goal) - d
            point = vertex + (goal - vertex) * mi.Point3f(near / (near - far))
            inside = dr.all(point >= dr.gather(mi.Point3f, low, at)) & dr.all(
                point <= dr.gather(mi.Point3f, high, at)
            )
            mirrors = kind == int(Kind.SPECULAR)
            good &= ~mirrors | (inside & ((near * far <= 0) | (dr.abs(near) < CLOSE)))
            moved = dr.select(kind == int(Kind.DIFFRACTION), goal, vertex)
            vertex = dr.select(mirrors, point, moved)
        found = np.array(dr.compress(good), dtype=np.int64)
        yield start + found // len(targets), found % len(targets)


def _flat(values: NDArray[np.float64]) -> mi.Float:
    return mi.Float(aligned(values.reshape(-1), np.float32))
