"""Draws from known posteriors, their credible sets and verdicts."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm, t

from calibray.result.verdict import Reason, ReasonKind, Verdict
from calibray.result.wording import reason_text
from calibray.uncertainty import assessment
from calibray.uncertainty.draws import Draws
from calibray.uncertainty.verdicts import Axes, JudgedSet, credible_sets, verdicts

NAMES = ("walls.relative_permittivity", "glass.relative_permittivity")


def normal_draws(mean, size, count=4000):
    """Draws of independent normal coordinates, as wide as the range where the size is None."""
    random = np.random.default_rng(3)
    columns = [
        random.uniform(0.0, 10.0, count) if deviation is None else random.normal(centre, deviation, count)
        for centre, deviation in zip(mean, size, strict=True)
    ]
    return Draws(np.stack(columns, axis=1), np.zeros(count), np.full(count, 1.0 / count))


def test_two_separate_ranges_are_ambiguous():
    value = np.concatenate([normal_draws([2.0], [0.2]).point, normal_draws([8.0], [0.2], 8000).point])
    draws = Draws(value, np.zeros(len(value)), np.full(len(value), 1 / len(value)))
    pieces = credible_sets(value[:, 0], draws.weight, 0.0, 10.0, [0.95])[0]
    assert [round(0.5 * (low + high)) for low, high in pieces] == [2, 8]
    (verdict,) = verdicts(draws, lambda x: x, Axes(NAMES[:1], np.zeros(1), np.full(1, 10.0)), 1.0)
    assert verdict.name == "ambiguous"
    assert "2 separate ranges" in reason_text(verdict.reason)


@pytest.mark.parametrize(("second", "verdict", "pieces"), [(2.02, "identified", 1), (2.6, "ambiguous", 2)])
def test_ranges_that_differ_by_little_are_one(second, verdict, pieces):
    """Precise data can leave two minima at 2.00 and 2.02, which no user would tell apart."""
    value = np.concatenate([normal_draws([2.0], [0.001]).point, normal_draws([second], [0.001]).point])
    draws = Draws(value, np.zeros(len(value)), np.full(len(value), 1 / len(value)))
    (judged,) = verdicts(draws, lambda x: x, Axes(NAMES[:1], np.zeros(1), np.full(1, 10.0)), 1.0)
    assert judged.name == verdict
    assert len(judged.pieces) == pieces
    assert (judged.lower, judged.upper) == pytest.approx((2.0, second), abs=0.01)


def test_an_undetermined_parameter_covers_its_bounds():
    lower, upper = np.zeros(2), np.full(2, 10.0)
    draws = normal_draws([3.0, None], [0.2, None])
    judged = verdicts(draws, lambda x: x[:, :1], Axes(NAMES, lower, upper), 1.0)
    assert [verdict.name for verdict in judged] == ["identified", "not identifiable"]
    assert reason_text(judged[1].reason) == "no link's path loss depends on this parameter"
    little = Reason(ReasonKind.NO_EFFECT, {"change_db": 0.01})
    assert reason_text(little) == "no link's path loss changes by more than 0.1 dB over the whole range"
    assert judged[0].lower == pytest.approx(3.0 - 1.96 * 0.2, abs=0.08)
    # Draws that disagree identify nothing, however narrow they are.
    rough = verdicts(replace(draws, agree=False), lambda x: x, Axes(NAMES, lower, upper), 1.0)
    assert [verdict.name for verdict in rough] == ["weakly identified", "not identifiable"]


@pytest.mark.parametrize("seed", range(20))
def test_a_parameter_known_for_the_measured_buildings_alone_is_weakly_identified(seed):
    """The posterior of all buildings is the whole range, with gaps and ends by chance."""
    random, equal = np.random.default_rng(seed), np.full(300, 1 / 300)
    every = Draws(random.uniform(0.0, 10.0, (300, 1)), np.zeros(300), equal)
    seen = Draws(random.normal(4.0, 0.5, (300, 1)), np.zeros(300), equal)
    axes = Axes(NAMES[:1], np.zeros(1), np.full(1, 10.0))
    (verdict,) = verdicts(every, lambda x: x, axes, 1.0, seen=seen)
    assert verdict.name == "weakly identified"
    assert "measured" in reason_text(verdict.reason)
    # Also the measured buildings reach a bound.
    low = random.exponential(0.5, (300, 1))
    for side, point in (("lower", low), ("upper", 10.0 - low)):
        (verdict,) = verdicts(every, lambda x: x, axes, 1.0, seen=replace(seen, point=point))
        assert verdict.name == "at bound"
        assert verdict.reason.values["side"] == side


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


def test_more_states_of_the_same_members_leave_their_sets_as_they_are():
    """Members of a population move little between states; kernels as narrow as for so many draws would leave gaps."""
    random = np.random.default_rng(2)
    members = random.uniform(0.0, 1.0, 1000)
    states = np.clip(members + 1e-6 * random.standard_normal((20, 1000)), 0.0, 1.0).ravel()
    one, many = (
        credible_sets(value, np.full(len(value), 1 / len(value)), 0.0, 1.0, [0.9])[0]
        for value in (members, states)
    )
    assert len(one) == len(many)
    assert np.allclose(one, many, atol=1e-3)


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
        r"90 % .* range; the 95 % interval also includes (\S+) to (\S+) \((\d) % of the posterior\)",
        reason_text(verdict.reason),
    )
    assert found is not None
    low, high, share = map(float, found.groups())
    assert 78 < low < high < 82
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
    (told,) = verdicts(
        normal_draws([None], [None]), lambda x: slope * x, Axes(NAMES[:1], np.zeros(1), np.full(1, 10.0)), 2.0
    )
    assert told.name == "not identifiable"
    assert words in reason_text(told.reason)
    assert f"up to {10 * slope:.1f} dB" in reason_text(told.reason)


def test_a_trade_off_is_reported():
    lower, upper, first = np.zeros(2), np.full(2, 10.0), normal_draws([None], [None]).point[:, 0]
    point = np.stack([first, 10.0 - first], axis=1)
    found = Draws(point, np.zeros(len(point)), np.full(len(point), 1.0 / len(point)))
    told = verdicts(found, lambda x: x.sum(axis=1, keepdims=True), Axes(NAMES, lower, upper), 1.0)
    assert told[0].name == "not identifiable"
    assert "trades off with glass.relative_permittivity" in reason_text(told[0].reason)


def test_a_parameter_at_its_bound_is_reported():
    point = 1.0 - np.random.default_rng(5).exponential(1 / 20, (4000, 1)).clip(0, 1)
    found = Draws(point, 20 * point[:, 0], np.full(4000, 1 / 4000))
    (told,) = verdicts(found, lambda x: x * 5, Axes(NAMES[:1], np.zeros(1), np.ones(1)), 1.0)
    assert told.name == "at bound"
    assert told.upper == 1.0
    assert told.lower == pytest.approx(1 - 3.0 / 20, abs=0.02)
    # The reason states the end of the set of 90 %, which is not that of the interval of 95 %.
    assert told.reason.values["value"] == pytest.approx(1 - np.log(10) / 20, abs=0.01)
    assert reason_text(told.reason).endswith(", with a probability of 90 %")


def test_credible_sets_cover_their_level():
    """For weighted and unweighted draws, wide, narrow and skewed."""
    random = np.random.default_rng(4)
    for draws in (
        random.normal(5, 1e-4, 3000),
        random.gamma(2.0, 0.5, 3000),
        t(4).rvs(3000, random_state=random) + 5,
    ):
        pieces = credible_sets(draws, np.full(3000, 1 / 3000), 0.0, 10.0, [0.9])[0]
        inside = np.any([(draws >= low) & (draws <= high) for low, high in pieces], axis=0)
        assert inside.mean() == pytest.approx(0.9, abs=0.02)
    value = random.uniform(2, 8, 4000)
    weight = norm.pdf(value, 5, 0.5)
    ((low, high),) = credible_sets(value, weight / weight.sum(), 0.0, 10.0, [0.95])[0]
    assert (low, high) == pytest.approx((5 - 0.98, 5 + 0.98), abs=0.12)


def test_wider_bounds_do_not_improve_a_verdict():
    draws = normal_draws([5.0], [1.0])

    def told(upper, customary):
        axes = Axes(NAMES[:1], np.zeros(1), np.full(1, upper), customary=customary)
        return verdicts(draws, lambda x: 5 * x, axes, 1.0)[0]

    assert told(10.0, None).name == told(40.0, np.full(1, 10.0)).name == "weakly identified"
    assert told(40.0, None).name == "identified"  # what shares of the bounds alone would say
    assert "of a usual range" in reason_text(told(40.0, np.full(1, 10.0)).reason)
    # Narrower bounds count as they are.
    assert told(10.0, np.full(1, 1000.0)).name == "weakly identified"


def test_sets_for_the_measured_buildings_are_reported_where_they_differ():
    def differ(*seen):
        whole = JudgedSet(((1.5, 12.0),), Verdict.NOT_IDENTIFIABLE, Reason(ReasonKind.NO_EFFECT), seen)
        return assessment._differ(whole)

    assert not differ((1.5, 12.0))
    # A gap of 6 % is chance, and not another interval.
    assert not differ((1.5, 10.0), (10.63, 12.0))
    assert differ((1.5, 5.0), (7.0, 12.0))
    assert differ((1.5, 10.5))
    assert not differ((1.5, 11.2))
