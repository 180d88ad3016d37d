"""The model of a vector against generalized least squares, finite differences and refits."""

import numpy as np
import pytest

from calibray.optimizers.multifidelity.kriging import Kriging, Likelihood, fit, matern, matern_slope, solve

RNG = np.random.default_rng(1)
POINTS = RNG.random((25, 3))
QUERY = np.random.default_rng(2).random((7, 3))


def truth(x: np.ndarray) -> np.ndarray:
    """Four residuals; the third coordinate has no influence."""
    waves = [np.sin(5.0 * x[:, 0]), np.cos(4.0 * x[:, 1]), x[:, 0] * x[:, 1], np.exp(x[:, 0] - x[:, 1])]
    return np.stack(waves, axis=1)


@pytest.fixture(scope="module")
def model() -> Kriging:
    return fit(POINTS, truth(POINTS))


def test_interpolates_what_it_was_given(model):
    mean, share = model.predict(POINTS)
    assert mean == pytest.approx(truth(POINTS), abs=1e-3)
    assert share.max() < 1e-6


def test_predicts_points_it_has_not_seen(model):
    mean, share = model.predict(QUERY)
    error = mean - truth(QUERY)
    assert np.abs(error).max() < 0.1
    scatter = error / np.sqrt(share[:, None] * model.variance)
    assert 0.2 < np.sqrt(np.mean(scatter**2)) < 3.0  # the variance it states is of the right size


def test_mean_and_variance_are_those_of_generalized_least_squares(model):
    """The textbook formulas of universal kriging (Rasmussen and Williams 2006, eqs. 2.41, 2.42)."""
    rates, nugget = np.exp(model.hyper[:3]), np.exp(model.hyper[3])

    def kernel(a, b):
        return matern(np.linalg.norm((a[:, None] - b[None]) * rates, axis=-1))

    def trend(x):
        return np.column_stack([np.ones(len(x)), x])

    inner, cross = kernel(POINTS, POINTS) + nugget * np.eye(25), kernel(QUERY, POINTS)
    invert = np.linalg.solve
    normal = trend(POINTS).T @ invert(inner, trend(POINTS))
    beta = invert(normal, trend(POINTS).T @ invert(inner, truth(POINTS)))
    mean = trend(QUERY) @ beta + cross @ invert(inner, truth(POINTS) - trend(POINTS) @ beta)
    gap = trend(QUERY) - cross @ invert(inner, trend(POINTS))
    share = 1.0 - np.sum(cross * invert(inner, cross.T).T, 1) + np.sum(gap * invert(normal, gap.T).T, 1)
    assert model.predict(QUERY)[0] == pytest.approx(mean, abs=1e-6)
    assert model.predict(QUERY)[1] == pytest.approx(share, abs=1e-6)


def test_linear_residuals_are_reproduced_everywhere():
    def plane(x):
        return np.stack([1.0 + x @ [2.0, -3.0, 0.5], x @ [0.0, 1.0, 4.0]], axis=1)

    far = 3.0 * QUERY - 1.0
    assert fit(POINTS, plane(POINTS)).predict(far)[0] == pytest.approx(plane(far), abs=1e-5)


def test_slope_equals_finite_differences(model):
    mean, slope = model.mean_and_slope(QUERY)
    assert mean == pytest.approx(model.predict(QUERY)[0], abs=1e-9)
    for column, step in enumerate(1e-6 * np.eye(3)):
        difference = (model.predict(QUERY + step)[0] - model.predict(QUERY - step)[0]) / 2e-6
        assert slope[:, :, column] == pytest.approx(difference, abs=1e-4)


def test_kernel_slope_equals_finite_differences():
    r = np.array([0.1, 1.0, 3.0])
    assert matern_slope(r) * r == pytest.approx((matern(r + 1e-6) - matern(r - 1e-6)) / 2e-6, abs=1e-8)
    assert np.isfinite(matern_slope(np.zeros(1))).all()


def test_likelihood_derivatives_equal_finite_differences():
    likelihood = Likelihood(POINTS, truth(POINTS))
    hyper = np.array([1.0, 0.3, -0.5, -5.0])
    slope = likelihood(hyper)[1]
    for index, step in enumerate(1e-5 * np.eye(4)):
        difference = (likelihood(hyper + step)[0] - likelihood(hyper - step)[0]) / 2e-5
        assert slope[index] == pytest.approx(difference, rel=1e-5)


def test_learns_which_parameter_has_no_influence(model):
    lengths = np.exp(-model.hyper[:3])
    assert lengths[2] > 5.0 * lengths[:2].max()


def test_left_out_equals_a_model_without_the_point(model):
    left_out = model.left_out()
    for row in (0, 7, 24):
        keep = np.arange(25) != row
        reduced = solve(POINTS[keep], truth(POINTS[keep]), model.hyper)
        assert left_out[row] == pytest.approx(reduced.predict(POINTS[row : row + 1])[0][0], abs=1e-5)


def test_a_pretended_point_changes_certainty_and_nothing_else(model):
    pretended = model.with_point(QUERY[0])
    assert pretended.predict(QUERY)[0] == pytest.approx(model.predict(QUERY)[0], abs=1e-6)
    before, after = model.predict(QUERY)[1], pretended.predict(QUERY)[1]
    assert after[0] < 1e-6
    assert (after <= before + 1e-9).all()
    assert np.array_equal(pretended.root, model.root)


def test_noise_is_learned_and_smoothed():
    rng = np.random.default_rng(4)
    points = rng.random((60, 2))
    clean = truth(points)
    noisy = clean + 0.1 * rng.standard_normal(clean.shape)
    smooth, exact = fit(points, noisy, noisy=True), fit(points, noisy)
    noise = np.sqrt(np.exp(smooth.hyper[-1]) * smooth.variance)
    assert np.median(noise) == pytest.approx(0.1, rel=0.5)
    error = [np.sqrt(np.mean((m.predict(points)[0] - clean) ** 2)) for m in (smooth, exact)]
    assert error[0] < 0.7 * error[1]


def test_constant_residuals_do_no_harm():
    """A link in line of sight does not depend on the materials at all."""
    residuals = np.column_stack([truth(POINTS), np.full(25, 3.0)])
    mean, _ = fit(POINTS, residuals).predict(QUERY)
    assert mean[:, 4] == pytest.approx(np.full(7, 3.0), abs=1e-6)
    assert np.isfinite(fit(POINTS, np.full((25, 2), 3.0)).predict(QUERY)[0]).all()
