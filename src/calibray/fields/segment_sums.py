"""Sums over segments: the paths of a link, or the interactions of a link and a material.

XLA adds scattered numbers one after the other, some 5 ns each. Most of them can be added in blocks instead: numbers
are ordered so that each block belongs to one segment, and only the remainder of every segment is scattered.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

BLOCK: Final = 32
"""Numbers in a block."""


@partial(jax.tree_util.register_dataclass, data_fields=["order", "segment"], meta_fields=["blocks", "count"])
@dataclass(frozen=True)
class Segments:
    """The segments of an array of numbers.

    Attributes:
        order: Order of the numbers, whole blocks first [n]; None if it is unchanged.
        segment: Segment of every block, then of every remaining number [blocks + n - BLOCK blocks].
        blocks: Number of whole blocks.
        count: Number of segments.
    """

    order: jax.Array | None
    segment: jax.Array
    blocks: int
    count: int


def make_segments(segment: NDArray[np.integer], count: int) -> Segments:
    """Order numbers for summation by their segments [n]; the order depends on `segment` only."""
    size = np.bincount(segment, minlength=count)
    if not (size >= BLOCK).any():
        return Segments(None, jnp.asarray(segment.astype(np.int32)), 0, count)
    order = np.argsort(segment, kind="stable")
    rank = np.arange(len(segment)) - np.repeat(np.cumsum(size) - size, size)  # within its segment
    in_block = rank < np.repeat(size // BLOCK * BLOCK, size)
    order = np.concatenate([order[in_block], order[~in_block]])
    blocks = int(in_block.sum()) // BLOCK
    owner = np.concatenate([segment[order[: blocks * BLOCK : BLOCK]], segment[order[blocks * BLOCK :]]])
    return Segments(jnp.asarray(order.astype(np.int32)), jnp.asarray(owner.astype(np.int32)), blocks, count)


def segment_sums(segments: Segments, values: jax.Array) -> jax.Array:
    """Sum of the numbers [n] of every segment [count]; 0 for a segment without numbers."""
    if segments.order is not None:
        end = segments.blocks * BLOCK
        blocks = values.at[segments.order[:end]].get(mode="promise_in_bounds").reshape(-1, BLOCK).sum(axis=1)
        rest = values.at[segments.order[end:]].get(mode="promise_in_bounds")
        values = jnp.concatenate([blocks, rest])
    return jax.ops.segment_sum(values, segments.segment, segments.count)
