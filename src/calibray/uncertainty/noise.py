"""What errors of measured links look like: Gaussian or Student-t, independent or shared by neighbours.

A link's error has the standard deviation scale x deviation, where the deviations are known factors (1 unless links
were measured with unequal care) and the scale is estimated. Outliers are what Student's t with few degrees of freedom
expects and a Gaussian does not.

Links whose receivers stand near one another share part of their error: clutter that the scene lacks shades them all.
Its covariance falls off exponentially with distance; range and size are those of the largest restricted likelihood
(H. D. Patterson and R. Thompson, Biometrika 58, 1971), so that what was fitted beside them does not pass for less
noise. Exact, by one Cholesky factor for each trial: some thousand links.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import elementwise, minimize
from scipy.spatial.distance import cdist, pdist
from scipy.special import gammaln

from calibray.errors import EngineError, InputError
from calibray.support.blas_threads import single_blas_thread

GAUSSIAN: Final = np.inf
"""Degrees of freedom at which Student's t is Gaussian."""

SHARES: Final = (0.001, 0.999)
"""Shares of the variance that neighbours may have in common; at 1 the covariance of near links is singular."""


@dataclass(frozen=True)
class Noise:
    """The distribution of independent errors.

    Attributes:
        freedom: Degrees of freedom of Student's t; +inf for a Gaussian.

    Raises:
        InputError: The degrees of freedom are not positive.

    Example:
        >>> errors = np.array([[3.0, -3.0] * 10 + [40.0]])
        >>> Noise().scale(errors).round(1), Noise(freedom=4.0).scale(errors).round(1)
        (array([9.2]), array([3.4]))
    """

    freedom: float = GAUSSIAN

    def __post_init__(self) -> None:
        if not self.freedom > 0:
            raise InputError(f"noise: freedom = {self.freedom:g}, must be greater than 0")

    def scale(self, errors: NDArray[np.float64], deviation: NDArray[np.float64] | float = 1.0) -> NDArray:
        """The scale of largest likelihood.

        Args:
            errors: Errors [n, m], [dB].
            deviation: Known factors of their standard deviations [m].

        Returns:
            The scale [n], [dB]; 0 where all errors are.
        """
        square = (errors / deviation) ** 2
        if np.isinf(self.freedom):
            return np.sqrt(square.mean(axis=1))
        largest = np.sqrt(square.max(axis=1))
        safe = np.where(largest > 0, largest, 1.0)
        relative = square / safe[:, None] ** 2

        def slope(logarithm: NDArray[np.float64], row: NDArray[np.intp]) -> NDArray[np.float64]:
            # The likelihood's slope: errors count by (freedom + 1) / (freedom + z^2).
            z = relative[row] * np.exp(-2.0 * logarithm)[..., None]
            return np.mean((self.freedom + 1.0) * z / (self.freedom + z), axis=-1) - 1.0

        # At the largest error the slope cannot be positive; half the errors being zero, it may never be.
        rows = np.arange(len(errors))
        low, high = np.full(len(errors), -30.0), np.zeros(len(errors))
        rising = slope(low, rows) > 0
        found = elementwise.find_root(slope, (low[rising], high[rising]), args=(rows[rising],))
        logarithm = low
        logarithm[rising] = found.x
        return largest * np.exp(logarithm)

    def log_likelihood(
        self,
        errors: NDArray[np.float64],
        scale: NDArray[np.float64],
        deviation: NDArray[np.float64] | float = 1.0,
    ) -> NDArray[np.float64]:
        """Logarithm of the density of errors.

        Args:
            errors: Errors [n, m], [dB].
            scale: Scale [n], [dB], greater than 0.
            deviation: Known factors of their standard deviations [m].

        Returns:
            The log likelihood, summed over links [n].
        """
        spread = np.broadcast_to(scale[:, None] * deviation, errors.shape)
        square, free = (errors / spread) ** 2, self.freedom
        if np.isinf(free):
            each = -0.5 * square - 0.5 * np.log(2 * np.pi)
        else:
            constant = gammaln((free + 1) / 2) - gammaln(free / 2) - 0.5 * np.log(free * np.pi)
            each = constant - 0.5 * (free + 1) * np.log1p(square / free)
        return (each - np.log(spread)).sum(axis=1)


@dataclass(frozen=True)
class Correlation:
    """Gaussian errors of which neighbours share a part.

    Attributes:
        range_m: Distance at which the shared part has fallen to 1/e [m].
        shared_db: Standard deviation of the shared part [dB].
        own_db: Standard deviation of each link's own part, times its deviation [dB].
        log_likelihood: Restricted log likelihood of the errors it was fitted to.
        independent: That of the best fit without a shared part.
    """

    range_m: float
    shared_db: float
    own_db: float
    log_likelihood: float
    independent: float

    def covariance(
        self, position: NDArray[np.float64], deviation: NDArray[np.float64] | float = 1.0
    ) -> NDArray[np.float64]:
        """Covariance of the errors of links.

        Args:
            position: Positions of their receivers [m, 3], [m].
            deviation: Known factors of their own standard deviations [m].

        Returns:
            The covariance [m, m], [dB^2].
        """
        own = np.broadcast_to(self.own_db * np.asarray(deviation), len(position))
        return self.shared_db**2 * np.exp(-cdist(position, position) / self.range_m) + np.diag(own**2)

    def whitened(
        self,
        position: NDArray[np.float64],
        values: NDArray[np.float64],
        deviation: NDArray[np.float64] | float = 1.0,
    ) -> NDArray[np.float64]:
        """Values of links, made independent and of unit variance: residuals or derivatives for least squares.

        Args:
            position: Positions of their receivers [m, 3], [m].
            values: What belongs to them [m, ...].
            deviation: Known factors of their own standard deviations [m].

        Returns:
            The inverse Cholesky factor of the covariance times the values [m, ...].
        """
        factor = cholesky(self.covariance(position, deviation), lower=True)
        return solve_triangular(factor, values.reshape(len(values), -1), lower=True).reshape(values.shape)


def fit_correlation(
    errors: NDArray[np.float64],
    position: NDArray[np.float64],
    *,
    deviation: NDArray[np.float64] | float = 1.0,
    design: NDArray[np.float64] | None = None,
) -> Correlation:
    """Range and size of the errors' shared part, of largest restricted likelihood.

    Args:
        errors: Errors at the best fit [m], [dB].
        position: Positions of the receivers [m, 3], [m].
        deviation: Known factors of the links' own standard deviations [m].
        design: Columns that were fitted to the same links, of full rank [m, q]: nuisances, and derivatives by the
            parameters.

    Returns:
        The correlation.

    Raises:
        InputError: Fewer than three links are left beside the columns, or all receivers stand at one place.
        EngineError: The errors are all zero.
    """
    count = len(errors)
    columns = np.zeros((count, 0)) if design is None else design
    if count - columns.shape[1] < 3:
        raise InputError(
            f"noise: {count} links beside {columns.shape[1]} fitted columns; the correlation of errors needs three more"
        )
    distance = cdist(position, position)
    apart = pdist(position)
    if not apart.any():
        raise InputError("noise: all receivers stand at one place; set range_m = 0")
    if not errors.any():
        raise EngineError("noise: all errors are zero, which no noise explains; check the measured values")
    own = np.diag(np.broadcast_to(deviation, count) ** 2.0)
    reach = np.log([apart[apart > 0].min() / 3, 3 * apart.max()])

    def trial(share: float, log_range: float) -> tuple[float, float]:
        """Restricted log likelihood, and the variance in all."""
        matrix = share * np.exp(-distance / np.exp(log_range)) + (1 - share) * own
        return _restricted(matrix, errors, columns)

    def cost(point: NDArray[np.float64]) -> float:
        return -trial(*point)[0]

    middle = np.quantile(reach, (0.4, 0.6, 0.8))
    starts = [np.array([share, at]) for share in (0.3, 0.8) for at in middle]
    # On factors of this size, threads of the linear algebra cost more than they give where others compute too.
    with single_blas_thread():
        bounds, first = (SHARES, tuple(reach)), min(starts, key=cost)
        found = minimize(cost, first, method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3})
        share, log_range = found.x
        likelihood, variance = trial(share, log_range)
        independent = _restricted(own, errors, columns)[0]
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
    """Restricted log likelihood of errors whose covariance is a matrix times a variance, and the best variance."""
    factor = cho_factor(matrix, lower=True)
    freedom = len(errors) - columns.shape[1]
    solved = cho_solve(factor, np.column_stack([errors, columns]))
    gram = columns.T @ solved[:, 1:]
    pull = columns.T @ solved[:, 0]
    left = errors @ solved[:, 0] - (pull @ np.linalg.solve(gram, pull) if len(gram) else 0.0)
    variance = left / freedom
    determinant = 2.0 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(gram)[1]
    return float(-0.5 * (freedom * (np.log(2 * np.pi * variance) + 1.0) + determinant)), float(variance)
