"""What a cheap model leaves unexplained: a Gaussian process over the box for every residual.

What a dear model's residual has beyond the cheap model's is an offset, a change of response, and a rest:

    K(x, x') = s^2 (s_0 + s_1 h(x).h(x') + s_2 M(x, x') + nugget)

Here h(x) holds what the cheap model's residuals do over the box, around their mean there. Links respond to parameters
alike, so that what a link lacks, such as paths that the cheap model has not, responds as other links do: this term is
the slope of a link's output mapping, and speaks for links of which the cheap model knows nothing. M is the Matern
kernel of `kriging.py`, on a length scale for each parameter. All residuals share K. Each has a variance of its own,
whose inverse gamma prior is integrated out, so that a few links that the cheap model has all wrong do not speak for
those that it has right.

M. C. Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425, sec. 4; C. E. Rasmussen, C. K. I. Williams, Gaussian
Processes for Machine Learning, MIT Press 2006, eqs. 2.25, 2.26, 5.9 and sec. 9.9; S. Rippa, Adv. Comput. Math. 11
(1999) 193.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from calibray.optimizers.multifidelity.kriging import matern, matern_slope

FREEDOM: Final = 4.0
"""Degrees of freedom of the prior of a residual's variance."""

SHARES: Final = (1.0, 0.1, 0.1)
"""Medians of the priors of s_0, s_1 and s_2, relative to the mean square of the cheap model's response."""

SHARE_SPREAD: Final = 2.0
"""Standard deviation of their logarithms."""

SHARE_BOUNDS: Final = (-14.0, 6.0)

LENGTH: Final = 0.5
"""Of the unit cube: median of the prior of a length scale."""

LENGTH_SPREAD: Final = 0.7
"""Standard deviation of its logarithm."""

LOG_RATE_BOUNDS: Final = (-2.0, 4.0)

NUGGET: Final = 1e-6
"""Keeps the matrix regular, and is what an engine's answers scatter by at least."""

NOISE: Final = (float(np.log(1e-4)), 3.0)
"""Mean and standard deviation of the logarithm of the nugget where it is learned."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Points as the process sees them.

    Attributes:
        unit: In the unit cube [n, d].
        response: What the cheap model's residuals do there, h [n, k].
    """

    unit: NDArray[np.float64]
    response: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """A fitted process.

    Attributes:
        seen: The evaluated points.
        remains: What the cheap model leaves there [n, m].
        hyper: Logarithms of s_0, s_1 and s_2, of the rates [d], and of the nugget.
        scale: The scale s.
        lower: Cholesky factor of K at the points [n, n].
        whitened: Its inverse times `remains` [n, m].
        weights: The inverse of K times `remains` [n, m].
    """

    seen: Seen
    remains: NDArray[np.float64]
    hyper: NDArray[np.float64]
    scale: float
    lower: NDArray[np.float64]
    whitened: NDArray[np.float64]
    weights: NDArray[np.float64]

    @property
    def precision(self) -> NDArray[np.float64]:
        """Inverse of the variance of each residual by that of K [m]."""
        return _precision(len(self.remains), np.sum(self.whitened**2, axis=0))

    @property
    def root(self) -> NDArray[np.float64]:
        """Factor B of the covariance of the residuals by that of K, B^T B [n + m, m]."""
        count, links = self.whitened.shape
        rows = np.vstack([self.whitened, np.sqrt(FREEDOM) * np.eye(links)])
        return rows / np.sqrt(count + FREEDOM)

    def predict(self, seen: Seen) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict what remains.

        Args:
            seen: Points.

        Returns:
            Mean [k, m], and the variance by that of each residual [k].
        """
        cross = _covariance(seen, self.seen, self.hyper, self.scale)  # eqs. 2.25 and 2.26
        half = solve_triangular(self.lower, cross.T, lower=True)
        s = np.exp(self.hyper[:3])
        own = self.scale**2 * (s[0] + s[1] * np.sum(seen.response**2, axis=1) + s[2])
        return cross @ self.weights, np.maximum(own - np.sum(half**2, axis=0), 0.0)

    def slope(self, seen: Seen, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of the predicted mean.

        Args:
            seen: Points.
            change: Derivatives of their responses by the coordinates of the unit cube [k, r, d].

        Returns:
            Derivatives by these coordinates [k, m, d].
        """
        d, (_, s_1, s_2) = seen.unit.shape[1], self.scale**2 * np.exp(self.hyper[:3])
        rates = np.exp(self.hyper[3 : 3 + d])
        distance = _distance(seen, self.seen, rates)
        toward = (seen.unit[:, :, None] - self.seen.unit.T) * rates[:, None] ** 2
        by_point = s_2 * matern_slope(distance)[:, None] * toward
        by_point += s_1 * np.moveaxis(change, 1, -1) @ self.seen.response.T
        return (by_point @ self.weights).transpose(0, 2, 1)

    def left_out(self) -> NDArray[np.float64]:
        """Errors of every point predicted from all the others [n, m]."""
        inverse = cho_solve((self.lower, True), np.eye(len(self.remains)))
        return self.weights / np.diag(inverse)[:, None]  # Rippa 1999


def fit(
    seen: Seen,
    remains: NDArray[np.float64],
    scale: float,
    *,
    noisy: bool = False,
    guess: NDArray[np.float64] | None = None,
) -> Discrepancy:
    """Fit the process, by the largest posterior density of its hyperparameters.

    Args:
        seen: The evaluated points, at least one.
        remains: What the cheap model leaves there [n, m].
        scale: Root mean square of the cheap model's response, which the prior is relative to.
        noisy: Learn the nugget too, for an engine whose answers scatter.
        guess: Hyperparameters to begin from beside the prior's.

    Returns:
        The process.
    """
    d = seen.unit.shape[1]
    nugget = NOISE[0] if noisy else float(np.log(NUGGET))
    prior = np.concatenate([np.log(SHARES), np.full(d, -np.log(LENGTH)), [nugget]])
    spread = np.concatenate([np.full(3, SHARE_SPREAD), np.full(d, LENGTH_SPREAD), [NOISE[1]]])
    bounds = [SHARE_BOUNDS] * 3 + [LOG_RATE_BOUNDS] * d + [(np.log(NUGGET), 0.0 if noisy else np.log(NUGGET))]
    likelihood = _likelihood(seen, remains, scale)

    def loss(hyper: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        value, slope = likelihood(hyper)
        away = (hyper - prior) / spread
        return value + 0.5 * float(away @ away), slope + away / spread

    starts = [prior] if guess is None else [prior, guess]
    tried = [
        minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30})
        for start in starts
    ]
    return solve(seen, remains, min(tried, key=lambda result: result.fun).x, scale)


def solve(seen: Seen, remains: NDArray[np.float64], hyper: NDArray[np.float64], scale: float) -> Discrepancy:
    """The process of known hyperparameters.

    Args:
        seen: The evaluated points.
        remains: What the cheap model leaves there [n, m].
        hyper: Logarithms of s_0, s_1 and s_2, of the rates [d], and of the nugget.
        scale: The scale s.

    Returns:
        The process.
    """
    kernel = _covariance(seen, seen, hyper, scale) + scale**2 * np.exp(hyper[-1]) * np.eye(len(remains))
    lower = np.asarray(np.linalg.cholesky(kernel), dtype=np.float64)
    whitened = solve_triangular(lower, remains, lower=True)
    return Discrepancy(seen, remains, hyper, scale, lower, whitened, solve_triangular(lower.T, whitened))


def negative_log_density(whitened: NDArray[np.float64]) -> NDArray[np.float64]:
    """Negative log density of what remains, but for a term that all have: that of a multivariate t.

    Args:
        whitened: What remains, times the inverse of the Cholesky factor of K [..., n, m].

    Returns:
        Its sum over the residuals [...].
    """
    count, square = whitened.shape[-2], np.sum(whitened**2, axis=-2)
    return 0.5 * (FREEDOM + count) * np.log1p(square / FREEDOM).sum(axis=-1)


def _covariance(a: Seen, b: Seen, hyper: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    s, rates = np.exp(hyper[:3]), np.exp(hyper[3:-1])
    rest = matern(_distance(a, b, rates))
    return scale**2 * (s[0] + s[1] * a.response @ b.response.T + s[2] * rest)


def _distance(a: Seen, b: Seen, rates: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cdist(a.unit * rates, b.unit * rates), dtype=np.float64)


def _precision(count: int, square: NDArray[np.float64]) -> NDArray[np.float64]:
    return (FREEDOM + count) / (FREEDOM + square)


def _likelihood(
    seen: Seen, remains: NDArray[np.float64], scale: float
) -> Callable[[NDArray[np.float64]], tuple[float, NDArray[np.float64]]]:
    """The negative logarithm of the likelihood of hyperparameters, a multivariate t, and its derivatives."""
    (count, links), unit = remains.shape, seen.unit
    square = (unit[:, None] - unit[None]) ** 2
    response, one = seen.response @ seen.response.T, np.eye(count)

    def likelihood(hyper: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        s, rates, nugget = np.exp(hyper[:3]), np.exp(2.0 * hyper[3:-1]), np.exp(hyper[-1])
        distance = np.sqrt(square @ rates)
        rest = matern(distance)
        try:
            lower = np.linalg.cholesky(scale**2 * (s[0] + s[1] * response + s[2] * rest + nugget * one))
        except np.linalg.LinAlgError:
            return 1e10, np.zeros_like(hyper)
        inverse = cho_solve((lower, True), one)
        weights = inverse @ remains
        quadratic = np.sum(remains * weights, axis=0)
        value = links * np.log(np.diag(lower)).sum()
        value += 0.5 * (FREEDOM + count) * np.log(FREEDOM + quadratic).sum()
        gap = links * inverse - (weights * _precision(count, quadratic)) @ weights.T
        gap *= 0.5 * scale**2  # eq. 5.9, with the precision that the t gives each residual
        by_share = s * [gap.sum(), np.sum(gap * response), np.sum(gap * rest)]
        by_rate = s[2] * ((gap * matern_slope(distance)).ravel() @ square.reshape(count**2, -1)) * rates
        return float(value), np.concatenate([by_share, by_rate, [nugget * np.trace(gap)]])

    return likelihood
