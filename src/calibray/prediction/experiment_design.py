"""Design of the next measurements: candidates are ranked by the uncertainty expected after they are measured.

The posterior draws represent the possible parameter values. Each draw in turn is assumed to be the true value, and the
other draws are weighted by how well they agree with the measurement that this value would produce. A candidate is
ranked by the logarithm of the remaining standard deviations, averaged over draws and parameters (an A-optimal design in
relative units, averaged over the posterior; K. Chaloner and I. Verdinelli, Bayesian experimental design: a review,
Statistical Science 10, 1995). The standard deviations are computed in two ways, and their logarithms are added:

- from the scatter of the weighted draws, which distinguishes separate minima but resolves a parameter only relative to
  its whole range;
- from the curvature at each draw, which shows by how much a measurement narrows a single minimum.

The scatter is uninformative if a range of a parameter contains few draws. If several separate ranges of a parameter fit
the links, the probability of ruling out all but one of these ranges is therefore included in the ranking. Each range
contains values that explain the links measured so far. The excess of a value is its sum of squares minus the sum of
squares of the best value. For a candidate, the squared difference between the predictions of this value and of the true
value is added to the excess. The smallest total in a range is the sum of squares that a fit within this range would
reach with all other parameters free. A range is ruled out if its smallest total exceeds that of the true range by more
than the quantile used for intervals. For two models, this criterion is the T-optimal design (A. C. Atkinson and V. V.
Fedorov, The design of experiments for discriminating between two rival models, Biometrika 62, 1975) with an expectation
over the true value (G. E. P. Box and W. J. Hill, Discrimination among mechanistic models, Technometrics 9, 1967).

Candidates are chosen one at a time. Part of the error is common to several candidates, because of an unknown offset or
shared clutter. Conditioning after each choice removes this common part, so a second measurement at the same point adds
less information.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import ndtr

UNIFORM_INFORMATION: Final = 12.0
"""Inverse variance of the uniform distribution over the unit interval, which is the information before any
measurement."""

LEAST_VARIANCE: Final = 1e-5
"""Smallest variance in the unit cube that the scatter of about a hundred draws can resolve."""

SEPARATION_WEIGHT: Final = 8.0
"""Weight of ruling out all but one range of a parameter, relative to narrowing the parameter by a factor of e."""

RULED_OUT: Final = 4.3
"""Excess of the sum of squares, in noise variances, above which a range is ruled out: F(0.95; 1, about 20)."""

EXCESS_DEVIATION: Final = 3.0
"""Standard deviation of the excess, in noise variances, due to the noise of the candidates' measurements."""

BATCH: Final = 4_000_000
"""Maximum number of array elements per batch (draws times values times candidates), which limits memory use."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Expected errors of the candidates' measurements if the parameters are known.

    Attributes:
        own_db: Standard deviation of the part of a candidate's error that is independent of other candidates [dB].
        common: Change in path loss [candidates, unknowns], [dB], per standard deviation of each unknown that is common
            to several candidates.
        position: Positions of the receivers, or of both ends [candidates, k], [m].
        shared_db: Standard deviation of the part of the error that neighbouring candidates share [dB]; 0 if they share
            none.
        range_m: Distance at which the correlation of the shared part has fallen to 1/e [m].
    """

    own_db: float
    common: NDArray[np.float64]
    position: NDArray[np.float64]
    shared_db: float = 0.0
    range_m: float = 1.0

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance of every candidate's error [candidates], [dB^2]."""
        return self.own_db**2 + self.shared_db**2 + np.sum(self.common**2, axis=1)

    def covariance(self, index: int) -> NDArray[np.float64]:
        """Covariance [candidates], [dB^2], of one candidate's error with the errors of all candidates."""
        covariance = self.common @ self.common[index]
        if self.shared_db:
            distance = cdist(self.position, self.position[index : index + 1])[:, 0]
            covariance = covariance + self.shared_db**2 * np.exp(-distance / self.range_m)
        covariance[index] += self.own_db**2
        return covariance


@dataclass(frozen=True, eq=False)
class Outlook:
    """The uncertainty expected after measuring one more candidate.

    Attributes:
        index: The candidate.
        narrowed: Standard deviation [d] of every parameter, relative to that before any candidate is measured; at most
            1.
        range_probability: Probability [d] that it is known in which of its separate ranges a parameter lies; 1 if it
            has only one range.
        information: Information matrix [n, d, d], at every draw, of all links measured up to and including this
            candidate.
    """

    index: int
    narrowed: NDArray[np.float64]
    range_probability: NDArray[np.float64]
    information: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Beliefs:
    """The state of the calibration before any candidate is measured.

    Attributes:
        point: Draws from the posterior in the unit cube [n, d].
        information: Information matrix [n, d, d], at every draw, of the links measured so far.
        piece: Index [m, d] of the separate range in which each parameter lies, first for the draws, then for further
            values that explain the links measured so far.
        excess: Sum of squares [m] of each draw and each further value, minus the smallest sum, in noise variances.
    """

    point: NDArray[np.float64]
    information: NDArray[np.float64]
    piece: NDArray[np.int64]
    excess: NDArray[np.float64]


def choose_candidates(
    beliefs: Beliefs, predicted: NDArray[np.float64], slope: NDArray[np.float64], errors: Errors, count: int
) -> list[Outlook]:
    """Choose the candidates to measure, one at a time.

    Args:
        beliefs: The state of the calibration.
        predicted: Path loss [m, candidates], [dB], of the candidates for each draw and each further value.
        slope: Derivatives of path loss [n, candidates, d], [dB], with respect to the coordinates of the unit cube, at
            the draws.
        errors: Expected errors of the measurements.
        count: Number of candidates to choose.

    Returns:
        The candidates in the order in which they are chosen, each with the uncertainty expected after measuring this
        candidate and the earlier ones.
    """
    prior_information = UNIFORM_INFORMATION * np.eye(beliefs.point.shape[1])
    beliefs = replace(beliefs, information=beliefs.information + prior_information)
    predicted, slope, variance = predicted.copy(), slope.copy(), errors.variance.copy()
    draws = len(beliefs.point)
    # Squared differences between the predictions of draws and values for the chosen candidates, in error variances.
    squares = np.zeros((draws, len(predicted)))
    taken = np.zeros(len(variance), dtype=bool)
    conditioned, outlooks = np.zeros((0, len(variance))), []
    before = np.maximum(np.std(beliefs.point, axis=0), np.sqrt(LEAST_VARIANCE))
    # If draws scatter less than the curvature implies, they are narrowed by a prior that the information matrices do
    # not include.
    scale = np.minimum(before / _by_curvature(beliefs.information), 1.0)
    narrowed = np.ones(len(before))
    for _ in range(min(count, len(variance))):
        deviation = np.sqrt(variance)
        rank = _rank_by_scatter(beliefs.point, squares[:, :draws], predicted[:draws] / deviation)
        rank += _rank_by_curvature(beliefs.information, slope / deviation[:, None])
        separation = separation_probability(beliefs.excess, beliefs.piece, squares, predicted / deviation)
        rank -= SEPARATION_WEIGHT * separation
        rank[taken] = np.inf
        best = int(np.argmin(rank))
        taken[best] = True
        best_predicted = predicted[:, best] / deviation[best]
        squares = squares + (best_predicted[:draws, None] - best_predicted) ** 2
        best_slope = slope[:, best] / deviation[best]
        added = best_slope[:, :, None] * best_slope[:, None, :]
        beliefs = replace(beliefs, information=beliefs.information + added)
        # Condition the other candidates on the chosen candidate, which is one step of a Cholesky factorization.
        covariance = errors.covariance(best) - conditioned.T @ conditioned[:, best]
        share = covariance / deviation[best]
        predicted -= best_predicted[:, None] * share
        slope -= best_slope[:, None, :] * share[:, None]
        variance = np.maximum(variance - share**2, 1e-6 * errors.own_db**2)
        conditioned = np.vstack([conditioned, share])
        # Where only the true draw keeps its weight, the scatter is too small, so the curvature gives the remaining
        # deviation.
        left = np.maximum(
            _scatter(beliefs.point, squares[:, :draws]), scale * _by_curvature(beliefs.information)
        )
        # A measurement never removes information, but the computed scatter of a hundred draws can still increase.
        narrowed = np.minimum(left / before, narrowed)
        probability = _range_probability(beliefs.piece[:draws], squares[:, :draws])
        outlooks.append(Outlook(best, narrowed, probability, beliefs.information))
    return outlooks


def initial_range_probability(piece: NDArray[np.int64]) -> NDArray[np.float64]:
    """Probability [d] that two draws lie in the same range of a parameter, before any candidate is measured.

    `piece` [n, d] is the index of the range in which each parameter of each draw lies.
    """
    return _range_probability(piece, np.zeros((len(piece), len(piece))))


def separation_probability(
    excess: NDArray[np.float64],
    piece: NDArray[np.int64],
    squares: NDArray[np.float64],
    predicted: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Probability [candidates] that measuring a candidate rules out all but one range of a parameter.

    The probability is averaged over draws and parameters; a parameter with a single range contributes 0. `excess` [m]
    is the sum of squares of every value minus the smallest sum, in noise variances; the first n values are the draws.
    `piece` [m, d] is the index of each parameter's range. `squares` [n, m] contains the sums of squared differences
    between the predictions of draws and values for the candidates chosen so far. `predicted` [m, candidates] is the
    path loss of the candidates for every value, in standard deviations of the candidates' errors.
    """
    draws, candidates = len(squares), predicted.shape[1]
    ambiguous = [column for column in piece.T if np.ptp(column)]
    probability, size = np.zeros(candidates), max(BATCH // squares.size, 1)
    if not ambiguous:
        return probability
    for start in range(0, candidates, size):
        batch = predicted[:, start : start + size]
        total = (excess + squares)[:, :, None] + (batch[:draws, None] - batch[None]) ** 2
        for column in ambiguous:
            probability[start : start + size] += _others_ruled_out(total, column).mean(axis=0)
    return probability / piece.shape[1]


def _others_ruled_out(total: NDArray[np.float64], piece: NDArray[np.int64]) -> NDArray[np.float64]:
    """Probability [n, c] that all ranges but that of the true draw are ruled out, given sums of squares [n, m, c]."""
    ranges, value_range = np.unique(piece, return_inverse=True)
    # The sum of squares of the best fit in each range.
    least = np.stack([total[:, value_range == k].min(axis=1) for k in range(len(ranges))])
    is_true = value_range[: len(total)] == np.arange(len(ranges))[:, None]
    best_rival = np.where(is_true[:, :, None], np.inf, least).min(axis=0)
    best_true = np.where(is_true[:, :, None], least, np.inf).min(axis=0)
    return ndtr((best_rival - best_true - RULED_OUT) / EXCESS_DEVIATION)


def _rank_by_scatter(
    point: NDArray[np.float64], squares: NDArray[np.float64], predicted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mean logarithm [candidates] of the draws' standard deviations after a candidate is measured."""
    draws, candidates = predicted.shape
    rank, size = np.empty(candidates), max(BATCH // draws**2, 1)
    for start in range(0, candidates, size):
        batch = predicted[:, start : start + size].T
        weight = _weights(squares + (batch[:, :, None] - batch[:, None, :]) ** 2)
        # Moments of the draws; each row assumes that its own draw is the true value.
        mean = weight @ point
        variance = np.maximum(weight @ point**2 - mean**2, 0.0)
        rank[start : start + size] = 0.5 * np.log(variance + LEAST_VARIANCE).mean(axis=(1, 2))
    return rank


def _rank_by_curvature(information: NDArray[np.float64], slope: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean logarithm [candidates] of the standard deviations implied by curvature, after a candidate is measured."""
    covariance = np.linalg.inv(information)
    # The Sherman-Morrison formula gives the inverse after one row of slopes is added.
    gain = slope @ covariance
    variance = np.diagonal(covariance, axis1=1, axis2=2)[:, None] - gain**2 / (
        1.0 + np.sum(gain * slope, axis=2, keepdims=True)
    )
    return 0.5 * np.log(np.maximum(variance, LEAST_VARIANCE**2)).mean(axis=(0, 2))


def _scatter(point: NDArray[np.float64], squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected standard deviation [d] of every parameter, computed from the scatter of the weighted draws."""
    weight = _weights(squares)
    variance = weight @ point**2 - (weight @ point) ** 2
    return np.sqrt(np.maximum(variance, 0.0)).mean(axis=0)


def _by_curvature(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected standard deviation [d] of every parameter, computed from the information matrices at the draws."""
    return np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)).mean(axis=0)


def _range_probability(piece: NDArray[np.int64], squares: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = _weights(squares)
    same_range = [weight[np.equal.outer(column, column)].sum() for column in piece.T]
    return np.array(same_range) / len(piece)


def _weights(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of the draws [..., n, n]; each row assumes that its own draw is the true value."""
    weight = np.exp(-0.5 * squares)
    return weight / weight.sum(axis=-1, keepdims=True)
