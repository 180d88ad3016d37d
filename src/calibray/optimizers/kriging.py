"""Universal kriging: an interpolating model of all residuals, on length scales learned from them.

Every residual is a linear trend plus weights on Matern-5/2 functions centred at the evaluated points. All residuals
share the input scales (one per parameter, so a parameter without influence drops out). The scales maximise the
restricted likelihood summed over all residuals: with tens of links, a dozen points determine them well. Each residual
has its own variance, which is profiled out. See `regression.py` for the mathematics.
"""

from __future__ import annotations

from dataclasses import dataclass

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

NUGGET = 1e-8
"""Share of the prior variance that keeps the matrix regular; it is below the precision of any engine."""

LENGTH = 0.3
"""Median of the prior of a length scale, as a share of the unit cube; its logarithm has standard deviation 1."""

LOG_RATE_BOUNDS = (-3.0, 5.0)
"""Length scales from 20 down to 0.007."""

NOISE_PRIOR = (np.log(1e-4), 3.0)
"""Mean and standard deviation of the logarithm of the nugget if it is estimated."""

CONSTANT = 1e-9
"""Standard deviation of a residual, relative to the largest, below which it does not affect the scales."""


@dataclass(frozen=True, eq=False)
class Kriging:
    """A fitted model.

    Attributes:
        process: The process; its variances are relative to those of the residuals.
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
        """Predicted mean [k, m], and variance as a share of the prior's, which is the same for all residuals [k]."""
        return self.process.predict(Inputs.plain(unit))

    def mean_and_slope(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predicted residuals [k, m] and their Jacobian [k, m, d] at points of the unit cube [k, d]."""
        inputs = Inputs.plain(unit)
        return self.process.mean(inputs), self.process.slope(inputs)

    def with_point(self, point: NDArray[np.float64]) -> Kriging:
        """Add a point [d] as if its evaluation equalled the prediction: same mean and prior, but no variance there."""
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
    """Fit a model and its input scales to residuals [n, m] at distinct points of the unit cube [n, d].

    There must be at least d + 2 points that span the cube. `noisy` also estimates the nugget, for an engine whose
    answers scatter; otherwise the model interpolates. `guess` is an additional starting point for the kernel, besides
    the prior's.
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
    """The restricted likelihood of kernels, given residuals [n, m] at points of the unit cube [n, d]."""
    return Likelihood(Inputs.plain(unit), residuals, linear=True)


def solve(unit: NDArray[np.float64], residuals: NDArray[np.float64], kernel: Kernel) -> Kriging:
    """The model with a known kernel, given residuals [n, m] at points of the unit cube [n, d]."""
    process = condition(Inputs.plain(unit), residuals, kernel, linear=True)
    return Kriging(process, process.root)


def _prior(dimension: int, noisy: bool) -> Prior:
    """v_0 and v_1 are 0 and v_2 is 1: the variances of the residuals are profiled out."""
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
