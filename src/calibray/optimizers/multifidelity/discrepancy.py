"""The discrepancy between an expensive and a cheap model: for every residual, a Gaussian process over the box.

The discrepancy consists of an offset, a change in response and a remainder, whose variances are v_0, v_1 and v_2 of
`regression.py`. h(x) is the scaled deviation of the cheap model's residuals from their mean over the box. Links respond
similarly to the parameters, so paths that the cheap model lacks respond like paths of other links. The v_1 term, which
is the slope of a link's output mapping, therefore also helps for links that the cheap model does not predict. Each
residual has its own variance, which is integrated out with an inverse gamma prior. Links that the cheap model predicts
poorly therefore do not affect other links.

M. C. Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425, sec. 4.

The predictive variance describes each point separately, but errors at nearby points are nearly equal. Samples of whole
functions are therefore required to locate the possible minima of an uncertain function. A function is drawn from the
prior as a sum of kernel features with normally distributed weights. A process that interpolates the differences between
the answers and this function is then added (J. T. Wilson et al., Efficiently sampling functions from Gaussian process
posteriors, ICML 2020, eq. 10). Features of the Matern kernel are cosines whose frequencies follow a t distribution with
5 degrees of freedom (A. Rahimi, B. Recht, Random features for large-scale kernel machines, NIPS 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.regression import (
    Inputs,
    Kernel,
    Likelihood,
    Prior,
    Process,
    condition,
    most_probable,
)

FREEDOM: Final = 4.0
"""Degrees of freedom of the prior on a residual's variance."""

VARIANCES: Final = (1.0, 0.1, 0.1)
"""Prior medians of v_0, v_1 and v_2, relative to the mean square of the cheap model's response."""

VARIANCE_SPREAD: Final = 2.0
"""Prior standard deviation of the logarithms of v_0, v_1 and v_2."""

LOG_VARIANCE_BOUNDS: Final = (-14.0, 6.0)

LENGTH: Final = 0.5
"""Prior median of a length scale, as a fraction of the edge of the unit cube."""

LENGTH_SPREAD: Final = 0.7
"""Prior standard deviation of the logarithm of a length scale."""

LOG_RATE_BOUNDS: Final = (-2.0, 4.0)

NUGGET: Final = 1e-6
"""Smallest nugget, relative to the mean square of the response. The nugget keeps the matrix non-singular."""

NOISE: Final = (float(np.log(1e-4)), 3.0)
"""Mean and standard deviation of the logarithm of the nugget if it is estimated."""


def fit(
    inputs: Inputs,
    values: NDArray[np.float64],
    scale: float,
    *,
    noisy: bool = False,
    guess: Kernel | None = None,
) -> Process:
    """Fit the process to discrepancies [n, m], with the most probable hyperparameters.

    The prior is relative to `scale`, the root mean square of the cheap model's response. If the answers are `noisy`,
    the nugget is also estimated. `guess` is an additional starting point of the kernel search.
    """
    likelihood = Likelihood(inputs, values, freedom=FREEDOM)
    prior = _prior(inputs.unit.shape[1], noisy)
    return solve(inputs, values, most_probable(likelihood, prior, scale=scale, guess=guess))


def expected(dimension: int, scale: float, noisy: bool) -> Kernel:
    """The kernel at the mean of the prior, for a response with a root mean square of `scale`."""
    return Kernel.of(_prior(dimension, noisy).mean, scale)


def _prior(dimension: int, noisy: bool) -> Prior:
    three, rates, low = np.ones(3), np.ones(dimension), float(np.log(NUGGET))
    return Prior(
        mean=np.concatenate([np.log(VARIANCES), -np.log(LENGTH) * rates, [NOISE[0] if noisy else low]]),
        spread=np.concatenate([VARIANCE_SPREAD * three, LENGTH_SPREAD * rates, [NOISE[1]]]),
        lower=np.concatenate([LOG_VARIANCE_BOUNDS[0] * three, LOG_RATE_BOUNDS[0] * rates, [low]]),
        upper=np.concatenate(
            [LOG_VARIANCE_BOUNDS[1] * three, LOG_RATE_BOUNDS[1] * rates, [0.0 if noisy else low]]
        ),
    )


def solve(inputs: Inputs, values: NDArray[np.float64], kernel: Kernel) -> Process:
    """The process with a given kernel, conditioned on discrepancies [n, m]."""
    return condition(inputs, values, kernel, freedom=FREEDOM)


def scaled_density(whitened: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Negative log density [s] of discrepancies [s, n, m] at the most probable scale, and this scale [s].

    Discrepancies are whitened by the inverse of the Cholesky factor of K. Each residual follows a multivariate t
    distribution, in which the covariance K is multiplied by the scale. The prior of the scale is the prior of a
    variance. Without this scale, constants that explain the answers much better than the kernel predicts would appear
    only slightly more probable than others.
    """
    count, links = whitened.shape[-2:]
    square, scale = np.sum(whitened**2, axis=-2), np.ones(len(whitened))
    for _ in range(30):
        # Iterative reweighting converges to the most probable scale of the t distributions.
        weight = (FREEDOM + count) / (FREEDOM + square / scale[:, None])
        scale = np.maximum(np.mean(weight * square, axis=1) / count, NUGGET)
    density = 0.5 * (FREEDOM + count) * np.log1p(square / scale[:, None] / FREEDOM).sum(axis=1)
    prior = 0.5 * (np.log(scale) / VARIANCE_SPREAD) ** 2
    return density + 0.5 * count * links * np.log(scale) + prior, scale


COSINES: Final = 256
"""Number of features (cosines) that represent the Matern kernel."""

SMOOTHNESS: Final = 5.0
"""Degrees of freedom of the t distribution of frequencies: twice the smoothness parameter of the kernel."""


@dataclass(frozen=True, eq=False)
class PriorDraw:
    """A function drawn from the prior: an offset, a linear function of the responses, and cosines.

    Attributes:
        offset: Constant part [m].
        steepness: Slopes with respect to the responses [r, m].
        frequency: Frequencies of the cosines [k, d].
        phase: Phases of the cosines [k].
        amplitude: Amplitudes of the cosines [k, m].
    """

    offset: NDArray[np.float64]
    steepness: NDArray[np.float64]
    frequency: NDArray[np.float64]
    phase: NDArray[np.float64]
    amplitude: NDArray[np.float64]

    def values(self, at: Inputs) -> NDArray[np.float64]:
        """Values at points [k, m]."""
        cosines = np.cos(at.unit @ self.frequency.T + self.phase)
        return self.offset + at.response @ self.steepness + cosines @ self.amplitude

    def slopes(self, at: Inputs, response_slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives at points [k, m, d], given the derivatives of the responses [k, r, d]."""
        sines = -np.sin(at.unit @ self.frequency.T + self.phase)[:, :, None] * self.frequency
        waves = np.einsum("kfd,fm->kmd", sines, self.amplitude, optimize=True)
        return waves + np.einsum("krd,rm->kmd", response_slope, self.steepness, optimize=True)


@dataclass(frozen=True, eq=False)
class SampledFunction:
    """A function that passes through the evaluated points.

    Attributes:
        prior: A draw from the prior.
        rest: Process that interpolates the differences, at the evaluated points, between the answers and the draw.
    """

    prior: PriorDraw
    rest: Process

    def values(self, at: Inputs) -> NDArray[np.float64]:
        """Values at points [k, m]."""
        return self.prior.values(at) + self.rest.mean(at)

    def slopes(self, at: Inputs, response_slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives [k, m, d] in unit-cube coordinates, given the derivatives of the responses [k, r, d]."""
        return self.prior.slopes(at, response_slope) + self.rest.slope(at, response_slope)


def sample_function(process: Process, random: np.random.Generator, stretch: float = 1.0) -> SampledFunction:
    """Draw a function; `stretch` multiplies its deviation from the mean, so a value of 0 gives the mean."""
    inputs, kernel = process.inputs, process.kernel
    (count, d), residuals = inputs.unit.shape, process.values.shape[1]
    size = stretch * np.sqrt(kernel.variances)

    def correlated(rows: int) -> NDArray[np.float64]:
        """Normal draws [rows, m] with the covariance between residuals, as in `Process.root`."""
        independent = np.sqrt(FREEDOM) * random.standard_normal((rows, residuals))
        draws = random.standard_normal((rows, count)) @ process.whitened
        return (draws + independent) / np.sqrt(count + FREEDOM)

    # A t variable is a normal variable divided by sqrt(c / n); c is a chi-square variable with n degrees of freedom.
    tail = np.sqrt(random.chisquare(SMOOTHNESS, (COSINES, 1)) / SMOOTHNESS)
    prior = PriorDraw(
        size[0] * correlated(1)[0],
        size[1] * correlated(inputs.response.shape[1]),
        kernel.rates * random.standard_normal((COSINES, d)) / tail,
        random.uniform(0.0, 2.0 * np.pi, COSINES),
        size[2] * np.sqrt(2.0 / COSINES) * correlated(COSINES),
    )
    # The answers are the sum of the function and errors, so a draw of the errors is also subtracted.
    scatter = stretch * np.sqrt(kernel.nugget) * correlated(count)
    missed = process.values - prior.values(inputs) - scatter
    return SampledFunction(prior, solve(inputs, missed, kernel))


def standardized_error(process: Process, points: NDArray[np.intp]) -> float:
    """Root mean square of the leave-one-out errors at `points`, each divided by its expected standard deviation."""
    expected = 1.0 / np.outer(process.inverse_diagonal, process.precision)
    return float(np.sqrt(np.mean((process.left_out_errors() ** 2 / expected)[points])))
