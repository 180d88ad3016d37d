"""Tables of the slab coefficients by angle of incidence, for programs with many interactions.

A coefficient depends on the geometry only through the cosine of incidence. If a program has many more interactions than
its tables have nodes, each candidate's coefficients are computed at the nodes. Interpolation by cubic polynomials
through four nodes then takes about 10 ns per interaction, instead of 100 ns for the formula. The position of an
interaction in its table does not depend on the materials, so it is computed once. Each pair of material and mode has a
separate row of nodes.

Nodes are evenly spaced in a root of the cosine: the square root or, for metals, whose Brewster angle is very close to
grazing incidence, the sixth root. A sheet of plasterboard at 2 GHz requires about a hundred intervals, and a thick slab
at 60 GHz requires thousands. `table_intervals` chooses the number of intervals from a few representative candidates.
`table_error` then bounds the error for every candidate, even at Brewster angles, grazing incidence and slab resonances.
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
from scipy.constants import speed_of_light

from calibray.fields.arithmetic import Pair, materialize
from calibray.fields.jax_context import jax_settings
from calibray.fields.slab import FIELD_COLUMN, Mode, coefficients_of_materials, loss_term
from calibray.paths import Kind, Paths

Intervals = int | NDArray[np.integer]
"""Number of intervals: one number for all rows, or one for each material and mode [M, 3]."""

FINEST: Final = 65536
"""Largest number of intervals in a row of the tables."""

COARSEST: Final = 16
"""Smallest number of intervals in a row."""

_STAGES: Final = (1024, 8192, FINEST)
"""Successive upper limits of the search for a number of intervals; each limit is tried only if the previous one is not
sufficient."""

_TOLERANCE_SHARE: Final = 0.1
"""Largest permitted error for the representative candidates, as a share of the tolerance."""

_METAL_LOSS: Final = 1e3
"""Loss term above which a material is treated as a metal."""

_GRAZING: Final = 1e-9
"""Smallest cosine at a node. At exactly 0, even air would be a perfect reflector."""

_EXTRA_NODES: Final = 3
"""Number of nodes of a row minus its number of intervals. The extra nodes are one before the first interval, one at the
end of the last interval, and one after it."""

_STENCIL: Final = 3
"""Number of nodes that `table_error` requires on each side of a node."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TableLayout:
    """The position of each coefficient in the tables. The rows of all pairs of material and mode are concatenated.

    Attributes:
        cell: Index of the node below the coefficient, counted over all rows; one array for each step of each group, [n]
            or [k, n].
        fraction: Distance of the coefficient from the node below, in units of the interval; arrays of the same shapes.
        cosine: Cosine of the angle of incidence at every node [N].
        material: Material of every node [N].
        mode: Mode of every node [N].
        rank: Index [N] of every node in its row; 0 for the node before grazing incidence.
        inner: Whether a node has at least three other nodes of its row, or their mirror images, on each side; shape
            [N].
    """

    cell: tuple[jax.Array, ...]
    fraction: tuple[jax.Array, ...]
    cosine: jax.Array
    material: jax.Array
    mode: jax.Array
    rank: jax.Array
    inner: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CoefficientTables:
    """Tables of coefficients. The numbers of a cell are adjacent in memory, so a look-up reads one or two cache lines.

    Attributes:
        values: Coefficients [N + 4, 16] of cubic polynomials in the fraction, from every node to the next. Powers are
            in ascending order. For each power, the real and imaginary parts of the transverse electric coefficient come
            first, then those of the transverse magnetic coefficient. At the last four nodes, both coefficients are 1.
    """

    values: jax.Array


Arguments = tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.float64]]
"""Materials, modes and cosines of incidence of the coefficients, each [J]."""


def coefficient_arguments(paths: Paths) -> Arguments:
    """Material, mode and cosine of incidence of every coefficient of a path program, each [J].

    The coefficients of all interactions come first, then those of the n-faces of diffracting wedges.
    """
    wedge = np.flatnonzero(paths.kind == Kind.DIFFRACTION)
    kind, material = (np.concatenate([column, column[wedge]]) for column in (paths.kind, paths.material))
    mode = np.select(
        [kind == Kind.REFRACTION, kind == Kind.DIFFUSE], [Mode.TRANSMISSION, Mode.FULL_REFLECTION], 0
    )
    return material, mode, np.concatenate([paths.cos_incidence, paths.diffraction.cos_incidence_n])


def spacing_roots(table: NDArray[np.float64], wavelength: float) -> NDArray[np.int64]:
    """Degree [M] of the root of the cosine in which a material's nodes are evenly spaced: 6 for metals, otherwise 2."""
    loss = loss_term(jnp.asarray(table[:, FIELD_COLUMN["conductivity"]]), jnp.asarray(wavelength))
    return np.where(np.asarray(loss) > _METAL_LOSS, 6, 2)


def table_layout(
    arguments: Arguments,
    root: NDArray[np.integer],
    steps: Sequence[NDArray[np.integer]],
    intervals: Intervals,
    dtype: type,
) -> TableLayout:
    """Find the position of every coefficient [J] in the tables. The degrees `root` [M] come from `spacing_roots`.

    `steps` contains the indices of the coefficients at each step of each group, in arrays of any shape. The index J
    marks an empty position, whose coefficient is 1.
    """
    material, mode, cosine = arguments
    rows, row = np.unique(material.astype(np.int64) * len(Mode) + mode, return_inverse=True)
    row = row.reshape(-1)
    cells = np.broadcast_to(intervals, (len(rows),)) if np.ndim(intervals) == 0 else np.ravel(intervals)[rows]
    ends = np.cumsum(cells + _EXTRA_NODES)
    first, total = ends - cells - _EXTRA_NODES, int(ends[-1]) if len(ends) else 0
    row_of_node = np.repeat(np.arange(len(rows)), cells + _EXTRA_NODES)
    rank = np.arange(total) - first[row_of_node]  # of a node within its row
    position = cosine ** (1 / root[material]) * cells[row]
    # Normal incidence is the end of the last interval, not the start of the next one.
    below = np.minimum(position.astype(np.int64), cells[row] - 1)
    # Empty positions use the cell among the last four nodes, where the coefficient is 1.
    cell = np.append(first[row] + 1 + below, total + 1).astype(np.uint32)
    fraction = np.append(position - below, 0.0).astype(dtype)
    last, material_of_node = cells[row_of_node] + _EXTRA_NODES - 1, (rows // len(Mode))[row_of_node]
    # The node before grazing incidence has the root -1 / cells. Its even power equals that of the node after grazing
    # incidence. The last node lies beyond normal incidence, where the formula continues smoothly.
    node_cosine = ((rank - 1) / cells[row_of_node]) ** root[material_of_node]
    return TableLayout(
        cell=tuple(jax.device_put(cell[step]) for step in steps),
        fraction=tuple(jax.device_put(fraction[step]) for step in steps),
        cosine=jax.device_put(np.maximum(node_cosine, _GRAZING).astype(dtype)),
        material=jax.device_put(material_of_node.astype(np.int32)),
        mode=jax.device_put((rows % len(Mode))[row_of_node].astype(np.int32)),
        rank=jax.device_put(rank.astype(np.int32)),
        inner=jax.device_put((rank > 0) & (rank <= last - _STENCIL)),
    )


def fill_tables(layout: TableLayout, table: jax.Array, wavelength: jax.Array) -> CoefficientTables:
    """Compute the coefficients at all nodes, given material constants [M, 8] and a wavelength [m]."""
    te, tm = coefficients_of_materials(
        layout.cosine,
        table,
        layout.material,
        wavelength,
        layout.mode == Mode.TRANSMISSION,
        layout.mode != Mode.REFLECTION,
    )
    ones = jnp.broadcast_to(jnp.array([1.0, 0.0, 1.0, 0.0], dtype=table.dtype), (4, 4))
    value = materialize(jnp.concatenate([jnp.stack([*te, *tm], axis=-1), ones]), wavelength)
    return CoefficientTables(_cubics(value))


def _cubics(value: jax.Array) -> jax.Array:
    """Coefficients [N, 16] of the cubics from each node to the next: Lagrange interpolation through four nodes.

    Cubics at nodes that lack a neighbour are meaningless and unused.
    """
    before, after, beyond = (jnp.roll(value, -step, axis=0) for step in (-1, 1, 2))
    linear = after - before / 3 - value / 2 - beyond / 6
    square = (before + after) / 2 - value
    cube = (beyond - before) / 6 + (value - after) / 2
    return jnp.concatenate([value, linear, square, cube], axis=-1)


def interpolate(tables: CoefficientTables, cell: jax.Array, fraction: jax.Array) -> tuple[Pair, Pair]:
    """Transverse electric and magnetic coefficients (real, imaginary) [...], interpolated from the tables.

    `cell` [...] is the index of the node below, counted over all rows, and `fraction` [...] is the distance from this
    node in units of the interval.
    """

    def value(part: int) -> jax.Array:
        factors = [tables.values[:, part + 4 * k].at[cell].get(mode="promise_in_bounds") for k in range(4)]
        return ((factors[3] * fraction + factors[2]) * fraction + factors[1]) * fraction + factors[0]

    return (value(0), value(1)), (value(2), value(3))


def table_error(tables: CoefficientTables, layout: TableLayout, num_materials: int) -> jax.Array:
    """Upper bound [M, 3], by material and mode, of the interpolation error in any real or imaginary part.

    The value at every inner node is compared with the cubic through the nodes one and three steps away, which has twice
    the step. The error of a cubic scales with the fourth power of the step, so the tables' error is about a sixteenth
    of the largest difference. The bound is twice this error.
    """
    value = tables.values[: len(layout.cosine), :4]

    def at(step: int) -> jax.Array:
        return jnp.roll(value, -step, axis=0)

    # Coefficients are even functions of the root of the cosine, so nodes beyond grazing incidence are mirror images.
    rank = layout.rank[:, None]
    before = jnp.where(rank == 1, at(3), jnp.where(rank == 2, at(1), at(-3)))
    gap = at(0) - 9 / 16 * (at(-1) + at(1)) + 1 / 16 * (before + at(3))
    error = jnp.where(layout.inner, jnp.abs(gap).max(axis=1), 0.0) / 8
    row = layout.material * len(Mode) + layout.mode
    return jnp.zeros(num_materials * len(Mode), error.dtype).at[row].max(error).reshape(num_materials, -1)


@jax_settings()
def table_intervals(paths: Paths, tables: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """Number of intervals [M, 3], by material and mode, that limits the coefficients' error to `tolerance` [1].

    Each number is a power of two up to `FINEST`, or 0 if no coefficient has this material and mode. `tables` [n, M, 8]
    contains the constants of representative candidates.
    """
    material, mode, _ = coefficient_arguments(paths)
    needed = np.zeros((tables.shape[1], len(Mode)), dtype=np.int64)
    wavelength = speed_of_light / paths.frequency
    root = spacing_roots(paths.material_table(), wavelength)
    for row in np.unique(material.astype(np.int64) * len(Mode) + mode).tolist():
        number, row_mode = divmod(row, len(Mode))
        needed[number, row_mode] = max(
            _row_intervals(constants, row_mode, int(root[number]), wavelength, _TOLERANCE_SHARE * tolerance)
            for constants in np.unique(tables[:, number], axis=0)
        )
    return needed


def _row_intervals(
    constants: NDArray[np.float64], mode: int, root: int, wavelength: float, tolerance: float
) -> int:
    """Number of intervals that a row requires for its material's constants [8]."""
    for finest in _STAGES:
        errors = np.asarray(_errors_by_intervals(constants[None], mode, root, wavelength, finest))
        sufficient = np.flatnonzero(errors <= tolerance)
        if len(sufficient):
            return COARSEST << int(sufficient[0])
    return FINEST


@partial(jax.jit, static_argnums=4)
def _errors_by_intervals(
    table: jax.Array, mode: jax.Array, root: jax.Array, wavelength: jax.Array, finest: int
) -> jax.Array:
    """Largest error of a row for each number of intervals; the numbers double from `COARSEST` to `finest`."""
    cosine = jnp.maximum((jnp.arange(2 * finest + 1) / (2 * finest)) ** root, _GRAZING)
    material = jnp.zeros(cosine.shape, dtype=jnp.int32)
    te, tm = coefficients_of_materials(
        cosine, table, material, wavelength, mode == Mode.TRANSMISSION, mode != Mode.REFLECTION
    )
    value = materialize(jnp.stack([*te, *tm], axis=-1), wavelength)
    errors, step = [], finest // COARSEST
    while step:
        node, middle = value[:: 2 * step], value[step :: 2 * step]
        # Coefficients are even functions of the root of the cosine, so the node before the first mirrors the second.
        node = jnp.concatenate([node[1:2], node])
        interpolated = 9 / 16 * (node[1:-2] + node[2:-1]) - 1 / 16 * (node[:-3] + node[3:])
        # The nodes end at normal incidence here, so the last interval lacks a neighbouring node and is omitted.
        errors.append(jnp.abs(middle[:-1] - interpolated).max())
        step //= 2
    return jnp.stack(errors)
