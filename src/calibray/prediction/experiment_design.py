"""Where to measure next: candidates ranked by what their measurement would leave open.

Draws from the posterior stand for what is still possible. Each in turn plays the truth, and the others are weighed by
how well they would agree with what is measured then: what remains of their scatter is the interval to be expected. That
sees minima apart from one another, which disagree about some candidates and not about others, but it sees a parameter
only against its whole range. Curvature sees how much closer each draw would be held where it lies, and nothing else.
A candidate is ranked by the sum of both: the mean logarithm of the standard deviations, over draws and parameters, by
scatter and by curvature (an A-optimal design in relative units, averaged over the posterior). Where separate ranges of
a parameter fit, the probability of ruling out all but one counts beside it (`ranges.py`): scatter hardly sees a range
that few draws lie in.

Candidates are chosen one after another. What their errors share, an offset that is hardly known or neighbours' common
clutter, is taken off by the conditional distribution after each choice, so that one point is not worth as much as a
second time beside it.

Tried and not kept: the probability, among draws, of taking the wrong one of separate ranges for the right one. It told
apart as many as scatter does, not more.

K. Chaloner and I. Verdinelli, Bayesian experimental design: a review, Statistical Science 10, 1995.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from calibray.prediction.mode_separation import BATCH, told_apart

FLAT: Final = 12.0
"""Inverse variance of a value that lies anywhere in the unit interval: what is known without any link."""

LEAST: Final = 1e-5
"""Variance in the unit cube below which a narrower scatter of so few draws tells nothing."""

APART: Final = 8.0
"""What it is worth to rule out all ranges of a parameter but one, by narrowing it e times."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors to be expected of candidates, for given parameters.

    Attributes:
        own_db: Standard deviation of each one's own part [dB].
        common: What they share, a column for each unknown: times its standard deviation [c, r], [dB].
        position: Where they stand [c, k], [m]: their receivers, or both ends.
        shared_db: Standard deviation of what neighbours share [dB]; 0 for nothing.
        range_m: Distance at which that has fallen to 1/e [m].
    """

    own_db: float
    common: NDArray[np.float64]
    position: NDArray[np.float64]
    shared_db: float = 0.0
    range_m: float = 1.0

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance of every candidate's error [c], [dB^2]."""
        return self.own_db**2 + self.shared_db**2 + np.sum(self.common**2, axis=1)

    def covariance(self, index: int) -> NDArray[np.float64]:
        """Covariance of one candidate's error with those of all [c], [dB^2]."""
        found = self.common @ self.common[index]
        if self.shared_db:
            apart = cdist(self.position, self.position[index : index + 1])[:, 0]
            found = found + self.shared_db**2 * np.exp(-apart / self.range_m)
        found[index] += self.own_db**2
        return found


@dataclass(frozen=True, eq=False)
class Outlook:
    """What is to be expected once one candidate more is measured.

    Attributes:
        index: The candidate.
        narrowed: Standard deviation of every parameter, by that before any [d]; 1 where nothing is learned.
        sure: Probability of knowing in which of its separate ranges a parameter lies [d]; 1 where there is one.
    """

    index: int
    narrowed: NDArray[np.float64]
    sure: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Beliefs:
    """What is believed before anything more is measured.

    Attributes:
        point: Draws from the posterior in the unit cube [n, d].
        information: Information of the links measured so far, at every draw [n, d, d].
        piece: Which of its separate ranges each parameter lies in [m, d]: of the draws, and after them of further
            values that explain the links so far, for ranges that few draws lie in.
        excess: Sum of squares by which each of these explains the links worse than the best, in variances of the
            noise [m].
    """

    point: NDArray[np.float64]
    information: NDArray[np.float64]
    piece: NDArray[np.int64]
    excess: NDArray[np.float64]


def choose(
    beliefs: Beliefs,
    predicted: NDArray[np.float64],
    slope: NDArray[np.float64],
    errors: Errors,
    count: int,
) -> list[Outlook]:
    """Choose candidates one after another.

    Args:
        beliefs: What is believed so far.
        predicted: Path loss of the candidates by every draw, and the further values [m, c], [dB].
        slope: Its derivatives by the coordinates of the unit cube, for the draws [n, c, d], [dB].
        errors: Errors to be expected of their measurements.
        count: How many to choose.

    Returns:
        The candidates in the order of their choice, each with what is to be expected once it is measured as well.
    """
    beliefs = replace(beliefs, information=beliefs.information + FLAT * np.eye(beliefs.point.shape[1]))
    predicted, slope, variance = predicted.copy(), slope.copy(), errors.variance.copy()
    draws = len(beliefs.point)
    known, taken = np.zeros((draws, len(predicted))), np.zeros(len(variance), dtype=bool)
    passed, found = np.zeros((0, len(variance))), []
    before = np.maximum(np.std(beliefs.point, axis=0), np.sqrt(LEAST))
    for _ in range(min(count, len(variance))):
        size = np.sqrt(variance)
        value = _by_scatter(beliefs.point, known[:, :draws], predicted[:draws] / size)
        value += _by_curvature(beliefs.information, slope / size[:, None])
        value -= APART * told_apart(beliefs.excess, beliefs.piece, known, predicted / size)
        value[taken] = np.inf
        best = int(np.argmin(value))
        taken[best] = True
        told = predicted[:, best] / size[best]
        known = known + (told[:draws, None] - told) ** 2
        row = slope[:, best] / size[best]
        beliefs = replace(beliefs, information=beliefs.information + row[:, :, None] * row[:, None, :])
        # What is shared with the one chosen is known by then: the rest is taken conditional on it.
        whole = errors.covariance(best) - passed.T @ passed[:, best]
        share = whole / size[best]
        predicted -= told[:, None] * share
        slope -= row[:, None, :] * share[:, None]
        variance = np.maximum(variance - share**2, 1e-6 * errors.own_db**2)
        passed = np.vstack([passed, share])
        narrowed = np.minimum(_scatter(beliefs.point, known[:, :draws]) / before, 1.0)
        found.append(Outlook(best, narrowed, _sure(beliefs.piece[:draws], known[:, :draws])))
    return found


def certain(piece: NDArray[np.int64]) -> NDArray[np.float64]:
    """Probability of knowing in which of its separate ranges a parameter lies, before anything more is measured.

    Args:
        piece: Range of every draw [n, d].

    Returns:
        The probability that two draws lie in the same one [d].
    """
    return _sure(piece, np.zeros((len(piece), len(piece))))


def _by_scatter(
    point: NDArray[np.float64], known: NDArray[np.float64], predicted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mean logarithm of the draws' standard deviations once a candidate is measured [c]."""
    count, candidates = predicted.shape
    found, size = np.empty(candidates), max(BATCH // count**2, 1)
    for start in range(0, candidates, size):
        part = predicted[:, start : start + size].T
        weight = _weights(known + (part[:, :, None] - part[:, None, :]) ** 2)
        mean = weight @ point
        variance = np.maximum(weight @ point**2 - mean**2, 0.0)
        found[start : start + size] = 0.5 * np.log(variance + LEAST).mean(axis=(1, 2))
    return found


def _by_curvature(information: NDArray[np.float64], slope: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean logarithm of standard deviations by curvature at the draws, once a candidate is measured [c]."""
    covariance = np.linalg.inv(information)
    # Sherman and Morrison: one row more.
    pull = slope @ covariance
    left = np.diagonal(covariance, axis1=1, axis2=2)[:, None] - pull**2 / (
        1.0 + np.sum(pull * slope, axis=2, keepdims=True)
    )
    return 0.5 * np.log(np.maximum(left, LEAST**2)).mean(axis=(0, 2))


def _scatter(point: NDArray[np.float64], known: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of every parameter to be expected [d]."""
    weight = _weights(known)
    variance = weight @ point**2 - (weight @ point) ** 2
    return np.sqrt(np.maximum(variance, 0.0)).mean(axis=0)


def _sure(piece: NDArray[np.int64], known: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = _weights(known)
    same = [weight[np.equal.outer(column, column)].sum() for column in piece.T]
    return np.array(same) / len(piece)


def _weights(known: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of the draws, the row's draw being the truth and its errors as large as they may be expected."""
    weight = np.exp(-0.5 * known)
    return weight / weight.sum(axis=-1, keepdims=True)
