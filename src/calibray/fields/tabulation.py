"""Coefficients of all interactions, one by one or from tables over the angle of incidence.

A coefficient depends on the geometry through the cosine of incidence alone. Where a program has many more
interactions than its tables have nodes, each candidate's coefficients are computed at the nodes and interpolated by
cubics through four of them: some ten nanoseconds an interaction instead of a hundred. Where an interaction stands in
the table never changes, so cell and fraction are computed once. Nodes are even in a root of the cosine, the second, or
the sixth for metals: their Brewster angle lies within a thousandth of grazing incidence, where even steps of the cosine
itself would miss it. Each pair of material and mode has a row with as many nodes as it needs (`resolution.py`).

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


METAL: Final = 1e3
"""Loss term beyond which a material is a metal."""

MODES: Final = 3
"""How many modes there are."""

Intervals = int | NDArray[np.integer]
"""Intervals over a root of the cosine: of every row, or by material and mode [M, 3]."""

CHOSEN: Final = 12
"""Materials among which a constant is chosen by comparing; of more, it is gathered."""

_MARGIN: Final = 3
"""Nodes of a row beyond its intervals: one before the first, one at the end of the last, one behind it."""

_AROUND: Final = 3
"""Nodes on either side of one that `table_error` leaves out."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["cell", "fraction", "cosine", "material", "mode", "inner"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Lookup:
    """Where each coefficient stands in tables, one row after the other for each pair of material and mode.

    Attributes:
        cell: Index of the node below, over all rows; one array for each step of each group, [n] or [k, n].
        fraction: Way from that node to the next, likewise.
        cosine: Cosine of incidence at every node [N].
        material: Material of every node [N].
        mode: Mode of every node [N].
        inner: Nodes with three others of their row on either side [K].
    """

    cell: tuple[jax.Array, ...]
    fraction: tuple[jax.Array, ...]
    cosine: jax.Array
    material: jax.Array
    mode: jax.Array
    inner: jax.Array

    @property
    def num_nodes(self) -> int:
        """Nodes of all rows."""
        return self.cosine.shape[0]


@partial(jax.tree_util.register_dataclass, data_fields=["values"], meta_fields=[])
@dataclass(frozen=True)
class Nodes:
    """Tables of coefficients; a cell's numbers lie side by side, so that a place costs one or two cache lines.

    Attributes:
        values: What cubics take from every node on: the real and imaginary part of the transverse electric and of the
            transverse magnetic coefficient at the node, then their factors of the way to the next node, of its square
            and of its cube. Four nodes at which everything is 1 follow those of the rows [N + 4, 16].
    """

    values: jax.Array


def roots(table: NDArray[np.float64], wavelength: float) -> NDArray[np.int64]:
    """Which root of the cosine the nodes of each material are even in.

    Args:
        table: Material constants [M, 8].
        wavelength: [m].

    Returns:
        6 for metals, else 2 [M].
    """
    loss = slab.loss_term(jnp.asarray(table[:, _COLUMN["conductivity"]]), jnp.asarray(wavelength))
    return np.where(np.asarray(loss) > METAL, 6, 2)


def make_lookup(
    material: NDArray[np.integer],
    mode: NDArray[np.integer],
    cosine: NDArray[np.float64],
    root: NDArray[np.integer],
    places: Sequence[NDArray[np.integer]],
    intervals: Intervals,
    dtype: type,
) -> Lookup:
    """Find every coefficient's place.

    Args:
        material: Material of every coefficient [J].
        mode: Its mode [J].
        cosine: Its cosine of incidence [J].
        root: Which root of the cosine the nodes of each material are even in [M].
        places: The coefficients that stand at each step, of any shape; J where none does, and 1 is wanted.
        intervals: Intervals of the rows.
        dtype: Precision of the fractions.

    Returns:
        The places.
    """
    rows, row = np.unique(material.astype(np.int64) * MODES + mode, return_inverse=True)
    # Cubics need four nodes, and the check seven.
    cells = np.broadcast_to(intervals, (len(rows),)) if np.ndim(intervals) == 0 else np.ravel(intervals)[rows]
    ends = np.cumsum(cells + _MARGIN)
    first, total = ends - cells - _MARGIN, int(ends[-1]) if len(ends) else 0
    of_node = np.repeat(np.arange(len(rows)), cells + _MARGIN)
    step = np.arange(total) - first[of_node]
    place = cosine ** (1 / root[material]) * cells[row.reshape(-1)]
    below = np.minimum(place.astype(np.int64), cells[row.reshape(-1)] - 1)
    cell = np.append(first[row.reshape(-1)] + 1 + below, total + 1).astype(np.uint32)
    fraction = np.append(place - below, 0.0).astype(dtype)
    last, owner = cells[of_node] + _MARGIN - 1, (rows // MODES)[of_node]
    return Lookup(
        cell=tuple(jnp.asarray(cell[some]) for some in places),
        fraction=tuple(jnp.asarray(fraction[some]) for some in places),
        cosine=jnp.asarray(np.maximum(((step - 1) / cells[of_node]) ** root[owner], GRAZING).astype(dtype)),
        material=jnp.asarray(owner.astype(np.int32)),
        mode=jnp.asarray((rows % MODES)[of_node].astype(np.int32)),
        inner=jnp.asarray(np.flatnonzero((step >= _AROUND) & (step <= last - _AROUND)).astype(np.int32)),
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
        _of_material(column["relative_permittivity"], material),
        _of_material(slab.loss_term(column["conductivity"], wavelength), material),
        _of_material(column["thickness"], material),
        wavelength,
        transmitted,
    )
    kept = _of_material(slab.safe_sqrt(1 - column["scattering_coefficient"] ** 2), material)
    factor = jnp.where(whole, 1.0, kept).astype(cosine.dtype)
    return (te[0] * factor, te[1] * factor), (tm[0] * factor, tm[1] * factor)


def _of_material(constant: jax.Array, material: jax.Array) -> jax.Array:
    """A constant of each interaction's material; chosen from a few, as numbers are gathered one after the other."""
    if not 0 < len(constant) <= CHOSEN:
        return constant[material]
    found = jnp.broadcast_to(constant[0], material.shape)
    for number in range(1, len(constant)):
        found = jnp.where(material == number, constant[number], found)
    return found


def nodes(lookup: Lookup, table: jax.Array, wavelength: jax.Array) -> Nodes:
    """The tables of the coefficients.

    Args:
        lookup: The tables' lay-out.
        table: Material constants [M, 8].
        wavelength: [m].

    Returns:
        The tables.
    """
    te, tm = evaluate(
        lookup.cosine, table, lookup.material, wavelength, lookup.mode == TRANSMITTED, lookup.mode != 0
    )
    ones = jnp.broadcast_to(jnp.array([1.0, 0.0, 1.0, 0.0], dtype=table.dtype), (4, 4))
    return Nodes(cubics(slab.keep(jnp.concatenate([jnp.stack([*te, *tm], axis=-1), ones]), wavelength)))


def cubics(value: jax.Array) -> jax.Array:
    """Cubics from every node to the next, through both and the one on either side (Lagrange).

    Args:
        value: Numbers at the nodes [N, 4].

    Returns:
        The cubics' factors [N, 16]; those of nodes without these neighbours mean nothing.
    """
    before, after, beyond = (jnp.roll(value, -step, axis=0) for step in (-1, 1, 2))
    linear = after - before / 3 - value / 2 - beyond / 6
    square = (before + after) / 2 - value
    cube = (beyond - before) / 6 + (value - after) / 2
    return jnp.concatenate([value, linear, square, cube], axis=-1)


def interpolate(tables: Nodes, cell: jax.Array, fraction: jax.Array) -> tuple[slab.Pair, slab.Pair]:
    """Coefficients of some interactions from their tables.

    Args:
        tables: The tables.
        cell: Index of the node below, over all rows [...].
        fraction: Way from that node to the next [...].

    Returns:
        Transverse electric and magnetic coefficients, (real, imaginary) [...].
    """

    def value(part: int) -> jax.Array:
        at = [tables.values[:, part + 4 * k].at[cell].get(mode="promise_in_bounds") for k in range(4)]
        return ((at[3] * fraction + at[2]) * fraction + at[1]) * fraction + at[0]

    return (value(0), value(1)), (value(2), value(3))


def table_error(tables: Nodes, lookup: Lookup) -> jax.Array:
    """Largest error of any interpolated coefficient.

    Every node is compared with the cubic through those one and three steps on either side of it. The error of cubics
    falls with the fourth power of the step, so that the error of the tables themselves is a sixteenth of the largest
    gap; twice as much is returned.

    Args:
        tables: The tables.
        lookup: Their lay-out.

    Returns:
        Largest absolute error of a coefficient's real or imaginary part [1].
    """
    value = tables.values[:, :4]

    def at(step: int) -> jax.Array:
        return value.at[lookup.inner + step].get(mode="promise_in_bounds")

    gap = at(0) - 9 / 16 * (at(-1) + at(1)) + 1 / 16 * (at(-3) + at(3))
    return jnp.abs(gap).max(initial=0.0) / 8
