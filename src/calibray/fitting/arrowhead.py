"""Minima of quadratics whose matrix is an arrowhead: blocks on the diagonal, bordered by a few columns.

That is what the normal equations of a nuisance look like: the columns of one group meet those of no other group,
while a column over all links meets them all. With the blocks eliminated first, a solution costs about as much as
reading the matrix, however many groups there are.

Bounds are kept by block principal pivoting (L. F. Portugal, J. J. Judice and L. N. Vicente, A comparison of block
pivoting and interior-point algorithms for linear least squares problems with nonnegative variables, Mathematics of
Computation 63, 1994), in all problems of a batch at once: components that leave their bounds are fixed there, fixed
ones that are pulled inwards are let go, and the rest is solved again. Where exchanging all of them does not make
them fewer, the last alone is exchanged (Murty's rule), which ends. The answer meets the conditions of the minimum
exactly; no step length or tolerance of convergence enters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calibray.errors import EngineError

DEPENDENT: Final = 1e-10
"""Share of a column's square that the columns before it must leave over; a column with less is held."""

ROUNDING: Final = 1e-11
"""Excess over a bound, and pull off a bound, that count as none; of the size of the problem."""

PATIENCE: Final = 3
"""Exchanges of all wrong components that do not make them fewer, before one at a time is exchanged."""

ROUNDS: Final = 1000
"""Exchanges that no problem has come near to needing."""


@dataclass(frozen=True, eq=False)
class Arrowhead:
    """The matrix N of x.N.x / 2 - side.x, scaled to ones on the diagonal, with q = g b + p rows.

    Attributes:
        scale: Roots of the diagonal before scaling, 1 where it is 0 [q].
        blocks: The blocks [g, b, b].
        border: The columns beside them [g, b, p].
        corner: Where the border's columns meet [p, p].
        held: Components that the data cannot tell: nothing depends on them, or those before them serve as well [q].
            The blocks' come before the border's.
    """

    scale: NDArray[np.float64]
    blocks: NDArray[np.float64]
    border: NDArray[np.float64]
    corner: NDArray[np.float64]
    held: NDArray[np.bool_]

    @classmethod
    def of(cls, matrix: sparse.coo_array, blocks: int, width: int) -> Arrowhead:
        """Take a matrix apart.

        Args:
            matrix: Positive semidefinite [q, q]; the blocks come first, and no two of them meet.
            blocks: Number of blocks g.
            width: Their width b.

        Returns:
            The arrowhead.
        """
        diagonal, split = matrix.diagonal(), blocks * width
        scale = np.where(diagonal > 0, np.sqrt(diagonal), 1.0)
        row, column = matrix.row, matrix.col
        value = matrix.data / (scale[row] * scale[column])
        edge = len(diagonal) - split
        inner, border, corner = np.zeros((split, width)), np.zeros((split, edge)), np.zeros((edge, edge))
        here = (row < split) & (column < split)
        inner[row[here], column[here] % width] = value[here]
        here = (row < split) & (column >= split)
        border[row[here], column[here] - split] = value[here]
        here = (row >= split) & (column >= split)
        corner[row[here] - split, column[here] - split] = value[here]
        square, beside = inner.reshape(blocks, width, width), border.reshape(blocks, width, edge)
        held = np.concatenate([_dependent(square).ravel(), np.zeros(edge, dtype=bool)])
        first = cls(scale, square, beside, corner, held)
        held[split:] = _dependent(first._left_over(~held[None])[0])
        return first

    def solve(self, free: NDArray[np.bool_], side: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minimum over the free components, the others being zero.

        Args:
            free: Which components are free, none of them held [m, q].
            side: Right-hand sides [m, q, k].

        Returns:
            The minima [m, q, k].
        """
        problems, count, sides = side.shape
        if problems > 1 and (free == free[0]).all():  # one matrix for all
            merged = self.solve(free[:1], side.transpose(1, 0, 2).reshape(1, count, problems * sides))
            return merged.reshape(count, problems, sides).transpose(1, 0, 2)
        scaled = np.where(free[..., None], side / self.scale[:, None], 0.0)
        return self._solve(free, scaled) / self.scale[:, None]

    def minimum(
        self, side: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Minimum within bounds; held components take the value nearest to zero.

        Args:
            side: Right-hand sides [m, q].
            lower: Lower bounds [q].
            upper: Upper bounds [q].

        Returns:
            The minima [m, q].

        Raises:
            EngineError: No minimum was found.
        """
        ends, side = (lower, upper), side / self.scale
        lower, upper = lower * self.scale, upper * self.scale
        # Blocks without a border are problems of their own.
        independent = 1 if self.border.shape[2] else len(self.blocks)
        free = np.tile(~self.held, (len(side), 1))
        value = np.tile(np.where(self.held, np.clip(0.0, lower, upper), 0.0), (len(side), 1))
        fewest = np.full((len(side), independent), len(lower) + 1)
        patience = np.full((len(side), independent), PATIENCE)
        pending = np.arange(len(side))
        for _ in range(ROUNDS):
            here, now = free[pending], value[pending]
            now = np.where(here, self._trial(side[pending], here, now), now)
            pull = side[pending] - self._times(now)
            slack = ROUNDING * (1.0 + np.abs(side[pending]).max(axis=1, initial=0.0))[:, None]
            outside = here & ((now < lower - slack) | (now > upper + slack))
            inwards = ((now <= lower) & (pull > slack)) | ((now >= upper) & (pull < -slack))
            wrong = outside | (~here & ~self.held & inwards)
            value[pending] = np.clip(now, lower, upper)
            pending, wrong = pending[(unfinished := wrong.any(axis=1))], wrong[unfinished]
            if not len(pending):
                inside = np.clip(value / self.scale, *ends)
                return np.where(value == lower, ends[0], np.where(value == upper, ends[1], inside))
            exchanged = _exchanged(wrong, fewest, patience, pending)
            free[pending] ^= exchanged
        raise EngineError(
            f"nuisance: no minimum within the bounds was found in {ROUNDS} exchanges; widen the bounds"
        )

    def _trial(
        self, side: NDArray[np.float64], free: NDArray[np.bool_], value: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Minimum over the free components, the others being fixed [m, q]."""
        rest = np.where(free, side - self._times(np.where(free, 0.0, value)), 0.0)
        if (free == free[0]).all():
            return self._solve(free[:1], rest.T[None])[0].T
        return self._solve(free, rest[..., None])[..., 0]

    def _solve(self, free: NDArray[np.bool_], side: NDArray[np.float64]) -> NDArray[np.float64]:
        """Block elimination; fixed components have a row of the identity."""
        groups, width, edge = self.border.shape
        split = groups * width
        blocks, border, corner = self._restricted(free)
        inner = side[:, :split].reshape(len(side), groups, width, -1)
        found = np.linalg.solve(blocks, np.concatenate([border, inner], axis=-1))
        across, within = found[..., :edge], found[..., edge:]
        left = corner - np.einsum("mgbp,mgbr->mpr", border, across, optimize=True)
        outer = np.linalg.solve(left, side[:, split:] - np.einsum("mgbp,mgbk->mpk", border, within))
        within = within - across @ outer[:, None]
        return np.concatenate([within.reshape(len(side), split, -1), outer], axis=1)

    def _left_over(self, free: NDArray[np.bool_]) -> NDArray[np.float64]:
        """What the blocks leave over of the corner (Schur complement) [m, p, p]."""
        blocks, border, corner = self._restricted(free)
        return corner - np.einsum("mgbp,mgbr->mpr", border, np.linalg.solve(blocks, border), optimize=True)

    def _restricted(
        self, free: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        groups, width, edge = self.border.shape
        inner, outer = free[:, : groups * width].reshape(-1, groups, width), free[:, groups * width :]
        return (
            np.where(inner[..., :, None] & inner[..., None, :], self.blocks, np.eye(width)),
            np.where(inner[..., :, None] & outer[:, None, None, :], self.border, 0.0),
            np.where(outer[:, :, None] & outer[:, None, :], self.corner, np.eye(edge)),
        )

    def _times(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """The matrix times vectors [m, q]."""
        groups, width, _ = self.border.shape
        inner, outer = value[:, : groups * width].reshape(-1, groups, width), value[:, groups * width :]
        above = np.einsum("gbc,mgc->mgb", self.blocks, inner) + np.einsum("gbp,mp->mgb", self.border, outer)
        below = np.einsum("gbp,mgb->mp", self.border, inner) + outer @ self.corner
        return np.concatenate([above.reshape(len(value), -1), below], axis=1)


def _dependent(matrix: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which columns of Gram matrices of unit columns [..., b, b] the columns before them make up [..., b]."""
    work, found = matrix.copy(), np.zeros(matrix.shape[:-1], dtype=bool)
    for k in range(matrix.shape[-1]):
        pivot = work[..., k, k].copy()
        found[..., k] = pivot <= DEPENDENT
        root = np.where(found[..., k], np.inf, np.sqrt(np.maximum(pivot, DEPENDENT)))
        column = work[..., :, k] / root[..., None]
        work -= column[..., :, None] * column[..., None, :]
    return found


def _exchanged(
    wrong: NDArray[np.bool_],
    fewest: NDArray[np.int64],
    patience: NDArray[np.int64],
    pending: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """Which wrong components to exchange: all while they get fewer, else the last of each independent problem.

    Args:
        wrong: Wrong components of the problems that are not solved [r, q].
        fewest: Fewest wrong ones so far, by independent part [m, i]; updated.
        patience: Further exchanges of all that do not make them fewer [m, i]; updated.
        pending: The problems that are not solved [r].

    Returns:
        What to exchange [r, q].
    """
    parts = wrong.reshape(len(wrong), fewest.shape[1], -1)
    count = parts.sum(axis=2)
    fewer, left = count < fewest[pending], patience[pending]
    last = parts.shape[2] - 1 - np.argmax(parts[..., ::-1], axis=2)
    alone = parts & (np.arange(parts.shape[2]) == last[..., None])
    fewest[pending] = np.minimum(count, fewest[pending])
    patience[pending] = np.where(fewer, PATIENCE, np.maximum(left - 1, 0))
    return np.where((fewer | (left > 0))[..., None], parts, alone).reshape(wrong.shape)
