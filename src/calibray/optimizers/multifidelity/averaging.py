"""A corrected model averaged over the constants that explain the answers, and the size of its errors.

A few answers do not determine the constants of a cheap model. Several sets of them explain the answers equally well and
predict minima at different points, and the lowest of these predictions is the most optimistic one. So members are drawn
from the posterior of the constants, each corrected until it passes through all answers. Where they agree, little is
uncertain.

Members are drawn by randomised maximum likelihood: each is fitted from a different start, to answers and a prior that
are both disturbed by their uncertainties (D. S. Oliver, N. He, A. C. Reynolds, ECMOR V, 1996). The predicted variance
is compared with the errors of the steps so far, to which nothing was fitted, and stretched accordingly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.descent import descend_all
from calibray.optimizers.multifidelity.correction import CONVERGED, STEPS, Corrected, constants_fit

UNLIKELY: Final = 30.0
"""Excess of the negative log density, per constant and three more, beyond which a member is left out.

Links share errors, so the posterior is wider than this density, which assumes independent links.
"""

CAPPED: Final = 100.0
"""Largest ratio of squared error to predicted variance that one step contributes."""


class Prediction(NamedTuple):
    """The prediction of an averaged model at points.

    Attributes:
        mean: Residuals, averaged over the members [k, m].
        variance: Variance of a residual, averaged over the residuals [k].
        members: For every member the residuals [k, m], and the variance relative to `Corrected.root` [k].
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    members: list[tuple[NDArray[np.float64], NDArray[np.float64]]]


@dataclass(frozen=True, eq=False)
class Averaged:
    """Corrected models that explain the same answers.

    Attributes:
        members: The models, the most likely one first.
    """

    members: tuple[Corrected, ...]

    def predict(self, unit: NDArray[np.float64]) -> Prediction:
        """Predict the residuals at points of the unit cube [k, d]."""
        predictions = [member.predict(unit) for member in self.members]
        mean = np.mean([residuals for residuals, _ in predictions], axis=0)
        variance = np.zeros(len(unit))
        for (residuals, share), member in zip(predictions, self.members, strict=True):
            variance += np.mean((residuals - mean) ** 2, axis=1)
            variance += share * np.mean(np.sum(member.root**2, axis=0))
        return Prediction(mean, variance / len(predictions), predictions)

    def with_point(self, point: NDArray[np.float64]) -> Averaged:
        """Add a point of the unit cube [d] as if evaluated exactly as predicted; the members then agree there."""
        residuals = self.predict(point[None]).mean
        return Averaged(tuple(member.with_point(point, residuals) for member in self.members))


@dataclass
class ErrorRecord:
    """How the errors of the steps so far compare with their predicted variances.

    Attributes:
        ratios: Mean square error over predicted variance of every step.
    """

    ratios: list[float] = field(default_factory=list)

    @property
    def stretch(self) -> float:
        """Factor on variances; the prior is one step with a ratio of 1."""
        return (1.0 + sum(self.ratios)) / (1.0 + len(self.ratios))

    def add(self, mean: NDArray[np.float64], variance: float, residuals: NDArray[np.float64]) -> None:
        """Add a step: predicted residuals [m], their averaged variance without the stretch, observed ones [m]."""
        ratio = float(np.mean((residuals - mean) ** 2)) / max(variance, 1e-12)
        self.ratios.append(min(ratio, CAPPED))


def average(corrected: Corrected, starts: NDArray[np.float64], random: np.random.Generator) -> Averaged:
    """Fit members from constants [s, q] around a model; keep those that explain the answers nearly as well."""
    prior = corrected.model.constants
    size = len(prior.centre)
    if not size:
        return Averaged((corrected,))
    centres = prior.draw(random.standard_normal(starts.shape))
    noise = random.standard_normal((len(starts), corrected.residuals.size))
    ends = []
    for start, centre, shift in zip((starts - prior.lower) / prior.width, centres, noise, strict=True):
        fit = constants_fit(corrected, centre, shift)
        ends.append(descend_all(start[None], fit, STEPS, CONVERGED).unit[0])
    present = (corrected.constants - prior.lower) / prior.width
    rows, _ = constants_fit(corrected)(np.vstack([present, *ends]))
    cost = 0.5 * np.sum(rows**2, axis=1)
    likely = cost[1:] - cost[0] < UNLIKELY * (size + 3)
    constants = prior.lower + np.array(ends)[likely] * prior.width
    return Averaged((corrected, *(corrected.with_constants(member) for member in constants)))
