"""SGWO-IM with a cheap model for a screen."""

import numpy as np
import pytest

from calibray.optimizers import SGWOIM, ScreenedSGWOIM, make
from calibray.optimizers.multifidelity.cheap_model import Differenced, value_of
from problem_families import landscapes


def run(screen, seed, budget=60):
    land = landscapes.hall()
    land.run(optimizer := ScreenedSGWOIM(land.lower, land.upper, seed=seed, screen=screen, budget=budget))
    return optimizer.best.y - land.minimum


@pytest.mark.parametrize("budget", [24, 30, 60, 225, 600])
def test_it_keeps_to_its_budget(budget):
    optimizer = make("sgwo-im-screened", np.zeros(3), np.ones(3), budget=budget)
    asked = 0
    while not optimizer.done:
        x = optimizer.ask()
        asked += len(x)
        optimizer.tell(x, np.sum(x**2, axis=1))
    assert asked == optimizer.budget == budget


def test_a_cheap_model_helps_and_one_that_is_noise_is_corrected():
    land = landscapes.hall()
    noise = np.random.default_rng(0)
    good = [run(lambda x: land.value(x) + 0.02 * x[:, 0], seed) for seed in range(6)]
    none = [run(None, seed) for seed in range(6)]
    bad = [run(lambda x: noise.normal(size=len(x)), seed) for seed in range(6)]
    plain = []
    for seed in range(6):
        land.run(optimizer := SGWOIM(land.lower, land.upper, seed=seed, **SGWOIM.within(60)))
        plain.append(optimizer.best.y - land.minimum)
    assert np.median(good) < 0.7 * np.median(none)
    assert np.median(good) < 0.7 * np.median(plain)
    assert np.median(bad) > np.median(good)
    assert np.isfinite(bad).all()


def test_the_first_pack_is_that_of_the_paper():
    paper, screened = SGWOIM([0.0] * 2, [1.0] * 2, seed=3), ScreenedSGWOIM([0.0] * 2, [1.0] * 2, seed=3)
    assert np.array_equal(paper.ask(), screened.ask())


def test_a_cheap_model_chooses_the_first_wolves():
    optimizer = ScreenedSGWOIM([0.0] * 2, [1.0] * 2, seed=3, screen=lambda x: np.sum((x - 0.3) ** 2, axis=1))
    first = optimizer.ask()
    assert first.shape == (5, 2)
    assert np.abs(first - 0.3).max() < 0.15


def test_the_value_of_a_cheap_model_is_that_of_the_rows_it_knows():
    known = np.array([True, True, False])
    model = Differenced(
        lambda x, _: np.stack([x[:, 0], 2.0 * x[:, 0], 1e6 + x[:, 0]], axis=1), np.ones(1), known
    )
    assert value_of(model, np.array([[1.0], [3.0]])) == pytest.approx(np.sqrt(2.5) * np.array([1.0, 3.0]))
