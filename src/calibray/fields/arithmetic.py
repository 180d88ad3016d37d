"""Arithmetic of complex numbers stored as pairs of real arrays, and sums over segments.

Compilers vectorize operations on pairs of real arrays, so these pairs are several times faster than complex types. All
functions of pairs work element by element and are differentiable.

A segment is either the paths of one link or the interactions of one link with one material. XLA scatters and adds one
number at a time, which takes about 5 ns per number. Most numbers are therefore added in blocks. The numbers are ordered
so that each block belongs to one segment. Only the remainder of each segment is scattered.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import NDArray

Pair = tuple[jax.Array, jax.Array]
"""A complex number, given as its real and imaginary parts."""

Values = TypeVar("Values")

_QUARTER: Final = (1.5707963267341256, 6.077100506506192e-11)
"""Pi / 2 as the sum of two numbers (Cody and Waite, Software Manual for the Elementary Functions, 1980, ch. 8). The
first number has 33 bits, so its product with the number of quarter turns is exact for up to a million turns."""

_SINE: Final = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
    1.0,
)
"""Minimax polynomial for sin(x) / x on [-pi / 4, pi / 4] in powers of x^2, with the highest power first."""

_COSINE: Final = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
    -0.5,
    1.0,
)
"""Minimax polynomial for cos(x) on the same interval in powers of x^2, highest first."""


def multiply(a: Pair, b: Pair) -> Pair:
    """Product of two complex numbers, each given as (real, imaginary) [...]."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def divide(a: Pair, b: Pair) -> Pair:
    """Quotient of two complex numbers, each given as (real, imaginary) [...]."""
    inverse = 1 / (b[0] * b[0] + b[1] * b[1])
    return (a[0] * b[0] + a[1] * b[1]) * inverse, (a[1] * b[0] - a[0] * b[1]) * inverse


def squared_magnitude(value: Pair) -> jax.Array:
    """Squared magnitude [...] of a complex number, (real, imaginary) [...]."""
    return value[0] * value[0] + value[1] * value[1]


def safe_sqrt(value: jax.Array) -> jax.Array:
    """Square root of non-negative numbers [...], with derivative 0 instead of infinity at 0."""
    positive = value > 0
    # The inner `where` avoids an infinite derivative in the branch that is not selected.
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)


def materialize(values: Values, positive: jax.Array) -> Values:
    """Compute and store the values once; `positive` is any positive number that is unknown at compile time.

    On the CPU, XLA fuses a computation into each of its uses, so it repeats sines and exponentials many times. XLA also
    removes `optimization_barrier`. XLA cannot fuse across a branch on a value that is unknown at compile time.
    """
    return jax.lax.cond(
        positive > 0, lambda kept: kept, lambda kept: jax.tree.map(jnp.negative, kept), values
    )


@jax.custom_jvp
def cosine_and_sine(angle: ArrayLike) -> tuple[jax.Array, jax.Array]:
    """Cosine and sine of angles [...], [rad].

    In double precision, XLA on the CPU calls the system's mathematical functions for one number at a time. This takes
    about 30 ns for a cosine and a sine. Polynomials without branches are vectorized and take 2 ns. Each result is
    within 2.3e-16 of the true value. Beyond a million turns, the rounding error of the angle itself dominates.
    """
    angle_as_given = jnp.asarray(angle)
    angle = angle_as_given.astype(jnp.float64)
    # The angle is `quarters` quarter turns plus a remainder of magnitude at most pi / 4. Subtracting the two parts of
    # pi / 2 in turn keeps the remainder accurate.
    quarters = jnp.round(angle * (2 / jnp.pi))
    rest = (angle - quarters * _QUARTER[0]) - quarters * _QUARTER[1]
    square = rest * rest
    sine, cosine = rest * _polynomial(_SINE, square), _polynomial(_COSINE, square)
    quadrant = quarters - 4 * jnp.floor(quarters / 4)  # 0, 1, 2 or 3
    odd = (quadrant == 1) | (quadrant == 3)
    # An odd number of quarter turns swaps cosine and sine. The cosine is negative in quadrants 1 and 2, and the sine in
    # quadrants 2 and 3.
    across, along = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    cosine = jnp.where((quadrant == 1) | (quadrant == 2), -across, across)
    sine = jnp.where(quadrant >= 2, -along, along)
    return cosine.astype(angle_as_given.dtype), sine.astype(angle_as_given.dtype)


@cosine_and_sine.defjvp
def _cosine_and_sine_jvp(primals: tuple, tangents: tuple) -> tuple:
    (angle,), (rate,) = primals, tangents
    cosine, sine = cosine_and_sine(angle)
    return (cosine, sine), (-sine * rate, cosine * rate)


def _polynomial(factors: tuple[float, ...], x: jax.Array) -> jax.Array:
    """Value of a polynomial by Horner's scheme; the coefficients start at the highest power."""
    value = jnp.full_like(x, factors[0])
    for factor in factors[1:]:
        value = value * x + factor
    return value


BLOCK: Final = 32
"""Number of values in a block."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Segments:
    """The segments of an array of numbers.

    Attributes:
        order: Order [n] in which the numbers are added, whole blocks first; None if the order is unchanged.
        segment: Index [blocks + n - BLOCK x blocks] of the segment of every block, then of every remaining number.
        blocks: Number of whole blocks.
        count: Number of segments.
    """

    order: jax.Array | None
    segment: jax.Array
    blocks: int = field(metadata={"static": True})
    count: int = field(metadata={"static": True})


def make_segments(segment: NDArray[np.integer], count: int) -> Segments:
    """Prepare sums over segments from the segment index of each number [n] and the number of segments."""
    size = np.bincount(segment, minlength=count)
    if not (size >= BLOCK).any():
        return Segments(None, jax.device_put(segment.astype(np.int32)), 0, count)
    order = np.argsort(segment, kind="stable")
    rank = np.arange(len(segment)) - np.repeat(np.cumsum(size) - size, size)  # within its segment
    # The first numbers of each segment fill whole blocks; the remainder does not.
    in_block = rank < np.repeat(size // BLOCK * BLOCK, size)
    order = np.concatenate([order[in_block], order[~in_block]])
    blocks = int(in_block.sum()) // BLOCK
    owner = np.concatenate([segment[order[: blocks * BLOCK : BLOCK]], segment[order[blocks * BLOCK :]]])
    return Segments(
        jax.device_put(order.astype(np.int32)), jax.device_put(owner.astype(np.int32)), blocks, count
    )


def segment_sums(segments: Segments, values: jax.Array) -> jax.Array:
    """Sums [count] of the numbers [n] in each segment; 0 for a segment without numbers."""
    if segments.order is not None:
        end = segments.blocks * BLOCK
        blocks = values.at[segments.order[:end]].get(mode="promise_in_bounds").reshape(-1, BLOCK).sum(axis=1)
        rest = values.at[segments.order[end:]].get(mode="promise_in_bounds")
        values = jnp.concatenate([blocks, rest])
    return jax.ops.segment_sum(values, segments.segment, segments.count)
