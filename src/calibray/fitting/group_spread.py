"""Spread of an effect between groups of links, by restricted maximum likelihood.

Residuals follow y = X b + Z u + e with u ~ N(0, lambda sigma^2) per group and e ~ N(0, sigma^2). X has what is fitted
besides. The restricted likelihood (H. D. Patterson and R. Thompson, Biometrika 58, 1971) does not take the scatter that
the fit of b removes for less spread, as a maximum likelihood would.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

RATIOS: Final = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 121)])
"""Ratios of both variances that are compared."""

SINGULAR: Final = 1e-10
"""Share of the largest singular value of the design below which its columns count as dependent."""


class GroupSpread(NamedTuple):
    """Standard deviations.

    Attributes:
        between: Between groups, in the unit of the residuals per unit of the column; 0 if no group differs.
        within: Of a single link, in the unit of the residuals.
    """

    between: float
    within: float


def group_spread(
    residuals: NDArray[np.float64],
    design: NDArray[np.float64],
    column: NDArray[np.float64],
    group: NDArray[np.int64],
) -> GroupSpread:
    """Estimate the spread of a column's coefficient between groups.

    Args:
        residuals: Residuals of the links [n].
        design: Columns X of what is fitted besides, with the derivatives of the model [n, k].
        column: The column [n].
        group: Group of every link [n], from 0.

    Returns:
        The standard deviations; none between groups if there are too few links.

    Example:
        >>> shift = np.repeat([3.0, -2.0, 0.0, -1.0], 5)
        >>> noise = np.tile([1.0, -1.0, 0.5, -0.5, 0.0], 4)
        >>> found = group_spread(shift + noise, np.ones((20, 1)), np.ones(20), np.repeat(np.arange(4), 5))
        >>> round(found.between, 1), round(found.within, 1)
        (2.1, 0.8)
    """
    left, size, _ = np.linalg.svd(design, full_matrices=False)
    basis = left[:, size > SINGULAR * max(size.max(initial=0.0), 1e-300)]
    freedom = len(residuals) - basis.shape[1]
    if freedom < 2:
        return GroupSpread(0.0, float(np.std(residuals)))
    all_columns = np.column_stack([basis, residuals])
    products, groups = all_columns.T @ all_columns, int(group.max()) + 1
    sums = np.stack([np.bincount(group, column * each, groups) for each in all_columns.T])
    square = np.bincount(group, column**2, groups)
    best, found = np.inf, GroupSpread(0.0, 0.0)
    for ratio in RATIOS:
        # V = I + ratio Z Z' is a block per group, so that its inverse is a rank-one update (Sherman and Morrison).
        weighted = products - (sums * (ratio / (1.0 + ratio * square))) @ sums.T
        inner, side = weighted[:-1, :-1], weighted[:-1, -1]
        variance = float(weighted[-1, -1] - side @ np.linalg.solve(inner, side)) / freedom
        variance = max(variance, 1e-12)
        deviance = freedom * np.log(variance) + np.log1p(ratio * square).sum() + np.linalg.slogdet(inner)[1]
        if deviance < best:
            best, found = deviance, GroupSpread(float(np.sqrt(ratio * variance)), float(np.sqrt(variance)))
    return found
