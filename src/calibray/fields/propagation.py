"""Fields carried along paths: the chain of Jones matrices between the two antennas.

- reflection and transmission: a real rotation into the frame of incidence, then the diagonal (c_te, c_tm);
- diffuse reflection: not linear in the field, its amplitude follows the field reflected specularly;
- diffraction: affine in the reflection coefficients of the two faces, J = C_0 + sum_k R_k C_k.
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp

from calibray.fields import slab
from calibray.fields.contributions import Pieces
from calibray.fields.program import Group, GroupedProgram


class Keep(Protocol):
    """What makes of numbers the same numbers, held for a reverse pass or not."""

    def __call__(self, values: slab.Values, /) -> slab.Values: ...  # noqa: D102


def path_fields(
    program: GroupedProgram,
    pieces: tuple[Pieces, ...],
    keep: Keep = lambda values: values,
) -> slab.Pair:
    """Gains of all paths.

    Args:
        program: The program.
        pieces: What the materials contribute at every position of every group.
        keep: Applied to the field after every interaction.

    Returns:
        Gains in the order of the groups, real and imaginary part [R, T, P].
    """
    parts = [_group_gains(group, piece, keep) for group, piece in zip(program.groups, pieces, strict=True)]
    if not parts:
        empty = jnp.zeros((1, 1, 0), dtype=program.wavelength.dtype)
        return empty, empty
    real, imaginary = (jnp.concatenate(side, axis=-1) for side in zip(*parts, strict=True))
    return real, imaginary


def _group_gains(group: Group, pieces: Pieces, keep: Keep) -> slab.Pair:
    """Gains of one group's paths, (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx, real and imaginary part [R, T, n]."""
    te, tm = (_complex(group.tx, component) for component in range(2))  # [T, n]
    coefficients, diffuse = iter(pieces[0]), iter(pieces[1])
    for step, letter in enumerate(group.signature):
        c_te, c_tm = next(coefficients)
        if letter == "r":
            te, tm = _row(te, tm, c_te, c_tm, group.rotation[step], keep)
            continue
        te, tm = _turn(group.rotation[step], te, tm)
        if letter == "c":
            te, tm = slab.multiply(c_te, te), slab.multiply(c_tm, tm)
        elif letter == "s":
            te, tm = _scatter(te, tm, c_te, c_tm, *next(diffuse), group.turn[step], keep)
        else:
            te, tm = _diffract(te, tm, (c_te, c_tm, *next(coefficients)), group.wedge[step])
        te, tm = keep((te, tm))
    real = imaginary = jnp.zeros((), dtype=te[0].dtype)
    for component, field in enumerate((te, tm)):  # E_rx^H E
        rx_real, rx_imaginary = (part[:, None] for part in _complex(group.rx, component))  # [R, 1, n]
        real = real + rx_real * field[0] + rx_imaginary * field[1]
        imaginary = imaginary + rx_real * field[1] - rx_imaginary * field[0]
    return real, imaginary


def _complex(field: jax.Array, component: int) -> slab.Pair:
    """One component of an antenna's field [ports, n], whose imaginary part is not stored where there is none."""
    real = field[0, :, component]
    return real, field[1, :, component] if field.shape[0] == 2 else jnp.zeros_like(real)


def _turn(rotation: jax.Array, a: slab.Pair, b: slab.Pair) -> tuple[slab.Pair, slab.Pair]:
    cos, sin = rotation
    return (cos * a[0] + sin * b[0], cos * a[1] + sin * b[1]), (
        cos * b[0] - sin * a[0],
        cos * b[1] - sin * a[1],
    )


def _row(
    te: slab.Pair, tm: slab.Pair, c_te: slab.Pair, c_tm: slab.Pair, rotation: jax.Array, keep: Keep
) -> tuple[slab.Pair, slab.Pair]:
    """Reflections and transmissions in a row; a loop of XLA would take twice as long, and no less to compile."""
    for step, turn in enumerate(rotation):
        te, tm = _turn(turn, te, tm)
        te = slab.multiply((c_te[0][step], c_te[1][step]), te)
        tm = slab.multiply((c_tm[0][step], c_tm[1][step]), tm)
        te, tm = keep((te, tm))
    return te, tm


def _scatter(
    te: slab.Pair,
    tm: slab.Pair,
    r_te: slab.Pair,
    r_tm: slab.Pair,
    straight: jax.Array,
    crossed: jax.Array,
    turn: jax.Array,
    keep: Keep,
) -> tuple[slab.Pair, slab.Pair]:
    """Diffuse reflection: S Gamma sqrt(f_s dOmega) times the XPD rotation (Degli-Esposti et al. 2007)."""
    incident = slab.power(te) + slab.power(tm)
    reflected = slab.power(r_te) * slab.power(te) + slab.power(r_tm) * slab.power(tm)
    ratio = keep(slab.safe_sqrt(reflected / jnp.where(incident > 0, incident, 1.0)))  # Gamma = |R E| / |E|
    theta, phi = _turn(turn, te, tm)  # the XPD matrix acts in the basis (theta, phi)
    straight, crossed = straight * ratio, crossed * ratio
    return (
        (straight * theta[0] - crossed * phi[0], straight * theta[1] - crossed * phi[1]),
        (crossed * theta[0] + straight * phi[0], crossed * theta[1] + straight * phi[1]),
    )


def _diffract(
    te: slab.Pair, tm: slab.Pair, coefficients: tuple[slab.Pair, ...], form: jax.Array
) -> tuple[slab.Pair, slab.Pair]:
    """Diffraction, J = C_0 + sum_k R_k C_k."""
    real, imaginary = form[0, 0], form[1, 0]  # [2, 2, n]
    for k, (r_real, r_imaginary) in enumerate(coefficients, start=1):
        real = real + r_real * form[0, k] - r_imaginary * form[1, k]
        imaginary = imaginary + r_real * form[1, k] + r_imaginary * form[0, k]
    rows = []
    for i in range(2):
        a = slab.multiply((real[i, 0], imaginary[i, 0]), te)
        b = slab.multiply((real[i, 1], imaginary[i, 1]), tm)
        rows.append((a[0] + b[0], a[1] + b[1]))
    return rows[0], rows[1]
