"""Profiles against textbook intervals, brute force, planted second minima and simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t

from calibray.errors import InputError
from calibray.inference.profile import Evaluate, profiles, threshold_square
from calibray.inference.verdicts import verdicts
from calibray.optimizers import LeastSquares, landscapes

LOWER, UPPER = np.zeros(2), np.full(2, 10.0)
NAMES = ("walls.relative_permittivity", "glass.relative_permittivity")


def linear(design: np.ndarray, measured: np.ndarray) -> Evaluate:
    """A linear model."""

    def evaluate(x):
        residuals = x @ design.T - measured
        return np.sqrt(np.mean(residuals**2, axis=1)), residuals, np.tile(design, (len(x), 1, 1))

    return evaluate


def optimum(design: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Its least squares within the bounds, unless they are active."""
    return np.linalg.lstsq(design, measured, rcond=None)[0][None]


def test_intervals_of_a_linear_model_are_the_textbook_ones():
    rng = np.random.default_rng(1)
    design = rng.normal(size=(25, 2)) @ np.array([[3.0, 1.0], [0.0, 0.4]])
    measured = design @ [4.0, 5.0] + rng.normal(0, 1.0, 25)
    best = optimum(design, measured)
    left = design @ best[0] - measured
    errors = np.sqrt(left @ left / 23 * np.diag(np.linalg.inv(design.T @ design)))
    reach = t.ppf(0.975, 23) * errors
    threshold = threshold_square(np.mean(left**2), 23)
    for curve in profiles(linear(design, measured), LOWER, UPPER, best, 23):
        k = curve.index
        ((low, high),) = curve.pieces(threshold)
        assert (low, high) == pytest.approx((best[0, k] - reach[k], best[0, k] + reach[k]), rel=1e-6)
        assert (np.diff(curve.value) > 0).all()
        assert curve.point[:, k] == pytest.approx(curve.value)


def waves(truth: float, count: int = 30, noise: float = 0.0) -> Evaluate:
    """A model that takes nearly the same values at x and 10 - x, and depends on y as usual."""
    rng = np.random.default_rng(2)
    even, odd, slope = rng.uniform(0.5, 2, count), 0.01 * rng.normal(size=count), rng.normal(size=count)

    def model(x):
        away = x[:, :1] - 5.0
        return even * away**2 + odd * away + slope * x[:, 1:]

    measured = model(np.array([[truth, 4.0]]))[0] + noise * rng.normal(size=count)

    def evaluate(x):
        residuals = model(x) - measured
        first = 2 * even * (x[:, :1] - 5.0) + odd
        jacobian = np.stack([first, np.broadcast_to(slope, residuals.shape)], axis=2)
        return np.sqrt(np.mean(residuals**2, axis=1)), residuals, jacobian

    return evaluate


def minima(evaluate: Evaluate, starts: int = 24) -> np.ndarray:
    """Local minima by least squares from many starts, distinct."""
    rng, found = np.random.default_rng(0), []
    for _ in range(starts):
        search = LeastSquares(LOWER, UPPER, starts=1, x0=rng.uniform(LOWER, UPPER))
        while not search.done:
            x = search.ask()
            value, residuals, jacobian = evaluate(x)
            search.tell(x, value, residuals=residuals, jacobian=jacobian)
        if all(np.abs(search.best.x - other).max() > 1e-3 for other in found):
            found.append(search.best.x)
    return np.array(found)


def test_a_second_basin_that_fits_is_reported_as_a_piece_of_its_own():
    evaluate = waves(8.0, noise=1.0)
    curves = profiles(evaluate, LOWER, UPPER, minima(evaluate), 28)
    first, second = verdicts(curves, evaluate, NAMES, LOWER, UPPER, 28)
    assert first.name == "ambiguous"
    assert len(first.pieces) == 2
    assert first.pieces[0][0] < 2.0 < first.pieces[0][1] < 5 < first.pieces[1][0] < 8.0 < first.pieces[1][1]
    assert "2 separate ranges fit at 95%" in first.reason
    assert (first.lower, first.upper) == (first.pieces[0][0], first.pieces[1][1])
    assert second.name == "identified"
    assert second.lower < 4.0 < second.upper
    # The minimum that a search gave up is what makes the difference.
    alone = profiles(evaluate, LOWER, UPPER, np.array([[first.best, second.best]]), 28, values=3)
    narrow = verdicts(alone, evaluate, NAMES, LOWER, UPPER, 28)[0]
    assert len(narrow.pieces) == 1


def test_the_profile_is_that_of_brute_force():
    land, rng = landscapes.tones(), np.random.default_rng(3)
    runs = [land.run(LeastSquares(land.lower, land.upper, starts=1, seed=seed)) for seed in range(24)]
    known = np.array([run.best.x for run in runs])
    for curve in profiles(land.evaluate, land.lower, land.upper, known, 27, values=9):
        for at in rng.choice(len(curve.value), 4, replace=False):
            others = rng.uniform(land.lower, land.upper, (20_000, 3))
            others[:, curve.index] = curve.value[at]
            assert curve.square[at] <= land.value(others).min() ** 2 + 1e-6
            assert land.value(curve.point[at][None])[0] ** 2 == pytest.approx(curve.square[at], rel=1e-6)


def test_a_lower_minimum_than_those_given_is_found_out():
    evaluate = waves(8.0)
    curves = profiles(evaluate, LOWER, UPPER, np.array([[2.0, 4.0]]), 28)
    assert curves[0].square.min() < 1e-6 < evaluate(np.array([[2.0, 4.0]]))[0][0] ** 2
    assert verdicts(curves, evaluate, NAMES, LOWER, UPPER, 28)[0].best == pytest.approx(8.0, abs=0.01)


def verdict_names(design: np.ndarray, truth: list[float], noise: float = 1.0) -> list:
    """Verdicts on a linear model, its optimum searched for within the bounds."""
    measured = design @ np.array(truth) + noise * np.random.default_rng(9).normal(size=len(design))
    evaluate = linear(design, measured)
    curves = profiles(evaluate, LOWER, UPPER, minima(evaluate, 2), len(design) - 2)
    return verdicts(curves, evaluate, NAMES, LOWER, UPPER, len(design) - 2)


def test_verdicts_tell_what_the_data_can_and_why():
    sharp = np.random.default_rng(3).normal(size=(40, 2))
    both = verdict_names(sharp, [4.0, 5.0])
    assert [each.name for each in both] == ["identified", "identified"]
    assert "of the range" in both[0].reason
    assert verdict_names(sharp * [1.0, 0.2], [4.0, 5.0])[1].name == "weakly identified"
    blind = verdict_names(sharp * [1.0, 0.01], [4.0, 5.0])
    assert [each.name for each in blind] == ["identified", "not identifiable"]
    assert blind[1].pieces == ((0.0, 10.0),)
    assert blind[1].reason.startswith("no link's path loss changes by more than 0.")
    alike = verdict_names(sharp[:, [0, 0]] + 0.01 * sharp, [4.0, 5.0])
    assert [each.name for each in alike] == ["not identifiable", "not identifiable"]
    assert alike[0].reason.startswith("glass.relative_permittivity makes up for it")
    ends = verdict_names(sharp, [0.0, 10.0])
    assert [each.name for each in ends] == ["at bound", "at bound"]
    assert ends[0].reason.startswith(
        "the interval ends at the lower bound: the data say only that it lies below"
    )
    assert (ends[0].lower, ends[1].upper) == (0.0, 10.0)
    noisy = verdict_names(sharp, [4.0, 5.0], noise=60.0)
    assert noisy[1].name == "not identifiable"


def test_the_intervals_cover_the_truth_95_times_in_100():
    rng, hits, half = np.random.default_rng(6), np.zeros(2), 0
    design, count = rng.normal(size=(9, 2)), 400
    for _ in range(count):
        truth = np.array([4.0, 5.0])
        measured = design @ truth + rng.normal(0, 0.7, 9)
        evaluate = linear(design, measured)
        curves = profiles(evaluate, LOWER, UPPER, optimum(design, measured), 7, values=3)
        found = verdicts(curves, evaluate, NAMES, LOWER, UPPER, 7)
        hits += [each.lower <= value <= each.upper for each, value in zip(found, truth, strict=True)]
        # The check of the check: intervals for noise understated by two miss much more often.
        small = threshold_square(min(curve.square.min() for curve in curves) / 4, 7)
        half += any(low <= 4.0 <= high for low, high in curves[0].pieces(small))
    assert hits / count == pytest.approx(0.95, abs=0.03)
    assert half / count < 0.8


def test_progress_is_told_and_minima_that_fail_are_refused():
    told = []
    evaluate = waves(8.0, noise=1.0)
    profiles(evaluate, LOWER, UPPER, minima(evaluate), 28, progress=lambda *parts: told.append(parts))
    assert told == [("profiling", 1, 2), ("profiling", 2, 2)]

    def failing(x):
        return np.full(len(x), np.inf), np.full((len(x), 5), np.inf), np.zeros((len(x), 5, 2))

    with pytest.raises(InputError, match="none of the minima could be evaluated"):
        profiles(failing, LOWER, UPPER, np.array([[2.0, 4.0]]), 3)
