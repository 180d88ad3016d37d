"""Spatial correlation of errors: restricted-likelihood fit, significance test, variogram and whitening.

A link's error has a correlated and an uncorrelated part. Nearby receivers share the correlated part, for example
because clutter that the scene lacks shadows all of them. The covariance of this part falls off exponentially with
distance. Range and size maximize the restricted likelihood (H. D. Patterson and R. Thompson, Biometrika 58, 1971),
which prevents the fit of the parameters from biasing the noise estimate downward. For up to a few thousand links, the
fit is exact, with one Cholesky factorization per trial.

Whitening makes errors independent. For up to a few hundred links, the covariance matrix of the errors is factored. For
more links, each error is modelled as its conditional mean given the errors of the nearest earlier links, plus an
independent remainder (A. V. Vecchia, J. R. Stat. Soc. B 50, 1988). The computing time is then proportional to the
number of links.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist, pdist

from calibray.errors import EngineError, InputError
from calibray.support.memory import single_blas_thread
from calibray.uncertainty.draws import evenly_spaced

SHARES: Final = (0.001, 0.999)
"""Bounds of the correlated fraction of the variance; with 1, the covariance of links at the same position would be
singular."""

FEWEST_LINKS: Final = 10
"""Number of links below which no correlation is reported; fewer links cannot establish a correlation."""

MOST_LINKS: Final = 500
"""Maximum number of links used for correlation and variogram; if there are more links, an evenly spaced subset is
used."""

SIGNIFICANT: Final = 3.0
"""Gain in log likelihood above which correlation is reported, about the 95 % quantile for two additional parameters."""

EXACT: Final = 600
"""Maximum number of links for which the covariance is factored exactly."""

NEAREST: Final = 20
"""Number of neighbours in Vecchia's approximation."""

CHUNK: Final = 500
"""Number of links whose neighbourhood equations are solved together."""

Neighbours = tuple[NDArray[np.int64], NDArray[np.int64]]
"""An order of the links [m], and the indices, in this order, of each link's nearest earlier links [m, NEAREST]; -1 if
there are fewer earlier links."""


@dataclass(frozen=True)
class Correlation:
    """Gaussian errors with a spatially correlated part.

    Attributes:
        range_m: Distance at which the correlated part has fallen to 1/e [m].
        shared_db: Standard deviation of the correlated part [dB].
        own_db: Standard deviation of the uncorrelated part [dB].
        log_likelihood: Restricted log likelihood of the fitted errors.
        independent: Restricted log likelihood of the best fit without a correlated part.
    """

    range_m: float
    shared_db: float
    own_db: float
    log_likelihood: float
    independent: float

    def covariance(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance of the errors of links [m, m], [dB^2], from the positions of the links [m, k], [m]."""
        shared = np.exp(-cdist(position, position) / self.range_m)
        return self.shared_db**2 * shared + self.own_db**2 * np.eye(len(position))


def fit_correlation(
    errors: NDArray[np.float64], position: NDArray[np.float64], design: NDArray[np.float64] | None = None
) -> Correlation:
    """Fit the range and size of the correlated part of the errors by restricted maximum likelihood.

    Positions [m, k] are those of the receivers or both ends, in metres. The columns of `design` [m, q], which has
    full rank, were fitted to the same links: nuisances, and derivatives with respect to the parameters.

    Raises:
        InputError: The number of links exceeds the number of columns by less than three, or all receivers share one
            position.
        EngineError: The errors are all zero.
    """
    count = len(errors)
    columns = np.zeros((count, 0)) if design is None else design
    if count - columns.shape[1] < 3:
        raise InputError(
            f"noise: the number of links ({count}) must exceed the number of fitted columns ({columns.shape[1]}) by at "
            "least 3 to fit the correlation of errors"
        )
    distance, pairs = cdist(position, position), pdist(position)
    if not pairs.any():
        raise InputError("noise: all receivers have the same position; set range_m = 0")
    if not errors.any():
        raise EngineError("noise: all errors are zero, so no noise can be fitted; check the measured values")
    # Below the first range, errors are independent; above the second range, errors are common to all links.
    log_ranges = np.log([pairs[pairs > 0].min() / 3, 3 * pairs.max()])

    def trial(share: float, log_range: float) -> tuple[float, float]:
        """Restricted log likelihood and total variance."""
        matrix = share * np.exp(-distance / np.exp(log_range)) + (1 - share) * np.eye(count)
        return _restricted(matrix, errors, columns)

    def cost(point: NDArray[np.float64]) -> float:
        return -trial(*point)[0]

    # The search is local, so it starts from the best of several trial points.
    start_ranges = np.quantile(log_ranges, (0.4, 0.6, 0.8))
    starts = [np.array([share, log_range]) for share in (0.3, 0.8) for log_range in start_ranges]
    # BLAS threads cost more time than they save on matrices of this size.
    with single_blas_thread():
        bounds, first = (SHARES, tuple(log_ranges)), min(starts, key=cost)
        optimum = minimize(cost, first, method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3})
        share, log_range = optimum.x
        likelihood, variance = trial(share, log_range)
        independent = _restricted(np.eye(count), errors, columns)[0]
    return Correlation(
        range_m=float(np.exp(log_range)),
        shared_db=float(np.sqrt(share * variance)),
        own_db=float(np.sqrt((1 - share) * variance)),
        log_likelihood=likelihood,
        independent=independent,
    )


def _restricted(
    matrix: NDArray[np.float64], errors: NDArray[np.float64], columns: NDArray[np.float64]
) -> tuple[float, float]:
    """Restricted log likelihood of errors whose covariance is `matrix` times a variance, and the best variance."""
    factor = cho_factor(matrix, lower=True)
    freedom = len(errors) - columns.shape[1]
    solved = cho_solve(factor, np.column_stack([errors, columns]))
    gram = columns.T @ solved[:, 1:]
    side = columns.T @ solved[:, 0]
    square = errors @ solved[:, 0] - (side @ np.linalg.solve(gram, side) if len(gram) else 0.0)
    variance = square / freedom
    determinant = 2.0 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(gram)[1]
    # f (log 2 pi v + 1) + log |V| + log |X'V^-1 X|, with the best variance v = S / f.
    return float(-0.5 * (freedom * (np.log(2 * np.pi * variance) + 1.0) + determinant)), float(variance)


def shared_errors(errors: NDArray[np.float64], position: NDArray[np.float64]) -> Correlation | None:
    """The correlation of the best fit's errors at positions [m, k], [m]; None if it is not significant."""
    if len(errors) < FEWEST_LINKS:
        return None
    chosen = evenly_spaced(len(errors), MOST_LINKS)
    try:
        correlation = fit_correlation(errors[chosen], position[chosen])
    except (InputError, EngineError):  # all links at one position, or all errors zero
        return None
    significant = correlation.log_likelihood - correlation.independent > SIGNIFICANT
    return correlation if significant else None


def variogram(
    errors: NDArray[np.float64], position: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Empirical variogram: half the mean squared difference between errors, as a function of link distance.

    A rising variogram indicates correlated errors, and a flat variogram indicates independent errors. Errors [m] are in
    dB. Positions [m, k] are those of the receivers or both ends, in metres. The result is the mean distance [8], [m],
    the semivariance [8], [dB^2], and the number of pairs [8], for distance classes with about the same number of pairs.
    With fewer than 8 pairs, there are fewer than 8 classes.
    """
    chosen = evenly_spaced(len(errors), MOST_LINKS)
    distance, half = pdist(position[chosen]), 0.5 * pdist(errors[chosen, None], "sqeuclidean")
    if len(distance):  # few pairs are farther apart than half the extent, and all of these join opposite ends
        near = distance <= max(np.median(distance), distance.max() / 2)
        distance, half = distance[near], half[near]
    order = np.argsort(distance, kind="stable")
    parts = [part for part in np.array_split(order, 8) if len(part)]
    return (
        np.array([distance[part].mean() for part in parts]),
        np.array([half[part].mean() for part in parts]),
        np.array([len(part) for part in parts], dtype=np.int64),
    )


@dataclass(frozen=True, eq=False)
class Whitener:
    """A factor of the inverse of a covariance matrix.

    Attributes:
        factor: Matrix [m, m] that transforms the errors into independent errors of unit variance.
        log_determinant: Log determinant of the covariance.
    """

    factor: NDArray[np.float64] | sparse.csr_array
    log_determinant: float

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Whiten values of the links [m, k]."""
        return self.factor @ values


def pairwise(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances [m, m] between link positions [n, k]; if there are many links, a subset of at least `EXACT` is used."""
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
    """Make the whitener for the errors of links with end positions [m, k], [m].

    The errors have been multiplied by `scale` [m], so that the uncorrelated part has the same variance for all links.
    The correlated part has the fraction `share` of the variance, from 0 to below 1. The covariance of this part falls
    to 1/e at the distance `range_m` [m]. For up to `exact` links, the covariance is factored exactly. If `neighbours`
    is None, the neighbours are computed.
    """
    count = len(position)
    if count <= exact:
        common = np.exp(-cdist(position, position) / range_m) * np.outer(scale, scale)
        return _exact(share * common + (1 - share) * np.eye(count))
    return _vecchia(position, scale, range_m, share, neighbours or nearest_earlier(position))


def shared(error: NDArray[np.float64], share: float) -> Whitener:
    """The whitener of errors of unit variance plus further errors with the standard deviations `error` [m].

    The links share the fraction `share` of the further variance. For more than `EXACT` links, errors are
    treated as independent.
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
    """A random order of links at positions [m, k], and the nearest earlier links of each link in this order."""
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
        # A missing neighbour has no covariance with other links.
        common = np.exp(-distance / range_m) * factor[:, :, None] * factor[:, None]
        matrix = share * common + (1 - share) * diagonal
        # Conditional mean and variance of the last member given its neighbours.
        weight = np.linalg.solve(matrix[:, :-1, :-1], matrix[:, :-1, -1:])[..., 0]
        variance = matrix[:, -1, -1] - np.sum(matrix[:, -1, :-1] * weight, axis=1)
        # Each row gives the member minus its conditional mean, divided by its conditional standard deviation.
        entries[rows] = np.column_stack([-weight, np.ones(len(rows))]) / np.sqrt(variance)[:, None]
        log_determinant += float(np.log(variance).sum())
    row, column = np.nonzero(members >= 0)
    parts = (entries[row, column], (row, order[members[row, column]]))
    return Whitener(sparse.csr_array(parts, shape=(count, count)), log_determinant)
