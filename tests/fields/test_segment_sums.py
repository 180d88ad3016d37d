"""Sums over segments equal those of adding the numbers one by one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibray.fields.arithmetic import BLOCK, make_segments, segment_sums

SIZES = {
    "no block": [3, 0, BLOCK - 1],
    "blocks and remainders": [5 * BLOCK + 3, 0, BLOCK, 7],
    "whole blocks": [2 * BLOCK, BLOCK],
    "nothing": [0, 0],
}


@pytest.mark.parametrize("case", SIZES)
def test_sums_and_their_derivative(case: str) -> None:
    random = np.random.default_rng(0)
    sizes = SIZES[case]
    segment = np.repeat(np.arange(len(sizes)), sizes)
    if case == "blocks and remainders":
        random.shuffle(segment)
    values = random.integers(-1000, 1000, len(segment)).astype(float)  # integers, whose sums are exact
    segments = make_segments(segment, len(sizes))

    @jax.jit
    def sums_and_slope(values: np.ndarray) -> tuple[jax.Array, jax.Array]:
        sums, pull = jax.vjp(lambda values: segment_sums(segments, values), values)
        return sums, pull(jnp.arange(1.0, len(sizes) + 1))[0]

    sums, slope = sums_and_slope(values)
    np.testing.assert_array_equal(sums, np.bincount(segment, values, len(sizes)))
    np.testing.assert_array_equal(slope, segment + 1)


def test_whole_blocks_are_not_scattered() -> None:
    segments = make_segments(np.repeat([0, 1], [5 * BLOCK + 3, BLOCK]), 2)
    assert segments.blocks == 6
    assert len(segments.segment) == 6 + 3
