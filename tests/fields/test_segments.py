"""Sums by segment: blocks and what is beyond them give what adding one by one gives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibray.fields.segments import BLOCK, make_segments, total

SIZES = {
    "no block": [3, 0, BLOCK - 1],
    "blocks and rests": [5 * BLOCK + 3, 0, BLOCK, 7],
    "blocks alone": [2 * BLOCK, BLOCK],
    "nothing": [0, 0],
}


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("case", SIZES)
def test_total_and_its_derivative(case: str, mixed: bool) -> None:
    random = np.random.default_rng(0)
    sizes = SIZES[case]
    segment = np.repeat(np.arange(len(sizes)), sizes)
    if mixed:
        random.shuffle(segment)
    values = random.integers(-1000, 1000, len(segment)).astype(float)  # whole numbers, whose sums are exact
    segments = make_segments(segment, len(sizes))
    expected = np.bincount(segment, values, len(sizes))
    np.testing.assert_array_equal(total(segments, jnp.asarray(values)), expected)
    slope = jax.grad(lambda x: (total(segments, x) * jnp.arange(1, len(sizes) + 1)).sum())
    np.testing.assert_array_equal(slope(jnp.asarray(values)), segment + 1)


def test_whole_blocks_are_not_scattered() -> None:
    segments = make_segments(np.repeat([0, 1], [5 * BLOCK + 3, BLOCK]), 2)
    assert segments.blocks == 6
    assert len(segments.segment) == 6 + 3
