"""Eliminates the nuisance: best coefficients and projected derivatives, for all candidates at once.

Variable projection (G. H. Golub and V. Pereyra, SIAM Journal on Numerical Analysis 10, 1973): the coefficients b
minimise sum_i w_i (gap_i - z_i.b)^2 + sum_j (ridge_j b_j)^2 within their bounds. With one column per link, each
coefficient is a clipped weighted mean. Otherwise `arrowhead.py` solves the normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calibray.fitting.arrowhead import Arrowhead
from calibray.fitting.nuisance import Nuisance

DENSE = 2**18
"""Entries of a design up to which one dense product over all candidates is faster than sparse products."""

Matrix = NDArray[np.float64] | sparse.csr_array


@dataclass(frozen=True, eq=False)
class Elimination:
    """Normal equations of a nuisance over weighted links.

    Attributes:
        design: Columns Z of the nuisance at the m links with weight [m, q].
        weighted: Z' W, with the diagonal matrix W of the weights [q, m].
        data: Z' W Z, the normal equations without priors [q, q].
        normal: The normal equations with priors, columns in the order of `order`.
        order: Index in the design of each column of `normal` [q].
        lower: Lower bounds [q].
        upper: Upper bounds [q].
        separable: Whether no link has more than one column.
        determined: Mask of the columns that the links determine [q]. Of linearly dependent columns, those of the finest
            grouping are kept.
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
            ridge: Square root of the prior's term on the diagonal of the normal equations [q].
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
            gap: Measured minus modelled path loss at the links with weight [n, m], [dB].

        Returns:
            Coefficients [n, q], [dB] per unit of the column; an undetermined one takes the value within its bounds
            that is nearest to 0.

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        return self.minimum((self.weighted @ gap.T).T)

    def minimum(self, side: NDArray[np.float64]) -> NDArray[np.float64]:
        """The best coefficients from sums over the links.

        Args:
            side: Right-hand side Z' W gap [n, q].

        Returns:
            Coefficients [n, q]; see `coefficients`.

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        side = side[:, self.order]
        best = np.empty_like(side)
        if self.separable:
            best[:, self.order] = side / np.where(self.normal.held, np.inf, self.normal.scale**2)
            return np.clip(best, self.lower, self.upper)
        best[:, self.order] = self.normal.minimum(side, self.lower[self.order], self.upper[self.order])
        return best

    def projection(
        self, slope: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Least-squares coefficients of the derivatives on the design; 0 for a coefficient at its bound.

        These are minus the derivatives of the best coefficients with respect to the parameters.

        Args:
            slope: Derivatives of the modelled path loss at the links with weight [n, m, d].
            coefficients: The best coefficients [n, q].

        Returns:
            Coefficients of the derivatives [n, q, d].
        """
        if isinstance(self.weighted, np.ndarray):
            side = self.weighted @ slope
        else:
            side = np.stack([self.weighted @ candidate for candidate in slope])
        return self.projection_from_sums(side, coefficients)

    def projection_from_sums(
        self, side: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """`projection` from sums over the links.

        Args:
            side: Z' W times the derivatives [n, q, d].
            coefficients: The best coefficients [n, q].

        Returns:
            Coefficients of the derivatives [n, q, d].
        """
        free = ((coefficients > self.lower) & (coefficients < self.upper))[:, self.order]
        projection = np.empty_like(side)
        projection[:, self.order] = self.normal.solve(free & ~self.normal.held, side[:, self.order])
        return projection

    def remove(self, slope: NDArray[np.float64], projection: NDArray[np.float64]) -> None:
        """Subtract the projection from derivatives, in place.

        Args:
            slope: Derivatives of the modelled path loss at the links with weight [n, m, d]; changed.
            projection: Their coefficients from `projection` [n, q, d].
        """
        if isinstance(self.design, np.ndarray):
            slope -= self.design @ projection
            return
        for candidate, coefficients in zip(slope, projection, strict=True):
            candidate -= self.design @ coefficients
