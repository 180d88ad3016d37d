"""Sums over runs of numbers that belong together: paths of a link, interactions of a link and a material.

XLA adds scattered numbers one after the other, some five nanoseconds each. Most of them can be added by blocks:
numbers are put in an order in which each block belongs to one segment, and only what does not fill a block is
scattered.
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


@partial(jax.tree_util.register_dataclass, data_fields=["order", "segment"], meta_fields=["blocks", "count"])
@dataclass(frozen=True)
class Segments:
    """Which numbers are added up.

    Attributes:
        order: Number at each place, whole blocks first [n]; None where the numbers stay as they are.
        segment: Segment of every block, then of every number beyond them [blocks + n - BLOCK blocks].
        blocks: Number of whole blocks.
        count: Number of segments.
    """

    order: jax.Array | None
    segment: jax.Array
    blocks: int
    count: int


def make_segments(segment: NDArray[np.integer], count: int) -> Segments:
    """Put numbers in order for summation.

    Args:
        segment: Segment of every number [n].
        count: Number of segments.

    Returns:
        The order, the same for the same segments.
    """
    size = np.bincount(segment, minlength=count)
    if not (size >= BLOCK).any():
        return Segments(None, jnp.asarray(segment.astype(np.int32)), 0, count)
    order = np.argsort(segment, kind="stable")
    rank = np.arange(len(segment)) - np.repeat(np.cumsum(size) - size, size)
    whole = rank < np.repeat(size // BLOCK * BLOCK, size)
    order = np.concatenate([order[whole], order[~whole]])
    blocks = int(whole.sum()) // BLOCK
    owner = np.concatenate([segment[order[: blocks * BLOCK : BLOCK]], segment[order[blocks * BLOCK :]]])
    return Segments(jnp.asarray(order.astype(np.int32)), jnp.asarray(owner.astype(np.int32)), blocks, count)


def total(segments: Segments, values: jax.Array) -> jax.Array:
    """Sum of the numbers of every segment.

    Args:
        segments: Which numbers are added up.
        values: The numbers [n].

    Returns:
        The sums [count]; 0 for a segment without numbers.
    """
    if segments.order is not None:
        end = segments.blocks * BLOCK
        regular = values.at[segments.order[:end]].get(mode="promise_in_bounds").reshape(-1, BLOCK).sum(axis=1)
        rest = values.at[segments.order[end:]].get(mode="promise_in_bounds")
        values = jnp.concatenate([regular, rest])
    return jax.ops.segment_sum(values, segments.segment, segments.count)
