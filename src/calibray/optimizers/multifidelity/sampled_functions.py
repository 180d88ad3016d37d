"""Functions that a fitted process deems possible, each drawn whole.

Where a process is uncertain, it says how much at every point; what it does not say is that errors at two near points
are one and the same. Who asks where the minimum of a function may lie needs whole functions. One is drawn from the
prior, as a sum of the process's features with normal weights, and what it misses at the evaluated points is added by
the process itself (J. T. Wilson et al., Efficiently sampling functions from Gaussian process posteriors, ICML 2020,
eq. 10). Features of the Matern kernel are cosines whose frequencies follow Student's t with 5 degrees of freedom
(A. Rahimi, B. Recht, Random features for large-scale kernel machines, NIPS 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.discrepancy import FREEDOM, Discrepancy, Seen

COSINES: Final = 256
"""Features of the Matern kernel."""

SMOOTHNESS: Final = 5.0
"""Twice that of the kernel."""


@dataclass(frozen=True, eq=False)
class Plausible:
    """A function that passes through the evaluated points.

    Attributes:
        offset: Its value but for all that follows [m].
        steep: Its slopes by the responses [r, m].
        frequency: Of its cosines [k, d].
        phase: Theirs [k].
        height: Theirs [k, m].
        rest: What all that misses at the evaluated points.
    """

    offset: NDArray[np.float64]
    steep: NDArray[np.float64]
    frequency: NDArray[np.float64]
    phase: NDArray[np.float64]
    height: NDArray[np.float64]
    rest: Discrepancy

    def values(self, seen: Seen) -> NDArray[np.float64]:
        """Evaluate it.

        Args:
            seen: Points.

        Returns:
            Values [k, m].
        """
        return self._prior(seen) + self.rest.predict(seen)[0]

    def slopes(self, seen: Seen, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Its derivatives.

        Args:
            seen: Points.
            change: Derivatives of their responses by the coordinates of the unit cube [k, r, d].

        Returns:
            Derivatives by these coordinates [k, m, d].
        """
        bent = -np.sin(seen.unit @ self.frequency.T + self.phase)[:, :, None] * self.frequency
        waves = np.einsum("kfd,fm->kmd", bent, self.height, optimize=True)
        lines = np.einsum("krd,rm->kmd", change, self.steep, optimize=True)
        return waves + lines + self.rest.slope(seen, change)

    def _prior(self, seen: Seen) -> NDArray[np.float64]:
        waves = np.cos(seen.unit @ self.frequency.T + self.phase)
        return self.offset + seen.response @ self.steep + waves @ self.height


def drawn(process: Discrepancy, random: np.random.Generator, stretch: float = 1.0) -> Plausible:
    """Draw a function.

    Args:
        process: The process.
        random: Random numbers.
        stretch: Factor of its deviations from the mean.

    Returns:
        The function.
    """
    seen, (d, links) = process.seen, (process.seen.unit.shape[1], process.remains.shape[1])
    size = stretch * process.scale * np.exp(0.5 * process.hyper)
    rates = np.exp(process.hyper[3 : 3 + d])

    def rows(count: int) -> NDArray[np.float64]:
        """Normal draws with the covariance of the residuals [count, m], as by `Discrepancy.root`."""
        known, (points, _) = process.whitened, process.whitened.shape
        own = np.sqrt(FREEDOM) * random.standard_normal((count, links))
        return (random.standard_normal((count, points)) @ known + own) / np.sqrt(points + FREEDOM)

    tail = np.sqrt(random.chisquare(SMOOTHNESS, (COSINES, 1)) / SMOOTHNESS)
    prior = Plausible(
        size[0] * rows(1)[0],
        size[1] * rows(seen.response.shape[1]),
        rates * random.standard_normal((COSINES, d)) / tail,
        random.uniform(0.0, 2.0 * np.pi, COSINES),
        size[2] * np.sqrt(2.0 / COSINES) * rows(COSINES),
        process,
    )
    scatter = stretch * process.scale * np.exp(0.5 * process.hyper[-1]) * rows(len(seen.unit))
    missed = process.remains - prior._prior(seen) - scatter
    return Plausible(
        prior.offset, prior.steep, prior.frequency, prior.phase, prior.height,
        discrepancy.solve(seen, missed, process.hyper, process.scale),
    )  # fmt: skip


def surprise(process: Discrepancy, points: NDArray[np.intp]) -> float:
    """By how much errors at points that are left out exceed what the process expects of them.

    Args:
        process: The process.
        points: Places of the points.

    Returns:
        Root mean square of the errors over their standard deviations; 1 where the process knows itself.
    """
    inverse = np.linalg.inv(process.lower @ process.lower.T)
    expected = 1.0 / np.outer(np.diag(inverse), process.precision)
    return float(np.sqrt(np.mean((process.left_out() ** 2 / expected)[points])))
