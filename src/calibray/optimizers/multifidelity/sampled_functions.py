"""Functions drawn from the posterior of a discrepancy, each one whole.

A process states its uncertainty point by point, but errors at two near points are the same error. To learn where the
minimum of an uncertain function may lie one needs whole functions. A function is drawn from the prior, as a sum of the
kernel's features with normal weights. The process then adds what that function misses at the evaluated points
(J. T. Wilson et al., Efficiently sampling functions from Gaussian process posteriors, ICML 2020, eq. 10). Features of
the Matern kernel are cosines whose frequencies follow Student's t with 5 degrees of freedom (A. Rahimi, B. Recht,
Random features for large-scale kernel machines, NIPS 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.discrepancy import FREEDOM
from calibray.optimizers.regression import Inputs, Process

COSINES: Final = 256
"""Features of the Matern kernel."""

SMOOTHNESS: Final = 5.0
"""Degrees of freedom of the frequencies: twice the smoothness of the kernel."""


@dataclass(frozen=True, eq=False)
class PriorDraw:
    """A function drawn from the prior: an offset, slopes by the responses, and cosines.

    Attributes:
        offset: Constant part [m].
        steepness: Slopes by the responses [r, m].
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
        """Derivatives at points [k, m, d], from those of their responses [k, r, d]."""
        sines = -np.sin(at.unit @ self.frequency.T + self.phase)[:, :, None] * self.frequency
        waves = np.einsum("kfd,fm->kmd", sines, self.amplitude, optimize=True)
        return waves + np.einsum("krd,rm->kmd", response_slope, self.steepness, optimize=True)


@dataclass(frozen=True, eq=False)
class SampledFunction:
    """A function that passes through the evaluated points.

    Attributes:
        prior: A draw from the prior.
        rest: Process through what the draw misses at the evaluated points.
    """

    prior: PriorDraw
    rest: Process

    def values(self, at: Inputs) -> NDArray[np.float64]:
        """Values at points [k, m]."""
        return self.prior.values(at) + self.rest.mean(at)

    def slopes(self, at: Inputs, response_slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives [k, m, d] by the unit cube's coordinates, given those of the responses [k, r, d]."""
        return self.prior.slopes(at, response_slope) + self.rest.slope(at, response_slope)


def sample_function(process: Process, random: np.random.Generator, stretch: float = 1.0) -> SampledFunction:
    """Draw a function; `stretch` multiplies its deviations from the mean, and 0 gives the mean."""
    inputs, kernel = process.inputs, process.kernel
    (count, d), residuals = inputs.unit.shape, process.values.shape[1]
    size = stretch * np.sqrt(kernel.variances)

    def correlated(rows: int) -> NDArray[np.float64]:
        """Normal draws with the covariance of the residuals [rows, m], as by `Process.root`."""
        independent = np.sqrt(FREEDOM) * random.standard_normal((rows, residuals))
        draws = random.standard_normal((rows, count)) @ process.whitened
        return (draws + independent) / np.sqrt(count + FREEDOM)

    # A t distribution is a normal one divided by the root of a chi-square.
    tail = np.sqrt(random.chisquare(SMOOTHNESS, (COSINES, 1)) / SMOOTHNESS)
    prior = PriorDraw(
        size[0] * correlated(1)[0],
        size[1] * correlated(inputs.response.shape[1]),
        kernel.rates * random.standard_normal((COSINES, d)) / tail,
        random.uniform(0.0, 2.0 * np.pi, COSINES),
        size[2] * np.sqrt(2.0 / COSINES) * correlated(COSINES),
    )
    scatter = stretch * np.sqrt(kernel.nugget) * correlated(count)
    missed = process.values - prior.values(inputs) - scatter
    return SampledFunction(prior, discrepancy.solve(inputs, missed, kernel))


def standardized_error(process: Process, points: NDArray[np.intp]) -> float:
    """Root mean square, over expected standard deviations, of errors at points left out; 1 if those are right."""
    expected = 1.0 / np.outer(process.inverse_diagonal, process.precision)
    return float(np.sqrt(np.mean((process.left_out_errors() ** 2 / expected)[points])))
