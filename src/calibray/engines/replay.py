"""Replay: stored paths, evaluated for any candidate, with derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calibray import fields
from calibray.engines.protocol import check_candidates
from calibray.parameters import Parameters
from calibray.paths import Paths

ANSWERS: Final = 2_000_000
"""Derivatives by every material's constants that a call returns, at most."""

LARGE: Final = 50_000
"""Interactions beyond which a program is large."""

TABULATED: Final = 30_000
"""Interactions beyond which coefficients may come from tables."""

NODES: Final = 0.25
"""Nodes of tables for each interaction, beyond which filling them would cost more than they spare."""

TABLE_TOLERANCE: Final = 1e-4
"""Largest error of a tabulated coefficient."""

FORETOLD: Final = 32
"""Candidates spread over the bounds that tell how fine tables must be, beside the first one."""

BLOCK: Final = 32
"""Candidates a call, at most."""


class Replay:
    """Stored paths, evaluated for any candidate.

    Args:
        paths: The path program.
        parameters: What the candidates' components stand for.
        combining: How a link's paths combine: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        dtype: Precision, `numpy.float64` or `numpy.float32`; if None, single precision for large programs whose paths
            combine by power.
        tabulate: Whether coefficients come from tables; if None, where that is quicker.
        block: Candidates a call, at most; a program is compiled for this number, and fewer cost no more than they are.

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
        block: int = BLOCK,
    ) -> None:
        self.paths, self.parameters, self.materials, self.calls = paths, parameters, dict(paths.materials), 0
        if dtype is None:
            dtype = np.float32 if self.large and combining == "power" else np.float64
        self._dtype, self._block = dtype, block
        self._combining = fields.Combining.make(combining, paths.link, paths.delay, bandwidth)
        self._rows, columns = parameters.matrix_indices(list(paths.materials))
        used, self._places = np.unique(columns, return_inverse=True)
        self._columns = columns
        self._base = paths.material_table().astype(dtype)
        self._fields = tuple(int(column) for column in used)
        self._intervals = None if tabulate is False else self._needed(force=tabulate is True)
        self._program = self._laid_out()

    @property
    def interactions(self) -> int:
        """Interactions that a candidate is evaluated at."""
        return self.paths.num_interactions

    @property
    def large(self) -> bool:
        """Whether there are so many interactions that a candidate costs milliseconds."""
        return self.interactions > LARGE

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

    def _value(self, tables: NDArray[np.floating], count: int) -> tuple[NDArray[np.floating], float]:
        return fields.path_losses(self._program, tables, self._combining, count)

    def _jacobian(
        self, tables: NDArray[np.floating], count: int
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], float]:
        loss, slope, error = fields.path_losses_and_slopes(
            self._program, tables, self._fields, self._combining, count
        )
        return loss, slope[:, :, self._rows, self._places], error

    def _run(self, function: Callable, candidates: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        values = check_candidates(candidates, len(self.parameters)).astype(self._dtype)
        parts, start = [], 0
        while start < len(values):
            size = self._size()
            block = values[start : start + size]
            tables = np.repeat(self._base[None], size, axis=0)
            tables[: len(block), self._rows, self._columns] = block
            *found, error = function(tables, len(block))
            if error > TABLE_TOLERANCE:
                self._refine()
                continue
            parts.append([np.asarray(part, dtype=float) for part in found])
            start += len(block)
        self.calls += len(values)
        return tuple(np.concatenate(column) for column in zip(*parts, strict=True))

    def _needed(self, force: bool) -> NDArray[np.int64] | None:
        """Intervals of the tables by material and mode; None where evaluating every coefficient is quicker."""
        if not force and self.interactions <= TABULATED:
            return None
        unit = qmc.Sobol(len(self.parameters), rng=0).random(FORETOLD)
        few = np.concatenate([self.parameters.start[None], self.parameters.from_unit(unit)])
        tables = self.parameters.constants_of(few, self.paths.materials, self.paths.frequency)
        found = fields.table_intervals(self.paths, tables, TABLE_TOLERANCE)
        return found if force or found.sum() <= NODES * self.interactions else None

    def _refine(self) -> None:
        """Make the tables of coefficients finer, for these candidates and all that follow."""
        if self._intervals is not None:
            finer = 2 * self._intervals
            self._intervals = finer if finer.max() <= fields.FINEST else None
        self._program = self._laid_out()

    def _laid_out(self) -> fields.GroupedProgram:
        return fields.layout(
            self.paths, self._dtype, self._intervals, self._combining.kind != "power"
        ).program

    def _size(self) -> int:
        """Candidates that a call takes: one where tables are filled for each."""
        if self._intervals is not None:
            return 1
        room = ANSWERS // max(self.paths.num_links * len(self.materials) * len(self._fields), 1)
        return min(self._block, 1 << max(room, 1).bit_length() - 1)
