"""Which candidates tell separate ranges apart, against sums of squares that are minimized in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from calibray.prediction.mode_separation import NEEDED, SOFT, told_apart

RANGES = np.repeat([0, 1], 2)[:, None]


def worth(excess: float) -> float:
    """Probability of ruling out a range whose least sum of squares is so much above that of the truth's own."""
    return float(ndtr((excess - NEEDED) / SOFT))


def test_the_value_of_the_other_range_that_fits_best_counts():
    """Of two values there the one that explains a candidate better is what a fit would find."""
    excess, predicted = np.array([0.0, 1.0, 2.0, 1.5]), np.array([[0.0], [9.0], [3.0], [4.0]])
    told = told_apart(excess, RANGES, np.zeros((1, 4)), predicted)
    assert told == pytest.approx(worth(min(2.0 + 9.0, 1.5 + 16.0)))


def test_a_truth_that_fits_worse_is_measured_by_the_best_of_its_own_range():
    excess, predicted = np.array([4.0, 1.0, 0.0, 0.0]), np.array([[0.0], [1.0], [3.0], [5.0]])
    told = told_apart(excess, RANGES, np.zeros((1, 4)), predicted)
    assert told == pytest.approx(worth(9.0 - (1.0 + 1.0)))


def test_candidates_that_add_to_those_chosen_against_the_range_that_is_left_come_first():
    """Three ranges: the first candidate has ruled out the second range, and the third is still to be told."""
    piece, excess = np.arange(3)[:, None], np.zeros(3)
    predicted = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 3.0]])
    fresh = told_apart(excess, piece, np.zeros((1, 3)), predicted)
    assert fresh == pytest.approx([worth(0.0), worth(0.0)])
    later = told_apart(excess, piece, np.array([[0.0, 25.0, 0.0]]), predicted)
    assert later == pytest.approx([worth(0.0), worth(9.0)])


def test_it_is_the_mean_over_draws_and_parameters_and_none_for_one_range():
    excess, predicted = np.zeros(4), np.array([[0.0], [1.0], [3.0], [4.0]])
    known = np.zeros((4, 4))
    each = [told_apart(excess, RANGES[order], np.zeros((1, 4)), predicted[order])[0] for order in turned(4)]
    both = np.hstack([RANGES, np.zeros_like(RANGES)])
    assert told_apart(excess, RANGES, known, predicted) == pytest.approx(np.mean(each))
    assert told_apart(excess, both, known, predicted) == pytest.approx(np.mean(each) / 2)
    assert told_apart(excess, both[:, 1:], known, predicted) == 0.0


def turned(count: int) -> list[np.ndarray]:
    """Orders of so many values, each leading in turn."""
    return [np.roll(np.arange(count), -k) for k in range(count)]


def test_parts_of_the_candidates_are_looked_at_alike(monkeypatch: pytest.MonkeyPatch):
    random = np.random.default_rng(2)
    excess, predicted = random.uniform(0, 4, 4), 3 * random.standard_normal((4, 7))
    known = random.uniform(0, 2, (4, 4))
    whole = told_apart(excess, RANGES, known, predicted)
    monkeypatch.setattr("calibray.prediction.mode_separation.BATCH", 32)
    assert told_apart(excess, RANGES, known, predicted) == pytest.approx(whole)
