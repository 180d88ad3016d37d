"""Kriging of a vector: radial basis functions for all residuals at once, on scales learned from them.

Every residual is a linear trend plus weights on Matern-5/2 functions centred at the evaluated points,
which is both interpolation by radial basis functions and universal kriging. All residuals share the
kernel, hence one factorization serves any number of them, and its input scales (one a parameter, so that a
parameter without influence drops out) are those of the largest restricted likelihood summed over all
residuals: with tens of links they are well determined by a dozen points. Each residual has its own
variance, which is profiled out.

Formulas: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, MIT Press 2006, eqs.
2.41, 2.42, 4.17 and 5.9; leave-one-out in closed form after S. Rippa, Adv. Comput. Math. 11 (1999) 193.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

NUGGET = 1e-8
"""Of the prior variance: keeps the matrix regular, below any engine's precision."""

LENGTH = 0.3
"""Of the unit cube: median of the prior of a length scale; its logarithm has standard deviation 1."""

LOG_RATE_BOUNDS = (-3.0, 5.0)
"""Length scales from 20 down to 0.007."""

NOISE_PRIOR = (np.log(1e-4), 3.0)
"""Mean and standard deviation of the logarithm of the nugget where it is learned."""

NOISE_BOUNDS = (np.log(NUGGET), 0.0)


class Predictor(Protocol):
    """A model of residuals that knows how far it may be off."""

    @property
    def root(self) -> NDArray[np.float64]:
        """Factor B of the prior covariance of the residuals, B^T B [k, m]."""
        ...

    def predict(self, x: NDArray[np.float64], /) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean [k, m] at points of the unit cube [k, d], and the variance as a share of the prior's [k]."""
        ...


@dataclass(frozen=True)
class Kriging:
    """A fitted model.

    Attributes:
        points: Evaluated points in the unit cube [n, d].
        residuals: Residuals there [n, m].
        hyper: Logarithms of the rates (inverse length scales) [d], then of the nugget.
        inverse: Inverse of the bordered kernel matrix [n + 1 + d, n + 1 + d].
        weights: Coefficients of kernels and trend [n + 1 + d, m].
        root: Factor B of the prior covariance of the residuals, B^T B [n - 1 - d, m].
    """

    points: NDArray[np.float64]
    residuals: NDArray[np.float64]
    hyper: NDArray[np.float64]
    inverse: NDArray[np.float64]
    weights: NDArray[np.float64]
    root: NDArray[np.float64]

    @property
    def variance(self) -> NDArray[np.float64]:
        """Prior variance of each residual [m]."""
        return np.sum(self.root**2, axis=0)

    def predict(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict residuals.

        Args:
            x: Points of the unit cube [k, d].

        Returns:
            Mean [k, m], and the variance as a share of the prior's, the same for every residual [k].
        """
        basis = np.hstack([matern(self._distance(x)), _trend(x)])
        spread = 1.0 - np.sum(basis @ self.inverse * basis, axis=1)  # eq. 2.42
        return basis @ self.weights, np.maximum(spread, 0.0)  # eq. 2.41

    def mean_and_slope(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict residuals and their derivatives.

        Args:
            x: Points of the unit cube [k, d].

        Returns:
            Mean [k, m] and Jacobian by the coordinates of the unit cube [k, m, d].
        """
        count, dimension = self.points.shape
        distance = self._distance(x)
        mean = np.hstack([matern(distance), _trend(x)]) @ self.weights
        toward = (x[:, :, None] - self.points.T) * np.exp(2.0 * self.hyper[:dimension, None])
        by_coordinate = (matern_slope(distance)[:, None] * toward) @ self.weights[:count]
        return mean, (by_coordinate + self.weights[count + 1 :]).transpose(0, 2, 1)

    def left_out(self) -> NDArray[np.float64]:
        """Predict every evaluated point from all the others, scales kept.

        Returns:
            Residuals [n, m].
        """
        count = len(self.points)
        return self.residuals - self.weights[:count] / np.diag(self.inverse)[:count, None]  # Rippa 1999

    def with_point(self, x: NDArray[np.float64]) -> Kriging:
        """Pretend that a point had been evaluated and had come out as predicted.

        Args:
            x: The point [d].

        Returns:
            A model with the same mean and prior, certain at that point too.
        """
        points = np.vstack([self.points, x])
        residuals = np.vstack([self.residuals, self.predict(x[None])[0]])
        return replace(solve(points, residuals, self.hyper), root=self.root)

    def _distance(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        rates = np.exp(self.hyper[: self.points.shape[1]])
        return np.asarray(cdist(x * rates, self.points * rates), dtype=np.float64)


def fit(
    points: NDArray[np.float64],
    residuals: NDArray[np.float64],
    *,
    noisy: bool = False,
    guess: NDArray[np.float64] | None = None,
) -> Kriging:
    """Fit a model, its input scales included.

    Args:
        points: Evaluated points in the unit cube [n, d], at least d + 2 distinct ones that span it.
        residuals: Residuals there [n, m].
        noisy: Learn the nugget too, for an engine whose answers scatter; else the model interpolates.
        guess: Logarithms of rates and nugget to begin from beside the prior's, such as an earlier fit's [d
            + 1].

    Returns:
        The model.
    """
    dimension = points.shape[1]
    prior_mean = np.append(np.full(dimension, -np.log(LENGTH)), NOISE_PRIOR[0] if noisy else np.log(NUGGET))
    prior_scale = np.append(np.ones(dimension), NOISE_PRIOR[1])
    nugget_bounds = NOISE_BOUNDS if noisy else (np.log(NUGGET), np.log(NUGGET))
    bounds = [LOG_RATE_BOUNDS] * dimension + [nugget_bounds]
    likelihood = Likelihood(points, residuals)

    def loss(hyper: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        value, slope = likelihood(hyper)
        away = (hyper - prior_mean) / prior_scale
        return value + 0.5 * float(
            away @ away
        ) / likelihood.links, slope + away / prior_scale / likelihood.links

    starts = [prior_mean] if guess is None else [prior_mean, guess]
    tried = [
        minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25})
        for start in starts
    ]
    return solve(points, residuals, min(tried, key=lambda result: result.fun).x)


def matern(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """The Matern kernel of smoothness 5/2 (eq. 4.17).

    Args:
        distance: Scaled distance [...].

    Returns:
        Correlation [...].
    """
    a = np.sqrt(5.0) * distance
    return (1.0 + a + a * a / 3.0) * np.exp(-a)


def matern_slope(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative of the kernel, divided by the distance.

    Args:
        distance: Scaled distance r [...].

    Returns:
        k'(r) / r [...].
    """
    a = np.sqrt(5.0) * distance
    return -5.0 / 3.0 * (1.0 + a) * np.exp(-a)


class Likelihood:
    """The negative logarithm of the restricted likelihood, mean over the residuals, and its derivatives.

    Args:
        points: Evaluated points in the unit cube [n, d].
        residuals: Residuals there [n, m].
    """

    def __init__(self, points: NDArray[np.float64], residuals: NDArray[np.float64]) -> None:
        self.square = ((points[:, None] - points[None]) ** 2).reshape(-1, points.shape[1])
        self.contrasts = _contrasts(_trend(points))
        spread = residuals.std(axis=0)
        self.residuals = residuals[:, spread > 1e-9 * max(spread.max(), 1e-300)]
        self.links = max(self.residuals.shape[1], 1)

    def __call__(self, hyper: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Evaluate it.

        Args:
            hyper: Logarithms of the rates [d], then of the nugget.

        Returns:
            Its value and its gradient [d + 1]; 1e10 where the kernel matrix is singular.
        """
        rates_squared, nugget = np.exp(2.0 * hyper[:-1]), np.exp(hyper[-1])
        count = len(self.residuals)
        distance = np.sqrt(self.square @ rates_squared).reshape(count, count)
        kernel = matern(distance) + nugget * np.eye(count)
        try:
            root = np.linalg.cholesky(self.contrasts.T @ kernel @ self.contrasts)
        except np.linalg.LinAlgError:
            return 1e10, np.zeros_like(hyper)
        half = solve_triangular(root, self.contrasts.T, lower=True)
        inverse = half.T @ half
        weights = inverse @ self.residuals
        free = len(root)
        quadratic = np.maximum(np.sum(self.residuals * weights, axis=0), 1e-300)
        value = 0.5 * free * np.log(quadratic / free).sum() / self.links + np.log(np.diag(root)).sum()
        gap = inverse - free / self.links * (weights / quadratic) @ weights.T  # eq. 5.9
        by_rate = 0.5 * ((gap * matern_slope(distance)).ravel() @ self.square) * rates_squared
        return value, np.append(by_rate, 0.5 * nugget * np.trace(gap))


def solve(points: NDArray[np.float64], residuals: NDArray[np.float64], hyper: NDArray[np.float64]) -> Kriging:
    """Solve for the coefficients of a model whose scales are known.

    Args:
        points: Evaluated points in the unit cube [n, d].
        residuals: Residuals there [n, m].
        hyper: Logarithms of the rates [d], then of the nugget.

    Returns:
        The model.
    """
    count, dimension = points.shape
    trend = _trend(points)
    size = count + trend.shape[1]
    scaled = points * np.exp(hyper[:dimension])
    kernel = matern(np.asarray(cdist(scaled, scaled), dtype=np.float64)) + np.exp(hyper[-1]) * np.eye(count)
    bordered = np.zeros((size, size))
    bordered[:count, :count], bordered[:count, count:], bordered[count:, :count] = kernel, trend, trend.T
    inverse = np.asarray(np.linalg.inv(bordered), dtype=np.float64)
    contrasts = _contrasts(trend)
    lower = np.linalg.cholesky(contrasts.T @ kernel @ contrasts)
    root = solve_triangular(lower, contrasts.T @ residuals, lower=True) / np.sqrt(len(lower))
    return Kriging(points, residuals, hyper, inverse, inverse[:, :count] @ residuals, root)


def _contrasts(trend: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormal combinations of points that no trend can be seen in [n, n - 1 - d]."""
    return np.linalg.qr(trend, mode="complete")[0][:, trend.shape[1] :]


def _trend(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.hstack([np.ones((len(x), 1)), x])
