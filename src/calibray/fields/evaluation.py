"""Path loss of every link of a program, and its derivatives, for batches of candidates.

Where coefficients are evaluated by the formula, a batch is one compiled loop over its candidates: the numbers of one
candidate stay in a core's nearest cache, and fewer candidates cost less. Within it, stages are held apart
(`slab.keep`): XLA on CPU would otherwise fuse each into all its uses and repeat it there. Large programs, whose
coefficients lie in tables, are evaluated in stages compiled apart; looking them up, carrying the fields along and
taking the power are one of these, which reads every constant once and writes one number a path.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial, reduce
from operator import add
from typing import Final, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.fields import slab, tabulation
from calibray.fields.combining import Offsets, check_combining, decibel, link_power, path_power
from calibray.fields.contributions import Contributions, Pieces, contributions, pieces, tangents
from calibray.fields.program import Formula, GroupedProgram, layout, material_table
from calibray.fields.propagation import path_fields
from calibray.fields.segments import total
from calibray.materials import Material
from calibray.paths import Paths

WIDE: Final = {"xla_cpu_prefer_vector_width": 512}
"""How formulas are compiled, in bits: XLA prefers 256 even where a processor takes eight numbers at once. A processor
without such instructions is given those that it has; the numbers are the same."""


def path_gains(paths: Paths, materials: Mapping[str, Material] | None = None) -> NDArray[np.complex128]:
    """Path gains for any materials, equal to Sionna RT's `Paths.a` for the same materials.

    Args:
        paths: The path program.
        materials: Constants by name; materials not named keep those of the trace.

    Returns:
        Complex gains [P]; [P, R, T] if an antenna is dual-polarized.

    Raises:
        InputError: A material is unknown.
    """
    plan = layout(paths)
    local = _contributions(plan.program, jnp.asarray(material_table(paths, materials)))
    real, imaginary = _gains(plan.program, local)
    found = np.empty((paths.num_paths, paths.rx_field.shape[1], paths.tx_field.shape[1]), dtype=complex)
    found[plan.order] = np.moveaxis(np.asarray(real) + 1j * np.asarray(imaginary), -1, 0)
    return found[:, 0, 0] if found.shape[1:] == (1, 1) else found


def path_loss(
    paths: Paths,
    materials: Mapping[str, Material] | None = None,
    combining: str = "power",
    bandwidth: float | None = None,
) -> NDArray[np.float64]:
    """Path loss of every link for any materials.

    Args:
        paths: The path program.
        materials: Constants by name; materials not named keep those of the trace.
        combining: "power" sums the paths' powers (a wide band, or many snapshots); "coherent" their fields at the
            carrier; "band" averages the coherent power over `bandwidth`.
        bandwidth: Bandwidth [Hz], for "band".

    Returns:
        Path loss [L], [dB]; +inf where a link has no path.

    Raises:
        InputError: The combining or a material is unknown, or the bandwidth missing.
    """
    offsets = check_combining(paths, combining, bandwidth)
    tables = jnp.asarray(material_table(paths, materials))[None]
    return np.asarray(path_losses(layout(paths).program, tables, combining, offsets)[0][0])


def program_path_loss(
    program: GroupedProgram, table: jax.Array, combining: str = "power", offsets: Offsets = None
) -> jax.Array:
    """Path loss of every link of a program, as one pure function.

    Args:
        program: The program.
        table: Material constants [M, 8].
        combining: "power", "coherent" or "band".
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Path loss [L], [dB]; +inf where a link has no path.
    """
    found = slab.keep(contributions(program, table), program.wavelength)
    return decibel(_power(program, pieces(program, found), combining, offsets))


def path_powers(program: GroupedProgram, table: jax.Array) -> jax.Array:
    """Power gain of every path, summed over receive ports and averaged over transmit ports.

    Args:
        program: The program.
        table: Material constants [M, 8].

    Returns:
        Power gains in the order of the program [P].
    """
    return _path_powers(program, _pieces(program, _contributions(program, table)))


def path_losses(
    program: GroupedProgram,
    tables: jax.Array,
    combining: str = "power",
    offsets: Offsets = None,
    count: int | None = None,
) -> tuple[jax.Array, float]:
    """Path loss of every link for a batch of candidates.

    Args:
        program: The program.
        tables: Material constants [n, M, 8].
        combining: "power", "coherent" or "band".
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].
        count: How many of the candidates are wanted, the first ones; what is told of the others means nothing.

    Returns:
        Path loss [n, L], [dB], +inf where a link has no path; and the largest error of a tabulated coefficient.
    """
    if isinstance(program.coefficients, Formula):
        return _each_loss(program, tables, len(tables) if count is None else count, combining, offsets), 0.0
    # Coefficients are looked up where they are used, which is quickest where they are used once.
    once = all(set(group.signature) <= {"c"} for group in program.groups)
    powers, errors = [], []
    for table in tables:
        found = _contributions(program, table)
        power = _link_power if once else _link_power_of_pieces
        powers.append(power(program, found if once else _wide_pieces(program, found), combining, offsets))
        errors.append(_table_error(program, found))
    return _decibel(jnp.stack(powers)), float(jnp.stack(errors).max())


def path_losses_and_slopes(
    program: GroupedProgram,
    tables: jax.Array,
    columns: tuple[int, ...],
    combining: str = "power",
    offsets: Offsets = None,
    count: int | None = None,
) -> tuple[jax.Array, jax.Array, float]:
    """Path loss of every link for a batch of candidates, and its derivatives by the materials' constants.

    Args:
        program: The program.
        tables: Material constants [n, M, 8].
        columns: Columns of the tables to derive by.
        combining: "power", "coherent" or "band".
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].
        count: How many of the candidates are wanted, the first ones; what is told of the others means nothing.

    Returns:
        Path loss [n, L], [dB], its derivatives [n, L, M, columns], [dB] per unit, 0 where a link has no path; and the
        largest error of a tabulated coefficient.
    """
    if isinstance(program.coefficients, Formula):
        number = len(tables) if count is None else count
        return *_each_slope(program, tables, number, columns, combining, offsets), 0.0
    powers, slopes, errors = [], [], []
    for table in tables:
        found, rates = _tangents(program, table, columns)
        power, slope = _power_and_slope(program, _wide_pieces(program, found), combining, offsets)
        powers.append(power)
        slopes.append(_decibel_slope(program, power, slope, rates, table.shape[0]))
        errors.append(_table_error(program, found))
    return _decibel(jnp.stack(powers)), jnp.stack(slopes), float(jnp.stack(errors).max())


def _power(
    program: GroupedProgram,
    found: tuple[Pieces, ...],
    combining: str,
    offsets: Offsets,
    keep: bool = False,
) -> jax.Array:
    """Power gain of every link [L]; `keep` holds the field after every interaction, for a reverse pass."""
    held = partial(slab.keep, positive=program.wavelength)
    gain = path_fields(program, found, held if keep else lambda field: field)
    if combining == "power":
        return total(program.by_link, held(path_power(gain)))
    link, delay = program.phases
    frequency = speed_of_light / program.wavelength
    return link_power(gain, link, delay, program.num_links, frequency, combining, offsets)


def _slope(
    program: GroupedProgram, found: tuple[Pieces, ...], combining: str, offsets: Offsets
) -> tuple[jax.Array, tuple[Pieces, ...]]:
    """Power gain of every link, and its derivative by every piece.

    Every path belongs to one link, so one reverse pass over the summed power gives the derivatives of all links.
    """
    power, pull = jax.vjp(lambda found: _power(program, found, combining, offsets, keep=True), found)
    (slope,) = pull(jnp.ones_like(power))
    return power, slope


def _contract(
    program: GroupedProgram,
    power: jax.Array,
    slope: tuple[Pieces, ...],
    rates: tuple[Contributions, ...],
    num_materials: int,
) -> jax.Array:
    """Derivatives of path loss [L, M, columns] from both passes.

    Every interaction belongs to one material, so one tangent per column serves all materials at once: the cost does not
    grow with their number.
    """
    parts = []
    for rate in rates:
        rises = [[], []]
        for group, rate_of_group in zip(slope, pieces(program, rate, blank=0.0), strict=True):
            for rise, outer, inner in zip(rises, group, rate_of_group, strict=True):
                rise += [_dot(a, b).ravel() for a, b in zip(outer, inner, strict=True)]
        sums = [
            total(segments, slab.keep(jnp.concatenate(rise), program.wavelength))
            for segments, rise in zip(program.by_material, rises, strict=True)
            if rise
        ]
        parts.append(sum(sums, jnp.zeros(program.num_links * num_materials, power.dtype)))
    inverse = jnp.where(power > 0, 1 / jnp.where(power > 0, power, 1.0), 0.0)
    by_material = jnp.stack(parts, axis=-1).reshape(program.num_links, num_materials, len(rates))
    return -10 / np.log(10) * inverse[:, None, None] * by_material


def _dot(a: object, b: object) -> jax.Array:
    """The sum of the products of two trees' numbers, entry by entry."""
    return reduce(add, (x * y for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)))


_decibel = jax.jit(decibel)
_contributions = jax.jit(contributions)
_pieces = jax.jit(pieces)  # where it may be part of what is compiled as a whole, which takes no options
_wide_pieces = jax.jit(pieces, compiler_options=WIDE)
_tangents = jax.jit(tangents, static_argnums=2)
_gains = jax.jit(lambda program, found: path_fields(program, pieces(program, found)))
_path_powers = jax.jit(lambda program, found: path_power(path_fields(program, found)))
_link_power_of_pieces = jax.jit(_power, static_argnums=2, compiler_options=WIDE)
_power_and_slope = jax.jit(_slope, static_argnums=2, compiler_options=WIDE)
_decibel_slope = jax.jit(_contract, static_argnums=4, compiler_options=WIDE)


@jax.jit
def _table_error(program: GroupedProgram, found: Contributions) -> jax.Array:
    # Asked for only where coefficients lie in tables.
    tables = cast(tabulation.Nodes, found.coefficients)
    return tabulation.table_error(tables, cast(tabulation.Lookup, program.coefficients))


@partial(jax.jit, static_argnums=2, compiler_options=WIDE)
def _link_power(program: GroupedProgram, found: Contributions, combining: str, offsets: Offsets) -> jax.Array:
    return _power(program, pieces(program, found), combining, offsets)


@partial(jax.jit, static_argnums=3, compiler_options=WIDE)
def _each_loss(
    program: GroupedProgram, tables: jax.Array, count: int, combining: str, offsets: Offsets
) -> jax.Array:
    """One candidate after the other, so that the numbers of each stay in a core's nearest cache."""

    def one(place: jax.Array, loss: jax.Array) -> jax.Array:
        return loss.at[place].set(program_path_loss(program, tables[place], combining, offsets))

    return jax.lax.fori_loop(0, count, one, jnp.zeros((len(tables), program.num_links), tables.dtype))


@partial(jax.jit, static_argnums=(3, 4), compiler_options=WIDE)
def _each_slope(
    program: GroupedProgram,
    tables: jax.Array,
    count: int,
    columns: tuple[int, ...],
    combining: str,
    offsets: Offsets,
) -> tuple[jax.Array, jax.Array]:
    held = partial(slab.keep, positive=program.wavelength)

    def one(place: jax.Array, told: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        found, rates = held(tangents(program, tables[place], columns))
        power, slope = held(_slope(program, pieces(program, found), combining, offsets))
        rise = _contract(program, power, slope, rates, tables.shape[1])
        return told[0].at[place].set(decibel(power)), told[1].at[place].set(rise)

    loss = jnp.zeros((len(tables), program.num_links), tables.dtype)
    rise = jnp.zeros((*loss.shape, tables.shape[1], len(columns)), tables.dtype)
    return jax.lax.fori_loop(0, count, one, (loss, rise))
