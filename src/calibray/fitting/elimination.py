"""Nuisances eliminated: their best coefficients, and what they take up of the derivatives, for all candidates at once.

Variable projection (G. H. Golub and V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973): the coefficients
minimise sum_i w_i (gap_i - z_i.b)^2 + sum_j (ridge_j b_j)^2 within their bounds. With one column per link, each
coefficient is a weighted mean, clipped; else the normal equations are solved, which `arrowhead.py` does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calibray.fitting.arrowhead import Arrowhead
from calibray.fitting.nuisance import Nuisance

DENSE = 2**18
"""Entries of a design up to which dense products, all candidates in one, are the faster ones."""

Matrix = NDArray[np.float64] | sparse.csr_array


@dataclass(frozen=True, eq=False)
class Elimination:
    """A nuisance over links of given weights.

    Attributes:
        design: Its columns at the links that count [m, q].
        weighted: The same transposed, times the weights [q, m].
        data: Their product, the normal equations of the data alone [q, q].
        normal: The normal equations, columns in the order of `order`.
        order: Place in the design of the columns of `normal` [q].
        lower: Lower bounds [q].
        upper: Upper bounds [q].
        separable: Whether no link has more than one column.
        determined: Which columns some link depends on, and no others make up [q]. Of columns that make up each other,
            those of the finest grouping are kept.
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
        """Set up the normal equations.

        Args:
            nuisance: The nuisance.
            weight: Weights of all links; 0 leaves a link out [L].
            ridge: Root of what the prior adds to the diagonal of the normal equations [q].

        Returns:
            The elimination.
        """
        counted = weight > 0
        design = nuisance.design if counted.all() else nuisance.design[counted]
        weighted = design.T.multiply(weight[counted]).tocsr()
        data = weighted @ design
        order, groups, width = nuisance.layout
        normal = (data + sparse.diags_array(ridge**2)).tocsr()[order][:, order].tocoo()
        arrowhead, determined = Arrowhead.of(normal, groups, width), np.zeros(len(order), dtype=bool)
        determined[order] = ~arrowhead.held
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
            determined=determined & (data.diagonal() > 0),
        )

    def coefficients(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """The best coefficients.

        Args:
            gap: Measured minus modelled path loss at the links that count [n, m], [dB].

        Returns:
            Coefficients [n, q], [dB] per unit of the column; what the data cannot tell is as near to 0 as its bounds
            let it be.

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        return self.minimum((self.weighted @ gap.T).T)

    def minimum(self, side: NDArray[np.float64]) -> NDArray[np.float64]:
        """The best coefficients from sums over the links.

        Args:
            side: Columns of the design times weights and gap [n, q].

        Returns:
            Coefficients [n, q]; see `coefficients`.

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        side = side[:, self.order]
        found = np.empty_like(side)
        if self.separable:
            found[:, self.order] = side / np.where(self.normal.held, np.inf, self.normal.scale**2)
            return np.clip(found, self.lower, self.upper)
        found[:, self.order] = self.normal.minimum(side, self.lower[self.order], self.upper[self.order])
        return found

    def taken_up(self, slope: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """How the best coefficients follow the modelled path loss; one at its bound does not.

        Args:
            slope: Derivatives of the modelled path loss at the links that count [n, m, d].
            coefficients: The best coefficients [n, q].

        Returns:
            Derivatives of the coefficients with their sign changed [n, q, d].
        """
        return self.followed(_products(self.weighted, slope), coefficients)

    def followed(self, side: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same from sums over the links.

        Args:
            side: Columns of the design times weights and derivatives [n, q, d].
            coefficients: The best coefficients [n, q].

        Returns:
            What `taken_up` gives [n, q, d].
        """
        free = ((coefficients > self.lower) & (coefficients < self.upper))[:, self.order]
        taken = np.empty_like(side)
        taken[:, self.order] = self.normal.solve(free & ~self.normal.held, side[:, self.order])
        return taken

    def remove(self, slope: NDArray[np.float64], taken: NDArray[np.float64]) -> None:
        """Take off, in place, what the coefficients take up of derivatives.

        Args:
            slope: Derivatives of the modelled path loss at the links that count [n, m, d]; changed.
            taken: What `taken_up` gave [n, q, d].
        """
        if isinstance(self.design, np.ndarray):
            slope -= self.design @ taken
            return
        for one, share in zip(slope, taken, strict=True):
            one -= self.design @ share


def _products(matrix: Matrix, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """A matrix [q, m] times each of some [n, m, d]."""
    if isinstance(matrix, np.ndarray):
        return matrix @ values
    return np.stack([matrix @ each for each in values])
