"""Indirect inference of means over buildings, against closed forms and planted buildings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from calibray.result.wording import reason_text
from calibray.uncertainty.importance_sampling import Draws
from calibray.uncertainty.indirect_inference import (
    LinearModel,
    draw_spreads,
    estimate_response,
    implied_means,
    overconfidence,
)
from calibray.uncertainty.noise_models import DIFFERING, NoiseModel, noise_models
from calibray.uncertainty.verdicts import Axes, verdicts

COUNTS = np.array([30, 6, 3, 1])
"""Links dominated by each of four buildings."""

LINK_BUILDING = np.repeat(np.arange(4), COUNTS)
NONE = np.zeros((len(LINK_BUILDING), 0))
HALF = 0.5
"""The estimate with equal buildings, in the unit cube."""


def behind(own: np.ndarray, effect: np.ndarray | float = 1.0, design: np.ndarray = NONE, prior: float = 0.0):
    """Means [n] that imply the estimate `HALF` for deviations of the buildings [n, 4], with linear path loss."""
    effect = np.broadcast_to(effect, len(LINK_BUILDING))
    slope = np.broadcast_to(effect[:, None], (len(own), len(effect), 1))
    precision = np.full((len(own), 1 + design.shape[1]), 0.0)
    precision[:, 0] = prior

    def change(x, portion):
        return effect * (x - HALF + portion * own[:, LINK_BUILDING])

    return implied_means(
        LinearModel(np.full((len(own), 1), HALF), slope, design, precision), change, np.zeros((len(own), 1))
    )[:, 0]


def drawn(spread: float, count: int = 2000) -> np.ndarray:
    """Deviations of the buildings [n, 4]."""
    return spread * np.random.default_rng(4).standard_normal((count, 4))


def test_many_links_on_one_building_share_its_deviation():
    own, share = drawn(0.05), COUNTS / COUNTS.sum()
    assert behind(own) == pytest.approx(HALF - own @ share)


def test_implied_means_with_an_offset_reproduce_the_estimate():
    """Least squares with an offset, on data from the implied means, ends in the estimate."""
    own, effect = drawn(0.05, 50), np.random.default_rng(4).uniform(2.0, 20.0, len(LINK_BUILDING))
    found = behind(own, effect, np.ones((len(effect), 1)))
    design = np.column_stack([effect, np.ones(len(effect))])
    answers = effect * (found[:, None] + own[:, LINK_BUILDING])
    assert np.linalg.lstsq(design, answers.T, rcond=None)[0][0] == pytest.approx(HALF)
    assert np.abs(behind(own, effect) - found).max() > 0.01


def test_the_linear_response_is_that_of_least_squares():
    """With a fitted offset."""
    random, own, place = np.random.default_rng(4), drawn(0.15, 4000), np.arange(4)
    effect = random.uniform(2.0, 20.0, len(LINK_BUILDING))
    design = np.column_stack([effect, np.ones(len(effect))])
    estimate = np.linalg.lstsq(design, (effect * own[:, LINK_BUILDING]).T, rcond=None)[0][0]
    slope = ((LINK_BUILDING[:, None] == place) * effect[:, None])[None]
    found = estimate_response(slope, np.zeros(4, int), np.ones((len(effect), 1)), np.zeros(2))
    assert own @ found[0] == pytest.approx(estimate)
    assert found.sum() == pytest.approx(1.0)
    held = estimate_response(slope, np.zeros(4, int), np.ones((len(effect), 1)), np.array([1e9, 0.0]))
    assert np.abs(held).max() < 1e-3


def test_means_that_cannot_be_followed_are_the_linear_ones():
    """With a step of path loss at the estimate, no mean nearby implies the estimate."""
    leaning = LinearModel(np.full((1, 1), HALF), np.ones((1, 3, 1)), np.zeros((3, 0)), np.zeros((1, 1)))
    found = implied_means(leaning, lambda x, portion: np.full((1, 3), 4.0), np.full((1, 1), 0.6))
    assert found.tolist() == [[0.6]]


def test_a_narrow_prior_keeps_means_at_the_estimate():
    assert np.abs(behind(drawn(0.05), prior=1e6) - HALF).max() < 1e-4


def test_smeared_oscillation_does_not_bias_the_means():
    """A damped oscillation per building: fitted as one it looks more damped than each of them."""
    random, wave, spread = np.random.default_rng(1), 25.0, 0.05
    link = random.uniform(0.5, 1.5, (1, 60))
    own = spread * random.standard_normal((200, 60))

    def response(damping, phase):
        return 10.0 * np.exp(-3.0 * damping * link) * np.sin(wave * phase + 6.0 * link)

    truth = np.full((200, 2), [0.3, 0.5])
    told = response(truth[:, :1], truth[:, 1:] + own)

    def residuals(x, answer):
        return response(x[0], x[1])[0] - answer

    estimate = np.array([
        least_squares(residuals, [0.3, 0.5], args=(answer,), bounds=([0, 0], [1, 1])).x for answer in told
    ])  # fmt: skip
    assert np.median(estimate[:, 0]) > 0.4
    step = 1e-6
    slope = np.stack(
        [
            (response(*(estimate + step * unit).T[..., None]) - response(*estimate.T[..., None])) / step
            for unit in np.eye(2)
        ],
        axis=2,
    )
    others = spread * random.standard_normal((200, 60))

    def change(x, portion):
        return response(x[:, :1], x[:, 1:] + portion * others) - response(*estimate.T[..., None])

    leaning = LinearModel(estimate, slope, np.zeros((60, 0)), np.full((200, 2), 1e-6))
    found = implied_means(leaning, change, np.full((200, 2), 0.9))
    assert (found == 0.9).mean() < 0.2  # that cannot be followed
    assert np.median(found[:, 0]) == pytest.approx(0.3, abs=0.05)


def test_overconfidence_is_the_ratio_of_variances_between_modes():
    """Variance of the log ratio of two modes with buildings, over the variance by noise only."""
    random = np.random.default_rng(4)
    effect = random.uniform(2.0, 20.0, len(LINK_BUILDING))
    other = np.where(LINK_BUILDING == 0, random.standard_normal(len(effect)), 0.0)
    columns = np.column_stack([effect, np.ones(len(effect))])

    def followed(gap: np.ndarray) -> np.ndarray:
        return gap - (columns @ np.linalg.lstsq(columns, gap.T, rcond=None)[0]).T

    own = random.standard_normal((2000, 1)) * other + drawn(0.3)[:, LINK_BUILDING]
    noise = random.standard_normal(own.shape)
    ratio, plain = (
        0.5 * (np.sum(followed(gap) ** 2, axis=1) - np.sum(followed(gap - other) ** 2, axis=1))
        for gap in (own + noise, noise)
    )
    leaning = LinearModel(
        np.full((len(own), 1), HALF), np.broadcast_to(effect[:, None], (len(own), len(effect), 1)),
        np.ones((len(effect), 1)), np.zeros((len(own), 2)),
    )  # fmt: skip
    others = np.broadcast_to(other, (len(own), 1, len(effect)))
    found = overconfidence(leaning, own, others)
    # The square of a normal number is 1 on the mean and 0.45 in the middle.
    assert 1.0 + (found - 1.0) / 0.455 == pytest.approx(ratio.var() / plain.var(), rel=0.1)
    assert found > 3.0
    assert overconfidence(leaning, own, 1e-3 * others) == 1.0  # no place of its own
    shared = np.broadcast_to(columns @ [0.3, -2.0], own.shape)
    assert overconfidence(leaning, shared, others) == pytest.approx(1.0)


def test_a_divided_log_density_is_that_of_more_noise():
    point = np.random.default_rng(6).uniform(-20.0, 20.0, (40_000, 1))
    density = -0.5 * point[:, 0] ** 2
    draws = Draws(point, density, np.exp(density) / np.exp(density).sum())
    wider = draws.tempered(9.0)
    assert wider.weight @ point[:, 0] ** 2 == pytest.approx(9.0, rel=0.05)
    assert draws.tempered(1.0) is draws


@pytest.fixture
def models() -> tuple[NoiseModel, ...]:
    return noise_models(np.random.default_rng(0).uniform(0, 100, (20, 3)), offset=False)


def weights(models: tuple[NoiseModel, ...], **kinds: float) -> np.ndarray:
    """Weights of the models at 4000 draws, from weights per kind [4000, models]."""
    number = {kind: sum(model.kind == kind for model in models) for kind in kinds}
    row = [kinds.get(model.kind, 0.0) / number.get(model.kind, 1) for model in models]
    return np.tile(row, (4000, 1))


def test_spreads_follow_the_evidence(models):
    apart = draw_spreads(models, weights(models, gaussian=0.2, heterogeneous=0.8), models)
    # Four times as likely now and twice before: the data speak for it by two to one, and so was thought before.
    assert np.mean(apart > 0) == pytest.approx(0.8 + 0.2 * 4 / 5, abs=0.015)
    assert np.mean(apart == 0.3) == pytest.approx(0.8 / 3 + 0.2 * 4 / 5 * 0.137, abs=0.03)
    alike = draw_spreads(models, weights(models, gaussian=1.0), models)
    assert np.mean(alike > 0) < 0.01
    # Heavy tails explain all: nothing was learnt of buildings, and they differ as likely as was thought before.
    heavy = draw_spreads(models, weights(models, **{"student-t": 1.0}), models)
    assert np.mean(heavy > 0) == pytest.approx(2 / 3, abs=0.03)


def test_without_heterogeneous_models_the_spread_is_zero(models):
    alike = tuple(model for model in models if model.kind != DIFFERING)
    share = weights(alike, gaussian=1.0)
    assert (draw_spreads(alike, share, alike) == 0).all()


def test_dropped_models_count_as_unlikely(models):
    """Negligible models are dropped; the remaining ones determine the odds."""
    left = tuple(replace(model) for model in models if model.kind == "gaussian")
    assert np.mean(draw_spreads(left, np.ones((2000, len(left))) / len(left), models) > 0) < 0.01


def test_parameters_of_measured_buildings_stay_weakly_identified():
    """Measured buildings are known to a tenth of the range; differences to others widen the interval."""
    random = np.random.default_rng(2)
    seen, means = (
        Draws(point, np.zeros(4000), np.full(4000, 1 / 4000))
        for point in (random.normal(0.5, 0.02, (4000, 1)), random.uniform(0.1, 0.9, (4000, 1)))
    )

    def told(draws: Draws, lean: Draws | None):
        ends = np.zeros(1), np.ones(1)
        return verdicts(draws, lambda points: points * 50.0, Axes(["walls"], *ends), 3.0, seen=lean)[0]

    assert told(means, seen).name == "weakly identified"
    assert "for the measured buildings" in reason_text(told(means, seen).reason)
    assert told(means, seen).pieces == told(means, None).pieces
    assert told(means, None).name == "not identifiable"
    assert told(means, means).name == "not identifiable"
    assert told(seen, seen).name == "identified"
