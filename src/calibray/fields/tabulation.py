"""Coefficients of all interactions, one by one or from tables over the angle of incidence.

A coefficient depends on the geometry through the cosine of incidence alone. Where a program has many more
interactions than a table has nodes, each candidate's coefficients are computed at the nodes and interpolated
linearly: a few nanoseconds an interaction instead of some fifty. Where an interaction stands in the table never
changes, so cell and fraction are computed once. Nodes are even in the root of the cosine: the Brewster angle of a metal
lies within a thousandth of grazing incidence, where even steps of the cosine itself would miss it.

The error is known, not hoped for: `table_error` compares nodes with what interpolation between their neighbours makes
of them, for the candidate at hand (Brewster angle, grazing incidence and resonances of a thick slab included).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.fields import slab
from calibray.materials import FIELDS

TRANSMITTED: Final = 1
RAW: Final = 2
"""Modes of a coefficient: 0 a reflection that loses the scattered energy, else a transmission or a raw reflection."""

GRAZING: Final = 1e-9
"""Cosine at the first node; at 0 itself, air would reflect all."""

_COLUMN: Final = {name: index for index, name in enumerate(FIELDS)}


@partial(jax.tree_util.register_dataclass, data_fields=["cell", "fraction", "row_material", "row_mode"],
         meta_fields=["intervals"])  # fmt: skip
@dataclass(frozen=True)
class Lookup:
    """Where each coefficient stands in a table with one row for each pair of material and mode.

    Attributes:
        cell: Index of the node below, over all rows; one array for each position of each group, J numbers in all.
        fraction: Way from that node to the next, likewise.
        row_material: Material of every row [rows].
        row_mode: Mode of every row [rows].
        intervals: Intervals over the root of the cosine.
    """

    cell: tuple[jax.Array, ...]
    fraction: tuple[jax.Array, ...]
    row_material: jax.Array
    row_mode: jax.Array
    intervals: int

    @property
    def num_nodes(self) -> int:
        """Nodes of all rows."""
        return self.row_material.shape[0] * (self.intervals + 1)


@partial(jax.tree_util.register_dataclass, data_fields=["values"], meta_fields=[])
@dataclass(frozen=True)
class Nodes:
    """Tables of coefficients; a node's numbers lie side by side, so that a place costs one cache line.

    Attributes:
        values: Real and imaginary part of the transverse electric and of the transverse magnetic coefficient at every
            node of all rows, then what each rises by up to the next node [rows x (intervals + 1), 8].
    """

    values: jax.Array


def make_lookup(
    material: NDArray[np.integer],
    mode: NDArray[np.integer],
    cosine: NDArray[np.float64],
    sizes: Sequence[int],
    intervals: int,
    dtype: type,
) -> Lookup:
    """Find every coefficient's place.

    Args:
        material: Material of every coefficient [J].
        mode: Its mode [J].
        cosine: Its cosine of incidence [J].
        sizes: How many coefficients stand at each position, J in all.
        intervals: Intervals over the root of the cosine.
        dtype: Precision of the fractions.

    Returns:
        The places.
    """
    rows, row = np.unique(material.astype(np.int64) * 4 + mode, return_inverse=True)
    place = np.sqrt(cosine) * intervals
    node = np.minimum(place.astype(np.int64), intervals - 1)
    ends = np.cumsum(sizes)[:-1]
    cell = (row.reshape(-1) * (intervals + 1) + node).astype(np.uint32)
    fraction = (place - node).astype(dtype)
    return Lookup(
        cell=tuple(jnp.asarray(part) for part in np.split(cell, ends)),
        fraction=tuple(jnp.asarray(part) for part in np.split(fraction, ends)),
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


def nodes(lookup: Lookup, table: jax.Array, wavelength: jax.Array) -> Nodes:
    """The coefficients at the nodes of the tables.

    Args:
        lookup: The tables' lay-out.
        table: Material constants [M, 8].
        wavelength: [m].

    Returns:
        The tables.
    """
    shape = (lookup.row_material.shape[0], lookup.intervals + 1)
    cosine = jnp.maximum(jnp.linspace(0, 1, lookup.intervals + 1, dtype=table.dtype) ** 2, GRAZING)
    mode = jnp.broadcast_to(lookup.row_mode[:, None], shape)
    material = jnp.broadcast_to(lookup.row_material[:, None], shape)
    te, tm = evaluate(
        jnp.broadcast_to(cosine, shape), table, material, wavelength, mode == TRANSMITTED, mode != 0
    )

    value = jnp.stack([*te, *tm], axis=-1)  # [rows, nodes, 4]
    rise = jnp.diff(value, axis=1, append=value[:, -1:])
    return Nodes(jnp.concatenate([value, rise], axis=-1).reshape(-1, 8))


def interpolate(tables: Nodes, cell: jax.Array, fraction: jax.Array) -> tuple[slab.Pair, slab.Pair]:
    """Coefficients of some interactions from their tables.

    Args:
        tables: The tables.
        cell: Index of the node below, over all rows [n].
        fraction: Way from that node to the next [n].

    Returns:
        Transverse electric and magnetic coefficients, (real, imaginary) [n].
    """
    at = [tables.values[:, part].at[cell].get(mode="promise_in_bounds") for part in range(8)]
    te_real, te_imag, tm_real, tm_imag = (at[part] + at[part + 4] * fraction for part in range(4))
    return (te_real, te_imag), (tm_real, tm_imag)


def table_error(tables: Nodes, lookup: Lookup) -> jax.Array:
    """Largest error of any interpolated coefficient.

    The tables are thinned to every other node, and the nodes left out are compared with what interpolation makes of
    them. The error of linear interpolation falls with the square of the interval, so that the error of the tables
    themselves is a quarter of the largest gap; twice as much is returned.

    Args:
        tables: The tables.
        lookup: Their lay-out, with an even number of intervals.

    Returns:
        Largest absolute error of a coefficient's real or imaginary part [1].
    """
    rows = tables.values[:, :4].reshape(-1, lookup.intervals + 1, 4)
    gap = rows[:, 1::2] - 0.5 * (rows[:, :-1:2] + rows[:, 2::2])
    return 0.5 * jnp.abs(gap).max(initial=0.0)
