"""Path loss of links: the chain of Jones matrices between the antennas of every path, and the sum over paths.

- Reflection and transmission: a real rotation into the frame of incidence, then the diagonal (c_te, c_tm).
- Diffuse reflection: not linear in the field, because its amplitude depends on the magnitude of the specularly
  reflected field.
- Diffraction: affine in the reflection coefficients of the wedge's two faces, J = C_0 + sum_k R_k C_k.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Final, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fields.arithmetic import Pair, Values, cosine_and_sine, multiply, safe_sqrt, squared_magnitude
from calibray.fields.grouping import COEFFICIENT, RUN, SCATTERING
from calibray.fields.jax_context import jax_settings
from calibray.fields.material_response import GroupResponse
from calibray.fields.program import Group, GroupedProgram


class Keep(Protocol):
    """The identity, or a function that stores the values for a reverse pass."""

    def __call__(self, values: Values, /) -> Values: ...  # noqa: D102


def path_fields(
    program: GroupedProgram, responses: tuple[GroupResponse, ...], keep: Keep = lambda values: values
) -> Pair:
    """Gains [R, T, P] of all paths in the order of the groups, as real and imaginary parts.

    `keep` is applied to the field after every interaction.
    """
    gains = [
        _group_gains(group, response, keep) for group, response in zip(program.groups, responses, strict=True)
    ]
    if not gains:
        empty = jnp.zeros((1, 1, 0), dtype=program.wavelength.dtype)
        return empty, empty
    real, imaginary = (jnp.concatenate(part, axis=-1) for part in zip(*gains, strict=True))
    return real, imaginary


def _group_gains(group: Group, response: GroupResponse, keep: Keep) -> Pair:
    """Gains [R, T, n] of one group's paths, as real and imaginary parts.

    The gain of a path is a = (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx; the factor (lambda / 4 pi) A is part of `rx`.
    """
    te, tm = (_component(group.tx, component) for component in range(2))  # [T, n]
    coefficients, amplitudes = iter(response[0]), iter(response[1])
    for step, letter in enumerate(group.signature):
        c_te, c_tm = next(coefficients)
        if letter == RUN:
            te, tm = _run(te, tm, c_te, c_tm, group.rotation[step], keep)
            continue
        te, tm = _rotate(group.rotation[step], te, tm)
        if letter == COEFFICIENT:
            te, tm = multiply(c_te, te), multiply(c_tm, tm)
        elif letter == SCATTERING:
            te, tm = _scatter((te, tm), (c_te, c_tm), next(amplitudes), group.turn[step], keep)
        else:
            te, tm = _diffract(te, tm, (c_te, c_tm, *next(coefficients)), group.wedge[step])
        te, tm = keep((te, tm))
    real = imaginary = jnp.zeros((), dtype=te[0].dtype)
    for component, wave in enumerate((te, tm)):  # E_rx^H E
        rx_real, rx_imaginary = (part[:, None] for part in _component(group.rx, component))  # [R, 1, n]
        real = real + rx_real * wave[0] + rx_imaginary * wave[1]
        imaginary = imaginary + rx_real * wave[1] - rx_imaginary * wave[0]
    return real, imaginary


def _component(field: jax.Array, component: int) -> Pair:
    """One component of an antenna's field [ports, n]; an imaginary part that is 0 everywhere is not stored."""
    real = field[0, :, component]
    return real, field[1, :, component] if field.shape[0] == 2 else jnp.zeros_like(real)


def _rotate(rotation: jax.Array, a: Pair, b: Pair) -> tuple[Pair, Pair]:
    cos, sin = rotation
    return (cos * a[0] + sin * b[0], cos * a[1] + sin * b[1]), (
        cos * b[0] - sin * a[0],
        cos * b[1] - sin * a[1],
    )


def _run(te: Pair, tm: Pair, c_te: Pair, c_tm: Pair, rotation: jax.Array, keep: Keep) -> tuple[Pair, Pair]:
    """Reflections and transmissions in succession.

    The loop is unrolled: an XLA loop takes twice as long to run and just as long to compile.
    """
    for step, cos_sin in enumerate(rotation):
        te, tm = _rotate(cos_sin, te, tm)
        te = multiply((c_te[0][step], c_te[1][step]), te)
        tm = multiply((c_tm[0][step], c_tm[1][step]), tm)
        te, tm = keep((te, tm))
    return te, tm


def _scatter(
    field: tuple[Pair, Pair],
    coefficients: tuple[Pair, Pair],
    amplitudes: tuple[jax.Array, jax.Array],
    turn: jax.Array,
    keep: Keep,
) -> tuple[Pair, Pair]:
    """Diffuse reflection: S Gamma sqrt(f_s dOmega) times the XPD rotation (Degli-Esposti et al. 2007)."""
    (te, tm), (r_te, r_tm), (co_polarized, cross_polarized) = field, coefficients, amplitudes
    incident = squared_magnitude(te) + squared_magnitude(tm)
    reflected = squared_magnitude(r_te) * squared_magnitude(te) + squared_magnitude(r_tm) * squared_magnitude(
        tm
    )
    # Gamma = |R E| / |E| for the incident field E
    gamma = keep(safe_sqrt(reflected / jnp.where(incident > 0, incident, 1.0)))
    theta, phi = _rotate(turn, te, tm)  # the XPD matrix acts in the basis (theta, phi)
    co, cross = co_polarized * gamma, cross_polarized * gamma
    return (
        (co * theta[0] - cross * phi[0], co * theta[1] - cross * phi[1]),
        (cross * theta[0] + co * phi[0], cross * theta[1] + co * phi[1]),
    )


def _diffract(te: Pair, tm: Pair, coefficients: tuple[Pair, ...], form: jax.Array) -> tuple[Pair, Pair]:
    """Diffraction, J = C_0 + sum_k R_k C_k."""
    real, imaginary = form[0, 0], form[1, 0]  # [2, 2, n]
    for k, (r_real, r_imaginary) in enumerate(coefficients, start=1):
        real = real + r_real * form[0, k] - r_imaginary * form[1, k]
        imaginary = imaginary + r_real * form[1, k] + r_imaginary * form[0, k]
    rows = []
    for i in range(2):
        a = multiply((real[i, 0], imaginary[i, 0]), te)
        b = multiply((real[i, 1], imaginary[i, 1]), tm)
        rows.append((a[0] + b[0], a[1] + b[1]))
    return rows[0], rows[1]


COMBINING: Final = ("power", "coherent", "band")
"""Names of the methods of combining paths."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Combining:
    """Method of combining the paths of a link.

    Attributes:
        kind: "power": sum |a|^2; "coherent": |sum a e^{-j 2 pi f tau}|^2; "band": the average of the coherent power
            over a band.
        nodes: For "band": frequencies relative to the carrier [Hz] and weights [2, q]; otherwise None.
    """

    kind: str = field(default="power", metadata={"static": True})
    nodes: NDArray[np.float64] | None = None

    @classmethod
    def make(
        cls, kind: str, link: NDArray[np.integer], delay: NDArray[np.float64], bandwidth: float | None = None
    ) -> Combining:
        """Check and prepare a method of combining paths: "power", "coherent", or "band" with a bandwidth [Hz].

        `link` [P] must be non-decreasing. `delay` [P] is in seconds.

        Raises:
            InputError: The kind is unknown, or the bandwidth is missing or not positive.
        """
        if kind not in COMBINING:
            raise InputError(f"combining = {kind!r}: must be one of {', '.join(COMBINING)}")
        return cls(kind, _band_nodes(link, delay, bandwidth) if kind == "band" else None)


POWER: Final = Combining()
"""Combining paths by summing their powers."""


def _band_nodes(
    link: NDArray[np.integer], delay: NDArray[np.float64], bandwidth: float | None
) -> NDArray[np.float64]:
    """Gauss-Legendre nodes and weights [2, q] over a band, with enough nodes for the largest delay span of any link.

    The average of |H|^2 over the band contains oscillations e^{j 2 pi f (tau_i - tau_j)}. A quadrature rule with n
    nodes integrates these oscillations to machine precision if n exceeds about ten plus a quarter of their phase change
    over the band.

    Raises:
        InputError: The bandwidth is not positive.
    """
    if bandwidth is None or not (np.isfinite(bandwidth) and bandwidth > 0):
        raise InputError(f'combining = "band": the bandwidth [Hz] must be a positive number, not {bandwidth}')
    spread = 0.0
    if len(link):
        start = np.flatnonzero(np.diff(link, prepend=-1))
        spread = float(np.max(np.maximum.reduceat(delay, start) - np.minimum.reduceat(delay, start)))
    nodes, weights = np.polynomial.legendre.leggauss(int(np.pi * bandwidth * spread) + 12)
    return np.stack([nodes * bandwidth / 2, weights / 2])


def path_power(gain: Pair) -> jax.Array:
    """Power gain [P] of every path, summed over receive ports and averaged over transmit ports.

    Path gains are given as real and imaginary parts [R, T, P].
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
    """Power gain [L] of every link, from its path gains [R, T, P]; 0 for a link without a path.

    With several ports, the power is summed over receive ports and averaged over transmit ports.
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
    """Path loss -10 log10(power) [dB] from power gains; +inf where the power is 0."""
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
    """Path loss [L], [dB], of every link, from complex path gains [P, R, T]; +inf for a link without a path."""
    real, imaginary = (jnp.asarray(np.moveaxis(part, 0, -1)) for part in (gain.real, gain.imag))
    return np.asarray(decibel(link_power((real, imaginary), link, delay, num_links, frequency, combining)))
