"""Coefficients of a homogeneous slab in air (ITU-R P.2040-3 section 2.2.2.2), in real arithmetic.

Complex numbers are pairs (real, imaginary): compilers vectorize that form, and it runs several times faster than
complex types. All functions are elementwise and differentiable.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from scipy.constants import epsilon_0, speed_of_light

from calibray.fields.trigonometry import circle

Pair = tuple[jax.Array, jax.Array]
Values = TypeVar("Values")


def loss_term(conductivity: jax.Array, wavelength: jax.Array) -> jax.Array:
    """Sigma / (2 pi f eps_0), the negative imaginary part of eta (ITU-R P.2040-3 eq. 9).

    Args:
        conductivity: [S/m].
        wavelength: [m].

    Returns:
        The term [1].
    """
    return conductivity * wavelength / (2 * jnp.pi * speed_of_light * epsilon_0)


def keep(values: Values, positive: jax.Array) -> Values:
    """The same values, computed once.

    XLA on CPU fuses a computation into each of its uses, and so repeats sines and exponentials many times over; it
    also drops `optimization_barrier`. It cannot look through a branch on a value that it does not know.

    Args:
        values: Arrays.
        positive: Any positive number known at run time only.

    Returns:
        The values.
    """
    return jax.lax.cond(
        positive > 0, lambda kept: kept, lambda kept: jax.tree.map(jnp.negative, kept), values
    )


def coefficients(
    cosine: jax.Array,
    permittivity: jax.Array,
    loss: jax.Array,
    thickness: jax.Array,
    wavelength: jax.Array,
    transmitted: jax.Array | bool,
) -> tuple[Pair, Pair]:
    """Transverse electric and magnetic coefficient of reflection or transmission.

    Args:
        cosine: Cosine of the angle of incidence [...].
        permittivity: Relative permittivity eps_r [...].
        loss: `loss_term` [...].
        thickness: Thickness d [...], [m].
        wavelength: [m].
        transmitted: Where the transmission coefficient is wanted in place of the reflection coefficient [...].

    Returns:
        The two coefficients, each as (real, imaginary) [...], in the precision of the cosine. They are computed in
        double precision: the fourth power of a metal's permittivity is beyond the range of single precision.
    """
    precision = cosine.dtype
    cosine, permittivity, loss, thickness, wavelength = (
        jnp.asarray(value, jnp.float64) for value in (cosine, permittivity, loss, thickness, wavelength)
    )
    root = keep(_root((permittivity - 1) + cosine * cosine, loss), wavelength)  # sqrt(eta - sin^2 theta)
    scale = 2 * jnp.pi * thickness / wavelength
    decay, (cosine_q, sine_q) = jnp.exp(scale * root[1]), circle(scale * root[0])
    phase = keep((decay * cosine_q, -decay * sine_q), wavelength)  # e^{-jq}, q of eq. 44
    across = multiply(phase, phase)
    eta_cosine = permittivity * cosine, -loss * cosine
    te = _slab(
        (cosine - root[0], -root[1]), (cosine + root[0], root[1]), phase, across, transmitted
    )  # eq. 37a
    tm = _slab(
        (eta_cosine[0] - root[0], eta_cosine[1] - root[1]),
        (eta_cosine[0] + root[0], eta_cosine[1] + root[1]),
        phase,
        across,
        transmitted,
    )  # eq. 37b
    return (te[0].astype(precision), te[1].astype(precision)), (
        tm[0].astype(precision),
        tm[1].astype(precision),
    )


def safe_sqrt(value: jax.Array) -> jax.Array:
    """Square root with derivative 0 instead of infinity at 0.

    Args:
        value: At least 0 [...].

    Returns:
        The root [...].
    """
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)


def multiply(a: Pair, b: Pair) -> Pair:
    """Product of two complex numbers.

    Args:
        a: The one, (real, imaginary) [...].
        b: The other [...].

    Returns:
        The product [...].
    """
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def power(value: Pair) -> jax.Array:
    """Squared magnitude of a complex number.

    Args:
        value: (real, imaginary) [...].

    Returns:
        The square [...].
    """
    return value[0] * value[0] + value[1] * value[1]


def _slab(less: Pair, more: Pair, phase: Pair, across: Pair, transmitted: jax.Array | bool) -> Pair:
    """Coefficient of a slab whose half space has R' = less / more, with one division for all."""
    square, norm = multiply(less, less), multiply(more, more)
    loop = multiply(square, across)
    denominator = norm[0] - loop[0], norm[1] - loop[1]
    wanted = multiply(multiply(less, more), (1 - across[0], -across[1]))  # eq. 43a
    if transmitted is not False:
        through = multiply((norm[0] - square[0], norm[1] - square[1]), phase)  # eq. 43b
        wanted = tuple(jnp.where(transmitted, t, r) for t, r in zip(through, wanted, strict=True))
    return _divide((wanted[0], wanted[1]), denominator)


def _root(real: jax.Array, loss: jax.Array) -> Pair:
    """Principal square root of real - j loss, both at least 0; 1e-30 at least, whose fourth power is a number."""
    size = jnp.maximum(real, 1e-60)
    modulus = jnp.sqrt(size * size + loss * loss)
    root = jnp.sqrt(0.5 * (modulus + size))
    return root, -0.5 * loss / root


def _divide(a: Pair, b: Pair) -> Pair:
    inverse = 1 / (b[0] * b[0] + b[1] * b[1])
    return (a[0] * b[0] + a[1] * b[1]) * inverse, (a[1] * b[0] - a[0] * b[1]) * inverse
