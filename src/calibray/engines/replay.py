"""Replay: stored paths, evaluated for any candidate, with derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray import fields
from calibray.engines.protocol import check_candidates
from calibray.fields.tabulation import Lookup
from calibray.parameters import Parameters
from calibray.paths import Paths

BLOCK_INTERACTIONS: Final = 50_000
"""Interactions times candidates evaluated at once, whose numbers fit into a core's cache."""

TABULATED: Final = 50_000
"""Interactions beyond which coefficients come from tables."""

FIRST_INTERVALS: Final = 2048
LAST_INTERVALS: Final = 65536
"""Intervals of a table of coefficients, at first and at most."""

NODE_COST: Final = 4
"""Interactions looked up in the time of evaluating a node, with its share of the check."""

TABLE_TOLERANCE: Final = 1e-4
"""Largest error of a tabulated coefficient."""

LARGEST_BLOCK: Final = 16
"""Candidates a call, at most; fewer are filled up, so that a program is compiled for one number of candidates."""


class Replay:
    """Stored paths, evaluated for any candidate.

    Args:
        paths: The path program.
        parameters: What the candidates' components stand for.
        combining: How a link's paths combine: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        dtype: Precision, `numpy.float64` or `numpy.float32`; if None, single precision for large programs whose paths
            combine by power.
        tabulate: Whether coefficients come from tables; if None, for large programs.

    Raises:
        InputError: A parameter's material is not in the paths, or the combining cannot be used.
    """

    def __init__(
        self,
        paths: Paths,
        parameters: Parameters,
        combining: str = "power",
        bandwidth: float | None = None,
        dtype: type | None = None,
        tabulate: bool | None = None,
    ) -> None:
        self.paths, self.parameters, self.materials, self.calls = paths, parameters, dict(paths.materials), 0
        if dtype is None:
            dtype = np.float32 if self.large and combining == "power" else np.float64
        self._dtype = dtype
        self._offsets = fields.check_combining(paths, combining, bandwidth)
        self._combining = combining
        self._rows, columns = parameters.indices(list(paths.materials))
        used, self._places = np.unique(columns, return_inverse=True)
        self._columns = columns
        self._base = jnp.asarray(fields.material_table(paths).astype(dtype))
        self._fields = tuple(int(column) for column in used)
        self._intervals = FIRST_INTERVALS if (self.large if tabulate is None else tabulate) else None
        self._forced = tabulate is True
        self._program = self._laid_out()

    @property
    def interactions(self) -> int:
        """Interactions that a candidate is evaluated at."""
        return self.paths.num_interactions

    @property
    def large(self) -> bool:
        """Whether there are so many interactions that a candidate costs milliseconds."""
        return self.interactions > TABULATED

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        (loss,) = self._run(self._value, candidates)
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link, and its derivatives by the parameters.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        loss, jacobian = self._run(self._jacobian, candidates)
        return loss, jacobian

    def _value(self, tables: jax.Array) -> tuple[jax.Array, float]:
        return fields.path_losses(self._program, tables, self._combining, self._offsets)

    def _jacobian(self, tables: jax.Array) -> tuple[jax.Array, jax.Array, float]:
        loss, slope, error = fields.path_losses_and_slopes(
            self._program, tables, self._fields, self._combining, self._offsets
        )
        return loss, _chosen(slope, self._rows, self._places), error

    def _run(self, function: Callable, candidates: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        values = check_candidates(candidates, len(self.parameters)).astype(self._dtype)
        parts, start = [], 0
        while start < len(values):
            size = self._size()
            block = values[start : start + size]
            padded = np.concatenate([block, np.repeat(block[-1:], size - len(block), axis=0)])
            tables = _tables(self._base, self._rows, self._columns, jnp.asarray(padded))
            *found, error = function(tables)
            if error > TABLE_TOLERANCE:
                self._refine()
                continue
            parts.append([np.asarray(part, dtype=float)[: len(block)] for part in found])
            start += len(block)
        self.calls += len(values)
        return tuple(np.concatenate(column) for column in zip(*parts, strict=True))

    def _refine(self) -> None:
        """Make the tables of coefficients finer, for these candidates and all that follow."""
        finer = 2 * (self._intervals or LAST_INTERVALS)
        self._intervals = finer if finer <= LAST_INTERVALS else None
        self._program = self._laid_out()

    def _laid_out(self) -> fields.GroupedProgram:
        phases = self._combining != "power"
        program = fields.layout(self.paths, self._dtype, self._intervals, phases).program
        if self._forced or not isinstance(places := program.coefficients, Lookup):
            return program
        # Filling tables would cost more than evaluating every coefficient by itself.
        if NODE_COST * places.num_nodes > self.paths.num_interactions:
            self._intervals = None
            return fields.layout(self.paths, self._dtype, None, phases).program
        return program

    def _size(self) -> int:
        """Candidates that a call takes: one where tables are filled for each."""
        if self._intervals is not None:
            return 1
        room = BLOCK_INTERACTIONS // max(self.paths.num_interactions, 1)
        return min(LARGEST_BLOCK, 1 << max(room, 1).bit_length() - 1)


@jax.jit
def _chosen(slope: jax.Array, rows: NDArray[np.int64], places: NDArray[np.int64]) -> jax.Array:
    return slope[:, :, rows, places]


@jax.jit
def _tables(
    base: jax.Array, rows: NDArray[np.int64], columns: NDArray[np.int64], values: jax.Array
) -> jax.Array:
    return jax.vmap(lambda value: base.at[rows, columns].set(value))(values)
