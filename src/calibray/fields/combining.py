"""From path gains to the path loss of a link."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fields.arithmetic import Pair, cosine_and_sine, multiply, squared_magnitude
from calibray.fields.jax_context import jax_settings

COMBINING: Final = ("power", "coherent", "band")
"""Names of the ways of combining paths."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Combining:
    """How the paths of a link combine.

    Attributes:
        kind: "power": sum |a|^2; "coherent": |sum a e^{-j 2 pi f tau}|^2; "band": the average of the coherent power
            over a band.
        nodes: For "band": frequencies relative to the carrier [Hz] and weights [2, q]; otherwise None.
    """

    kind: str = field(default="power", metadata={"static": True})
    nodes: NDArray[np.float64] | None = None

    @classmethod
    def make(
        cls,
        kind: str,
        link: NDArray[np.integer],
        delay: NDArray[np.float64],
        bandwidth: float | None = None,
    ) -> Combining:
        """Check a way of combining, "power", "coherent" or "band" with a bandwidth [Hz], and prepare it for paths.

        Links of the paths [P] do not decrease; delays are [P], [s].

        Raises:
            InputError: The kind is unknown, or the bandwidth is missing or not positive.
        """
        if kind not in COMBINING:
            raise InputError(f"combining = {kind!r}: must be one of {', '.join(COMBINING)}")
        return cls(kind, _band_nodes(link, delay, bandwidth) if kind == "band" else None)


POWER: Final = Combining()
"""The sum of powers."""


def _band_nodes(
    link: NDArray[np.integer], delay: NDArray[np.float64], bandwidth: float | None
) -> NDArray[np.float64]:
    """Gauss-Legendre nodes and weights over a band [2, q], enough for the largest spread of delays within a link.

    The average of |H|^2 over the band contains oscillations e^{j 2 pi f (tau_i - tau_j)}. A rule with n nodes
    integrates them to machine precision if n exceeds about a quarter of their phase [rad] plus ten.

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


def path_power(gain: Pair) -> jax.Array:
    """Power gain of every path [P], summed over receive ports and averaged over transmit ports.

    Path gains are [R, T, P], real and imaginary part.
    """
    return squared_magnitude(gain).sum(axis=(0, 1)) / gain[0].shape[1]


def link_power(
    gain: Pair,
    link: jax.Array | NDArray[np.integer],
    delay: jax.Array | NDArray[np.float64],
    num_links: int,
    frequency: jax.Array | float,
    combining: Combining = POWER,
) -> jax.Array:
    """Power gain of every link [L] from its path gains [R, T, P]; 0 for a link without a path.

    With several ports the power is summed over receive ports and averaged over transmit ports.
    """
    total = partial(jax.ops.segment_sum, segment_ids=link, num_segments=num_links)
    if combining.kind == "power":
        return total(path_power(gain))
    ports = gain[0].shape[1]
    nodes = jnp.array([[0.0], [1.0]]) if combining.nodes is None else jnp.asarray(combining.nodes)
    phase = -2 * jnp.pi * jnp.asarray(delay)[:, None] * (frequency + nodes[0])  # -2 pi f tau [P, q]
    turn = cosine_and_sine(phase)
    turned = multiply((gain[0][..., None], gain[1][..., None]), turn)  # a e^{-j 2 pi f tau} [R, T, P, q]
    real, imaginary = (total(jnp.moveaxis(part, 2, 0)) for part in turned)  # [L, R, T, q]
    return (squared_magnitude((real, imaginary)) * nodes[1]).sum(axis=(1, 2, 3)) / ports


def decibel(power: jax.Array) -> jax.Array:
    """Path loss -10 log10(power) of power gains [dB]; +inf where the power is 0."""
    reached = power > 0
    return jnp.where(reached, -10 * jnp.log10(jnp.where(reached, power, 1.0)), jnp.inf)


@jax_settings()
def path_loss_of_gains(
    gain: NDArray[np.complex128],
    link: NDArray[np.integer],
    delay: NDArray[np.float64],
    num_links: int,
    frequency: float,
    combining: Combining = POWER,
) -> NDArray[np.float64]:
    """Path loss of every link [L], [dB], from complex path gains [P, R, T]; +inf for a link without a path."""
    real, imaginary = (jnp.asarray(np.moveaxis(part, 0, -1)) for part in (gain.real, gain.imag))
    return np.asarray(decibel(link_power((real, imaginary), link, delay, num_links, frequency, combining)))
