"""Gaussian process regression of many residuals that share one kernel.

    K(x, x') = v_0 + v_1 h(x).h(x') + v_2 M(x, x') + nugget [x = x']

M is the Matern-5/2 kernel with one rate (inverse length scale) per coordinate of the unit cube. If there is a cheap
model, h(x) is its response at x. v_0 allows for an offset, v_1 for a change in response, and v_2 for a smooth
remainder. All residuals share K, so a single factorization suffices for any number of residuals. With a linear trend,
the coefficients of 1 and x are unknown and have no prior (universal kriging).

One derivation covers regression with and without a trend. The columns of C [n, f] are orthonormal contrasts, which
eliminate the trend; without a trend, C is the identity. C^T y has covariance A = C^T K C, and P = C A^-1 C^T replaces
K^-1.

C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, MIT Press 2006, eqs. 2.25, 2.26, 2.41,
2.42, 4.17, 5.9 and sec. 9.9; closed-form leave-one-out errors: S. Rippa, Adv. Comput. Math. 11 (1999) 193.

`Kriging` interpolates all residuals; it estimates the length scales from the residuals. Every residual is a
linear trend plus a weighted sum of Matern-5/2 functions centred at the evaluated points. All residuals share the input
scales. There is one scale per parameter, so a parameter without influence is effectively ignored. The scales maximize
the restricted log likelihood summed over all residuals. With tens of links, a dozen points determine these scales well.
The variance of each residual is profiled out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

SINGULAR = 1e10
"""Value that replaces the negative log likelihood if the kernel matrix cannot be factorized."""


@dataclass(frozen=True, eq=False)
class Inputs:
    """Points as inputs to the kernel.

    Attributes:
        unit: Coordinates in the unit cube [n, d].
        response: Response h of the cheap model at the points [n, r]; without a cheap model, r = 0.
    """

    unit: NDArray[np.float64]
    response: NDArray[np.float64]

    @staticmethod
    def plain(unit: NDArray[np.float64]) -> Inputs:
        """Points [n, d] of the unit cube, without a cheap model."""
        return Inputs(unit, np.zeros((len(unit), 0)))


@dataclass(frozen=True, eq=False)
class Kernel:
    """A kernel with its hyperparameters.

    Attributes:
        variances: v_0, v_1 and v_2.
        rates: Inverse length scales [d].
        nugget: Variance of independent errors of the values at the points.
    """

    variances: NDArray[np.float64]
    rates: NDArray[np.float64]
    nugget: float

    @staticmethod
    def of(hyper: NDArray[np.float64], scale: float = 1.0) -> Kernel:
        """Create a kernel from the logarithms [3 + d + 1] of v_0, v_1, v_2, the rates [d] and the nugget.

        The variances and the nugget are multiplied by `scale` squared.
        """
        return Kernel(scale**2 * np.exp(hyper[:3]), np.exp(hyper[3:-1]), float(scale**2 * np.exp(hyper[-1])))

    def logarithms(self, scale: float = 1.0) -> NDArray[np.float64]:
        """The logarithms that `of` accepts; -inf for a variance of 0."""
        with np.errstate(divide="ignore"):
            variances = np.log(self.variances / scale**2)
        return np.concatenate([variances, np.log(self.rates), [np.log(self.nugget / scale**2)]])

    def scaled(self, factor: float) -> Kernel:
        """The kernel with the variances and the nugget multiplied by a factor."""
        return Kernel(factor * self.variances, self.rates, factor * self.nugget)

    def covariance(self, a: Inputs, b: Inputs) -> NDArray[np.float64]:
        """Covariance [k, n] between the points a [k] and b [n], without the nugget."""
        smooth = matern(self.distance(a, b))
        return self.variances[0] + self.variances[1] * a.response @ b.response.T + self.variances[2] * smooth

    def variance(self, at: Inputs) -> NDArray[np.float64]:
        """Prior variance [k] at points, without the nugget."""
        return self.variances[0] + self.variances[1] * np.sum(at.response**2, axis=1) + self.variances[2]

    def matrix(self, at: Inputs) -> NDArray[np.float64]:
        """Covariance matrix K [n, n] of points, with the nugget."""
        return self.covariance(at, at) + self.nugget * np.eye(len(at.unit))

    def distance(self, a: Inputs, b: Inputs) -> NDArray[np.float64]:
        """Distances [k, n] between points, in units of the length scales."""
        return np.asarray(cdist(a.unit * self.rates, b.unit * self.rates), dtype=np.float64)


class Trend(NamedTuple):
    """A trend at evaluated points.

    `contrasts` is C [n, f]; `left_inverse` [p, n] maps values at the points to the coefficients of the trend.
    """

    contrasts: NDArray[np.float64]
    left_inverse: NDArray[np.float64]

    @staticmethod
    def of(unit: NDArray[np.float64], linear: bool) -> Trend:
        """The trend at points [n, d]: a linear trend, or no trend."""
        if not linear:
            return Trend(np.eye(len(unit)), np.zeros((0, len(unit))))
        basis = trend_basis(unit)
        size = basis.shape[1]
        # The first columns of Q span the trend, and the other columns are the contrasts.
        q, r = np.linalg.qr(basis, mode="complete")
        return Trend(q[:, size:], solve_triangular(r[:size], q[:, :size].T))


@dataclass(frozen=True, eq=False)
class Process:
    """A Gaussian process conditioned on values at evaluated points; build it with `condition`.

    Attributes:
        inputs: The evaluated points.
        values: Values of every residual at these points [n, m].
        kernel: The kernel.
        linear: Whether there is a linear trend.
        freedom: Degrees of freedom of the prior on a residual's variance; 0 if the variance is profiled out.
        trend: The trend at the points.
        lower: Cholesky factor of A [f, f].
        whitened: Inverse of `lower` times C^T y [f, m].
        weights: P y [n, m].
        coefficients: Coefficients of the trend [p, m].
    """

    inputs: Inputs
    values: NDArray[np.float64]
    kernel: Kernel
    linear: bool
    freedom: float
    trend: Trend
    lower: NDArray[np.float64]
    whitened: NDArray[np.float64]
    weights: NDArray[np.float64]
    coefficients: NDArray[np.float64]

    @property
    def precision(self) -> NDArray[np.float64]:
        """Inverse of the factor [m] by which K is multiplied to give the covariance of each residual."""
        return _precision(len(self.whitened), np.sum(self.whitened**2, axis=0), self.freedom)

    @property
    def root(self) -> NDArray[np.float64]:
        """Factor B of the covariance B^T B between residuals, relative to K: [f, m], or [f + m, m] with a prior."""
        rows = self.whitened
        if self.freedom:
            rows = np.vstack([rows, np.sqrt(self.freedom) * np.eye(rows.shape[1])])
        return rows / np.sqrt(len(self.whitened) + self.freedom)

    @property
    def inverse_diagonal(self) -> NDArray[np.float64]:
        """Diagonal of P [n]."""
        return np.sum(self._whiten(np.eye(len(self.values))) ** 2, axis=0)

    def predict(self, at: Inputs) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predicted mean [k, m], and predictive variance [k] relative to the variance of each residual."""
        cross, prior = self.kernel.covariance(at, self.inputs), self.kernel.variance(at)
        mean, unexplained = cross @ self.weights, cross
        if self.linear:
            # The weights g = basis @ left_inverse interpolate the trend. The remainder z(x) - g.y is then predicted.
            basis, left_inverse = trend_basis(at.unit), self.trend.left_inverse
            spread = left_inverse @ self.kernel.matrix(self.inputs)
            mean = mean + basis @ self.coefficients
            unexplained = cross - basis @ spread
            prior = prior - 2.0 * np.sum((basis @ left_inverse) * cross, axis=1)
            prior = prior + np.sum((basis @ (spread @ left_inverse.T)) * basis, axis=1)
        known = self._whiten(unexplained.T)
        return mean, np.maximum(prior - np.sum(known**2, axis=0), 0.0)  # eqs. 2.25, 2.26, 2.41, 2.42

    def mean(self, at: Inputs) -> NDArray[np.float64]:
        """Predicted mean at points [k, m]."""
        mean = self.kernel.covariance(at, self.inputs) @ self.weights
        return mean + trend_basis(at.unit) @ self.coefficients if self.linear else mean

    def slope(self, at: Inputs, response_slope: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Derivatives [k, m, d] of the mean with respect to unit-cube coordinates; `response_slope` is [k, r, d]."""
        rates, variances = self.kernel.rates, self.kernel.variances
        # dM / dx_j = M'(r) / r x rate_j^2 x (difference along j).
        toward = (at.unit[:, :, None] - self.inputs.unit.T) * rates[:, None] ** 2
        by_coordinate = variances[2] * matern_slope(self.kernel.distance(at, self.inputs))[:, None] * toward
        if response_slope is not None:
            by_coordinate += variances[1] * np.moveaxis(response_slope, 1, -1) @ self.inputs.response.T
        slope = by_coordinate @ self.weights
        if self.linear:
            slope = slope + self.coefficients[1:]
        return slope.transpose(0, 2, 1)

    def left_out_errors(self) -> NDArray[np.float64]:
        """Leave-one-out errors, value minus prediction [n, m], with unchanged hyperparameters (Rippa 1999)."""
        return self.weights / self.inverse_diagonal[:, None]

    def _whiten(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Whiten columns of values at the points [n, k]; the result has the shape [f, k]."""
        return solve_triangular(self.lower, self.trend.contrasts.T @ columns, lower=True)


def condition(
    inputs: Inputs, values: NDArray[np.float64], kernel: Kernel, *, linear: bool = False, freedom: float = 0.0
) -> Process:
    """Condition a process on values; the arguments are described in `Process`."""
    trend, matrix = Trend.of(inputs.unit, linear), kernel.matrix(inputs)
    lower = np.asarray(np.linalg.cholesky(trend.contrasts.T @ matrix @ trend.contrasts), dtype=np.float64)
    whitened = solve_triangular(lower, trend.contrasts.T @ values, lower=True)
    weights = trend.contrasts @ solve_triangular(lower.T, whitened)
    coefficients = trend.left_inverse @ (values - matrix @ weights)
    return Process(inputs, values, kernel, linear, freedom, trend, lower, whitened, weights, coefficients)


class Likelihood:
    """Restricted negative log likelihood of kernels (the likelihood of the contrasts), up to a constant.

    Without a prior on the variances, each variance takes its most likely value. With a prior, the residuals follow a
    multivariate t distribution. The arguments are described in `Process`.
    """

    def __init__(
        self, inputs: Inputs, values: NDArray[np.float64], *, linear: bool = False, freedom: float = 0.0
    ) -> None:
        unit = inputs.unit
        self.values, self.freedom = values, freedom
        self.response = inputs.response @ inputs.response.T
        self.squares = ((unit[:, None] - unit[None]) ** 2).reshape(-1, unit.shape[1])
        self.contrasts = Trend.of(unit, linear).contrasts

    def __call__(self, kernel: Kernel) -> tuple[float, NDArray[np.float64]]:
        """Return the value and its gradient [3 + d + 1].

        The gradient is with respect to the logarithms of v_0, v_1, v_2, the rates and the nugget. If the kernel matrix
        cannot be factorized, the value is `SINGULAR`, and the gradient is zero.
        """
        count, residuals = self.values.shape
        rates_squared = kernel.rates**2
        distance = np.sqrt(self.squares @ rates_squared).reshape(count, count)
        v_0, v_1, v_2 = kernel.variances
        smooth = matern(distance)
        matrix = v_0 + v_1 * self.response + v_2 * smooth + kernel.nugget * np.eye(count)
        try:
            lower = np.linalg.cholesky(self.contrasts.T @ matrix @ self.contrasts)
        except np.linalg.LinAlgError:
            return SINGULAR, np.zeros(len(rates_squared) + 4)
        half = solve_triangular(lower, self.contrasts.T, lower=True)
        inverse = half.T @ half  # P
        weights = inverse @ self.values
        square = np.maximum(np.sum(self.values * weights, axis=0), 1e-300)
        free = len(lower)
        # Negative log density: Student's t or, if `freedom` is 0, a Gaussian with profiled variances.
        value = residuals * np.log(np.diag(lower)).sum()
        value += 0.5 * (self.freedom + free) * np.log((self.freedom + square) / (self.freedom + free)).sum()
        # Derivative with respect to K (eq. 5.9); each residual is weighted by its precision.
        by_k = residuals * inverse - (weights * _precision(free, square, self.freedom)) @ weights.T
        by_k *= 0.5
        by_variance = kernel.variances * [by_k.sum(), np.sum(by_k * self.response), np.sum(by_k * smooth)]
        by_rate = v_2 * ((by_k * matern_slope(distance)).ravel() @ self.squares) * rates_squared
        return float(value), np.concatenate([by_variance, by_rate, [kernel.nugget * np.trace(by_k)]])


class Prior(NamedTuple):
    """Independent normal priors, with bounds, on the logarithms of v_0, v_1, v_2, rates and nugget [3 + d + 1].

    Attributes:
        mean: Means.
        spread: Standard deviations.
        lower: Lower bounds.
        upper: Upper bounds.
        fixed: Number of leading entries that are fixed at their means.
    """

    mean: NDArray[np.float64]
    spread: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    fixed: int = 0


def most_probable(
    likelihood: Likelihood,
    prior: Prior,
    *,
    scale: float = 1.0,
    divisor: float = 1.0,
    guess: Kernel | None = None,
    steps: int = 30,
) -> Kernel:
    """Find the kernel with the largest posterior density.

    The variances and the nugget are multiplied by `scale` squared. The negative log density is divided by `divisor`,
    which determines the size of the first step. Searches of at most `steps` steps start at the mean of the prior and,
    if given, at `guess`, for example the kernel of an earlier fit.
    """
    held, learned = prior.mean[: prior.fixed], slice(prior.fixed, None)

    def loss(hyper: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        value, slope = likelihood(Kernel.of(np.concatenate([held, hyper]), scale))
        away = (hyper - prior.mean[learned]) / prior.spread[learned]
        value += 0.5 * float(away @ away)
        return value / divisor, (slope[learned] + away / prior.spread[learned]) / divisor

    starts = [prior.mean] if guess is None else [prior.mean, guess.logarithms(scale)]
    bounds = list(zip(prior.lower[learned], prior.upper[learned], strict=True))
    ends = [
        minimize(loss, start[learned], jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": steps})
        for start in starts
    ]
    return Kernel.of(np.concatenate([held, min(ends, key=lambda end: end.fun).x]), scale)


def matern(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """The Matern-5/2 kernel at distances [...] in units of the length scales (eq. 4.17)."""
    a = np.sqrt(5.0) * distance
    return (1.0 + a + a * a / 3.0) * np.exp(-a)


def matern_slope(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative of the Matern kernel divided by the distance, M'(r) / r [...]; this ratio is finite at 0."""
    a = np.sqrt(5.0) * distance
    return -5.0 / 3.0 * (1.0 + a) * np.exp(-a)


def trend_basis(unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """The basis functions of a linear trend, 1 and the coordinates, at points of the unit cube [n, 1 + d]."""
    return np.hstack([np.ones((len(unit), 1)), unit])


def _precision(free: int, square: NDArray[np.float64], freedom: float) -> NDArray[np.float64]:
    return (freedom + free) / (freedom + square)


NUGGET = 1e-8
"""Nugget that keeps the matrix non-singular, as a fraction of the prior variance; it is negligible for any engine."""

LENGTH = 0.3
"""Prior median of a length scale, as a fraction of the cube's edge. The logarithm has a standard deviation of 1."""

LOG_RATE_BOUNDS = (-3.0, 5.0)
"""Bounds on the logarithm of a rate, which correspond to length scales from 20 down to 0.007."""

NOISE_PRIOR = (np.log(1e-4), 3.0)
"""Mean and standard deviation of the logarithm of the nugget if it is estimated."""

CONSTANT = 1e-9
"""A residual does not affect the scales if its standard deviation is below this fraction of the largest one."""


@dataclass(frozen=True, eq=False)
class Kriging:
    """A fitted kriging model.

    Attributes:
        process: The process, with variances relative to the variances of the residuals.
        root: Factor B of the prior covariance B^T B of the residuals [n - 1 - d, m].
    """

    process: Process
    root: NDArray[np.float64]

    @property
    def residuals(self) -> NDArray[np.float64]:
        """Residuals at the evaluated points [n, m]."""
        return self.process.values

    @property
    def variance(self) -> NDArray[np.float64]:
        """Prior variance of each residual [m]."""
        return np.sum(self.root**2, axis=0)

    def predict(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predicted mean [k, m], and predictive variance as a fraction of the prior variance [k], for all residuals."""
        return self.process.predict(Inputs.plain(unit))

    def mean_and_slope(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predicted residuals [k, m] and their Jacobian [k, m, d] at points of the unit cube [k, d]."""
        inputs = Inputs.plain(unit)
        return self.process.mean(inputs), self.process.slope(inputs)

    def with_point(self, point: NDArray[np.float64]) -> Kriging:
        """Add a point [d] as if its evaluation had returned the prediction; the mean and the prior stay unchanged."""
        unit = np.vstack([self.process.inputs.unit, point])
        residuals = np.vstack([self.residuals, self.predict(point[None])[0]])
        return Kriging(solve(unit, residuals, self.process.kernel).process, self.root)


def fit(
    unit: NDArray[np.float64],
    residuals: NDArray[np.float64],
    *,
    noisy: bool = False,
    guess: Kernel | None = None,
) -> Kriging:
    """Fit a model and its input scales to residuals [n, m] at distinct points [n, d] of the unit cube.

    There must be at least d + 2 points that span the cube. If the engine's answers are `noisy`, the nugget is also
    estimated; otherwise, the model interpolates the answers. `guess` is an additional starting point of the kernel
    search.
    """
    spread = residuals.std(axis=0)
    varying = residuals[:, spread > CONSTANT * max(spread.max(), 1e-300)]
    kernel = most_probable(
        likelihood(unit, varying),
        _prior(unit.shape[1], noisy),
        divisor=max(varying.shape[1], 1),
        guess=guess,
        steps=25,
    )
    return solve(unit, residuals, kernel)


def likelihood(unit: NDArray[np.float64], residuals: NDArray[np.float64]) -> Likelihood:
    """The restricted likelihood of kernels, given residuals [n, m] at points [n, d] of the unit cube."""
    return Likelihood(Inputs.plain(unit), residuals, linear=True)


def solve(unit: NDArray[np.float64], residuals: NDArray[np.float64], kernel: Kernel) -> Kriging:
    """Build the model with a given kernel from residuals [n, m] at points [n, d] of the unit cube."""
    process = condition(Inputs.plain(unit), residuals, kernel, linear=True)
    return Kriging(process, process.root)


def _prior(dimension: int, noisy: bool) -> Prior:
    """The prior with v_0 = v_1 = 0; v_2 is 1, because the variances of the residuals are profiled out."""
    low, rates = float(np.log(NUGGET)), np.ones(dimension)
    return Prior(
        mean=np.concatenate(
            [[-np.inf, -np.inf, 0.0], -np.log(LENGTH) * rates, [NOISE_PRIOR[0] if noisy else low]]
        ),
        spread=np.concatenate([np.ones(3), rates, [NOISE_PRIOR[1]]]),
        lower=np.concatenate([np.zeros(3), LOG_RATE_BOUNDS[0] * rates, [low]]),
        upper=np.concatenate([np.zeros(3), LOG_RATE_BOUNDS[1] * rates, [0.0 if noisy else low]]),
        fixed=3,
    )
