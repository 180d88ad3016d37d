"""Errors that neighbouring links share, made independent: exactly, or by each link's nearest neighbours.

The covariance is (1 - share) of each link's own and share exp(-distance / range) of what neighbours have in common. Up
to some hundred links it is factored; beyond, each error is written as its mean given those of its nearest neighbours
among the links before it, plus an independent rest (A. V. Vecchia, J. R. Stat. Soc. B 50, 1988), which costs as much as
there are links.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.distance import cdist

EXACT: Final = 600
"""Links up to which the covariance is factored."""

NEAREST: Final = 20
"""Neighbours that a link's error is explained by, beyond."""


@dataclass(frozen=True, eq=False)
class Whitener:
    """A factor of the inverse of a covariance.

    Attributes:
        factor: The matrix that makes errors independent and of unit variance [m, m].
        log_determinant: Logarithm of the determinant of the covariance.
    """

    factor: NDArray[np.float64] | sparse.csr_array
    log_determinant: float

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Make values of links independent.

        Args:
            values: What belongs to the links [m, k].

        Returns:
            Their whitened combinations [m, k].
        """
        return self.factor @ values


def pairwise(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances between links [m, m], [m]; of those beyond `EXACT`, every so-manieth stands for all.

    Args:
        position: Where they stand [n, k], [m].
    """
    some = position[:: max(1, len(position) // EXACT)]
    return np.asarray(cdist(some, some), dtype=np.float64)


def whitener(
    position: NDArray[np.float64],
    scale: NDArray[np.float64],
    range_m: float,
    share: float,
    exact: int = EXACT,
) -> Whitener:
    """What makes the errors of links independent.

    Args:
        position: Where the links' ends stand [m, k], [m].
        scale: Factors that errors and their shared part were multiplied by; a link's own part has unit size then [m].
        range_m: Distance at which the shared part has fallen to 1/e [m].
        share: Share of the variance that is shared, from 0 to below 1.
        exact: Links up to which the covariance is factored.

    Returns:
        The whitener.
    """
    count = len(position)
    if count <= exact:
        common = np.exp(-cdist(position, position) / range_m) * np.outer(scale, scale)
        factor = cholesky(share * common + (1 - share) * np.eye(count), lower=True)
        inverse = solve_triangular(factor, np.eye(count), lower=True)
        return Whitener(inverse, 2.0 * float(np.log(np.diag(factor)).sum()))
    return _vecchia(position, scale, range_m, share)


def _vecchia(
    position: NDArray[np.float64], scale: NDArray[np.float64], range_m: float, share: float
) -> Whitener:
    count = len(position)
    order = np.random.default_rng(0).permutation(count)  # near and far ones among those before
    place, size = position[order], scale[order]
    rows, columns, entries, log_determinant = [], [], [], 0.0
    for index in range(count):
        near = np.zeros(0, dtype=np.int64)
        if index:
            distance = np.linalg.norm(place[:index] - place[index], axis=1)
            near = (
                np.argsort(distance)[:NEAREST]
                if index <= NEAREST
                else np.argpartition(distance, NEAREST)[:NEAREST]
            )
        mine = np.append(near, index)
        common = np.exp(-cdist(place[mine], place[mine]) / range_m) * np.outer(size[mine], size[mine])
        matrix = share * common + (1 - share) * np.eye(len(mine))
        weight = np.linalg.solve(matrix[:-1, :-1], matrix[:-1, -1])
        variance = float(matrix[-1, -1] - matrix[-1, :-1] @ weight)
        rows.append(np.full(len(mine), index))
        columns.append(order[mine])
        entries.append(np.append(-weight, 1.0) / np.sqrt(variance))
        log_determinant += np.log(variance)
    parts = (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
    return Whitener(sparse.csr_array(parts, shape=(count, count)), log_determinant)
