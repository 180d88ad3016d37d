"""Likelihood of censored links: fits are unbiased."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.uncertainty.laplace import joint, log_evidence, log_survival
from calibray.uncertainty.noise_models import GAUSSIAN, HEAVY, Marginal, NoiseModel, noise_models

SLOPE, OFFSET_DB, SPREAD_DB, LIMIT_DB = 5.0, 80.0, 4.0, 105.0
WAY = np.tile(np.linspace(0.0, 10.0, 40), 3)
SLOPES = np.linspace(2.0, 8.0, 241)
GAUSS = NoiseModel(GAUSSIAN, 1.0)
STUDENT = NoiseModel(HEAVY, 1.0, freedom=4.0)


def test_the_integral_agrees_with_quadrature():
    random = np.random.default_rng(1)
    gap = 1.5 + 3.0 * random.standard_normal((1, 25))
    censored = gap[0] > 2.5
    gap = np.where(censored, 2.5, gap)
    design, ridge = np.ones((25, 1)), np.array([1 / 10.0])
    offsets, logs = np.meshgrid(np.linspace(-15, 25, 201), np.linspace(-1.5, 4.0, 141), indexing="ij")
    scale, prior = np.exp(logs), np.exp(-0.5 * (ridge * offsets) ** 2) * ridge / np.sqrt(2 * np.pi)
    for freedom in (np.inf, 4.0):
        log_density = np.zeros_like(offsets)
        for value, missing in zip(gap[0], censored, strict=True):
            error = (value - offsets) / scale
            if missing:
                log_density += log_survival(error, freedom)
            else:
                # The density is what the survival loses over a short way.
                step = 1e-4
                lost = np.exp(log_survival(error - step, freedom)) - np.exp(
                    log_survival(error + step, freedom)
                )
                log_density += np.log(np.maximum(lost / (2 * step), 1e-200)) - logs
        area = (40 / 200) * (5.5 / 140)
        exact = np.log(np.sum(np.exp(log_density) * prior) * area)
        assert log_evidence(gap, censored, design, ridge, freedom)[0] == pytest.approx(exact, abs=0.1)


@pytest.mark.parametrize("freedom", [np.inf, 2.0, 4.0])
def test_derivatives_agree_with_finite_differences(freedom):
    random = np.random.default_rng(2)
    censored = np.arange(30) % 3 == 0
    left, columns = 3 * random.standard_normal((4, 30)), random.standard_normal((30, 2))
    point = np.column_stack([random.standard_normal((4, 2)), random.uniform(0.5, 1.5, 4)])
    given = left, censored, columns, np.array([0.3, 0.0]), freedom
    _, slope, curvature = joint(point, *given)
    for k in range(3):
        step = 1e-5 * np.eye(3)[k]
        (above, up, _), (below, down, _) = joint(point + step, *given), joint(point - step, *given)
        assert slope[:, k] == pytest.approx((above - below) / 2e-5, rel=1e-6, abs=1e-6)
        assert curvature[:, k] == pytest.approx((down - up) / 2e-5, rel=1e-5, abs=1e-5)


def test_without_censored_links_the_density_is_the_usual_one():
    random = np.random.default_rng(3)
    gap, way = 3 * random.standard_normal((3, 60)), random.standard_normal(60)
    design, ridge = np.column_stack([np.ones(60), way]), np.zeros(2)
    models = (GAUSS, STUDENT)
    known = Marginal.of(design, ridge, np.ones(60), np.zeros((60, 3)), 3.0, models).densities(gap)
    heard = np.zeros(60, dtype=bool)
    for column, model in enumerate(models):
        found = log_evidence(gap, heard, design, ridge, model.freedom)
        assert found == pytest.approx(known[:, column], abs=0.2)


@pytest.mark.parametrize("model", [GAUSS, STUDENT])
def test_half_of_the_links_censored_cause_no_bias(model):
    """Path loss rises along a route; from the middle on it is mostly below the noise floor."""
    told: dict[str, list[float]] = {"censored": [], "left out": [], "at the floor": []}
    for seed in range(25):
        random = np.random.default_rng([seed, 7])
        noise = (
            random.standard_t(4, len(WAY)) / np.sqrt(2)
            if model is STUDENT
            else random.standard_normal(len(WAY))
        )
        loss = OFFSET_DB + SLOPE * WAY + SPREAD_DB * noise
        censored = loss >= LIMIT_DB
        assert 0.35 < censored.mean() < 0.65
        measured, every = np.where(censored, LIMIT_DB, loss), np.zeros(len(WAY), dtype=bool)
        told["censored"].append(likeliest(measured, WAY, censored, model))
        told["left out"].append(likeliest(loss[~censored], WAY[~censored], every[~censored], model))
        told["at the floor"].append(likeliest(measured, WAY, every, model))
    error = {name: np.std(values, ddof=1) / np.sqrt(25) for name, values in told.items()}
    assert abs(np.mean(told["censored"]) - SLOPE) < 3 * error["censored"]
    assert np.mean(told["left out"]) < SLOPE - 5 * error["left out"]
    assert np.mean(told["at the floor"]) < SLOPE - 5 * error["at the floor"]


def likeliest(measured: np.ndarray, way: np.ndarray, censored: np.ndarray, model: NoiseModel) -> float:
    """Slope of highest density, with offset and scale integrated out."""
    one = np.ones(len(way))
    marginal = Marginal.of(
        one[:, None], np.zeros(1), one, np.zeros((len(way), 3)), SPREAD_DB, [model], censored
    )
    found = marginal.densities(measured - SLOPES[:, None] * way)[:, 0]
    return float(SLOPES[np.argmax(found)])


def test_a_censored_link_without_a_path_agrees_with_the_model():
    gap = np.array(
        [[1.0, -2.0, 0.5, 3.0, -np.inf], [1.0, -2.0, 0.5, 3.0, -500.0], [1.0, -2.0, 0.5, -np.inf, -3.0]]
    )
    censored = np.array([False, False, False, False, True])
    models = noise_models(np.zeros((5, 3)), range_m=0.0)
    marginal = Marginal.of(np.ones((5, 1)), np.zeros(1), np.ones(5), np.zeros((5, 3)), 2.0, models, censored)
    found = marginal.densities(gap)
    assert found[0] == pytest.approx(found[1], abs=1e-4)
    assert (found[2] == -np.inf).all()
