"""Functions drawn from a fitted discrepancy."""

from dataclasses import replace

import numpy as np
import pytest

from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.discrepancy import sample_function, standardized_error
from calibray.optimizers.regression import Inputs, Process


def inputs(unit: np.ndarray) -> Inputs:
    """Points with the response of a plane."""
    return Inputs(unit, 2.0 * (unit - 0.5))


@pytest.fixture(scope="module")
def process() -> Process:
    """A process through six values of two residuals."""
    unit = np.random.default_rng(2).random((6, 2))
    values = np.stack([np.sin(4 * unit[:, 0]) + unit[:, 1], np.cos(3 * unit[:, 1])], axis=1)
    return discrepancy.fit(inputs(unit), values, 1.0)


def test_functions_pass_through_the_values_and_scatter_elsewhere_as_predicted(process):
    random, unit = np.random.default_rng(0), np.random.default_rng(1).random((40, 2))
    functions = [sample_function(process, random) for _ in range(200)]
    for function in functions[:5]:
        assert function.values(process.inputs) == pytest.approx(process.values, abs=2e-2)
    values = np.array([function.values(inputs(unit)) for function in functions])
    mean, share = process.predict(inputs(unit))
    expected = np.sqrt(np.outer(share, np.sum(process.root**2, axis=0)))
    ratio = np.sqrt(np.mean((values - mean) ** 2, axis=0)) / expected
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)
    assert np.quantile(ratio, (0.05, 0.95)) == pytest.approx([1.0, 1.0], abs=0.4)


def test_without_deviations_the_function_is_the_mean(process):
    unit = np.random.default_rng(1).random((40, 2))
    function = sample_function(process, np.random.default_rng(0), 0.0)
    assert function.values(inputs(unit)) == pytest.approx(process.mean(inputs(unit)), abs=1e-9)


def test_slopes_equal_finite_differences(process):
    function, unit = sample_function(process, np.random.default_rng(4)), np.array([[0.3, 0.6], [0.8, 0.1]])
    slopes = function.slopes(inputs(unit), np.broadcast_to(2.0 * np.eye(2), (2, 2, 2)))
    for k, move in enumerate(1e-6 * np.eye(2)):
        difference = function.values(inputs(unit + move)) - function.values(inputs(unit - move))
        assert slopes[:, :, k] == pytest.approx(difference / 2e-6, rel=1e-4, abs=1e-5)


def test_an_overconfident_process_has_a_large_standardized_error(process):
    points = np.arange(6)
    kernel = replace(process.kernel, variances=process.kernel.variances / 1e4)
    confident = discrepancy.solve(process.inputs, process.values, kernel)
    overconfident = replace(confident, whitened=confident.whitened * 0.1)
    assert standardized_error(overconfident, points) > 2.0 > standardized_error(process, points)
