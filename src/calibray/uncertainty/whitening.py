"""Whitening of spatially correlated errors: exact, or with the nearest neighbours of each link.

The covariance is (1 - share) for each link plus share x exp(-distance / range) between links. For up to some hundred
links, we factor it. For more links, each error is its conditional mean given its nearest neighbours among the earlier
links, plus an independent rest (A. V. Vecchia, J. R. Stat. Soc. B 50, 1988). The time is then proportional to the
number of links.
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
"""Number of links up to which the covariance is factored exactly."""

NEAREST: Final = 20
"""Neighbours in Vecchia's approximation."""

CHUNK: Final = 500
"""Number of links whose neighbourhoods are solved together."""

Neighbours = tuple[NDArray[np.int64], NDArray[np.int64]]
"""An order of links [m], and the positions of each one's nearest earlier links in it, -1 for none [m, NEAREST]."""


@dataclass(frozen=True, eq=False)
class Whitener:
    """A factor of the inverse of a covariance.

    Attributes:
        factor: Matrix that turns the errors into independent ones of unit variance [m, m].
        log_determinant: Log determinant of the covariance.
    """

    factor: NDArray[np.float64] | sparse.csr_array
    log_determinant: float

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Whiten values of the links [m, k]."""
        return self.factor @ values


def pairwise(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances between positions [n, k] of links; beyond `EXACT` links those of an evenly spaced subset [m, m]."""
    subset = position[:: max(1, len(position) // EXACT)]
    return np.asarray(cdist(subset, subset), dtype=np.float64)


def whitener(
    position: NDArray[np.float64],
    scale: NDArray[np.float64],
    range_m: float,
    share: float,
    exact: int = EXACT,
    neighbours: Neighbours | None = None,
) -> Whitener:
    """Make the whitener of correlated errors.

    Args:
        position: Positions of the links' ends [m, k], [m].
        scale: Factors by which the errors were multiplied so that the uncorrelated part has unit size [m].
        range_m: Distance at which the correlated part has fallen to 1/e [m].
        share: Correlated share of the variance, from 0 to below 1.
        exact: Number of links up to which the covariance is factored exactly.
        neighbours: The links' nearest earlier neighbours, if they are known.

    Returns:
        The whitener.
    """
    count = len(position)
    if count <= exact:
        common = np.exp(-cdist(position, position) / range_m) * np.outer(scale, scale)
        return _exact(share * common + (1 - share) * np.eye(count))
    return _vecchia(position, scale, range_m, share, neighbours or nearest_earlier(position))


def shared(error: NDArray[np.float64], share: float) -> Whitener:
    """The whitener of errors of unit variance plus further ones with these standard deviations [m].

    All links have a share of the further variance in common; beyond `EXACT` links, all errors are independent.
    """
    if len(error) > EXACT:
        variance = 1.0 + error**2
        return Whitener(sparse.diags_array(1.0 / np.sqrt(variance)).tocsr(), float(np.log(variance).sum()))
    return _exact(np.diag(1.0 + (1 - share) * error**2) + share * np.outer(error, error))


def _exact(covariance: NDArray[np.float64]) -> Whitener:
    factor = cholesky(covariance, lower=True)
    inverse = solve_triangular(factor, np.eye(len(covariance)), lower=True)
    return Whitener(inverse, 2.0 * float(np.log(np.diag(factor)).sum()))


def nearest_earlier(position: NDArray[np.float64]) -> Neighbours:
    """A random order of links at positions [m, k], with earlier ones both near and far; and the nearest ones."""
    order = np.random.default_rng(0).permutation(len(position))
    shuffled, near = position[order], np.full((len(order), NEAREST), -1)
    for index in range(1, len(order)):
        distance = np.sum((shuffled[:index] - shuffled[index]) ** 2, axis=1)
        near[index, :index] = (
            np.arange(index) if index <= NEAREST else np.argpartition(distance, NEAREST)[:NEAREST]
        )
    return order, near


def _vecchia(
    position: NDArray[np.float64],
    scale: NDArray[np.float64],
    range_m: float,
    share: float,
    neighbours: Neighbours,
) -> Whitener:
    order, nearest = neighbours
    count = len(position)
    members = np.column_stack([nearest, np.arange(count)])
    entries, log_determinant, diagonal = np.zeros(members.shape), 0.0, np.eye(NEAREST + 1)
    for rows in np.array_split(np.arange(count), -(-count // CHUNK)):
        chosen = order[members[rows]]
        place, factor = position[chosen], np.where(members[rows] < 0, 0.0, scale[chosen])
        distance = np.sqrt(np.sum((place[:, :, None] - place[:, None]) ** 2, axis=-1))
        # A neighbour that does not exist has no covariance with others.
        common = np.exp(-distance / range_m) * factor[:, :, None] * factor[:, None]
        matrix = share * common + (1 - share) * diagonal
        # Conditional mean and variance of the last member given its neighbours.
        weight = np.linalg.solve(matrix[:, :-1, :-1], matrix[:, :-1, -1:])[..., 0]
        variance = matrix[:, -1, -1] - np.sum(matrix[:, -1, :-1] * weight, axis=1)
        entries[rows] = np.column_stack([-weight, np.ones(len(rows))]) / np.sqrt(variance)[:, None]
        log_determinant += float(np.log(variance).sum())
    row, column = np.nonzero(members >= 0)
    parts = (entries[row, column], (row, order[members[row, column]]))
    return Whitener(sparse.csr_array(parts, shape=(count, count)), log_determinant)
