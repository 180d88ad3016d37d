"""Response of the materials: the coefficients of all interactions, and the amplitudes of diffuse reflection.

`material_response` computes the response for all groups together, in flat arrays or as tables. `split_by_step` splits
the response into parts for each step of each group.

The scattering patterns f_s of diffuse reflection follow Degli-Esposti et al., IEEE Trans. Antennas Propag. 55(1), 2007.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from numpy.typing import NDArray
from scipy.special import binom

from calibray.fields.arithmetic import Pair, safe_sqrt
from calibray.fields.coefficient_tables import CoefficientTables, TableLayout, fill_tables, interpolate
from calibray.fields.grouping import DIFFRACTION, SCATTERING
from calibray.fields.program import DiffuseArguments, FormulaArguments, GroupedProgram
from calibray.fields.slab import FIELD_COLUMN, coefficients_of_materials, loss_term

Coefficients = tuple[Pair, Pair]
"""Transverse electric and transverse magnetic coefficients."""

GroupResponse = tuple[tuple[Coefficients, ...], tuple[tuple[jax.Array, jax.Array], ...]]
"""The coefficients at every step of a group (two at a diffraction), and two amplitudes at every diffuse reflection."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MaterialResponse:
    """The material-dependent quantities for all interactions.

    Attributes:
        coefficients: Transverse electric and magnetic coefficients, each (real, imaginary) [K], or the tables of these
            coefficients.
        co_polarized: Amplitude S sqrt(f_s dOmega (1 - K_x)) of each diffuse interaction in the original polarization
            [D].
        cross_polarized: Amplitude S sqrt(f_s dOmega K_x) in the orthogonal polarization [D].
    """

    coefficients: Coefficients | CoefficientTables
    co_polarized: jax.Array
    cross_polarized: jax.Array


def material_response(program: GroupedProgram, table: jax.Array) -> MaterialResponse:
    """Response of the materials with the constants `table` [M, 8]."""
    source = program.coefficients
    if isinstance(source, FormulaArguments):
        coefficients = coefficients_of_materials(
            source.cosine,
            table,
            source.material,
            program.wavelength,
            source.transmitted if source.any_transmitted else False,
            source.transmitted | source.unreduced,
        )
        if source.blank is not None:
            te, tm = (
                (jnp.where(source.blank, 1.0, real), jnp.where(source.blank, 0.0, imaginary))
                for real, imaginary in coefficients
            )
            coefficients = te, tm
    else:
        coefficients = fill_tables(source, table, program.wavelength)
    diffuse = program.diffuse
    root = safe_sqrt(pattern_value(table, diffuse) * diffuse.solid_angle)  # sqrt(f_s dOmega)
    scattering, xpd = (table[:, FIELD_COLUMN[name]] for name in ("scattering_coefficient", "xpd_coefficient"))
    co_polarized, cross_polarized = (
        (scattering * safe_sqrt(share)).at[diffuse.material].get(mode="promise_in_bounds") * root
        for share in (1 - xpd, xpd)
    )
    return MaterialResponse(coefficients, co_polarized, cross_polarized)


def response_and_derivatives(
    program: GroupedProgram, table: jax.Array, columns: tuple[int, ...]
) -> tuple[MaterialResponse, tuple[MaterialResponse, ...]]:
    """The response, and its derivatives with respect to the constants in `columns` of each interaction's material."""
    response, push = jax.linearize(partial(material_response, program), table)
    permittivity, conductivity = FIELD_COLUMN["relative_permittivity"], FIELD_COLUMN["conductivity"]
    derivatives = {
        column: push(jnp.zeros_like(table).at[:, column].set(1.0))
        for column in columns
        if not (column == conductivity and permittivity in columns)
    }
    if conductivity in columns and permittivity in columns:
        derivatives[conductivity] = _by_conductivity(program, derivatives[permittivity])
    return response, tuple(derivatives[column] for column in columns)


def _by_conductivity(program: GroupedProgram, by_permittivity: MaterialResponse) -> MaterialResponse:
    """Derivatives with respect to conductivity, computed from those with respect to permittivity to save a pass.

    Coefficients are analytic in eta = eps_r - j loss, and the loss is proportional to the conductivity. The derivative
    with respect to the conductivity is therefore -j times the loss per unit of conductivity times the derivative with
    respect to the permittivity.
    """
    loss_per_unit = loss_term(jnp.ones_like(program.wavelength), program.wavelength)

    def by_loss(real: jax.Array, imaginary: jax.Array) -> Pair:
        return loss_per_unit * imaginary, -loss_per_unit * real

    coefficients = by_permittivity.coefficients
    if isinstance(coefficients, CoefficientTables):
        pairs = coefficients.values.reshape(len(coefficients.values), -1, 2)
        derivatives = jnp.stack(by_loss(pairs[..., 0], pairs[..., 1]), axis=-1)
        tables = CoefficientTables(derivatives.reshape(coefficients.values.shape))
        return replace(by_permittivity, coefficients=tables)
    te, tm = coefficients
    return replace(by_permittivity, coefficients=(by_loss(*te), by_loss(*tm)))


def split_by_step(
    program: GroupedProgram, response: MaterialResponse, blank: float = 1.0
) -> tuple[GroupResponse, ...]:
    """The response, or its derivatives, split into parts for each step of each group.

    Reverse passes differentiate with respect to these parts, because differentiating with respect to the flat arrays
    would take one pass over the complete arrays for each part. `blank` is the value of a coefficient at empty
    positions: 1, or 0 for derivatives.
    """
    groups, row = [], 0
    step_coefficients = _coefficients_by_step(program, response, blank)
    for group in program.groups:
        coefficients, amplitudes = [], []
        for letter in group.signature:
            # A diffraction uses the coefficients of both faces of the wedge.
            coefficients += [next(step_coefficients) for _ in range(2 if letter == DIFFRACTION else 1)]
            if letter == SCATTERING:
                rows = slice(row, row + group.size)
                amplitudes.append((response.co_polarized[rows], response.cross_polarized[rows]))
                row += group.size
        groups.append((tuple(coefficients), tuple(amplitudes)))
    return tuple(groups)


def _coefficients_by_step(
    program: GroupedProgram, response: MaterialResponse, blank: float
) -> Iterator[Coefficients]:
    """The coefficients of all groups, one step at a time."""
    source = program.coefficients
    if isinstance(source, TableLayout) and isinstance(response.coefficients, CoefficientTables):
        for cell, fraction in zip(source.cell, source.fraction, strict=True):
            yield interpolate(response.coefficients, cell, fraction)
    elif not isinstance(response.coefficients, CoefficientTables):
        start, (te, tm) = 0, response.coefficients
        source = cast(FormulaArguments, source)
        for shape, lines in zip(source.shapes, source.lines, strict=True):
            yield (
                (_unpacked(te[0], start, lines, shape, blank), _unpacked(te[1], start, lines, shape)),
                (_unpacked(tm[0], start, lines, shape, blank), _unpacked(tm[1], start, lines, shape)),
            )
            start += sum(lines)


def _unpacked(
    values: jax.Array, start: int, lines: tuple[int, ...], shape: tuple[int, ...], blank: float = 0.0
) -> jax.Array:
    """The coefficients of one step of a group, with `blank` at positions that are not stored.

    Each line is read past its end, and the excess is replaced by `blank`, so no separate pass is necessary.
    """
    parts, size = [], shape[-1]
    for length in reversed(lines):  # the last line is stored first
        part = values[start : start + size]
        part = jnp.pad(part, (0, size - len(part)))
        parts.append(part if length == size else jnp.where(jnp.arange(size) < length, part, blank))
        start += length
    return jnp.stack(parts[::-1]) if len(shape) > 1 else parts[0]


LARGEST_EXPONENT = 64
"""Largest exponent alpha for which the normalization is a sum. Above this exponent, a Gaussian lobe is accurate to
0.0021 dB."""


def pattern_value(table: jax.Array, diffuse: DiffuseArguments) -> jax.Array:
    """Angular density f_s [D], [1/sr], of the diffusely reflected power, for material constants [M, 8]."""
    material, patterns, lambertian = diffuse.material, diffuse.patterns, diffuse.cos_scattered / jnp.pi
    if all(pattern == "lambertian" for pattern in patterns):
        return lambertian
    alpha_r, alpha_i, share = (table[:, FIELD_COLUMN[name]] for name in ("alpha_r", "alpha_i", "lambda_"))
    # The directive pattern is the backscattering pattern with all energy in the lobe around the specular direction.
    is_directive = np.array([pattern == "directive" for pattern in patterns])
    share, alpha_i = jnp.where(is_directive, 1.0, share), jnp.where(is_directive, 1.0, alpha_i)
    norm_r, norm_i = (_normalization(alpha, diffuse) for alpha in (alpha_r, alpha_i))
    alpha_r, alpha_i, share = alpha_r[material], alpha_i[material], share[material]
    # ((1 + cos psi) / 2)^alpha, with psi measured from the specular direction and from the direction to the source.
    lobes = (
        share * (0.5 * (1 + diffuse.cos_specular)) ** alpha_r
        + (1 - share) * (0.5 * (1 + diffuse.cos_backward)) ** alpha_i
    )
    is_lambertian = jnp.asarray(np.array([pattern == "lambertian" for pattern in patterns]))[material]
    return jnp.where(is_lambertian, lambertian, lobes / (share * norm_r + (1 - share) * norm_i))


def _normalization(alpha: jax.Array, diffuse: DiffuseArguments) -> jax.Array:
    """F_alpha [D], the integral of a lobe over the half space (eqs. 7 and 8 of Degli-Esposti), for exponents alpha [M].

    The integral is interpolated linearly between integer exponents. Above `LARGEST_EXPONENT`, ((1 + cos psi) / 2)^alpha
    is nearly exp(-alpha psi^2 / 4), and the plane of the surface truncates its tail.
    """
    low = jnp.clip(jnp.floor(alpha), 1, LARGEST_EXPONENT - 1)
    weight, row = alpha - low, low.astype(jnp.int32)
    table = jnp.asarray(_whole_normalizations(), diffuse.cos_incidence.dtype)
    factors = ((1 - weight) * table[:, row] + weight * table[:, row + 1])[:, diffuse.material]
    series = jnp.polyval(factors[:-1], 1 - diffuse.cos_incidence**2, unroll=4)
    alpha, elevation = alpha[diffuse.material], jnp.arcsin(jnp.minimum(diffuse.cos_incidence, 1))
    narrow = 4 * jnp.pi / (alpha + 1) * ndtr(jnp.sqrt(alpha / 2) * elevation)
    return jnp.where(alpha > LARGEST_EXPONENT, narrow, factors[-1] + diffuse.cos_incidence * series)


@cache
def _whole_normalizations() -> NDArray[np.float64]:
    """Coefficients of F_alpha for alpha = 0 .. LARGEST_EXPONENT [terms, alpha].

    F_alpha = 2^-alpha sum_j binom(alpha, j) I_j. I_j is 2 pi / (j + 1) for even j; for odd j, this value is multiplied
    by cos theta sum_{w <= (j - 1) / 2} binom(2w, w) (sin^2 theta / 4)^w. The result contains the coefficients of cos
    theta sin^2w theta, highest power first, then the constant.
    """
    alpha = np.arange(LARGEST_EXPONENT + 1)
    j, w = alpha[:, None], np.arange(LARGEST_EXPONENT // 2)[::-1, None]
    share = binom(alpha, j) / 2.0**alpha * 2 * np.pi / (j + 1)
    from_w_on = np.cumsum(share[-2::-2], axis=0)
    return np.concatenate([from_w_on * binom(2 * w, w) / 4.0**w, share[::2].sum(axis=0)[None]])
