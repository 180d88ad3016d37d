"""The remarks on values outside their intervals, on departures from the noise model and on a missed optimum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import planted
from calibray.engines import Replay
from calibray.fitting.problem import Problem
from calibray.result.verdict import Interval, Remark, RemarkKind, Verdict
from calibray.result.wording import remark_text
from calibray.study import Setup, Study
from calibray.uncertainty.draws import Draws
from calibray.uncertainty.noise_models import CORRELATED
from calibray.uncertainty.remarks import MISSED_DB, departures, missed, outside_interval
from link_tables import links_from_frame

NAMES = tuple(planted.TRUTH)


def problem_of(**sections: Any) -> Problem:
    study = Study.from_content(planted.content("links.csv", **sections))
    links = replace(links_from_frame(planted.links()), path_loss_db=planted.path_loss() + 10.0)
    setup = Setup.open(study, links=links)
    return Problem.of(setup, Replay(planted.engine().paths, setup.parameters))


def remarks(
    optimum: dict[str, float], log_odds: float = 3.0, noise: Any = None, **sections: Any
) -> tuple[str, ...]:
    problem = problem_of(**{"noise": None, **sections})
    pieces = ((2.0, 3.0), (6.0, 9.0))
    intervals = {name: Interval(0.1, 2.0, 9.0, Verdict.AMBIGUOUS, pieces) for name in NAMES}
    probable, noise = dict.fromkeys(NAMES, 7.0), noise or {CORRELATED: 0.9, "gaussian": 0.1, "offset": 1.0}
    found = outside_interval(problem, optimum, intervals, probable, log_odds, noise)
    assert all(remark.kind is RemarkKind.OUTSIDE_INTERVAL for remark in found)
    return tuple(map(remark_text, found))


def test_values_within_their_intervals_give_no_remark():
    assert remarks(dict.fromkeys(NAMES, 2.5)) == ()
    assert remarks(dict.fromkeys(NAMES, 5.9)) == ()  # within the slack


def test_the_slack_of_a_logarithmic_parameter_is_a_factor():
    scaled = {name: {"bounds": list(planted.BOUNDS), "scale": "log"} for name in NAMES}
    inside, outside = ({**dict.fromkeys(NAMES, 2.5), NAMES[1]: value} for value in (9.3, 1.9))
    assert remarks(inside, parameters=scaled) == ()
    assert remarks(outside, parameters=scaled)
    # On a linear scale, it is the other way round.
    assert remarks(inside)
    assert remarks(outside) == ()


def test_values_outside_their_intervals_are_named_with_the_reason():
    outside = {**dict.fromkeys(NAMES, 2.5), NAMES[1]: 4.4}
    (text,) = remarks(outside)
    assert f"{NAMES[1]} 4.4, interval 2 to 3, 6 to 9, most probable 7" in text
    assert NAMES[0] not in text
    assert "neighbouring links have less weight than independent links if they share part" in text
    assert f"{np.exp(3.0):.2g} times as probable" in text
    assert "unless another model is chosen on held-out links ([holdout])" in text
    # With blocks held out already, that advice would be empty.
    assert "[holdout]" not in remarks(outside, holdout={"blocks": 3})[0]
    assert remarks(outside, holdout={"where": "rx_x > 0"})[0] == text
    assert "more than 1,000 times" in remarks(outside, 50.0)[0]


@pytest.mark.parametrize("log_odds", [-2.0, 0.0, 0.5])
def test_values_as_probable_as_any_are_not_called_less_probable(log_odds):
    (text,) = remarks({**dict.fromkeys(NAMES, 2.5), NAMES[1]: 4.4}, log_odds)
    assert f"{NAMES[1]} 4.4, interval 2 to 3, 6 to 9." in text
    assert "times as probable" not in text
    assert "not the most probable" not in text
    assert "No other candidate is clearly more probable" in text


def test_a_cause_without_its_own_sentence_is_another_noise_model():
    text = remarks(dict.fromkeys(NAMES, 4.0), noise={"logistic": 0.9, CORRELATED: 0.1, "offset": 1.0})[0]
    assert "because the noise model of the intervals differs from that of the RMSE" in text


def test_noise_that_the_data_favour_is_reported():
    study = Study.from_content(planted.content("links.csv"))

    def kinds(**noise):
        return [remark.kind for remark in departures(noise, study)]

    # Kinds that share the weight count against Gaussian noise; those of little weight do not.
    assert kinds(gaussian=0.02, correlated=0.2, out_of_sight=0.7) == [RemarkKind.ERRORS_OUT_OF_SIGHT]
    assert kinds(gaussian=0.5, correlated=0.2, out_of_sight=0.3) == []
    # Beforehand, half of the weight is that of buildings which differ.
    assert kinds(gaussian=0.9, heterogeneous=0.7) == []
    assert kinds(gaussian=0.9, heterogeneous=0.8) == [RemarkKind.HETEROGENEITY]


@pytest.mark.parametrize(
    ("stated", "kind"),
    [
        ({"kind": "student-t"}, "student-t"),
        ({"range_m": 20}, "correlated"),
        ({"heterogeneity": 0.2}, "heterogeneous"),
    ],
)
def test_what_the_study_states_is_no_finding(stated, kind):
    free, study = (Study.from_content(planted.content("links.csv", noise=noise)) for noise in (None, stated))
    assert len(departures({kind: 1.0}, free)) == 1
    assert departures({kind: 1.0}, study) == ()


@pytest.mark.parametrize(
    ("trace", "advice"),
    [
        ({"max_depth": 2}, "set in [trace]: refraction = true, diffraction = true, max_depth = 3."),
        ({"max_depth": 2, "diffraction": True}, "set in [trace]: refraction = true, max_depth = 3."),
        ({"max_depth": 5, "refraction": True, "diffraction": True}, "set in [trace]: max_depth = 6."),
        ({"max_depth": 100, "refraction": True, "diffraction": True}, "The intervals account for this."),
    ],
)
def test_the_remark_on_errors_out_of_sight_advises_what_the_study_lacks(trace, advice):
    study = Study.from_content(planted.content("links.csv", trace=trace))
    (remark,) = departures({"out_of_sight": 1.0}, study)
    assert remark_text(remark).endswith(advice)


def test_a_missed_optimum_is_judged_by_the_objective():
    """The objective includes the prior of the offset; the RMSE does not."""
    problem = problem_of(offset={"prior_db": 0.5})
    point = problem.parameters.to_search(np.array([[2.0, 9.0, 4.0], [5.0, 5.0, 5.0]]))
    evaluated = problem.evaluate(point)
    objective, rmse = evaluated.value, evaluated.rmse_db
    assert not np.isclose(objective, rmse, atol=0.1).any()
    lowest = float(objective.min())
    draws = Draws(point, np.array([0.0, -1.0]), np.array([0.5, 0.5]))
    assert missed(problem, draws, lowest + 0.9 * MISSED_DB) == ()
    (remark,) = missed(problem, draws, lowest + 1.1 * MISSED_DB)
    assert remark.kind is RemarkKind.MISSED_OPTIMUM
    assert remark.values["draws_db"] == pytest.approx(lowest)
    text = remark_text(remark)
    assert (
        f"an objective of {lowest:.2f} dB, but the method reached {lowest + 1.1 * MISSED_DB:.2f} dB" in text
    )


def test_the_method_auto_is_not_advised_to_itself():
    values = {"draws_db": 1.0, "found_db": 2.0, "start_db": 1.0}
    for kind in (RemarkKind.MISSED_OPTIMUM, RemarkKind.WORSE_THAN_START):
        own, other = (remark_text(Remark(kind, values | {"method": name})) for name in ("auto", "random"))
        assert own.endswith("Use a larger budget (method.options).")
        assert other.endswith("Use a larger budget (method.options), or the method 'auto'.")
