"""Candidates turned around: in which direction the geometry of a path is computed, and how it becomes the wave's.

A mirror image, a straight line through a wall and the point of an edge where a path is shortest are the same from
either end, so what can be a path from one end can be one from the other. Sionna's method of images is in single
precision: its points lie up to a tenth of a millimetre beside where they are, elsewhere from the other end, and near
the angle at which nothing is reflected that changes a path's gain by a thousandth. So the geometry of a link's paths is
computed from one and the same of its ends (`computed_from_receivers`), whichever is called transmitter and whichever
sent out rays, and the program of the paths is turned around. What the same rays find is so the same for a link and for
the link in the other direction. Paths that scatter or are diffracted are computed in the direction of the wave, which
their fields in Sionna have.

What has a direction is the order of the interactions, both ends, and the faces of an edge: Sionna calls the one that
the source lights the 0-face.
"""

# Mitsuba makes its types when its variant is chosen: its stubs know them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from calibray.paths import Kind
from calibray.tracing.launches import Launch, computed_from_receivers
from calibray.tracing.sionna.arrays import aligned, per_interaction, points, vertices_of
from calibray.tracing.sionna.chunks import Chunk

if TYPE_CHECKING:
    from calibray.tracing.sionna.tracer import Tracer


def settled(
    tracer: Tracer, candidates: PathsBuffer, launch: Launch, targets: NDArray[np.float64], backwards: bool
) -> list[Chunk]:
    """The paths among candidates, their geometry computed from the end that it is always computed from.

    Args:
        tracer: The tracer.
        candidates: Candidates, their geometry not computed yet.
        launch: Where they start, and the links that they belong to.
        targets: The other end of every one of these links [n, 3], [m].
        backwards: Whether they start at the links' receivers.

    Returns:
        At least one chunk; those of paths that were computed from their receivers are turned.
    """
    source, target = points(launch.source[None]), points(targets)
    place = np.array(candidates.target_indices, dtype=np.int64)
    ends = (targets, launch.source) if backwards else (launch.source, targets)
    turned = computed_from_receivers(*np.broadcast_arrays(*ends))[place]
    kind = per_interaction(candidates, "interaction_types")
    turned &= ~np.isin(kind, (Kind.DIFFUSE, Kind.DIFFRACTION)).any(axis=1)
    chunks = []
    for direction in (False, True):
        index = np.flatnonzero(turned == direction)
        if not len(index) and (direction or len(place)):
            continue
        whole = len(index) == len(place)
        buffer = candidates if whole else candidates.gather(mi.UInt(aligned(index, np.uint32)))
        ends = (source, target) if direction == backwards else (target, source)
        if direction != backwards:
            buffer = turned_around(buffer, target)
        tracer.settle(buffer, *ends)
        end: Any = buffer.target_indices if direction == backwards else buffer.source_indices
        chunks.append(Chunk(buffer, *ends, launch.links[np.array(end, dtype=np.int64)], direction))
    return chunks


def turned_around(buffer: PathsBuffer, sources: mi.Point3f) -> PathsBuffer:
    """Candidates in the other direction.

    Args:
        buffer: Candidates without a diffuse reflection, their geometry not computed yet.
        sources: Where they start once they are turned.

    Returns:
        The same candidates in the same order, their sources the targets and their targets the sources.
    """
    if not buffer.buffer_size:
        return buffer
    turned = buffer.reverse()
    # Sionna's types say nothing; there are wedges where diffraction was asked for.
    wedges: Any = turned.diffracting_wedges
    if wedges is not None:
        start = np.array(sources, dtype=float).T[np.array(turned.source_indices, dtype=np.int64)]
        kind = per_interaction(turned, "interaction_types")
        wedges.swap_faces(mi.Bool(aligned(_unlit(turned, kind, start), np.bool_)))
        edge = kind == Kind.DIFFRACTION
        depth = mi.UInt(aligned(np.where(edge.any(axis=1), edge.argmax(axis=1) + 1, 0), np.uint32))
        turned.set_primitive(depth, wedges.prim0, depth > 0)
    turned.schedule()
    dr.eval()
    return turned


def _unlit(buffer: PathsBuffer, kind: NDArray[np.int64], source: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the 0-face of a candidate's edge looks away from what comes from its source [P].

    The wave comes from the source's image in the planes before the edge, whichever point of the edge it meets.
    """
    wedges: Any = buffer.diffracting_wedges
    image, vertex = source.copy(), vertices_of(buffer)
    ahead = np.ones(len(kind), dtype=bool)
    for step in range(kind.shape[1]):
        ahead &= kind[:, step] != Kind.DIFFRACTION
        mirrors = ahead & (kind[:, step] == Kind.SPECULAR)
        active = mi.Bool(aligned(mirrors, np.bool_))
        found = buffer.get_primitive_props(mi.UInt(step + 1), True, False, active)
        normal = np.array(found, dtype=float).T.reshape(-1, 3) * mirrors[:, None]
        image -= 2 * np.sum((image - vertex[:, step]) * normal, axis=1)[:, None] * normal
    origin, normal_0 = (np.array(part, dtype=float).T for part in (wedges.o, wedges.n0))
    return np.sum((origin - image) * normal_0, axis=1) > 0
