"""Coefficients of all interactions, one by one or from tables over the angle of incidence.

A coefficient depends on the geometry through the cosine of incidence alone. Where a program has many more
interactions than a table has nodes, each candidate's coefficients are computed at the nodes and interpolated
linearly: a few nanoseconds an interaction instead of some fifty. Where an interaction stands in the table never
changes, so cell and fraction are computed once.

The error is known, not hoped for: `table_error` evaluates the formula between the nodes, where linear interpolation
is worst, for the candidate at hand (Brewster angle, grazing incidence and resonances of a thick slab included).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np

from calibray import slab
from calibray.materials import FIELDS

TRANSMITTED: Final = 1
RAW: Final = 2
"""Modes of a coefficient: 0 a reflection that loses the scattered energy, else a transmission or a raw reflection."""

_COLUMN: Final = {name: index for index, name in enumerate(FIELDS)}


@partial(jax.tree_util.register_dataclass, data_fields=["cell", "fraction", "row_material", "row_mode"],
         meta_fields=["intervals"])  # fmt: skip
@dataclass(frozen=True)
class Lookup:
    """Where each coefficient stands in a table with one row for each pair of material and mode.

    Attributes:
        cell: Index of the node below, over all rows [J].
        fraction: Way from that node to the next [J].
        row_material: Material of every row [rows].
        row_mode: Mode of every row [rows].
        intervals: Intervals over the cosine.
    """

    cell: jax.Array
    fraction: jax.Array
    row_material: jax.Array
    row_mode: jax.Array
    intervals: int


def make_lookup(
    material: np.ndarray, mode: np.ndarray, cosine: np.ndarray, intervals: int, dtype: type
) -> Lookup:
    """Find every coefficient's place.

    Args:
        material: Material of every coefficient [J].
        mode: Its mode [J].
        cosine: Its cosine of incidence [J].
        intervals: Intervals over the cosine.
        dtype: Precision of the fractions.

    Returns:
        The places.
    """
    rows, row = np.unique(material.astype(np.int64) * 4 + mode, return_inverse=True)
    node = np.minimum((cosine * intervals).astype(np.int64), intervals - 1)
    return Lookup(
        cell=jnp.asarray((row.reshape(-1) * (intervals + 1) + node).astype(np.int32)),
        fraction=jnp.asarray((cosine * intervals - node).astype(dtype)),
        row_material=jnp.asarray((rows // 4).astype(np.int32)),
        row_mode=jnp.asarray((rows % 4).astype(np.int32)),
        intervals=intervals,
    )


def evaluate(
    cosine: jax.Array,
    table: jax.Array,
    material: jax.Array,
    wavelength: jax.Array,
    transmitted: jax.Array | bool,
    whole: jax.Array,
) -> tuple[slab.Pair, slab.Pair]:
    """Coefficients from the formula.

    Args:
        cosine: Cosines of incidence [...].
        table: Material constants [M, 8].
        material: Material of each coefficient [...].
        wavelength: [m].
        transmitted: Where a transmission is wanted [...].
        whole: Where nothing is taken off for scattered energy [...].

    Returns:
        Transverse electric and magnetic coefficients, (real, imaginary) [...].
    """
    column = {name: table[:, index] for name, index in _COLUMN.items()}
    te, tm = slab.coefficients(
        cosine,
        column["relative_permittivity"][material],
        slab.loss_term(column["conductivity"], wavelength)[material],
        column["thickness"][material],
        wavelength,
        transmitted,
    )
    kept = slab.safe_sqrt(1 - column["scattering_coefficient"] ** 2)[material]
    factor = jnp.where(whole, 1.0, kept).astype(cosine.dtype)
    return (te[0] * factor, te[1] * factor), (tm[0] * factor, tm[1] * factor)


def look_up(lookup: Lookup, table: jax.Array, wavelength: jax.Array) -> tuple[slab.Pair, slab.Pair]:
    """Coefficients interpolated from tables.

    Args:
        lookup: Where they stand.
        table: Material constants [M, 8].
        wavelength: [m].

    Returns:
        Transverse electric and magnetic coefficients, (real, imaginary) [J].
    """
    nodes = jnp.linspace(0, 1, lookup.intervals + 1, dtype=lookup.fraction.dtype)
    values = _at(lookup, table, wavelength, nodes)

    def interpolated(value: jax.Array) -> jax.Array:
        slope = jnp.diff(value, axis=1, append=value[:, -1:])
        flat, rise = slab.keep((value.reshape(-1), slope.reshape(-1)), wavelength)
        return flat[lookup.cell] + rise[lookup.cell] * lookup.fraction

    return jax.tree.map(interpolated, values)


def table_error(lookup: Lookup, table: jax.Array, wavelength: jax.Array) -> jax.Array:
    """Largest error of any interpolated coefficient, found half-way between the nodes.

    Args:
        lookup: The tables' lay-out.
        table: Material constants [M, 8].
        wavelength: [m].

    Returns:
        Largest absolute error of a coefficient's real or imaginary part [1].
    """
    half = jnp.linspace(0, 1, 2 * lookup.intervals + 1, dtype=lookup.fraction.dtype)
    values = _at(lookup, table, wavelength, half)
    gaps = [
        jnp.abs(value[:, 1::2] - 0.5 * (value[:, :-1:2] + value[:, 2::2])).max()
        for value in jax.tree.leaves(values)
    ]
    return jnp.stack(gaps).max()


def _at(
    lookup: Lookup, table: jax.Array, wavelength: jax.Array, cosine: jax.Array
) -> tuple[slab.Pair, slab.Pair]:
    shape = (lookup.row_material.shape[0], cosine.shape[0])
    mode = jnp.broadcast_to(lookup.row_mode[:, None], shape)
    material = jnp.broadcast_to(lookup.row_material[:, None], shape)
    return evaluate(
        jnp.broadcast_to(cosine, shape), table, material, wavelength, mode == TRANSMITTED, mode != 0
    )
