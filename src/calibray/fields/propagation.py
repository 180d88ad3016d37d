"""Propagates fields along paths: the chain of Jones matrices between the two antennas.

- Reflection and transmission: a real rotation into the frame of incidence, then the diagonal (c_te, c_tm).
- Diffuse reflection: not linear in the field, because its amplitude follows the specularly reflected field.
- Diffraction: affine in the reflection coefficients of the wedge's two faces, J = C_0 + sum_k R_k C_k.
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp

from calibray.fields.arithmetic import Pair, Values, multiply, safe_sqrt, squared_magnitude
from calibray.fields.grouping import COEFFICIENT, RUN, SCATTERING
from calibray.fields.material_response import GroupResponse
from calibray.fields.program import Group, GroupedProgram


class Keep(Protocol):
    """The identity, or a function that stores the values for a reverse pass."""

    def __call__(self, values: Values, /) -> Values: ...  # noqa: D102


def path_fields(
    program: GroupedProgram,
    responses: tuple[GroupResponse, ...],
    keep: Keep = lambda values: values,
) -> Pair:
    """Gains of all paths in the order of the groups, real and imaginary part [R, T, P].

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
    """Gains of one group's paths, real and imaginary part [R, T, n].

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
    for component, field in enumerate((te, tm)):  # E_rx^H E
        rx_real, rx_imaginary = (part[:, None] for part in _component(group.rx, component))  # [R, 1, n]
        real = real + rx_real * field[0] + rx_imaginary * field[1]
        imaginary = imaginary + rx_real * field[1] - rx_imaginary * field[0]
    return real, imaginary


def _component(field: jax.Array, component: int) -> Pair:
    """One component of an antenna's field [ports, n]; the imaginary part is not stored if it is 0 everywhere."""
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

    The loop is unrolled: a loop of XLA takes twice as long to run and as long to compile.
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
    # Gamma = |R E| / |E|, of the incident field
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
