"""Which candidates tell separate ranges of a parameter apart.

Values that explain the links so far lie in each range, and each comes with the sum of squares by which it explains them
worse than the best. A draw from the posterior plays the truth: at a candidate every other value disagrees with it by
some square, which is added to its sum. The least sum in a range is what a fit would reach there with all other
parameters free. A range is ruled out once its least sum exceeds that of the truth's own by the quantile of an interval:
a candidate is worth the probability of that for the range that is hardest to rule out, averaged over the draws.
Candidates chosen before count by what they have added, so that they are sought out for the range that is left.

Between two models this is the T-optimal design of A. C. Atkinson and V. V. Fedorov, The design of experiments for
discriminating between two rival models, Biometrika 62, 1975, with the expectation over the truth of G. E. P. Box and
W. J. Hill, Discrimination among mechanistic models, Technometrics 9, 1967.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

NEEDED: Final = 4.3
"""Excess of the sum of squares, in variances of the noise, that rules a range out: F(0.95; 1, about 20)."""

SOFT: Final = 3.0
"""Standard deviation of what the excess comes to be, by the noise of the candidates."""

BATCH: Final = 4_000_000
"""Draws times values times candidates that are looked at once, which bounds the memory."""


def told_apart(
    excess: NDArray[np.float64],
    piece: NDArray[np.int64],
    known: NDArray[np.float64],
    predicted: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Probability of ruling out all ranges of a parameter but one, once a candidate is measured.

    Args:
        excess: Sum of squares of every value above the least, in variances of the noise [m]; draws lead.
        piece: Range that each parameter of it lies in [m, d].
        known: Squares by which values differ from the first n of them, the draws, at what was chosen before [n, m].
        predicted: Path loss of candidates by every value, in standard deviations of their errors [m, c].

    Returns:
        The probability, averaged over draws and parameters; a parameter with one range adds none [c].
    """
    count, candidates = len(known), predicted.shape[1]
    split = [column for column in piece.T if np.ptp(column)]
    found, size = np.zeros(candidates), max(BATCH // known.size, 1)
    if not split:
        return found
    for start in range(0, candidates, size):
        part = predicted[:, start : start + size]
        square = (excess + known)[:, :, None] + (part[:count, None] - part[None]) ** 2
        for column in split:
            found[start : start + size] += _ruled_out(square, column).mean(axis=0)
    return found / piece.shape[1]


def _ruled_out(square: NDArray[np.float64], piece: NDArray[np.int64]) -> NDArray[np.float64]:
    """Probability that every range but a draw's own is ruled out [n, c], from sums of squares [n, m, c]."""
    names, which = np.unique(piece, return_inverse=True)
    least = np.stack([square[:, which == k].min(axis=1) for k in range(len(names))])
    own = which[: len(square)] == np.arange(len(names))[:, None]
    rival = np.where(own[:, :, None], np.inf, least).min(axis=0)
    kept = np.where(own[:, :, None], least, np.inf).min(axis=0)
    return ndtr((rival - kept - NEEDED) / SOFT)
