"""Path loss of every link of a program, and its derivatives, for batches of candidates.

With the slab formula, one compiled loop evaluates the candidates of a batch one by one. One candidate's data therefore
stay in the core's L1 cache, and a smaller batch takes proportionally less time. Within the loop, the stages are
materialized (`calibray.fields.arithmetic.materialize`). Otherwise, XLA on the CPU would fuse each stage into all of its
uses and repeat it there.

Large programs with tables are evaluated in stages that are compiled separately. One stage interpolates the
coefficients, propagates the fields and computes the power. This stage therefore reads every constant once and writes
one number per path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial, reduce
from operator import add
from typing import Final, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.fields import coefficient_tables
from calibray.fields.arithmetic import Pair, materialize, segment_sums
from calibray.fields.coefficient_tables import CoefficientTables, TableLayout
from calibray.fields.effects import (
    AntennaFields,
    EffectBatch,
    antenna_fields,
    apply_effects,
    with_antenna_fields,
)
from calibray.fields.grouping import COEFFICIENT
from calibray.fields.jax_context import WIDE, compiled, jax_settings
from calibray.fields.material_response import (
    GroupResponse,
    MaterialResponse,
    material_response,
    response_and_derivatives,
    split_by_step,
)
from calibray.fields.program import FormulaArguments, GroupedProgram, layout
from calibray.fields.propagation import POWER, Combining, decibel, link_power, path_fields, path_power
from calibray.materials import Material
from calibray.paths import Paths

WITHOUT_TABLES: Final = np.zeros((1, 1, 3))
"""Interpolation errors of coefficients without tables; all are 0. The array broadcasts over candidates and
materials."""


@jax_settings()
def path_gains(paths: Paths, materials: Mapping[str, Material] | None = None) -> NDArray[np.complex128]:
    """Path gains for given materials, equal to Sionna RT's `Paths.a` for the same materials.

    Args:
        paths: The path program.
        materials: Material constants by name; the other materials keep the constants of the trace.

    Returns:
        Complex gains [P], or [P, R, T] if an antenna is dual-polarized.

    Raises:
        InputError: A material is unknown.
    """
    plan = layout(paths)
    real, imaginary = _gains(plan.program, jax.device_put(paths.material_table(materials)))
    gains = np.empty((paths.num_paths, paths.rx_field.shape[1], paths.tx_field.shape[1]), dtype=complex)
    gains[plan.order] = np.moveaxis(np.asarray(real) + 1j * np.asarray(imaginary), -1, 0)
    return gains[:, 0, 0] if gains.shape[1:] == (1, 1) else gains


def path_loss(
    paths: Paths,
    materials: Mapping[str, Material] | None = None,
    combining: str = "power",
    bandwidth: float | None = None,
) -> NDArray[np.float64]:
    """Path loss of every link for given materials.

    Args:
        paths: The path program.
        materials: Material constants by name; the other materials keep the constants of the trace.
        combining: "power" sums the paths' powers (for a wide band, or an average over many snapshots), "coherent" sums
            their fields at the carrier, and "band" averages the coherent power over `bandwidth`.
        bandwidth: Bandwidth [Hz], for "band".

    Returns:
        Path loss [L], [dB]; +inf for a link without a path.

    Raises:
        InputError: `combining` or a material is unknown, or the bandwidth is missing or not positive.
    """
    prepared = Combining.make(combining, paths.link, paths.delay, bandwidth)
    tables = paths.material_table(materials)[None]
    return path_losses(layout(paths).program, tables, prepared)[0][0]


@jax_settings()
def program_path_loss(program: GroupedProgram, table: jax.Array, combining: Combining = POWER) -> jax.Array:
    """Path loss of every link [L], [dB], for material constants [M, 8], as a pure function.

    Path loss is +inf for a link without a path. Differentiate or compile the function within
    `calibray.fields.jax_settings`.
    """
    response = materialize(material_response(program, table), program.wavelength)
    return decibel(_power(program, split_by_step(program, response), combining))


@jax_settings()
def program_gains(program: GroupedProgram, table: jax.Array) -> Pair:
    """Gains [R, T, P] of all paths in the program's order, as real and imaginary parts; a pure function.

    `table` contains the material constants [M, 8].
    """
    response = materialize(material_response(program, table), program.wavelength)
    return path_fields(program, split_by_step(program, response))


@jax_settings()
def path_powers(program: GroupedProgram, table: ArrayLike) -> jax.Array:
    """Power gain of every path [P], in the order of the program, for material constants [M, 8].

    The power is summed over receive ports and averaged over transmit ports. The function is pure.
    """
    return _path_powers(program, _split_by_step(program, _material_response(program, jnp.asarray(table))))


@jax_settings()
def path_losses(
    program: GroupedProgram,
    tables: NDArray[np.floating],
    combining: Combining = POWER,
    count: int | None = None,
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Path loss [count, L], [dB], of a batch of candidates with material constants [n, M, 8].

    Path loss is +inf for a link without a path. The second result is the largest error [count, M, 3] of a tabulated
    coefficient, by candidate, material and mode. Without tables, this error is 0. Only the first `count` candidates are
    evaluated. The function is compiled for batches of n candidates, so a partly filled batch needs no new compilation.
    """
    count = len(tables) if count is None else count
    if isinstance(program.coefficients, FormulaArguments):
        return np.asarray(_losses(program, tables, None, count, combining))[:count], WITHOUT_TABLES
    # If each coefficient is used only once, it is fastest to look it up where it is used.
    single_use = all(set(group.signature) <= {COEFFICIENT} for group in program.groups)
    powers, errors = [], []
    for table in tables[:count]:
        response, error = _response_and_error(program, table)
        if single_use:
            power = _link_power(program, response, combining)
        else:
            power = _link_power_of_steps(program, _split_by_step_wide(program, response), combining)
        # Wait for this candidate, so that only one candidate's intermediate arrays are in memory.
        powers.append(np.asarray(power))
        errors.append(error)
    return _stacked_losses(powers, len(tables)), np.stack(errors)


@jax_settings()
def path_losses_and_slopes(
    program: GroupedProgram,
    tables: NDArray[np.floating],
    columns: tuple[int, ...],
    combining: Combining = POWER,
    count: int | None = None,
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Path loss as in `path_losses`, and its derivatives [count, L, M, columns], [dB] per unit.

    The derivatives are with respect to the material constants in `columns` of the tables. All derivatives are 0 for a
    link without a path. The third result is the largest error [count, M, 3] of a tabulated coefficient, by candidate,
    material and mode. Without tables, this error is 0.
    """
    count = len(tables) if count is None else count
    if isinstance(program.coefficients, FormulaArguments):
        loss, slope = _slopes_by_formula(program, tables, count, columns, combining)
        return np.asarray(loss)[:count], np.asarray(slope)[:count], WITHOUT_TABLES
    powers, slopes, errors = [], [], []
    for table in tables[:count]:
        response, derivatives, error = _response_derivatives_and_error(program, table, columns)
        power, by_step = _power_and_slope(program, _split_by_step_wide(program, response), combining)
        powers.append(power)
        slopes.append(np.asarray(_path_loss_slope(program, power, by_step, derivatives, len(table))))
        errors.append(error)
    return _stacked_losses(powers, len(tables)), np.stack(slopes), np.stack(errors)


def _stacked_losses(powers: Sequence[ArrayLike], size: int) -> NDArray[np.floating]:
    """Path loss [n, L], [dB], from the powers of n candidates; the conversion is compiled for `size` candidates."""
    stacked = np.stack(powers)
    padded = np.zeros((size, stacked.shape[1]), stacked.dtype)
    padded[: len(stacked)] = stacked
    return np.asarray(_decibel(padded))[: len(stacked)]


@jax_settings()
def path_losses_with_effects(
    program: GroupedProgram,
    tables: NDArray[np.floating],
    effects: EffectBatch,
    combining: Combining = POWER,
    count: int | None = None,
) -> NDArray[np.floating]:
    """Path loss [count, L], [dB], for material constants [n, M, 8] and effects; see `path_losses`."""
    count = len(tables) if count is None else count
    return np.asarray(_losses(program, tables, effects, count, combining))[:count]


@jax_settings()
def path_losses_and_slopes_with_effects(
    program: GroupedProgram,
    tables: NDArray[np.floating],
    effects: EffectBatch,
    columns: tuple[int, ...],
    combining: Combining = POWER,
    count: int | None = None,
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Path loss with effects, and its derivatives.

    The derivatives are with respect to constants, [count, L, M, columns], and to effect parameters, [count, L, e].
    """
    count = len(tables) if count is None else count
    answers = _slopes_with_effects(program, tables, effects, count, columns, combining)
    loss, slope, by_effect = (np.asarray(answer)[:count] for answer in answers)
    return loss, slope, by_effect


def _power(
    program: GroupedProgram, responses: tuple[GroupResponse, ...], combining: Combining, keep: bool = False
) -> jax.Array:
    """Power gain [L] of every link; with `keep`, the field after every interaction is stored for a reverse pass."""
    stored = partial(materialize, positive=program.wavelength)
    gain = path_fields(program, responses, stored if keep else lambda field: field)
    if combining.kind == "power":
        return segment_sums(program.by_link, stored(path_power(gain)))
    link, delay = program.phases
    frequency = speed_of_light / program.wavelength
    return link_power(gain, link, delay, program.num_links, frequency, combining)


def _slope(
    program: GroupedProgram, responses: tuple[GroupResponse, ...], combining: Combining
) -> tuple[jax.Array, tuple[GroupResponse, ...]]:
    """Power gain of every link, and its derivative with respect to the response at every step.

    Every path belongs to one link, so one reverse pass over the sum of all powers yields the derivatives for all links.
    """
    power, pull = jax.vjp(lambda responses: _power(program, responses, combining, keep=True), responses)
    (slope,) = pull(jnp.ones_like(power))
    return power, slope


def contract(
    program: GroupedProgram,
    slope: tuple[GroupResponse, ...],
    derivatives: tuple[MaterialResponse, ...],
    num_materials: int,
) -> jax.Array:
    """Derivatives [L, M, columns] of a quantity of every link with respect to material constants.

    Every interaction belongs to one material, so one tangent per column yields the derivatives for all materials. The
    computing time therefore does not grow with the number of materials. `slope` contains the derivatives of the
    quantity with respect to the response at every step. `derivatives` contains the derivatives of the response with
    respect to the constants in each column.
    """
    if not derivatives:
        return jnp.zeros((program.num_links, num_materials, 0), program.wavelength.dtype)
    by_column = []
    for derivative in derivatives:
        products = ([], [])  # of coefficients, of diffuse amplitudes
        inner_groups = split_by_step(program, derivative, blank=0.0)
        for outer_group, inner_group in zip(slope, inner_groups, strict=True):
            for product, outer, inner in zip(products, outer_group, inner_group, strict=True):
                product += [_dot(a, b).ravel() for a, b in zip(outer, inner, strict=True)]
        sums = [
            segment_sums(segments, materialize(jnp.concatenate(product), program.wavelength))
            for segments, product in zip(program.by_material, products, strict=True)
            if product
        ]
        by_column.append(sum(sums, jnp.zeros(program.num_links * num_materials, program.wavelength.dtype)))
    return jnp.stack(by_column, axis=-1).reshape(program.num_links, num_materials, len(derivatives))


def _contract(
    program: GroupedProgram,
    power: jax.Array,
    slope: tuple[GroupResponse, ...],
    derivatives: tuple[MaterialResponse, ...],
    num_materials: int,
) -> jax.Array:
    """Derivatives [L, M, columns] of path loss, from the derivatives of the power with respect to the response."""
    return _loss_slope(power)[:, None, None] * contract(program, slope, derivatives, num_materials)


def _loss_slope(power: jax.Array) -> jax.Array:
    """Derivative [L] of each link's path loss [dB] with respect to its power; 0 for a link without a path."""
    return -10 / np.log(10) * jnp.where(power > 0, 1 / jnp.where(power > 0, power, 1.0), 0.0)


def _by_path(by_field: list[AntennaFields], tangents: list[AntennaFields], blank: jax.Array) -> jax.Array:
    """Derivatives [P, e] of the power of every path with respect to effect parameters, through the antenna fields.

    `blank` is the empty result [0, e] of a program without paths.
    """
    groups = [blank]
    for outer, inner in zip(by_field, tangents, strict=True):
        # Fields have the shape [2 or 1, ports, 2, n], and their tangents the shape [..., n, e].
        products = (jnp.einsum("abcn,abcne->ne", a, b) for a, b in zip(outer, inner, strict=True))
        groups.append(reduce(add, products))
    return jnp.concatenate(groups)


def _dot(a: object, b: object) -> jax.Array:
    """Inner product of two pytrees of arrays."""
    return reduce(add, (x * y for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)))


_decibel = jax.jit(decibel)
# JAX traces this function once for all batch sizes.
_path_loss = jax.jit(program_path_loss, inline=True)
_material_response = jax.jit(material_response)
# The functions that `path_powers` calls have no compiler options, because a user may compile them as part of another
# function.
_split_by_step = jax.jit(split_by_step)
_split_by_step_wide = jax.jit(split_by_step, compiler_options=WIDE)
_gains = compiled(program_gains)
_path_powers = jax.jit(lambda program, responses: path_power(path_fields(program, responses)))
_link_power_of_steps = jax.jit(_power, compiler_options=WIDE)
_power_and_slope = jax.jit(_slope, compiler_options=WIDE)
_path_loss_slope = jax.jit(_contract, static_argnums=4, compiler_options=WIDE)


@partial(jax.jit, compiler_options=WIDE)
def _response_and_error(program: GroupedProgram, table: jax.Array) -> tuple[MaterialResponse, jax.Array]:
    response = material_response(program, table)
    return response, _table_error(program, response, len(table))


@partial(jax.jit, static_argnums=2, compiler_options=WIDE)
def _response_derivatives_and_error(
    program: GroupedProgram, table: jax.Array, columns: tuple[int, ...]
) -> tuple[MaterialResponse, tuple[MaterialResponse, ...], jax.Array]:
    response, derivatives = response_and_derivatives(program, table, columns)
    return response, derivatives, _table_error(program, response, len(table))


def _table_error(program: GroupedProgram, response: MaterialResponse, num_materials: int) -> jax.Array:
    tables = cast(CoefficientTables, response.coefficients)
    return coefficient_tables.table_error(tables, cast(TableLayout, program.coefficients), num_materials)


@partial(jax.jit, compiler_options=WIDE)
def _link_power(program: GroupedProgram, response: MaterialResponse, combining: Combining) -> jax.Array:
    return _power(program, split_by_step(program, response), combining)


@compiled(static_argnums=3)
def _slopes_by_formula(
    program: GroupedProgram, tables: jax.Array, count: int, columns: tuple[int, ...], combining: Combining
) -> tuple[jax.Array, jax.Array]:
    """Path loss [n, L] and derivatives [n, L, M, columns] of the first `count` candidates, one at a time."""
    stored = partial(materialize, positive=program.wavelength)

    def evaluate(index: jax.Array, results: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        losses, slopes = results
        response, derivatives = stored(response_and_derivatives(program, tables[index], columns))
        power, by_step = stored(_slope(program, split_by_step(program, response), combining))
        slope = _contract(program, power, by_step, derivatives, tables.shape[1])
        return (
            losses.at[index].set(decibel(power).astype(losses.dtype)),
            slopes.at[index].set(slope.astype(slopes.dtype)),
        )

    losses = jnp.zeros((len(tables), program.num_links), tables.dtype)
    slopes = jnp.zeros((*losses.shape, tables.shape[1], len(columns)), tables.dtype)
    return jax.lax.fori_loop(0, count, evaluate, (losses, slopes))


@compiled
def _losses(
    program: GroupedProgram, tables: jax.Array, effects: EffectBatch | None, count: int, combining: Combining
) -> jax.Array:
    """Path loss [n, L] of the first `count` candidates, one at a time."""

    def evaluate(index: jax.Array, losses: jax.Array) -> jax.Array:
        changed = program
        if effects is not None:
            changed = apply_effects(program, effects.effects, effects.values[index])
        return losses.at[index].set(_path_loss(changed, tables[index], combining).astype(losses.dtype))

    return jax.lax.fori_loop(0, count, evaluate, jnp.zeros((len(tables), program.num_links), tables.dtype))


@compiled(static_argnums=4)
def _slopes_with_effects(
    program: GroupedProgram,
    tables: jax.Array,
    effects: EffectBatch,
    count: int,
    columns: tuple[int, ...],
    combining: Combining,
) -> tuple[jax.Array, ...]:
    """Path loss [n, L] and derivatives [n, L, M, columns], [n, L, e] of the first `count` candidates, one at a time."""
    stored, values = partial(materialize, positive=program.wavelength), effects.values

    def evaluate(index: jax.Array, results: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        # Effects change only the antenna fields. The tangents of these fields are therefore combined with the
        # derivatives of the power with respect to the fields.
        fields, push = jax.linearize(
            lambda value: antenna_fields(apply_effects(program, effects.effects, value)), values[index]
        )
        changed = with_antenna_fields(program, fields)
        response, derivatives = stored(response_and_derivatives(changed, tables[index], columns))
        responses = split_by_step(changed, response)
        power, pull = jax.vjp(
            lambda responses, fields: _power(
                with_antenna_fields(changed, fields), responses, combining, keep=True
            ),
            responses,
            fields,
        )
        by_step, by_field = stored(pull(jnp.ones_like(power)))
        tangents = jax.vmap(push, out_axes=-1)(jnp.eye(values.shape[1], dtype=values.dtype))
        by_path = _by_path(by_field, tangents, jnp.zeros((0, values.shape[1]), values.dtype))
        by_effect = jax.vmap(partial(segment_sums, program.by_link), -1, -1)(by_path)
        slope = _contract(changed, power, by_step, derivatives, tables.shape[1])
        answers = decibel(power), slope, _loss_slope(power)[:, None] * by_effect
        return tuple(
            result.at[index].set(answer.astype(result.dtype))
            for result, answer in zip(results, answers, strict=True)
        )

    shapes = (), (tables.shape[1], len(columns)), (values.shape[1],)
    blank = tuple(jnp.zeros((len(tables), program.num_links, *shape), tables.dtype) for shape in shapes)
    return jax.lax.fori_loop(0, count, evaluate, blank)
