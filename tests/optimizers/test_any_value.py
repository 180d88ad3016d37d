"""Minimizing a Student-t likelihood, whose minimum is far from that of the root mean square."""

import numpy as np
import pytest
from scipy.optimize import minimize

from calibray.errors import InputError
from calibray.optimizers import DFOLS, GWO, METHODS, LeastSquares, VectorSurrogate, make
from calibray.optimizers.evaluations import root_mean_square

LOWER, UPPER = np.array([0.0, -4.0]), np.array([6.0, 4.0])
LINKS, FREEDOM, SCALE = 40, 3.0, 0.2
TRUTH = np.array([2.2, 1.1])

_random = np.random.default_rng(4)
_RATE, _SLOPE = _random.uniform(0.4, 1.2, LINKS), _random.uniform(-1.0, 1.0, LINKS)
# Outliers in three of ten links move the minimum of a mean square, but hardly that of a Student-t likelihood.
_DATA = np.sin(_RATE * TRUTH[0]) * 2.0 + _SLOPE * TRUTH[1] + SCALE * _random.standard_normal(LINKS)
_DATA[:12] += 6.0
CONSTANT = -3.0 * LINKS  # an arbitrary constant; likelihoods with densities above 1 are negative


def errors(x):
    """Errors [n, m] and their derivatives [n, m, d]."""
    phase = x[:, :1] * _RATE
    slope = np.stack([2.0 * np.cos(phase) * _RATE, np.broadcast_to(_SLOPE, phase.shape)], axis=-1)
    return 2.0 * np.sin(phase) + x[:, 1:] * _SLOPE - _DATA, slope


def deviance_residuals(x):
    """Deviance residuals [n, m] of the Student-t distribution, and their derivatives [n, m, d]."""
    error, slope = errors(x)
    spread = FREEDOM * SCALE**2
    residuals = np.sign(error) * np.sqrt((FREEDOM + 1.0) * np.log1p(error**2 / spread))
    rate = (FREEDOM + 1.0) * error / (spread + error**2) / residuals
    return residuals, rate[:, :, None] * slope


def deviance(residuals):
    """Deviance residuals to the negative log-likelihood [n]."""
    return CONSTANT + 0.5 * np.sum(residuals**2, axis=1)


def likelihood(x):
    """The negative log-likelihood [n] by its formula."""
    spread = FREEDOM * SCALE**2
    return CONSTANT + 0.5 * (FREEDOM + 1.0) * np.sum(np.log1p(errors(x)[0] ** 2 / spread), axis=1)


def lowest(value):
    """The lowest point of a function on the box, by many searches of SciPy."""
    starts = np.random.default_rng(1).uniform(LOWER, UPPER, (40, 2))
    bounds = list(zip(LOWER, UPPER, strict=True))
    ends = [minimize(lambda x: value(x[None])[0], start, bounds=bounds, tol=1e-12) for start in starts]
    return min(ends, key=lambda end: end.fun).x


BEST = lowest(likelihood)


def minimise_likelihood(optimizer):
    while not optimizer.done:
        x = optimizer.ask()
        residuals, jacobian = deviance_residuals(x)
        optimizer.tell(x, likelihood(x), residuals, jacobian)
    return optimizer.best


def test_the_minima_of_likelihood_and_mean_square_differ():
    gaussian = lowest(lambda x: root_mean_square(errors(x)[0]))
    assert np.abs(BEST - TRUTH).max() < 0.05
    assert np.abs(gaussian - TRUTH).max() > 0.4
    assert likelihood(gaussian[None])[0] > likelihood(BEST[None])[0] + 20.0
    x = np.array([[1.0, 0.5]])
    residuals, jacobian = deviance_residuals(x)
    assert deviance(residuals) == pytest.approx(likelihood(x), rel=1e-12)
    for column, step in enumerate(1e-6 * np.eye(2)):
        difference = (deviance_residuals(x + step)[0] - deviance_residuals(x - step)[0]) / 2e-6
        assert jacobian[:, :, column] == pytest.approx(difference, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "excess"),
    [
        ("least-squares", 1e-8),
        ("vector-surrogate", 1e-3),
        ("space-mapping", 1e-3),
        ("dfo-ls", 1e-3),
        ("pounders", 1e-3),
        ("gauss-newton", 1e-2),
        ("gaussian-process", 0.1),
        ("cma-es", 0.1),
        ("differential-evolution", 1.0),
        ("sgwo-im", 1.0),
        ("gwo", 1.0),
        ("random", 20.0),
        ("latin-hypercube", 20.0),
        ("sobol", 20.0),
    ],
)
def test_every_method_minimises_a_likelihood(name, excess):
    budget = 40 if name in ("vector-surrogate", "space-mapping", "gaussian-process") else 225
    optimizer = make(name, LOWER, UPPER, seed=1, budget=budget, starts=32, objective=deviance)
    best = minimise_likelihood(optimizer)
    low = likelihood(BEST[None])[0]
    assert low - 1e-9 <= best.y <= low + excess
    assert best.y == likelihood(best.x[None])[0]
    if excess < 0.1:
        assert best.x == pytest.approx(BEST, abs=0.02)


def test_the_table_above_lists_every_method():
    marks = test_every_method_minimises_a_likelihood.pytestmark[0].args[1]
    assert {name for name, _ in marks} == set(METHODS)


@pytest.mark.parametrize("method", [LeastSquares, VectorSurrogate, DFOLS])
def test_a_value_that_disagrees_with_its_residuals_is_refused(method):
    x = np.array([[1.0, 0.5], [2.0, 1.0]])
    residuals, jacobian = deviance_residuals(x)
    with pytest.raises(InputError, match=r"y\[0\] = .*, but sqrt\(mean\(residuals\[0\]\*\*2\)\)"):
        method(LOWER, UPPER).tell(x, likelihood(x), residuals, jacobian)
    optimizer = method(LOWER, UPPER, objective=deviance)
    with pytest.raises(InputError, match=r"y\[1\] = .*, but objective\(residuals\[1\]\) = "):
        optimizer.tell(x, likelihood(x) + np.arange(2), residuals, jacobian)
    assert optimizer.evaluations == 0
    optimizer.tell(x, likelihood(x), residuals, jacobian)
    assert optimizer.evaluations == 2


@pytest.mark.parametrize("method", [LeastSquares, VectorSurrogate, DFOLS])
@pytest.mark.parametrize("together", [True, False])
def test_residuals_whose_mean_square_contradicts_the_value_are_refused(method, together):
    """Plain errors with a Student-t likelihood: the method would minimize another function."""

    def objective(residuals):
        return np.sum(np.log1p(residuals**2), axis=1)

    optimizer = method(LOWER, UPPER, objective=objective)
    x = np.array([[1.0, 0.0], [2.0, 0.0]])
    # Three errors of middle size are less likely than one outlier, and yet have the lower mean square.
    residuals = np.array([[1.2, 1.2, 1.2], [3.0, 0.0, 0.0]])
    evaluations = (x, objective(residuals), residuals, np.zeros((2, 3, 2)))
    if not together:
        optimizer.tell(*(part[:1] for part in evaluations))
        evaluations = tuple(part[1:] for part in evaluations)
    with pytest.raises(
        InputError, match="the mean square must increase with the value: pass deviance residuals"
    ):
        optimizer.tell(*evaluations)
    assert optimizer.evaluations == 1 - together


def test_a_method_of_the_value_alone_ignores_residuals():
    optimizer = GWO(LOWER, UPPER)
    optimizer.tell([[1.0, 0.0]], [-5.0], residuals=[[3.0, 4.0]])
    assert optimizer.best.y == -5.0


def test_a_failed_evaluation_needs_no_residuals():
    optimizer = LeastSquares(LOWER, UPPER, starts=8, objective=deviance)
    first = True
    while not optimizer.done:
        x = optimizer.ask()
        residuals, jacobian = deviance_residuals(x)
        y = likelihood(x)
        if first:
            y[0], residuals[0], jacobian[0] = np.inf, np.nan, np.nan
        first = False
        optimizer.tell(x, y, residuals, jacobian)
    assert optimizer.best.y == pytest.approx(likelihood(BEST[None])[0], abs=1e-8)
