"""A corrected model averaged over what its constants may be, and how far it can be relied on.

A few answers do not tell the constants that a cheap model takes for granted: several sets of them explain these equally
well and promise minima in different places, where the best of all promises is kept least. So members are drawn from the
posterior of the constants, each corrected until it passes through all answers. Where they agree, little is in doubt.

Members are drawn by randomised maximum likelihood: each is fitted from a place of its own to answers and a prior that
are both disturbed as the model deems possible (D. S. Oliver, N. He, A. C. Reynolds, ECMOR V, 1996). What all that says
of errors is compared with the errors of the steps taken so far, which nothing was fitted to, and stretched by it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.correction import STEPS, Corrected, constants_fit, descended

UNLIKELY: Final = 30.0
"""Of a member's constants and three more: excess of their cost, a negative log density, at which it is left out.

Errors that links share make the posterior wider than the density says, which takes them for independent.
"""

CAPPED: Final = 100.0
"""Most that one step says of the errors' mean square."""


class Outlook(NamedTuple):
    """What an averaged model says of points.

    Attributes:
        mean: Residuals, averaged over the members [k, m].
        variance: Of a residual, on average [k].
        parts: Of every member the residuals [k, m], and the variance of each by that of `root` [k].
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    parts: list[tuple[NDArray[np.float64], NDArray[np.float64]]]


@dataclass(frozen=True, eq=False)
class Averaged:
    """Corrected models that explain the same answers.

    Attributes:
        members: The models, the most likely one first.
    """

    members: tuple[Corrected, ...]

    def predict(self, unit: NDArray[np.float64]) -> Outlook:
        """Predict residuals.

        Args:
            unit: Points of the unit cube [k, d].

        Returns:
            What the members say together.
        """
        parts = [member.predict(unit) for member in self.members]
        mean = np.mean([part[0] for part in parts], axis=0)
        variance = np.zeros(len(unit))
        for (own, share), member in zip(parts, self.members, strict=True):
            variance += np.mean((own - mean) ** 2, axis=1)
            variance += share * np.mean(np.sum(member.root**2, axis=0))
        return Outlook(mean, variance / len(parts), parts)

    def with_point(self, point: NDArray[np.float64]) -> Averaged:
        """Pretend that a point had been evaluated and had come out as predicted.

        Args:
            point: The point of the unit cube [d].

        Returns:
            Members that agree there.
        """
        told = self.predict(point[None]).mean
        return Averaged(tuple(member.with_point(point, told) for member in self.members))


@dataclass
class Track:
    """What came of predictions.

    Attributes:
        ratios: Of every step, the mean square of its errors by the variance expected.
    """

    ratios: list[float] = field(default_factory=list)

    @property
    def stretch(self) -> float:
        """Factor on variances; one step's worth speaks for 1."""
        return (1.0 + sum(self.ratios)) / (1.0 + len(self.ratios))

    def note(self, mean: NDArray[np.float64], variance: float, residuals: NDArray[np.float64]) -> None:
        """Take in a step.

        Args:
            mean: Residuals predicted [m].
            variance: Of a residual, on average, without the stretch.
            residuals: What was answered [m].
        """
        ratio = float(np.mean((residuals - mean) ** 2)) / max(variance, 1e-12)
        self.ratios.append(min(ratio, CAPPED))


def averaged(corrected: Corrected, starts: NDArray[np.float64], random: np.random.Generator) -> Averaged:
    """Draw members around a corrected model.

    Args:
        corrected: The model, with its most likely constants [q].
        starts: Constants that members are fitted from, one each [s, q].
        random: Random numbers.

    Returns:
        The model and those members that explain the answers nearly as well.
    """
    given = corrected.model.constants
    size, width = len(given.centre), given.upper - given.lower
    if not size:
        return Averaged((corrected,))
    drawn = given.centre + given.spread * random.standard_normal(starts.shape)
    drawn = np.clip(drawn, given.lower, given.upper)
    noise = random.standard_normal((len(starts), corrected.residuals.size))
    ended = []
    for start, centre, shift in zip((starts - given.lower) / width, drawn, noise, strict=True):
        fit = constants_fit(corrected, centre, shift)
        ended.append(descended(start[None], fit, STEPS, 1e-4).unit[0])
    rows, _ = constants_fit(corrected)(np.vstack([(corrected.constants - given.lower) / width, *ended]))
    cost = 0.5 * np.sum(rows**2, axis=1)
    kept = cost[1:] - cost[0] < UNLIKELY * (size + 3)
    found = given.lower + np.array(ended)[kept] * width
    return Averaged((corrected, *(_around(corrected, each) for each in found)))


def _around(corrected: Corrected, constants: NDArray[np.float64]) -> Corrected:
    """A model with other constants, corrected until it passes through the answers too."""
    moved = replace(corrected, constants=constants)
    cheap, seen = moved.seen(corrected.rest.seen.unit)
    rest = corrected.rest
    return replace(moved, rest=discrepancy.solve(seen, moved.residuals - cheap, rest.hyper, rest.scale))
