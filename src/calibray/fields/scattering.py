"""Scattering patterns f_s of diffuse reflection (Degli-Esposti et al., IEEE Trans. Antennas Propag. 55(1), 2007)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import binom

from calibray.fields.slab import FIELD_COLUMN

LARGEST_EXPONENT = 64
"""Largest exponent alpha of a lobe whose normalization is tabulated; beyond, it is extrapolated linearly."""


def pattern_value(
    table: jax.Array,
    material: jax.Array,
    cosine: jax.Array,
    cos_scattered: jax.Array,
    cos_specular: jax.Array,
    cos_backward: jax.Array,
    patterns: tuple[str, ...],
) -> jax.Array:
    """Density f_s [n], [1/sr], of the diffusely reflected power over directions.

    The cosines [n] are those of the angle of incidence, and between the scattered direction and the normal, the
    specular direction and the direction back to the source.
    """
    lambertian = cos_scattered / jnp.pi
    if all(pattern == "lambertian" for pattern in patterns):
        return lambertian
    alpha_r, alpha_i, share = (
        table[:, FIELD_COLUMN[name]][material] for name in ("alpha_r", "alpha_i", "lambda_")
    )
    # The directive pattern is the backscattering one with all energy in the lobe around the specular direction.
    is_directive = jnp.asarray(np.array([pattern == "directive" for pattern in patterns]))[material]
    share, alpha_i = jnp.where(is_directive, 1.0, share), jnp.where(is_directive, 1.0, alpha_i)
    lobes = (
        share * (0.5 * (1 + cos_specular)) ** alpha_r + (1 - share) * (0.5 * (1 + cos_backward)) ** alpha_i
    )
    norm = share * _normalization(alpha_r, cosine) + (1 - share) * _normalization(alpha_i, cosine)
    is_lambertian = jnp.asarray(np.array([pattern == "lambertian" for pattern in patterns]))[material]
    return jnp.where(is_lambertian, lambertian, lobes / norm)


def _normalization(alpha: jax.Array, cosine: jax.Array) -> jax.Array:
    """F_alpha, integral of a lobe over the half space (eqs. 7 and 8 of the paper); linear between whole exponents."""
    low = jnp.clip(jnp.floor(alpha), 1, LARGEST_EXPONENT - 1)
    weight = alpha - low
    values = _whole_normalizations(cosine)
    row = low.astype(jnp.int32)
    column = jnp.arange(values.shape[1])
    return (1 - weight) * values[row, column] + weight * values[row + 1, column]


def _whole_normalizations(cosine: jax.Array) -> jax.Array:
    """F_alpha for alpha = 0 .. LARGEST_EXPONENT [alpha, n].

    F_alpha = 2^-alpha sum_j binom(alpha, j) I_j. I_j is 2 pi / (j + 1) for even j, and for odd j that times
    cos theta sum_{w <= (j - 1) / 2} binom(2w, w) (sin^2 theta / 4)^w.
    """
    sine_squared = 1 - cosine**2
    moments, series = [], jnp.zeros_like(cosine)
    for j in range(LARGEST_EXPONENT + 1):
        if j % 2 == 0:
            moments.append(jnp.full_like(cosine, 2 * np.pi / (j + 1)))
        else:
            w = (j - 1) // 2
            series = series + binom(2 * w, w) / 4.0**w * sine_squared**w
            moments.append(cosine * series * 2 * np.pi / (j + 1))
    weights = np.array(
        [
            [binom(alpha, j) / 2.0**alpha for j in range(LARGEST_EXPONENT + 1)]
            for alpha in range(LARGEST_EXPONENT + 1)
        ]
    )
    return jnp.asarray(weights, dtype=cosine.dtype) @ jnp.stack(moments)
