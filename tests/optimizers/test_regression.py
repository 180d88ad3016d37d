"""Gaussian process regression against textbook formulas, finite differences and refits, with a trend and without."""

import numpy as np
import pytest
from scipy.stats import multivariate_t

from calibray.optimizers import regression
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.regression import (
    Inputs,
    Kernel,
    Kriging,
    Likelihood,
    fit,
    matern,
    matern_slope,
    solve,
)

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


def test_the_model_interpolates_its_data(model):
    mean, share = model.predict(POINTS)
    assert mean == pytest.approx(truth(POINTS), abs=1e-3)
    assert share.max() < 1e-6


def test_predictions_at_new_points_are_as_accurate_as_stated(model):
    mean, share = model.predict(QUERY)
    error = mean - truth(QUERY)
    assert np.abs(error).max() < 0.1
    standardized = error / np.sqrt(share[:, None] * model.variance)
    assert 0.2 < np.sqrt(np.mean(standardized**2)) < 3.0


def test_mean_and_variance_equal_generalized_least_squares(model):
    """The textbook formulas of universal kriging (Rasmussen and Williams 2006, eqs. 2.41, 2.42)."""
    rates, nugget = model.process.kernel.rates, model.process.kernel.nugget

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


def test_the_slope_equals_finite_differences(model):
    mean, slope = model.mean_and_slope(QUERY)
    assert mean == pytest.approx(model.predict(QUERY)[0], abs=1e-9)
    for column, step in enumerate(1e-6 * np.eye(3)):
        difference = (model.predict(QUERY + step)[0] - model.predict(QUERY - step)[0]) / 2e-6
        assert slope[:, :, column] == pytest.approx(difference, abs=1e-4)


def test_the_kernels_slope_equals_finite_differences():
    r = np.array([0.1, 1.0, 3.0])
    assert matern_slope(r) * r == pytest.approx((matern(r + 1e-6) - matern(r - 1e-6)) / 2e-6, abs=1e-8)
    assert np.isfinite(matern_slope(np.zeros(1))).all()


WITH_RESPONSE = Inputs(POINTS, np.random.default_rng(3).standard_normal((25, 2)))


@pytest.mark.parametrize(
    ("likelihood", "hyper"),
    [
        (regression.likelihood(POINTS, truth(POINTS)), [-np.inf, -np.inf, 0.0, 1.0, 0.3, -0.5, -5.0]),
        (Likelihood(WITH_RESPONSE, truth(POINTS), freedom=4.0), [0.3, -1.0, -0.5, 0.4, 0.9, 0.2, -3.0]),
    ],
    ids=["with a trend", "with a prior of the variances"],
)
def test_derivatives_of_the_likelihood_equal_finite_differences(likelihood, hyper):
    hyper = np.array(hyper)
    slope = likelihood(Kernel.of(hyper))[1]
    for index in np.flatnonzero(np.isfinite(hyper)):
        step = 1e-5 * np.eye(7)[index]
        after, before = (likelihood(Kernel.of(moved))[0] for moved in (hyper + step, hyper - step))
        if index == 2 and not np.isfinite(hyper[0]):
            continue  # the variance is profiled out, so its derivative is rounding
        assert slope[index] == pytest.approx((after - before) / 2e-5, rel=1e-4)


def test_a_kernel_is_restored_from_its_logarithms():
    hyper = np.array([-np.inf, -1.0, 0.5, 0.4, 0.9, -3.0])
    assert Kernel.of(hyper, 0.7).logarithms(0.7) == pytest.approx(hyper)


def test_a_parameter_without_influence_gets_a_long_length_scale(model):
    lengths = 1.0 / model.process.kernel.rates
    assert lengths[2] > 5.0 * lengths[:2].max()


def test_left_out_predictions_equal_a_model_without_the_point(model):
    left_out = model.residuals - model.process.left_out_errors()
    for row in (0, 7, 24):
        keep = np.arange(25) != row
        reduced = solve(POINTS[keep], truth(POINTS[keep]), model.process.kernel)
        assert left_out[row] == pytest.approx(reduced.predict(POINTS[row : row + 1])[0][0], abs=1e-5)


def test_a_point_added_as_predicted_changes_only_the_uncertainty(model):
    extended = model.with_point(QUERY[0])
    assert extended.predict(QUERY)[0] == pytest.approx(model.predict(QUERY)[0], abs=1e-6)
    before, after = model.predict(QUERY)[1], extended.predict(QUERY)[1]
    assert after[0] < 1e-6
    assert (after <= before + 1e-9).all()
    assert np.array_equal(extended.root, model.root)


def test_noise_is_learned_and_smoothed():
    rng = np.random.default_rng(4)
    points = rng.random((60, 2))
    clean = truth(points)
    noisy = clean + 0.1 * rng.standard_normal(clean.shape)
    smooth, exact = fit(points, noisy, noisy=True), fit(points, noisy)
    noise = np.sqrt(smooth.process.kernel.nugget * smooth.variance)
    assert np.median(noise) == pytest.approx(0.1, rel=0.5)
    error = [np.sqrt(np.mean((m.predict(points)[0] - clean) ** 2)) for m in (smooth, exact)]
    assert error[0] < 0.7 * error[1]


def test_constant_residuals_do_no_harm():
    """A link in line of sight does not depend on the materials."""
    residuals = np.column_stack([truth(POINTS), np.full(25, 3.0)])
    mean, _ = fit(POINTS, residuals).predict(QUERY)
    assert mean[:, 4] == pytest.approx(np.full(7, 3.0), abs=1e-6)
    assert np.isfinite(fit(POINTS, np.full((25, 2), 3.0)).predict(QUERY)[0]).all()


def test_a_discrepancy_follows_a_multivariate_t():
    rng = np.random.default_rng(4)
    inputs, values = Inputs(rng.random((6, 2)), rng.standard_normal((6, 3))), rng.standard_normal((6, 5))
    kernel = Kernel.of(np.array([0.3, -1.0, -0.5, 0.4, 0.9, -3.0]), 0.7)
    process = discrepancy.solve(inputs, values, kernel)
    samples = np.stack([process.whitened, 2.0 * process.whitened])
    student = multivariate_t(np.zeros(6), np.eye(6), df=discrepancy.FREEDOM)  # pyright: ignore[reportArgumentType]
    value, scale = discrepancy.scaled_density(samples)
    density = np.array(
        [student.logpdf(sample.T / np.sqrt(s)).sum() for sample, s in zip(samples, scale, strict=True)]
    )
    of_scale = 0.5 * values.size * np.log(scale) + 0.5 * (np.log(scale) / discrepancy.VARIANCE_SPREAD) ** 2
    assert np.diff(value - of_scale) == pytest.approx(-np.diff(density))


def test_left_out_errors_of_a_discrepancy_equal_a_process_without_the_point():
    rng = np.random.default_rng(4)
    inputs, values = Inputs(rng.random((6, 2)), rng.standard_normal((6, 3))), rng.standard_normal((6, 5))
    kernel = Kernel.of(np.array([0.3, -1.0, -0.5, 0.4, 0.9, -3.0]), 0.7)
    others = np.arange(6) != 2
    fewer = discrepancy.solve(Inputs(inputs.unit[others], inputs.response[others]), values[others], kernel)
    error = values[2] - fewer.predict(Inputs(inputs.unit[2:3], inputs.response[2:3]))[0][0]
    assert discrepancy.solve(inputs, values, kernel).left_out_errors()[2] == pytest.approx(error)
