"""What the materials contribute at every interaction.

`contributions` turns material constants into coefficients, flat over all interactions or as tables to look them up in,
and into the amplitudes of diffuse reflection; `pieces` hands them out to the positions of every group.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, cast

import jax
import jax.numpy as jnp

from calibray.fields import slab, tabulation
from calibray.fields.program import Formula, GroupedProgram
from calibray.fields.scattering import pattern_value
from calibray.materials import FIELDS

Pieces = tuple[tuple[tuple[slab.Pair, slab.Pair], ...], tuple[tuple[jax.Array, jax.Array], ...]]
"""Of one group: the coefficients at every place where one stands, and both amplitudes at every diffuse reflection."""

_FIELD: Final = {name: column for column, name in enumerate(FIELDS)}


@partial(
    jax.tree_util.register_dataclass, data_fields=["coefficients", "straight", "crossed"], meta_fields=[]
)
@dataclass(frozen=True)
class Contributions:
    """All that the fields take from the materials.

    Attributes:
        coefficients: Transverse electric and magnetic coefficients, each (real, imaginary) [K]; or their tables.
        straight: S sqrt(f_s dOmega (1 - K_x)) of the diffuse interactions, which keep the polarization [D].
        crossed: S sqrt(f_s dOmega K_x), which turns it [D].
    """

    coefficients: tuple[slab.Pair, slab.Pair] | tabulation.Nodes
    straight: jax.Array
    crossed: jax.Array


def contributions(program: GroupedProgram, table: jax.Array) -> Contributions:
    """What the materials contribute.

    Args:
        program: The program.
        table: Material constants [M, 8].

    Returns:
        The contributions.
    """
    source = program.coefficients
    if isinstance(source, Formula):
        found = tabulation.evaluate(
            source.cosine,
            table,
            source.material,
            program.wavelength,
            source.transmitted if source.any_transmitted else False,
            source.transmitted | source.raw,
        )
        coefficients = found if source.blank is None else _filled(source.blank, *found)
    else:
        coefficients = tabulation.nodes(source, table, program.wavelength)
    material, solid_angle, scattered, cosine, specular, backward = program.diffuse
    f_s = pattern_value(table, material, cosine, scattered, specular, backward, program.patterns)
    density = slab.safe_sqrt(f_s * solid_angle)
    scattering, xpd = table[:, _FIELD["scattering_coefficient"]], table[:, _FIELD["xpd_coefficient"]]
    straight, crossed = (
        (scattering * slab.safe_sqrt(share)).at[material].get(mode="promise_in_bounds") * density
        for share in (1 - xpd, xpd)
    )
    return Contributions(coefficients, straight, crossed)


def tangents(
    program: GroupedProgram, table: jax.Array, columns: tuple[int, ...]
) -> tuple[Contributions, tuple[Contributions, ...]]:
    """What the materials contribute, and its derivatives by each interaction's own material.

    Args:
        program: The program.
        table: Material constants [M, 8].
        columns: Columns of the table to derive by.

    Returns:
        The contributions, and their derivatives by each column.
    """
    found, push = jax.linearize(partial(contributions, program), table)
    rates = {
        column: push(jnp.zeros_like(table).at[:, column].set(1.0))
        for column in columns
        if not (column == _FIELD["conductivity"] and _FIELD["relative_permittivity"] in columns)
    }
    return found, tuple(
        rates[column]
        if column in rates
        else _by_conductivity(program, rates[_FIELD["relative_permittivity"]])
        for column in columns
    )


def _by_conductivity(program: GroupedProgram, by_permittivity: Contributions) -> Contributions:
    """Derivatives by the conductivity: coefficients are analytic in eta = eps_r - j loss, the loss its multiple."""
    per_unit = slab.loss_term(jnp.ones_like(program.wavelength), program.wavelength)

    def turned(real: jax.Array, imaginary: jax.Array) -> slab.Pair:
        return per_unit * imaginary, -per_unit * real

    given = by_permittivity.coefficients
    if isinstance(given, tabulation.Nodes):
        pairs = given.values.reshape(len(given.values), -1, 2)
        both = jnp.stack(turned(pairs[..., 0], pairs[..., 1]), axis=-1)
        return replace(by_permittivity, coefficients=tabulation.Nodes(both.reshape(given.values.shape)))
    te, tm = given
    return replace(by_permittivity, coefficients=(turned(*te), turned(*tm)))


def pieces(program: GroupedProgram, found: Contributions, blank: float = 1.0) -> tuple[Pieces, ...]:
    """The contributions cut into what each position of each group takes, in the order of the program.

    Derivatives are taken by these pieces: by the flat arrays, every piece would cost a pass over all of them.

    Args:
        program: The program.
        found: The contributions, or their derivatives by something.
        blank: What a coefficient is where nothing stands: 1, or of derivatives 0.

    Returns:
        The pieces, group by group.
    """
    cut, row = [], 0
    given = _coefficients(program, found, blank)
    for group in program.groups:
        coefficients, diffuse = [], []
        for letter in group.signature:
            coefficients += [next(given) for _ in range(2 if letter == "d" else 1)]
            if letter == "s":
                where = slice(row, row + group.size)
                diffuse.append((found.straight[where], found.crossed[where]))
                row += group.size
        cut.append((tuple(coefficients), tuple(diffuse)))
    return tuple(cut)


def _coefficients(
    program: GroupedProgram, found: Contributions, blank: float
) -> Iterator[tuple[slab.Pair, slab.Pair]]:
    """The coefficients of one position after the other."""
    source = program.coefficients
    if isinstance(source, tabulation.Lookup) and isinstance(found.coefficients, tabulation.Nodes):
        for cell, fraction in zip(source.cell, source.fraction, strict=True):
            yield tabulation.interpolate(found.coefficients, cell, fraction)
    elif not isinstance(found.coefficients, tabulation.Nodes):
        start, (te, tm) = 0, found.coefficients
        for shape, lines in zip(cast(Formula, source).shapes, cast(Formula, source).lines, strict=True):
            some = start, lines, shape
            yield (
                (_laid(te[0], *some, blank), _laid(te[1], *some)),
                (_laid(tm[0], *some, blank), _laid(tm[1], *some)),
            )
            start += sum(lines)


def _laid(
    values: jax.Array, start: int, lines: tuple[int, ...], shape: tuple[int, ...], blank: float = 0.0
) -> jax.Array:
    """The numbers of one step of a group, the last line first; `blank` stands where nothing is evaluated.

    A line is read on into the next one and the rest left out, which takes no pass of its own over the numbers.
    """
    parts, size = [], shape[-1]
    for length in reversed(lines):
        part = values[start : start + size]
        part = jnp.pad(part, (0, size - len(part)))
        parts.append(part if length == size else jnp.where(jnp.arange(size) < length, part, blank))
        start += length
    return jnp.stack(parts[::-1]) if len(shape) > 1 else parts[0]


def _filled(blank: jax.Array, te: slab.Pair, tm: slab.Pair) -> tuple[slab.Pair, slab.Pair]:
    """Coefficients that are 1 where nothing stands."""
    whole = [(jnp.where(blank, 1.0, real), jnp.where(blank, 0.0, imaginary)) for real, imaginary in (te, tm)]
    return whole[0], whole[1]
