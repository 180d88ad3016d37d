"""Elimination of the nuisance: the best coefficients and the projected derivatives, for all candidates at once.

In variable projection (G. H. Golub and V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973), the coefficients b
minimize sum_i w_i (gap_i - z_i.b)^2 + sum_j (ridge_j b_j)^2 within their bounds. If each link has an entry in only one
column, each coefficient is a clipped weighted mean.

Otherwise the normal equations have an arrowhead matrix: diagonal blocks bordered by a few columns. Columns of different
groups share no link, so they form separate blocks. Columns with entries at all links couple to every block and form the
border. Block elimination solves the system in about the time needed to read the matrix, however many groups there are.

Block principal pivoting (L. F. Portugal, J. J. Judice and L. N. Vicente, A comparison of block pivoting and
interior-point algorithms for linear least squares problems with nonnegative variables, Mathematics of Computation 63,
1994) enforces the bounds in all problems of a batch simultaneously. Each iteration fixes components outside their
bounds at the bound, releases the fixed components whose gradient points inwards, and solves again. If the number of
infeasible components stops decreasing, only the last one is exchanged (Murty's rule); this guarantees termination. The
result meets the optimality conditions exactly, without a step length or a convergence tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calibray.errors import EngineError
from calibray.fitting.nuisance import Nuisance

DENSE: Final = 2**18
"""Maximum number of entries of a design for which one dense product over all candidates is faster than sparse
products."""

DEPENDENT: Final = 1e-10
"""A column counts as linearly dependent if at most this fraction of its squared norm remains after the preceding
columns are projected out. Rounding leaves about 1e-16 per column."""

PRIOR: Final = 1e-6
"""Weight of the prior on a linearly dependent column, relative to the squared norm of the column. In three of 600
random problems with bounds, this weight gives a sum of squares 3e-5 to 4e-4 above the minimum. With 1e-7, the
coefficients lose one digit of accuracy."""

ROUNDING: Final = 1e-11
"""Tolerance for bound violations and gradients due to rounding in double precision, relative to the size of the
right-hand side."""

PATIENCE: Final = 3
"""Number of full exchanges without progress after which components are exchanged one at a time."""

MAX_EXCHANGES: Final = 1000
"""Maximum number of exchanges; the tested problems needed far fewer."""

Matrix = NDArray[np.float64] | sparse.csr_array


@dataclass(frozen=True, eq=False)
class Elimination:
    """Normal equations of a nuisance over weighted links.

    Attributes:
        design: Columns Z [m, q] of the nuisance at the m links with nonzero weight.
        weighted: Z' W [q, m], with the diagonal matrix W of the weights.
        data: Z' W Z, the normal equations without priors [q, q].
        normal: The normal equations with priors; `order` states the order of their columns.
        order: Index, in the design, of each column of `normal` [q].
        lower: Lower bounds [q].
        upper: Upper bounds [q].
        separable: Whether every link has an entry in at most one column.
        determined: Mask [q] of the columns whose coefficients the links determine. Of linearly dependent columns, those
            of the finest grouping count as determined.
    """

    design: Matrix
    weighted: Matrix
    data: sparse.csr_array
    normal: Arrowhead
    order: NDArray[np.int64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    separable: bool
    determined: NDArray[np.bool_]

    @classmethod
    def of(cls, nuisance: Nuisance, weight: NDArray[np.float64], ridge: NDArray[np.float64]) -> Elimination:
        """Set up the normal equations with the weights [L] of all links; a weight of 0 leaves a link out.

        `ridge` [q] is the square root of the priors' contribution to the diagonal of these equations.
        """
        counted = weight > 0
        design = nuisance.design if counted.all() else nuisance.design[counted]
        weighted = design.T.multiply(weight[counted]).tocsr()
        data = weighted @ design
        order, groups, width = nuisance.layout
        normal = (data + sparse.diags_array(ridge**2)).tocsr()[order][:, order].tocoo()
        arrowhead, determined = Arrowhead.of(normal, groups, width), np.zeros(len(order), dtype=bool)
        determined[order] = ~arrowhead.dependent
        small = np.count_nonzero(counted) * len(order) <= DENSE
        return cls(
            design=design.toarray() if small else design,
            weighted=weighted.toarray() if small else weighted,
            data=data.tocsr(),
            normal=arrowhead,
            order=order,
            lower=nuisance.lower,
            upper=nuisance.upper,
            separable=len(nuisance.terms) == 1,
            # With a prior, even a column without entries is independent of the others.
            determined=determined & (data.diagonal() > 0),
        )

    def coefficients(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """The best coefficients [n, q], in dB per unit of the column.

        `gap` [n, m] is measured minus modelled path loss [dB] at the links with nonzero weight. An undetermined
        coefficient takes the value nearest to 0 within its bounds, unless this value would keep other coefficients from
        reaching the minimum within their bounds.

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        return self.minimum((self.weighted @ gap.T).T)

    def minimum(self, side: NDArray[np.float64]) -> NDArray[np.float64]:
        """Like `coefficients`, but from sums over the links: the right-hand side Z' W gap [n, q].

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        side = side[:, self.order]
        best = np.empty_like(side)
        if self.separable:
            # One column per link: the normal equations are diagonal, so each clipped mean is the minimum.
            best[:, self.order] = side / np.where(self.normal.dependent, np.inf, self.normal.scale**2)
            return np.clip(best, self.lower, self.upper)
        best[:, self.order] = self.normal.minimum(side, self.lower[self.order], self.upper[self.order])
        return best

    def projection(
        self, slope: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Coefficients [n, q, d] of a least-squares fit of the design to the derivatives; 0 for those at a bound.

        They equal minus the derivatives of the best coefficients [n, q] with respect to the parameters.
        `slope` [n, m, d] contains the derivatives of the modelled path loss at the links with nonzero weight.
        """
        if isinstance(self.weighted, np.ndarray):
            side = self.weighted @ slope
        else:
            side = np.stack([self.weighted @ candidate for candidate in slope])
        return self.projection_from_sums(side, coefficients)

    def projection_from_sums(
        self, side: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Like `projection`, but from sums over the links: Z' W times the derivatives [n, q, d]."""
        # A coefficient at its bound does not depend on the parameters.
        free = ((coefficients > self.lower) & (coefficients < self.upper))[:, self.order]
        projection = np.empty_like(side)
        projection[:, self.order] = self.normal.solve(free, side[:, self.order])
        return projection

    def remove(self, slope: NDArray[np.float64], projection: NDArray[np.float64]) -> None:
        """Subtract, in place, the projection [n, q, d] from derivatives [n, m, d] at links with nonzero weight."""
        if isinstance(self.design, np.ndarray):
            slope -= self.design @ projection
            return
        for candidate, coefficients in zip(slope, projection, strict=True):
            candidate -= self.design @ coefficients


@dataclass(frozen=True, eq=False)
class Arrowhead:
    """The matrix N of the quadratic form x.N.x / 2 - side.x, scaled to a unit diagonal, with q = g b + p rows.

    Attributes:
        scale: Square roots [q] of the diagonal before scaling; 1 where the diagonal is 0.
        blocks: The g diagonal blocks [g, b, b].
        border: Products [g, b, p] of the block columns with the p border columns.
        corner: Products [p, p] of the border columns with each other.
        dependent: Mask [q] of the components whose column is zero or a linear combination of the preceding columns; the
            blocks precede the border. The matrix includes a small prior on these components. These components are
            therefore zero unless the bounds prevent the other components from reaching the minimum.
    """

    scale: NDArray[np.float64]
    blocks: NDArray[np.float64]
    border: NDArray[np.float64]
    corner: NDArray[np.float64]
    dependent: NDArray[np.bool_]

    @classmethod
    def of(cls, matrix: sparse.coo_array, blocks: int, width: int) -> Arrowhead:
        """Split a positive semidefinite matrix [q, q] into blocks, border and corner.

        The blocks come first, have the same width, and do not overlap.
        """
        diagonal, split = matrix.diagonal(), blocks * width
        scale = np.where(diagonal > 0, np.sqrt(diagonal), 1.0)
        row, column = matrix.row, matrix.col
        value = matrix.data / (scale[row] * scale[column])
        edge = len(diagonal) - split
        inner, border, corner = np.zeros((split, width)), np.zeros((split, edge)), np.zeros((edge, edge))
        in_blocks = (row < split) & (column < split)
        inner[row[in_blocks], column[in_blocks] % width] = value[in_blocks]
        in_border = (row < split) & (column >= split)
        border[row[in_border], column[in_border] - split] = value[in_border]
        in_corner = (row >= split) & (column >= split)
        corner[row[in_corner] - split, column[in_corner] - split] = value[in_corner]
        inner, border = inner.reshape(blocks, width, width), border.reshape(blocks, width, edge)
        dependent = np.concatenate([_dependent(inner).ravel(), np.zeros(edge, dtype=bool)])
        arrowhead = cls(scale, inner, border, corner, dependent)
        # Border columns are dependent if eliminating the blocks reduces them to zero.
        free, tip, outer = arrowhead._restricted(~dependent[None])
        left = outer - np.einsum("mgbp,mgbr->mpr", tip, np.linalg.solve(free, tip), optimize=True)
        dependent[split:] = _dependent(left[0])
        inner += PRIOR * dependent[:split].reshape(blocks, width, 1) * np.eye(width)
        corner += np.diag(PRIOR * dependent[split:])
        return arrowhead

    def solve(self, free: NDArray[np.bool_], side: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unconstrained minima [m, q, k] for right-hand sides [m, q, k] over the free components; the others are zero.

        `free` [m, q] is the mask of the free components.
        """
        problems, count, sides = side.shape
        if problems > 1 and (free == free[0]).all():  # all problems share one matrix
            merged = self.solve(free[:1], side.transpose(1, 0, 2).reshape(1, count, problems * sides))
            return merged.reshape(count, problems, sides).transpose(1, 0, 2)
        scaled = np.where(free[..., None], side / self.scale[:, None], 0.0)
        return self._solve(free, scaled) / self.scale[:, None]

    def minimum(
        self, side: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Minima [m, q] within bounds [q] for right-hand sides [m, q].

        Raises:
            EngineError: The exchanges did not terminate.
        """
        given_lower, given_upper, side = lower, upper, side / self.scale
        lower, upper = lower * self.scale, upper * self.scale
        # Blocks without a border are independent problems.
        independent = 1 if self.border.shape[2] else len(self.blocks)
        free, value = np.ones(side.shape, dtype=bool), np.zeros_like(side)
        fewest = np.full((len(side), independent), len(lower) + 1)
        patience = np.full((len(side), independent), PATIENCE)
        pending = np.arange(len(side))
        for _ in range(MAX_EXCHANGES):
            active = free[pending]
            trial = np.where(active, self._trial(side[pending], active, value[pending]), value[pending])
            descent = side[pending] - self._times(trial)  # minus the gradient
            slack = ROUNDING * (1.0 + np.abs(side[pending]).max(axis=1, initial=0.0))[:, None]
            outside = active & ((trial < lower - slack) | (trial > upper + slack))
            inwards = ((trial <= lower) & (descent > slack)) | ((trial >= upper) & (descent < -slack))
            # Free components outside their bounds, and fixed components whose descent direction points inwards.
            infeasible = outside | (~active & inwards)
            value[pending] = np.clip(trial, lower, upper)
            unfinished = infeasible.any(axis=1)
            pending, infeasible = pending[unfinished], infeasible[unfinished]
            if not len(pending):
                # Values at a bound are set to the given bound exactly, to avoid rounding errors from the scaling.
                inside = np.clip(value / self.scale, given_lower, given_upper)
                return np.where(value == lower, given_lower, np.where(value == upper, given_upper, inside))
            free[pending] ^= _to_exchange(infeasible, fewest, patience, pending)
        raise EngineError(
            f"nuisance: no minimum within the bounds was found in {MAX_EXCHANGES} exchanges; widen the bounds"
        )

    def _trial(
        self, side: NDArray[np.float64], free: NDArray[np.bool_], value: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Minimum [m, q] over the free components, with the other components fixed at their values."""
        rest = np.where(free, side - self._times(np.where(free, 0.0, value)), 0.0)
        if (free == free[0]).all():
            return self._solve(free[:1], rest.T[None])[0].T
        return self._solve(free, rest[..., None])[..., 0]

    def _solve(self, free: NDArray[np.bool_], side: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve by block elimination; the rows of fixed components are rows of the identity matrix."""
        groups, width, edge = self.border.shape
        split = groups * width
        blocks, border, corner = self._restricted(free)
        inner = side[:, :split].reshape(len(side), groups, width, -1)
        solved = np.linalg.solve(blocks, np.concatenate([border, inner], axis=-1))
        across, within = solved[..., :edge], solved[..., edge:]
        # Schur complement: the corner after elimination of the blocks.
        schur = corner - np.einsum("mgbp,mgbr->mpr", border, across, optimize=True)
        outer = np.linalg.solve(schur, side[:, split:] - np.einsum("mgbp,mgbk->mpk", border, within))
        within = within - across @ outer[:, None]
        return np.concatenate([within.reshape(len(side), split, -1), outer], axis=1)

    def _restricted(
        self, free: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Blocks, border and corner, with rows and columns of fixed components taken from the identity matrix."""
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
    """Mask of dependent columns [..., b], from Cholesky elimination of Gram matrices of unit columns [..., b, b]."""
    remainder, dependent = matrix.copy(), np.zeros(matrix.shape[:-1], dtype=bool)
    for k in range(matrix.shape[-1]):
        pivot = remainder[..., k, k].copy()
        dependent[..., k] = pivot <= DEPENDENT
        # A dependent column does not change the columns after it.
        root = np.where(dependent[..., k], np.inf, np.sqrt(np.maximum(pivot, DEPENDENT)))
        column = remainder[..., :, k] / root[..., None]
        remainder -= column[..., :, None] * column[..., None, :]
    return dependent


def _to_exchange(
    infeasible: NDArray[np.bool_],
    fewest: NDArray[np.int64],
    patience: NDArray[np.int64],
    pending: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """Mask [r, q] of components to exchange: all infeasible ones while their number decreases, then one in each part.

    `infeasible` is the mask of the infeasible components [r, q] of the unsolved problems `pending` [r]. For each
    independent part [m, i], `fewest` (the smallest number so far) and `patience` (the remaining full exchanges without
    progress) are updated in place.
    """
    parts = infeasible.reshape(len(infeasible), fewest.shape[1], -1)
    count = parts.sum(axis=2)
    fewer, remaining = count < fewest[pending], patience[pending]
    # Murty's rule exchanges a single component.
    last = parts.shape[2] - 1 - np.argmax(parts[..., ::-1], axis=2)
    last_only = parts & (np.arange(parts.shape[2]) == last[..., None])
    fewest[pending] = np.minimum(count, fewest[pending])
    patience[pending] = np.where(fewer, PATIENCE, np.maximum(remaining - 1, 0))
    return np.where((fewer | (remaining > 0))[..., None], parts, last_only).reshape(infeasible.shape)
