"""From path gains to the path loss of a link."""

from __future__ import annotations

from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fields import slab
from calibray.fields.trigonometry import circle
from calibray.paths import Paths

Offsets = jax.Array | NDArray[np.float64] | None
"""Frequencies relative to the carrier [Hz] and weights [2, q]; None where the sum is at the carrier alone."""

COMBINING: Final = ("power", "coherent", "band")


def path_power(gain: slab.Pair) -> jax.Array:
    """Power gain of every path, summed over receive ports and averaged over transmit ports.

    Args:
        gain: Path gains, real and imaginary part [R, T, P].

    Returns:
        Power gains [P].
    """
    return slab.power(gain).sum(axis=(0, 1)) / gain[0].shape[1]


def link_power(
    gain: slab.Pair,
    link: jax.Array | NDArray[np.integer],
    delay: jax.Array | NDArray[np.float64],
    num_links: int,
    frequency: jax.Array | float,
    combining: str = "power",
    offsets: Offsets = None,
) -> jax.Array:
    """Power gain of every link from its path gains.

    With several ports the power is summed over receive ports and averaged over transmit ports.

    Args:
        gain: Path gains, real and imaginary part [R, T, P].
        link: Link of every path [P].
        delay: Delay of every path [P], [s].
        num_links: Number of links L.
        frequency: Carrier frequency [Hz].
        combining: "power": sum |a|^2; "coherent": |sum a e^{-j 2 pi f tau}|^2; "band": the average of the coherent
            power over a band.
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Power gain [L]; 0 where a link has no path.
    """
    total = partial(jax.ops.segment_sum, segment_ids=link, num_segments=num_links)
    if combining == "power":
        return total(path_power(gain))
    ports = gain[0].shape[1]
    nodes = jnp.array([[0.0], [1.0]]) if offsets is None else jnp.asarray(offsets)
    phase = -2 * jnp.pi * jnp.asarray(delay)[:, None] * (frequency + nodes[0])  # [P, q]
    turn = circle(phase)
    rotated = slab.multiply((gain[0][..., None], gain[1][..., None]), turn)  # [R, T, P, q]
    real, imaginary = (total(jnp.moveaxis(part, 2, 0)) for part in rotated)  # [L, R, T, q]
    return (slab.power((real, imaginary)) * nodes[1]).sum(axis=(1, 2, 3)) / ports


def decibel(power: jax.Array) -> jax.Array:
    """Path loss [dB] of power gains; +inf where the power is 0."""
    reached = power > 0
    return jnp.where(reached, -10 * jnp.log10(jnp.where(reached, power, 1.0)), jnp.inf)


def band_quadrature(
    link: NDArray[np.integer], delay: NDArray[np.float64], bandwidth: float | None
) -> NDArray[np.float64]:
    """Gauss-Legendre nodes over a band, enough for the largest spread of delays within a link.

    The average of |H|^2 over the band holds oscillations e^{j 2 pi f (tau_i - tau_j)}; a rule with n nodes integrates
    them to machine precision once n exceeds about a quarter of their phase [rad] plus ten.

    Args:
        link: Link of every path, non-decreasing [P].
        delay: Delay of every path [P], [s].
        bandwidth: Bandwidth [Hz].

    Returns:
        Frequencies relative to the carrier [Hz] and weights that sum to 1 [2, q].

    Raises:
        InputError: The bandwidth is not positive.
    """
    if bandwidth is None or not (np.isfinite(bandwidth) and bandwidth > 0):
        raise InputError(f'combining = "band": bandwidth = {bandwidth}: must be a positive number of Hz')
    spread = 0.0
    if len(link):
        start = np.flatnonzero(np.diff(link, prepend=-1))
        spread = float(np.max(np.maximum.reduceat(delay, start) - np.minimum.reduceat(delay, start)))
    nodes, weights = np.polynomial.legendre.leggauss(int(np.pi * bandwidth * spread) + 12)
    return np.stack([nodes * bandwidth / 2, weights / 2])


def check_combining(paths: Paths, combining: str, bandwidth: float | None) -> NDArray[np.float64] | None:
    """The quadrature that a way of combining needs.

    Args:
        paths: The path program.
        combining: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".

    Returns:
        Nodes and weights for "band" [2, q], else None.

    Raises:
        InputError: The combining is unknown, or the bandwidth is missing.
    """
    if combining not in COMBINING:
        raise InputError(f"combining = {combining!r}: must be one of {', '.join(COMBINING)}")
    return band_quadrature(paths.link, paths.delay, bandwidth) if combining == "band" else None
