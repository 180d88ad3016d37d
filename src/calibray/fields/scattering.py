"""Scattering patterns f_s of diffuse reflection (Degli-Esposti et al., IEEE Trans. Antennas Propag. 55(1), 2007)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import binom

from calibray.materials import FIELDS

LARGEST_EXPONENT = 64
"""Largest exponent alpha of a lobe that the normalization is carried to."""


def pattern_value(
    table: jax.Array,
    material: jax.Array,
    cosine: jax.Array,
    scattered: jax.Array,
    specular: jax.Array,
    backward: jax.Array,
    patterns: tuple[str, ...],
) -> jax.Array:
    """Density f_s of the diffusely reflected power over directions.

    Args:
        table: Material constants [M, 8].
        material: Material of every interaction [n].
        cosine: Cosine of the angle of incidence [n].
        scattered: Cosine between scattered direction and normal [n].
        specular: Cosine between scattered and specular direction [n].
        backward: Cosine between scattered direction and the way back [n].
        patterns: Pattern of every material, by name.

    Returns:
        f_s [n], [1/sr].
    """
    lambertian = scattered / jnp.pi
    if all(pattern == "lambertian" for pattern in patterns):
        return lambertian
    alpha_r, alpha_i, share = (
        table[:, FIELDS.index(name)][material] for name in ("alpha_r", "alpha_i", "lambda_")
    )
    directive = jnp.asarray(np.array([pattern == "directive" for pattern in patterns]))[material]
    share, alpha_i = jnp.where(directive, 1.0, share), jnp.where(directive, 1.0, alpha_i)
    lobes = share * (0.5 * (1 + specular)) ** alpha_r + (1 - share) * (0.5 * (1 + backward)) ** alpha_i
    norm = share * _normalization(alpha_r, cosine) + (1 - share) * _normalization(alpha_i, cosine)
    plain = jnp.asarray(np.array([pattern == "lambertian" for pattern in patterns]))[material]
    return jnp.where(plain, lambertian, lobes / norm)


def _normalization(alpha: jax.Array, cosine: jax.Array) -> jax.Array:
    """F_alpha, the lobe's integral over the half space (the paper's eqs. 7-8); linear between whole exponents."""
    low = jnp.clip(jnp.floor(alpha), 1, LARGEST_EXPONENT - 1)
    weight = alpha - low
    values = _whole_normalizations(cosine)
    at = low.astype(jnp.int32)
    column = jnp.arange(values.shape[1])
    return (1 - weight) * values[at, column] + weight * values[at + 1, column]


def _whole_normalizations(cosine: jax.Array) -> jax.Array:
    """F_alpha for alpha = 0 .. LARGEST_EXPONENT [alpha, n]."""
    sine_squared = 1 - cosine**2
    moments, series = [], jnp.zeros_like(cosine)
    for j in range(LARGEST_EXPONENT + 1):
        if j % 2 == 0:
            moments.append(jnp.full_like(cosine, 2 * np.pi / (j + 1)))
        else:
            k = (j - 1) // 2
            series = series + binom(2 * k, k) / 4.0**k * sine_squared**k
            moments.append(cosine * series * 2 * np.pi / (j + 1))
    weights = np.array(
        [
            [binom(alpha, j) / 2.0**alpha for j in range(LARGEST_EXPONENT + 1)]
            for alpha in range(LARGEST_EXPONENT + 1)
        ]
    )
    return jnp.asarray(weights, dtype=cosine.dtype) @ jnp.stack(moments)
