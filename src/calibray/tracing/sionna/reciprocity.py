"""Candidates turned around: found from the receivers, they are made paths from the transmitters.

A mirror image, a straight line through a wall and the point of an edge where a path is shortest are the same from
either end, so what can be a path from one end can be one from the other. Candidates are turned before their geometry is
computed, so that a path is the same, digit by digit, from whichever end it was found. What has a direction is the order
of the interactions, both ends, and the faces of an edge: Sionna calls the one that the source lights the 0-face.
"""

# Mitsuba makes its types when its variant is chosen: its stubs know them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from calibray.paths import Kind
from calibray.tracing.sionna.arrays import aligned, per_interaction, vertices_of


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
