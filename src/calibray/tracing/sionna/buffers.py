"""Operations on Sionna's path buffers: remove empty entries and duplicates, reverse paths, convert to NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from calibray.paths import Kind
from calibray.tracing.trace_plan import find_repeats

# Mitsuba defines its types only when a variant is chosen, so its stubs declare these types as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false


def aligned(values: NDArray[Any], dtype: type) -> NDArray[Any]:
    """Convert numbers [n] to a data type, and copy them to memory aligned to 64 bytes.

    Dr.Jit uses NumPy's memory without copying it and compiles a separate kernel for each alignment. With random
    alignment, a kernel is rarely found in Dr.Jit's cache, and every process spends seconds on compilation.
    """
    memory = np.empty(values.size * np.dtype(dtype).itemsize + 64, dtype=np.uint8)
    start = -memory.ctypes.data % 64
    copy = memory[start : start + memory.size - 64].view(dtype)
    copy[:] = values
    return copy


def to_points(position: NDArray[np.float64]) -> mi.Point3f:
    """Convert positions [n, 3], [m], to opaque Dr.Jit points, so that no kernel is compiled for their values."""
    points = mi.Point3f(*(aligned(axis, np.float32) for axis in position.T))
    dr.make_opaque(points)
    return points


def to_numpy(vectors: Any) -> NDArray[np.float64]:
    """Convert points or vectors to double precision [n, 3]."""
    # Without this evaluation, the kernel that computes the values would also interleave them, and would be compiled
    # again for each number of vectors.
    dr.eval(vectors)
    return np.stack([np.array(axis, dtype=float) for axis in vectors], axis=-1)


def to_numpy_complex(value: mi.Complex2f) -> NDArray[np.complex128]:
    """Convert complex numbers to double precision [n]."""
    return np.array(value.real, dtype=float) + 1j * np.array(value.imag, dtype=float)


def per_interaction(buffer: PathsBuffer, name: str) -> NDArray[np.int64]:
    """Read an integer property of the interactions of a buffer's paths [P, D]."""
    return np.array(getattr(buffer, name), dtype=np.int64).reshape(-1, buffer.depth_dim_size)


def vertices_of(buffer: PathsBuffer) -> NDArray[np.float64]:
    """Read the interaction points of a buffer's paths [P, D, 3], [m]."""
    axes = (buffer.vertices_x, buffer.vertices_y, buffer.vertices_z)
    return np.stack(
        [np.array(axis, dtype=float).reshape(-1, buffer.depth_dim_size) for axis in axes], axis=-1
    )


def normals_at(buffer: PathsBuffer, step: int, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Read the surface normals [P, 3] at interaction `step` of paths; values outside the mask [P] are undefined."""
    depth, active = dr.opaque(mi.UInt, step + 1), mi.Bool(aligned(mask, np.bool_))
    return to_numpy(buffer.get_primitive_props(depth, True, False, active))


@dataclass(frozen=True)
class TracedBuffer:
    """Paths in one of Sionna's buffers.

    Attributes:
        buffer: The P paths.
        source: Transmitters at which the paths start.
        target: Receivers at which the paths end.
        link: Link of every path [P].
    """

    buffer: PathsBuffer
    source: mi.Point3f
    target: mi.Point3f
    link: NDArray[np.integer]


def drop_empty_entries(buffer: PathsBuffer) -> PathsBuffer:
    """Remove the entries that Sionna RT 2.2 counts but does not fill; empty entries occur with refraction.

    An empty entry has no interaction and refers to the first source and target. The geometry stage would turn each
    empty entry into another direct path between these ends.
    """
    if not buffer.buffer_size:
        return buffer
    filled = buffer.valid | (buffer.get_interaction_type(mi.UInt(1), mi.Bool(True)) != 0)
    index = mi.UInt(dr.compress(filled))
    return buffer if dr.width(index) == buffer.buffer_size else buffer.gather(index)


def drop_repeats(traced: list[TracedBuffer]) -> list[TracedBuffer]:
    """Remove paths that an earlier launch to the same receivers found; keep random samples of diffuse reflection.

    Buffers are in the order of the launches; paths that an earlier buffer contains are removed from later buffers.
    """
    if len(traced) == 1:
        return traced
    counts = [len(part.link) for part in traced]
    kind = np.concatenate([per_interaction(part.buffer, "interaction_types") for part in traced])
    is_repeat = find_repeats(
        launch=np.repeat(np.arange(len(traced)), counts),
        link=np.concatenate([part.link for part in traced]),
        kind=kind,
        shape=np.concatenate([per_interaction(part.buffer, "shapes") for part in traced]),
        vertex=np.concatenate([vertices_of(part.buffer) for part in traced]),
        is_sample=(kind == Kind.DIFFUSE).any(axis=1),
    )
    unique = []
    for part, repeat in zip(traced, np.split(is_repeat, np.cumsum(counts)[:-1]), strict=True):
        if repeat.any():
            part.buffer.valid &= mi.Bool(aligned(~repeat, np.bool_))
            part.buffer.discard_invalid()
            part.buffer.schedule()
            dr.eval()
        unique.append(replace(part, link=part.link[~repeat]))
    return unique


def reverse(buffer: PathsBuffer, sources: mi.Point3f) -> PathsBuffer:
    """Reverse candidate paths, so that paths found from the receivers start at the transmitters.

    Mirror images, straight lines through walls and the shortest path over an edge are the same in both directions.
    Candidates for one direction are therefore also candidates for the opposite direction. Candidates are reversed
    before their geometry is computed, so that a path is identical to the last digit, regardless of which end sent the
    rays. Three properties depend on the direction: the order of the interactions, the two ends, and the faces of an
    edge, because Sionna's 0-face is the illuminated face.
    """
    if not buffer.buffer_size:
        return buffer
    reversed_buffer = buffer.reverse()
    # Sionna has no type annotations for the wedges; without diffraction, the wedges are None.
    wedges: Any = reversed_buffer.diffracting_wedges
    if wedges is not None:
        start = to_numpy(sources)[np.array(reversed_buffer.source_indices, dtype=np.int64)]
        kind = per_interaction(reversed_buffer, "interaction_types")
        wedges.swap_faces(mi.Bool(aligned(_zero_face_is_dark(reversed_buffer, kind, start), np.bool_)))
        at_edge = kind == Kind.DIFFRACTION
        # Sionna numbers interactions from 1; 0 denotes a path without an edge.
        depth = np.where(at_edge.any(axis=1), at_edge.argmax(axis=1) + 1, 0)
        edge_depth = mi.UInt(aligned(depth, np.uint32))
        reversed_buffer.set_primitive(edge_depth, wedges.prim0, edge_depth > 0)
    reversed_buffer.schedule()
    dr.eval()
    return reversed_buffer


def _zero_face_is_dark(
    buffer: PathsBuffer, kind: NDArray[np.int64], source: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Mask [P] of the candidates with an edge whose 0-face is turned away from the incident wave."""
    # For any point of the edge, the wave comes from the image of the source in the planes before the edge.
    image, vertex = source.copy(), vertices_of(buffer)
    before_edge = np.ones(len(kind), dtype=bool)
    for step in range(kind.shape[1]):
        before_edge &= kind[:, step] != Kind.DIFFRACTION
        mirrors = before_edge & (kind[:, step] == Kind.SPECULAR)
        normal = normals_at(buffer, step, mirrors) * mirrors[:, None]
        # Mirror image: s - 2 ((s - v) . n) n, with v a point of the plane and n its normal.
        image -= 2 * np.sum((image - vertex[:, step]) * normal, axis=1)[:, None] * normal
    wedges: Any = buffer.diffracting_wedges
    edge_origin, zero_normal = to_numpy(wedges.o), to_numpy(wedges.n0)
    return np.sum((edge_origin - image) * zero_normal, axis=1) > 0
