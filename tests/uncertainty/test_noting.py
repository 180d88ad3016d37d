"""What is said where the least RMSE and the intervals disagree."""

from __future__ import annotations

from typing import Any

import numpy as np

import planted
from calibray.fitting.problem import Problem
from calibray.measurements import links_from_frame
from calibray.study import Setup, Study
from calibray.uncertainty.linear_theory import Interval
from calibray.uncertainty.noise_models import CORRELATED
from calibray.uncertainty.remarks import contradicted

NAMES = tuple(planted.TRUTH)


def said(found: dict[str, float], behind: float = 3.0, **sections: Any) -> tuple[str, ...]:
    study = Study.from_content(planted.content("links.csv", **sections))
    problem = Problem.of(Setup.open(study, links=links_from_frame(planted.links())), planted.engine())
    pieces = ((2.0, 3.0), (6.0, 9.0))
    told = {name: Interval(0.1, 2.0, 9.0, "ambiguous", pieces) for name in NAMES}
    likeliest = dict.fromkeys(NAMES, 7.0)
    return contradicted(problem, found, told, likeliest, behind, {CORRELATED: 0.9, "gaussian": 0.1})


def test_values_within_their_intervals_are_not_spoken_of():
    assert said(dict.fromkeys(NAMES, 2.5)) == ()
    assert said(dict.fromkeys(NAMES, 5.9)) == ()  # just beside


def test_values_outside_their_intervals_are_named_with_the_reason():
    sentence, advice = said(dict.fromkeys(NAMES, 2.5) | {NAMES[1]: 4.4})
    assert f"{NAMES[1]} 4.4, interval 2 to 3, 6 to 9, likeliest 7" in sentence
    assert NAMES[0] not in sentence
    assert "errors that neighbours share" in sentence
    assert f"{np.exp(3.0):.2g} times as likely" in sentence
    assert "blocks = 4" in advice
    # Whose links are held out in turn need not be told to.
    judged = said({**dict.fromkeys(NAMES, 2.5), NAMES[1]: 4.4}, holdout={"blocks": 3})[1]
    assert "blocks = 4" not in judged
    assert judged.startswith("Do not take the values of the least RMSE")
    half = said({**dict.fromkeys(NAMES, 2.5), NAMES[1]: 4.4}, holdout={"where": "rx_x > 0"})[1]
    assert half == advice
    assert "more than 1,000 times" in said({**dict.fromkeys(NAMES, 2.5), NAMES[1]: 4.4}, 50.0)[0]
