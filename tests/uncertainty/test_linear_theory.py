"""Intervals against theory and simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t

from calibray.uncertainty.verdicts import linear_intervals


def linear_problem(noise: np.ndarray, offset: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares of y = D theta (+ c) + noise: optimum [d], residuals [m], Jacobian without c [m, d]."""
    design = np.random.default_rng(2).normal(size=(len(noise), 2)) @ np.array([[3.0, 1.0], [0.0, 0.4]]) + 1.0
    slope = design - design.mean(axis=0) if offset else design
    y = design @ TRUTH + noise - (noise.mean() + (design @ TRUTH).mean() if offset else 0.0)
    best, *_ = np.linalg.lstsq(slope, y, rcond=None)
    return best, slope @ best - y, slope


TRUTH = np.array([4.0, 5.0])
LOWER, UPPER = np.zeros(2), np.full(2, 10.0)


@pytest.mark.parametrize("offset", [False, True])
def test_intervals_of_a_linear_problem_are_the_textbook_ones(offset):
    best, residuals, slope = linear_problem(np.random.default_rng(1).normal(0, 0.5, 25), offset)
    found = linear_intervals(best, residuals, slope, LOWER, UPPER, 25 - 2 - int(offset))
    variance = residuals @ residuals / (25 - 2 - offset)
    errors = np.sqrt(np.diag(variance * np.linalg.inv(slope.T @ slope)))
    assert [interval.standard_error for interval in found] == pytest.approx(errors)
    reach = t.ppf(0.975, 25 - 2 - offset)
    assert [interval.upper for interval in found] == pytest.approx(best + reach * errors)
    assert [interval.lower for interval in found] == pytest.approx(best - reach * errors)


def coverage(noise: np.ndarray, factor: float = 1.0) -> np.ndarray:
    """Share of intervals, scaled by a factor, that cover the truth [d], over many campaigns [n, m]."""
    hits = np.zeros(2)
    for sample in noise:
        found = linear_intervals(*linear_problem(sample, True), LOWER, UPPER, len(sample) - 3)
        middle = np.array([(each.lower + each.upper) / 2 for each in found])
        half = np.array([(each.upper - each.lower) / 2 for each in found])
        hits += abs(middle - TRUTH) <= factor * half
    return hits / len(noise)


def test_intervals_cover_the_truth_95_times_in_100():
    # Few links, so that Student's t matters (1.96 would cover 89 %); the simulation's own error is 0.4 %.
    independent = np.random.default_rng(4).normal(0, 0.5, (4000, 9))
    assert coverage(independent) == pytest.approx(0.95, abs=0.01)
    assert (coverage(independent, factor=0.5) < 0.75).all()
    # Correlated errors make the true intervals wider, as the docstring says.
    shared = np.repeat(np.random.default_rng(4).normal(0, 0.5, (1000, 3)), 10, axis=1)
    order = np.argsort(np.random.default_rng(2).normal(size=(30, 2))[:, 0])
    assert coverage(shared[:, np.argsort(order)]).min() < 0.8


def verdicts(slope: np.ndarray, best: np.ndarray = TRUTH, noise: float = 0.5) -> list[str]:
    """Verdicts at an optimum, with residuals of a given size."""
    residuals = noise * np.where(np.arange(len(slope)) % 2, 1.0, -1.0)
    return [each.verdict for each in linear_intervals(best, residuals, slope, LOWER, UPPER, len(slope) - 2)]


def test_verdicts_follow_the_information_in_the_data():
    sharp = np.random.default_rng(3).normal(size=(40, 2))
    assert verdicts(sharp) == ["identified", "identified"]
    assert verdicts(sharp * [1.0, 0.01]) == ["identified", "not identifiable"]
    assert verdicts(sharp * [1.0, 0.0]) == ["identified", "not identifiable"]
    assert verdicts(sharp[:, [0, 0]]) == ["not identifiable", "not identifiable"]  # they trade off
    assert verdicts(sharp, np.array([0.0, 10.0])) == ["at bound", "at bound"]
    assert verdicts(sharp, noise=50.0) == ["not identifiable", "not identifiable"]


def test_intervals_end_at_the_bounds():
    sharp = np.random.default_rng(3).normal(size=(40, 2))
    found = linear_intervals(np.array([0.0, 9.9]), np.full(40, 0.5), sharp, LOWER, UPPER, 38)
    assert found[0].lower == 0.0 < found[0].upper
    assert found[1].upper == 10.0 > found[1].lower
    blind = linear_intervals(TRUTH, np.full(40, 0.5), sharp * [1.0, 0.0], LOWER, UPPER, 38)
    assert (blind[1].lower, blind[1].upper) == (0.0, 10.0)
