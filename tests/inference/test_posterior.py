"""Draws against the posterior of a linear model, between basins, and within bounds."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.inference.posterior import draws


def linear(count=40, noise=1.0, seed=1):
    """A linear model's mean square of residuals, its least squares and their covariance."""
    random = np.random.default_rng(seed)
    design = random.normal(size=(count, 2)) @ np.array([[1.0, 0.6], [0.0, 0.3]])
    measured = design @ [4.0, 5.0] + noise * random.normal(size=count)
    best = np.linalg.lstsq(design, measured, rcond=None)[0]
    left = design @ best - measured
    covariance = np.linalg.inv(design.T @ design) * (left @ left) / (count - 2)
    return (lambda x: np.mean((x @ design.T - measured) ** 2, axis=1)), best, covariance


def test_draws_of_a_linear_model_have_its_mean_and_covariance():
    square, best, covariance = linear()
    found = draws(square, best[None], np.full(2, -50.0), np.full(2, 50.0), 40, count=2000, steps=80)
    errors = np.sqrt(np.diag(covariance))
    assert found.mean(axis=0) == pytest.approx(best, abs=0.15 * errors.min())
    # A flat prior and an unknown size of the noise make Student's t with n - 2 degrees of freedom.
    assert np.cov(found.T) == pytest.approx(covariance * 38 / 36, rel=0.15)


def test_a_wrong_number_of_links_makes_them_too_narrow():
    square, best, covariance = linear()
    found = draws(square, best[None], np.full(2, -50.0), np.full(2, 50.0), 160, count=2000, steps=80)
    assert (np.diag(np.cov(found.T)) < 0.4 * np.diag(covariance)).all()


def test_two_basins_that_fit_alike_are_both_drawn_from():
    def square(x):
        return 1.0 + 3.0 * ((x[:, 0] - 5.0) ** 2 - 9.0) ** 2

    found = draws(square, np.array([[2.0], [8.0]]), np.zeros(1), np.full(1, 10.0), 30, count=400)
    low = found[:, 0] < 5
    assert 0.35 < low.mean() < 0.65
    assert found[low].mean() == pytest.approx(2.0, abs=0.05)
    assert found[~low].mean() == pytest.approx(8.0, abs=0.05)


def test_what_the_data_cannot_tell_spreads_over_its_bounds():
    found = draws(
        lambda x: 1.0 + (x[:, 0] - 1.0) ** 2,
        np.array([[1.0, 0.2]]),
        np.zeros(2),
        np.ones(2),
        50,
        count=800,
        steps=100,
    )
    assert ((found >= 0) & (found <= 1)).all()
    assert found[:, 1].std() == pytest.approx(1 / np.sqrt(12), rel=0.1)
    assert found[:, 0].mean() > 0.8
