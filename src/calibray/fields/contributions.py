"""What the materials contribute at every interaction.

`contributions` turns material constants into coefficients, flat over all interactions or as tables to look them up in,
and into the amplitudes of diffuse reflection; `pieces` hands them out to the positions of every group.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp

from calibray.fields import slab, tabulation
from calibray.fields.program import Formula, Program
from calibray.fields.scattering import pattern_value
from calibray.materials import FIELDS

Pieces = tuple[tuple[tuple[slab.Pair, slab.Pair], ...], tuple[tuple[jax.Array, jax.Array], ...]]
"""Of one group: the two coefficients at every place where one stands, amplitude and XPD at every diffuse one."""

_FIELD: Final = {name: column for column, name in enumerate(FIELDS)}


@partial(jax.tree_util.register_dataclass, data_fields=["coefficients", "amplitude", "xpd"], meta_fields=[])
@dataclass(frozen=True)
class Contributions:
    """All that the fields take from the materials.

    Attributes:
        coefficients: Transverse electric and magnetic coefficients, each (real, imaginary) [J]; or their tables.
        amplitude: S sqrt(f_s dOmega) of the diffuse interactions [D].
        xpd: Their XPD coefficient K_x [D].
    """

    coefficients: tuple[slab.Pair, slab.Pair] | tabulation.Nodes
    amplitude: jax.Array
    xpd: jax.Array


def contributions(program: Program, table: jax.Array) -> Contributions:
    """What the materials contribute.

    Args:
        program: The program.
        table: Material constants [M, 8].

    Returns:
        The contributions.
    """
    source = program.coefficients
    if isinstance(source, Formula):
        coefficients = tabulation.evaluate(
            source.cosine,
            table,
            source.material,
            program.wavelength,
            source.transmitted if source.any_transmitted else False,
            source.transmitted | source.raw,
        )
    else:
        coefficients = tabulation.nodes(source, table, program.wavelength)
    material, solid_angle, scattered, cosine, specular, backward = program.diffuse
    rows = table.at[material].get(mode="promise_in_bounds")
    f_s = pattern_value(rows, material, cosine, scattered, specular, backward, program.patterns)
    return Contributions(
        coefficients=coefficients,
        amplitude=rows[:, _FIELD["scattering_coefficient"]] * slab.safe_sqrt(f_s * solid_angle),
        xpd=rows[:, _FIELD["xpd_coefficient"]],
    )


def tangents(
    program: Program, table: jax.Array, columns: tuple[int, ...]
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
    return found, tuple(push(jnp.zeros_like(table).at[:, column].set(1.0)) for column in columns)


def pieces(program: Program, found: Contributions) -> tuple[Pieces, ...]:
    """The contributions cut into what each position of each group takes, in the order of the program.

    Derivatives are taken by these pieces: by the flat arrays, every piece would cost a pass over all of them.

    Args:
        program: The program.
        found: The contributions, or their derivatives by something.

    Returns:
        The pieces, group by group.
    """
    cut, row = [], 0
    given = _coefficients(program, found)
    for group in program.groups:
        coefficients, diffuse = [], []
        for letter in group.signature:
            coefficients += [next(given) for _ in range(2 if letter == "d" else 1)]
            if letter == "s":
                diffuse.append((found.amplitude[row : row + group.size], found.xpd[row : row + group.size]))
                row += group.size
        cut.append((tuple(coefficients), tuple(diffuse)))
    return tuple(cut)


def _coefficients(program: Program, found: Contributions) -> Iterator[tuple[slab.Pair, slab.Pair]]:
    """The coefficients of one position after the other."""
    if isinstance(found.coefficients, tabulation.Nodes):
        lookup = program.coefficients
        for cell, fraction in zip(lookup.cell, lookup.fraction, strict=True):
            yield tabulation.interpolate(found.coefficients, cell, fraction)
    else:
        at = 0
        for size in program.positions:
            where = slice(at, at + size)
            yield tuple((real[where], imaginary[where]) for real, imaginary in found.coefficients)
            at += size
