"""Separation of ranges by candidates, against sums of squares that are minimized in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from calibray.prediction.experiment_design import EXCESS_DEVIATION, RULED_OUT, separation_probability

RANGES = np.repeat([0, 1], 2)[:, None]


def ruled_out(excess: float) -> float:
    """Probability of ruling out a range, given the excess of its least sum of squares over the true range."""
    return float(ndtr((excess - RULED_OUT) / EXCESS_DEVIATION))


def test_the_best_fit_in_the_other_range_counts():
    """A fit would find the value there that explains the candidate better."""
    excess, predicted = np.array([0.0, 1.0, 2.0, 1.5]), np.array([[0.0], [9.0], [3.0], [4.0]])
    probability = separation_probability(excess, RANGES, np.zeros((1, 4)), predicted)
    assert probability == pytest.approx(ruled_out(min(2.0 + 9.0, 1.5 + 16.0)))


def test_the_true_range_counts_by_its_best_fit():
    excess, predicted = np.array([4.0, 1.0, 0.0, 0.0]), np.array([[0.0], [1.0], [3.0], [5.0]])
    probability = separation_probability(excess, RANGES, np.zeros((1, 4)), predicted)
    assert probability == pytest.approx(ruled_out(9.0 - (1.0 + 1.0)))


def test_candidates_against_the_remaining_range_come_first():
    """Three ranges: the first candidate has ruled out the second range, and the third remains."""
    piece, excess = np.arange(3)[:, None], np.zeros(3)
    predicted = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 3.0]])
    before = separation_probability(excess, piece, np.zeros((1, 3)), predicted)
    assert before == pytest.approx([ruled_out(0.0), ruled_out(0.0)])
    after = separation_probability(excess, piece, np.array([[0.0, 25.0, 0.0]]), predicted)
    assert after == pytest.approx([ruled_out(0.0), ruled_out(9.0)])


def test_the_probability_is_a_mean_over_draws_and_parameters_and_0_for_one_range():
    excess, predicted = np.zeros(4), np.array([[0.0], [1.0], [3.0], [4.0]])
    squares = np.zeros((4, 4))
    by_draw = [
        separation_probability(excess, RANGES[order], np.zeros((1, 4)), predicted[order])[0]
        for order in rotations(4)
    ]
    both = np.hstack([RANGES, np.zeros_like(RANGES)])
    assert separation_probability(excess, RANGES, squares, predicted) == pytest.approx(np.mean(by_draw))
    assert separation_probability(excess, both, squares, predicted) == pytest.approx(np.mean(by_draw) / 2)
    assert separation_probability(excess, both[:, 1:], squares, predicted) == 0.0


def rotations(count: int) -> list[np.ndarray]:
    """Rotations of a number of values, each first in turn."""
    return [np.roll(np.arange(count), -k) for k in range(count)]


def test_batches_of_candidates_give_the_same(monkeypatch: pytest.MonkeyPatch):
    random = np.random.default_rng(2)
    excess, predicted = random.uniform(0, 4, 4), 3 * random.standard_normal((4, 7))
    squares = random.uniform(0, 2, (4, 4))
    whole = separation_probability(excess, RANGES, squares, predicted)
    monkeypatch.setattr("calibray.prediction.experiment_design.BATCH", 32)
    assert separation_probability(excess, RANGES, squares, predicted) == pytest.approx(whole)
