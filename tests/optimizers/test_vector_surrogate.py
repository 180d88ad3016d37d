"""The vector surrogate: it comes close to the minimum in few evaluations, and its steps are as documented."""

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.optimizers import LatinHypercube, VectorSurrogate
from calibray.optimizers.regression import fit
from calibray.optimizers.vector_surrogate import improvement, mean_square, predicted_minima
from problem_families.landscapes import street

STREET = street()


def excess(method, seed: int, **settings) -> float:
    """Excess of the best evaluation over the global minimum."""
    optimizer = method(STREET.lower, STREET.upper, seed=seed, **settings)
    return STREET.run(optimizer).best.y - STREET.minimum


@pytest.mark.parametrize("seed", [0, 1])
def test_sixty_evaluations_come_close_to_the_global_minimum(seed):
    modelled = excess(VectorSurrogate, seed, budget=60)
    assert modelled < 0.06  # dB; rounding changes the course of a run
    assert modelled < 0.5 * excess(LatinHypercube, seed, budget=60)


def test_batches_of_four_come_close_too():
    assert excess(VectorSurrogate, 0, budget=48, batch=4) < 0.1


def bent(dimension: int, optimizer: VectorSurrogate, noise: float = 0.0) -> VectorSurrogate:
    """Minimise residuals that vanish at a planted point, bent by neighbouring parameters."""
    rng = np.random.default_rng(9)
    while not optimizer.done:
        x = optimizer.ask()
        away = x - np.linspace(0.2, 0.8, dimension)
        r = np.hstack([away + 0.5 * np.roll(away, 1, axis=1) ** 2, np.sin(away)])
        r = r + noise * rng.standard_normal(r.shape)
        optimizer.tell(x, np.sqrt(np.mean(r**2, axis=1)), r)
    return optimizer


@pytest.mark.parametrize("dimension", [1, 12])
def test_dimensions(dimension):
    optimizer = VectorSurrogate(np.zeros(dimension), np.ones(dimension), budget=10 + 4 * dimension)
    assert bent(dimension, optimizer).best.x == pytest.approx(np.linspace(0.2, 0.8, dimension), abs=5e-3)


def test_budget_batches_and_initial_design():
    optimizer = VectorSurrogate(STREET.lower, STREET.upper, budget=21, initial=10, batch=4)
    sizes = []
    while not optimizer.done:
        x = optimizer.ask()
        assert len(np.unique(x, axis=0)) == len(x)
        sizes.append(len(x))
        optimizer.tell(x, *STREET.evaluate(x)[:2])
    assert sizes == [10, 4, 4, 3]
    assert VectorSurrogate(STREET.lower, STREET.upper).budget == 60


def test_earlier_points_count_as_initial_design():
    x = np.random.default_rng(0).uniform(STREET.lower, STREET.upper, (20, 3))
    warm = VectorSurrogate(STREET.lower, STREET.upper, budget=10)
    warm.tell(x, *STREET.evaluate(x)[:2])
    assert len(warm.ask()) == 1
    partly = VectorSurrogate(STREET.lower, STREET.upper)
    partly.tell(x[:3], *STREET.evaluate(x[:3])[:2])
    assert len(partly.ask()) == 5
    clumped = VectorSurrogate(STREET.lower, STREET.upper)
    near = x[0] + 0.01 * (x[:3] - x[0])
    clumped.tell(near, *STREET.evaluate(near)[:2])
    assert len(clumped.ask()) == 7  # clumped points count as one
    flat = VectorSurrogate(STREET.lower, STREET.upper, budget=12)
    x[:, 1] = 4.0  # these points do not vary the second parameter
    flat.tell(x, *STREET.evaluate(x)[:2])
    assert STREET.run(flat).evaluations == 32


def test_a_box_without_a_point_far_from_all_evaluated_ones_is_searched_on(monkeypatch):
    """In one parameter, some hundred evaluations leave no gap of the smallest separation."""
    monkeypatch.setattr("calibray.optimizers.vector_surrogate.SEPARATION", 0.02)
    optimizer = bent(1, VectorSurrogate([0.0], [1.0], budget=60))
    assert optimizer.evaluations == 60


def test_the_default_budget_is_used_up():
    optimizer = bent(5, VectorSurrogate(np.zeros(5), np.ones(5)))
    assert optimizer.best.y < 0.01
    assert optimizer.evaluations == 100


def test_a_noisy_engine_is_smoothed():
    """The best noisy value is partly luck, so the point is compared with the planted one."""
    optimizer = bent(3, VectorSurrogate(np.zeros(3), np.ones(3), noisy=True, seed=2, budget=40), noise=0.02)
    assert optimizer.best.x == pytest.approx(np.linspace(0.2, 0.8, 3), abs=0.03)


def test_moments_of_the_mean_square_against_monte_carlo():
    rng = np.random.default_rng(3)
    points = rng.random((12, 2))
    residuals = np.stack([np.sin(3.0 * points @ [1.0, k]) for k in np.linspace(-1.0, 1.0, 30)], axis=1)
    model = fit(points, residuals)
    x = np.vstack([rng.random((5, 2)), [[1.5, -0.5]]])
    mean, share = model.predict(x)
    errors = rng.standard_normal((20_000, 1, len(model.root))) @ model.root * np.sqrt(share[:, None])
    sampled = np.mean((mean + errors) ** 2, axis=-1)
    centre, spread = mean_square(model, x)
    assert centre == pytest.approx(sampled.mean(axis=0), rel=0.03)
    assert spread == pytest.approx(sampled.std(axis=0), rel=0.05)


def test_expected_improvement_of_one_residual_equals_its_integral():
    points = np.random.default_rng(3).random((12, 2))
    model = fit(points, np.sin(3.0 * points.sum(axis=1, keepdims=True)))
    x = np.array([[0.5, 0.5], [0.1, 0.9], [1.6, 1.2], [-1.0, -1.0]])
    mean, share = model.predict(x)
    best = 0.4
    expected = []
    for centre, spread in zip(mean[:, 0], np.sqrt(share * model.variance[0]), strict=True):
        r = np.linspace(-best, best, 20_001)
        density = np.exp(-0.5 * ((r - centre) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
        expected.append(np.trapezoid((best**2 - r**2) * density, r))
    normal = np.random.default_rng(4).standard_normal((200_000, len(model.root)))
    assert improvement(mean, share, normal @ model.root, best) == pytest.approx(expected, rel=0.03, abs=1e-6)
    assert max(expected) > 0.02


def test_expected_improvement_is_zero_at_evaluated_points():
    points = np.random.default_rng(3).random((12, 2))
    model = fit(points, np.sin(3.0 * points))
    y = np.sqrt(np.mean(model.residuals**2, axis=1))
    normal = np.random.default_rng(4).standard_normal((256, len(model.root)))
    mean, share = model.predict(points)
    assert improvement(mean, share, normal @ model.root, 0.99 * y.min()) == pytest.approx(
        np.zeros(12), abs=1e-4
    )


def test_predicted_minima_are_minima_of_the_model():
    rng = np.random.default_rng(3)
    points = rng.random((20, 2))
    model = fit(points, np.stack([np.sin(6.0 * points[:, 0]) - 0.5, points[:, 1] - 0.3], axis=1))
    minima = predicted_minima(model, rng.random((16, 2)))
    values = np.mean(model.predict(minima)[0] ** 2, axis=1)
    assert (np.diff(values) >= 0.0).all()
    around = np.clip(minima[:1] + 1e-3 * rng.standard_normal((200, 2)), 0.0, 1.0)
    assert (np.mean(model.predict(around)[0] ** 2, axis=1) >= values[0]).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"initial": 4}, r"initial = 4; it must be a whole number >= 5"),
        ({"batch": 0}, r"batch = 0"),
        ({"budget": 0}, r"budget = 0"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        VectorSurrogate(STREET.lower, STREET.upper, **settings)
