"""Reflection and transmission coefficients of a homogeneous slab in air (ITU-R P.2040-3 section 2.2.2.2)."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import jax
import jax.numpy as jnp
from scipy.constants import epsilon_0, speed_of_light

from calibray.fields.arithmetic import Pair, cosine_and_sine, divide, materialize, multiply, safe_sqrt
from calibray.materials import FIELDS

FIELD_COLUMN: Final = {name: column for column, name in enumerate(FIELDS)}
"""Column of each material constant in a table of materials."""

_SELECTED_MATERIALS: Final = 12
"""Largest number of materials for which a constant is selected by comparing indices. With more materials, constants are
gathered: XLA gathers one number at a time, but vectorizes comparisons."""


class Mode(IntEnum):
    """Kind of a slab coefficient."""

    REFLECTION = 0
    """Coefficient of a specular reflection or a wedge face; reduced by the scattered energy."""
    TRANSMISSION = 1
    FULL_REFLECTION = 2
    """Reflection coefficient in a diffuse interaction; not reduced."""


def loss_term(conductivity: jax.Array, wavelength: jax.Array) -> jax.Array:
    """Minus the imaginary part of the complex relative permittivity [1], from a conductivity [S/m]."""
    # ITU-R P.2040-3 eq. 9: eta'' = sigma / (2 pi f eps_0), f = c / lambda.
    return conductivity * wavelength / (2 * jnp.pi * speed_of_light * epsilon_0)


def coefficients(
    cosine: jax.Array,
    permittivity: jax.Array,
    loss: jax.Array,
    thickness: jax.Array,
    wavelength: jax.Array,
    transmitted: jax.Array | bool,
) -> tuple[Pair, Pair]:
    """Transverse electric and magnetic coefficients of reflection, or of transmission where `transmitted` is true.

    The permittivity is relative, `loss` comes from `loss_term`, and thickness and wavelength are in metres. Each
    coefficient is a pair (real, imaginary) [...] in the precision of the cosine. Internally, coefficients are computed
    in double precision, because the fourth power of a metal's permittivity exceeds the range of single precision.
    """
    precision = cosine.dtype
    cosine, permittivity, loss, thickness, wavelength = (
        jnp.asarray(value, jnp.float64) for value in (cosine, permittivity, loss, thickness, wavelength)
    )
    # sqrt(eta - sin^2 theta) of eqs. 37 and 44, with eta = eps_r - j loss (eq. 9)
    root = materialize(_root((permittivity - 1) + cosine * cosine, loss), wavelength)
    # eq. 44: q = (2 pi d / lambda) sqrt(eta - sin^2 theta)
    scale = 2 * jnp.pi * thickness / wavelength
    decay, (cosine_q, sine_q) = jnp.exp(scale * root[1]), cosine_and_sine(scale * root[0])
    phase = materialize((decay * cosine_q, -decay * sine_q), wavelength)  # e^{-jq}
    phase_twice = multiply(phase, phase)  # e^{-j2q}
    eta_cosine = permittivity * cosine, -loss * cosine
    # eq. 37a: R'_te = (cos theta - root) / (cos theta + root)
    te = _slab((cosine - root[0], -root[1]), (cosine + root[0], root[1]), phase, phase_twice, transmitted)
    # eq. 37b: R'_tm = (eta cos theta - root) / (eta cos theta + root)
    tm = _slab(
        (eta_cosine[0] - root[0], eta_cosine[1] - root[1]),
        (eta_cosine[0] + root[0], eta_cosine[1] + root[1]),
        phase,
        phase_twice,
        transmitted,
    )
    return (te[0].astype(precision), te[1].astype(precision)), (
        tm[0].astype(precision),
        tm[1].astype(precision),
    )


def coefficients_of_materials(
    cosine: jax.Array,
    table: jax.Array,
    material: jax.Array,
    wavelength: jax.Array,
    transmitted: jax.Array | bool,
    unreduced: jax.Array,
) -> tuple[Pair, Pair]:
    """Coefficients [...] from material constants [M, 8].

    Scattering reduces the reflection coefficients, except where `unreduced` [...] is true.
    """
    column = {name: table[:, index] for name, index in FIELD_COLUMN.items()}
    te, tm = coefficients(
        cosine,
        _of_material(column["relative_permittivity"], material),
        _of_material(loss_term(column["conductivity"], wavelength), material),
        _of_material(column["thickness"], material),
        wavelength,
        transmitted,
    )
    # A reflection keeps sqrt(1 - S^2) of its amplitude (Degli-Esposti et al. 2007).
    reduction = _of_material(safe_sqrt(1 - column["scattering_coefficient"] ** 2), material)
    factor = jnp.where(unreduced, 1.0, reduction).astype(cosine.dtype)
    return (te[0] * factor, te[1] * factor), (tm[0] * factor, tm[1] * factor)


def _of_material(constant: jax.Array, material: jax.Array) -> jax.Array:
    """Constant [M] of each interaction's material [...]."""
    if not 0 < len(constant) <= _SELECTED_MATERIALS:
        return constant[material]
    value = jnp.broadcast_to(constant[0], material.shape)
    for number in range(1, len(constant)):
        value = jnp.where(material == number, constant[number], value)
    return value


def _slab(
    numerator: Pair, denominator: Pair, phase: Pair, phase_twice: Pair, transmitted: jax.Array | bool
) -> Pair:
    """Coefficient of a slab, given the half-space coefficient R' = numerator / denominator.

    Numerators and denominators of eqs. 43a and 43b are multiplied by the squared denominator of R', so that one
    division suffices.
    """
    square, norm = multiply(numerator, numerator), multiply(denominator, denominator)
    round_trip = multiply(square, phase_twice)
    divisor = norm[0] - round_trip[0], norm[1] - round_trip[1]
    # eq. 43a: R = R' (1 - e^{-j2q}) / (1 - R'^2 e^{-j2q})
    dividend = multiply(multiply(numerator, denominator), (1 - phase_twice[0], -phase_twice[1]))
    if transmitted is not False:
        # eq. 43b: T = (1 - R'^2) e^{-jq} / (1 - R'^2 e^{-j2q})
        through = multiply((norm[0] - square[0], norm[1] - square[1]), phase)
        dividend = (
            jnp.where(transmitted, through[0], dividend[0]),
            jnp.where(transmitted, through[1], dividend[1]),
        )
    return divide(dividend, divisor)


def _root(real: jax.Array, loss: jax.Array) -> Pair:
    """Principal square root of real - j loss, for non-negative arguments.

    The magnitude is at least 1e-30, so that its fourth power does not underflow.
    """
    size = jnp.maximum(real, 1e-60)
    modulus = jnp.sqrt(size * size + loss * loss)
    root = jnp.sqrt(0.5 * (modulus + size))
    return root, -0.5 * loss / root
