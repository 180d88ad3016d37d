"""Draws from known posteriors, their credible sets and verdicts."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm, t

from calibray.result.wording import reason_text
from calibray.uncertainty.credible_sets import credible
from calibray.uncertainty.importance_sampling import TOO_FEW, Draws, pooled, sample
from calibray.uncertainty.verdicts import Axes, verdicts

NAMES = ("walls.relative_permittivity", "glass.relative_permittivity")


def gaussian(mean, size):
    def density(points):
        return -0.5 * np.sum(((points - mean) / size) ** 2, axis=1)

    return density


def moments(found: Draws):
    mean = found.weight @ found.point
    return mean, np.sqrt(found.weight @ (found.point - mean) ** 2)


def test_draws_have_the_mean_and_deviation_of_a_known_density():
    mean, size = np.array([4.0, 5.0]), np.array([0.3, 0.002])
    found = sample(gaussian(mean, size), np.zeros(2), np.full(2, 9.0), mean[None], np.diag(size**2)[None])
    assert found.effective > 400
    told = moments(found)
    assert told[0] == pytest.approx(mean, abs=0.1 * size.max())
    assert told[1] == pytest.approx(size, rel=0.08)


def test_a_wrong_density_makes_draws_too_narrow():
    mean, size = np.array([4.0, 5.0]), np.array([0.3, 0.2])
    density = gaussian(mean, size)
    found = sample(lambda x: 4 * density(x), np.zeros(2), np.full(2, 9.0), mean[None], np.diag(size**2)[None])
    assert (moments(found)[1] < 0.6 * size).all()


def test_an_unknown_basin_gets_its_share():
    """Two Gaussians; the search knew one, the other has two thirds of the mass."""

    def density(points):
        x = points[:, 0]
        return np.logaddexp(norm.logpdf(x, 2.0, 0.2), np.log(2) + norm.logpdf(x, 8.0, 0.2))

    found = sample(density, np.zeros(1), np.full(1, 10.0), np.array([[2.0]]), np.array([[[0.04]]]))
    assert found.weight[found.point[:, 0] > 5].sum() == pytest.approx(2 / 3, abs=0.08)
    pieces = credible(found.point[:, 0], found.weight, 0.0, 10.0, 0.95)
    assert [round(0.5 * (low + high)) for low, high in pieces] == [2, 8]
    (verdict,) = verdicts(found, lambda x: x, Axes(NAMES[:1], np.zeros(1), np.full(1, 10.0)), 1.0)
    assert verdict.name == "ambiguous"
    assert "2 separate ranges" in reason_text(verdict.reason)


def test_rounds_continue_while_draws_are_few():
    """A mode too narrow for one round."""
    asked: list[int] = []

    def density(points):
        asked.append(len(points))
        return -0.5 * np.sum(((points - 0.3) / 0.001) ** 2, axis=1)

    where = np.zeros(4), np.ones(4), np.full((1, 4), 0.8), np.diag(np.full(4, 0.01))[None]
    few = sample(density, *where, batch=64, rounds=1)
    assert len(asked) == 2
    asked.clear()
    enough = sample(density, *where, batch=64, rounds=1, more=lambda: len(asked) < 60)
    assert few.flattened
    assert enough.effective >= 64
    assert 2 < len(asked) < 60


@pytest.mark.parametrize("size", [0.006, 0.003])
def test_many_narrow_modes_of_each_parameter_are_all_sampled(size):
    """As from reflections inside walls: six modes for each of four parameters, 1296 together, one known minimum."""
    places, count = np.array([0.1, 0.263, 0.419, 0.58, 0.741, 0.9]), 4
    share = np.arange(1.0, 7.0) / 21.0

    def density(points):
        each = np.log(share) - 0.5 * ((points[..., None] - places) / size) ** 2
        return np.logaddexp.reduce(each, axis=2).sum(axis=1)

    one, wide = np.full((1, count), places[0]), np.diag(np.full(count, size**2))[None]
    found = sample(density, np.zeros(count), np.ones(count), one, wide, rounds=20)
    assert found.effective > 400
    for value in found.point.T:
        near = np.abs(value[:, None] - places) < 5 * size
        assert found.weight @ near == pytest.approx(share, abs=0.08)


def test_an_undetermined_parameter_covers_its_bounds():
    def density(points):
        return -0.5 * ((points[:, 0] - 3.0) / 0.2) ** 2

    lower, upper = np.zeros(2), np.full(2, 10.0)
    found = sample(density, lower, upper, np.array([[3.0, 1.0]]), np.array([np.diag([0.04, 9.0])]))
    assert moments(found)[1][1] == pytest.approx(10 / np.sqrt(12), rel=0.08)
    told = verdicts(found, lambda x: x[:, :1], Axes(NAMES, lower, upper), 1.0)
    assert [each.name for each in told] == ["identified", "not identifiable"]
    assert "no link's path loss changes by more than 0.0 dB" in reason_text(told[1].reason)
    assert told[0].lower == pytest.approx(3.0 - 1.96 * 0.2, abs=0.08)


def test_gaps_between_draws_of_a_parameter_without_effect_are_chance():
    """Few draws leave gaps; without any effect the interval is the whole range, with an effect it is not."""
    point = np.random.default_rng(4).uniform(0.0, 1.0, (400, 1))
    point = 0.06 + 0.88 * point[np.abs(point[:, 0] - 0.5) > 0.08][:100]
    draws = Draws(point, np.zeros(100), np.full(100, 0.01))

    def told(slope):
        return verdicts(draws, lambda x: slope * x, Axes(NAMES[:1], np.zeros(1), np.ones(1)), 3.0)[0]

    assert told(0.1).name == told(50.0).name == "not identifiable"
    assert len(told(0.1).pieces) == 1
    assert len(told(50.0).pieces) == 2
    assert told(50.0).lower > 0.02
    assert (told(0.1).lower, told(0.1).upper) == (0.0, 1.0)
    # A prior that keeps draws away from a bound is no chance.
    far = verdicts(
        replace(draws, point=0.3 + 0.7 * point),
        lambda x: 0.1 * x,
        Axes(NAMES[:1], np.zeros(1), np.ones(1)),
        3.0,
    )
    assert far[0].name == "not identifiable"
    assert far[0].lower == pytest.approx(0.34, abs=0.04)
    assert far[0].upper == 1.0


def test_pieces_outside_the_judged_set_are_reported():
    """Seven of a hundred draws are separate: the 95 % interval covers them, the 90 % set does not."""
    random = np.random.default_rng(3)
    point = np.concatenate([random.normal(3.0, 0.1, 1860), random.normal(8.0, 0.02, 140)])[:, None]
    draws = Draws(point, np.zeros(2000), np.full(2000, 1 / 2000))
    limits = np.zeros(1), np.full(1, 10.0)
    (verdict,) = verdicts(draws, lambda x: x, Axes(NAMES[:1], *limits, lambda _, value: 10 * value), 1.0)
    assert verdict.name == "identified"
    assert len(verdict.pieces) == 2
    found = re.fullmatch(
        r"90 % .* range; the 95 % interval also includes (\S+) to (\S+) \((\d)% of it\)",
        reason_text(verdict.reason),
    )
    assert found is not None
    low, high, share = map(float, found.groups())
    assert 79 < low < high < 81
    assert share in (6, 7)
    (alone,) = verdicts(
        Draws(point[:1860], np.zeros(1860), np.full(1860, 1 / 1860)),
        lambda x: x,
        Axes(NAMES[:1], *limits),
        1.0,
    )
    assert "also includes" not in reason_text(alone.reason)


@pytest.mark.parametrize(("slope", "words"), [(20.0, "other unknowns can compensate"), (0.5, "too little")])
def test_reasons_for_an_unidentifiable_parameter_with_effect(slope, words):
    """No trade-off; links change by the given decibels over the range, with errors of 2 dB."""
    found = sample(
        lambda points: np.zeros(len(points)),
        np.zeros(1),
        np.full(1, 10.0),
        np.array([[5.0]]),
        np.ones((1, 1, 1)),
    )
    (told,) = verdicts(found, lambda x: slope * x, Axes(NAMES[:1], np.zeros(1), np.full(1, 10.0)), 2.0)
    assert told.name == "not identifiable"
    assert words in reason_text(told.reason)
    assert f"up to {10 * slope:.1f} dB" in reason_text(told.reason)


def test_a_trade_off_is_reported():
    def density(points):
        return -0.5 * (points.sum(axis=1) - 10.0) ** 2 / 0.1**2

    lower, upper = np.zeros(2), np.full(2, 10.0)
    wide = np.array([np.array([[9.0, -8.9], [-8.9, 9.0]])])
    found = sample(density, lower, upper, np.array([[5.0, 5.0]]), wide)
    told = verdicts(found, lambda x: x.sum(axis=1, keepdims=True), Axes(NAMES, lower, upper), 1.0)
    assert told[0].name == "not identifiable"
    assert "trades off with glass.relative_permittivity" in reason_text(told[0].reason)


def test_a_parameter_at_its_bound_is_reported():
    found = sample(lambda x: 20 * x[:, 0], np.zeros(1), np.ones(1), np.array([[0.95]]), np.array([[[0.01]]]))
    (told,) = verdicts(found, lambda x: x * 5, Axes(NAMES[:1], np.zeros(1), np.ones(1)), 1.0)
    assert told.name == "at bound"
    assert told.upper == 1.0
    assert told.lower == pytest.approx(1 - 3.0 / 20, abs=0.02)


def test_credible_sets_cover_their_level():
    """For weighted and unweighted draws, wide, narrow and skewed."""
    random = np.random.default_rng(4)
    for draws in (
        random.normal(5, 1e-4, 3000),
        random.gamma(2.0, 0.5, 3000),
        t(4).rvs(3000, random_state=random) + 5,
    ):
        pieces = credible(draws, np.full(3000, 1 / 3000), 0.0, 10.0, 0.9)
        inside = np.any([(draws >= low) & (draws <= high) for low, high in pieces], axis=0)
        assert inside.mean() == pytest.approx(0.9, abs=0.02)
    value = random.uniform(2, 8, 4000)
    weight = norm.pdf(value, 5, 0.5)
    ((low, high),) = credible(value, weight / weight.sum(), 0.0, 10.0, 0.95)
    assert (low, high) == pytest.approx((5 - 0.98, 5 + 0.98), abs=0.12)


def test_too_few_draws_are_flattened():
    # Twelve well-determined parameters: one or two rounds of points have almost none of high density.
    dimension, size = 12, np.full(12, 0.003)
    density = gaussian(np.linspace(0.2, 0.8, dimension), size)
    start = np.linspace(0.2, 0.8, dimension)[None] + 0.02
    found = sample(
        density, np.zeros(dimension), np.ones(dimension), start, np.diag(np.full(dimension, 0.02))[None], batch=64,
        rounds=1,
    )  # fmt: skip
    assert found.flattened
    assert found.effective >= TOO_FEW
    narrow = sample(
        gaussian(np.full(2, 0.5), np.full(2, 0.1)), np.zeros(2), np.ones(2), np.full((1, 2), 0.5),
        0.01 * np.eye(2)[None],
    )  # fmt: skip
    assert not narrow.flattened
    assert pooled([found, found]).flattened
    assert not pooled([narrow, narrow]).flattened
