"""Chunks of paths in Sionna's own buffers, and what is found twice when rays are shared out over launches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers import sb_deterministic
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from calibray.paths import Kind
from calibray.tracing.sionna.arrays import aligned, per_interaction, vertices_of
from calibray.tracing.trace_plan import find_repeats


@dataclass(frozen=True)
class Chunk:
    """Paths in Sionna's own buffer, between one position and some others; `link` is the link of every path [P]."""

    buffer: PathsBuffer
    source: mi.Point3f
    target: mi.Point3f
    link: NDArray[np.integer]


@contextmanager
def rays_towards(square: NDArray[np.float64] | None) -> Iterator[None]:
    """Let Sionna send its rays into directions of ours in place of a lattice of its own.

    Args:
        square: The directions, as points of the unit square [2, rays]; Sionna's own if None.

    Yields:
        Nothing; they are taken as long as the context is open.
    """
    whole = sb_deterministic.fibonacci_lattice
    if square is not None:
        sb_deterministic.fibonacci_lattice = lambda _: mi.Point2f(
            *(aligned(axis, np.float32) for axis in square)
        )
    try:
        yield
    finally:
        sb_deterministic.fibonacci_lattice = whole


def without_empty_places(buffer: PathsBuffer) -> PathsBuffer:
    """Candidates without the places that Sionna RT 2.2 counts but does not fill, now and then with refraction.

    Without an interaction, and of the first source and target, each would become a direct path between these two.

    Args:
        buffer: Candidates; direct paths among them are known to be valid.

    Returns:
        The same, if no place is empty, or a copy without those.
    """
    if not buffer.buffer_size:
        return buffer
    filled = buffer.valid | (buffer.get_interaction_type(mi.UInt(1), mi.Bool(True)) != 0)
    found = mi.UInt(dr.compress(filled))
    return buffer if dr.width(found) == buffer.buffer_size else buffer.gather(found)


def without_repeats(pieces: list[Chunk]) -> list[Chunk]:
    """Chunks of several launches to the same receivers, each path of a kind that is not sampled only once.

    Args:
        pieces: The chunks as found.

    Returns:
        The chunks without paths that an earlier one holds.
    """
    if len(pieces) == 1:
        return pieces
    kind = np.concatenate([per_interaction(chunk.buffer, "interaction_types") for chunk in pieces])
    found = find_repeats(
        np.repeat(np.arange(len(pieces)), [len(chunk.link) for chunk in pieces]),
        np.concatenate([chunk.link for chunk in pieces]),
        kind,
        np.concatenate([per_interaction(chunk.buffer, "shapes") for chunk in pieces]),
        np.concatenate([vertices_of(chunk.buffer) for chunk in pieces]),
        (kind == Kind.DIFFUSE).any(axis=1),
    )
    ends = np.cumsum([len(chunk.link) for chunk in pieces])[:-1]
    kept = []
    for chunk, leave_out in zip(pieces, np.split(found, ends), strict=True):
        if leave_out.any():
            chunk.buffer.valid &= mi.Bool(aligned(~leave_out, np.bool_))
            chunk.buffer.discard_invalid()
            chunk.buffer.schedule()
            dr.eval()
        kept.append(replace(chunk, link=chunk.link[~leave_out]))
    return kept
