"""The log-distance model against planted laws and NumPy's fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import planted
from calibray.errors import EngineError
from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.objective import make_objective
from calibray.measurements import Measurements, SourceTable
from calibray.result.prediction_model import FittedTerm
from calibray.study import Study
from calibray.validation.baselines import (
    OUT_OF_SIGHT_DB,
    has_obstruction,
    log_distance,
    obstructed,
    obstructed_objective,
)
from calibray.validation.choice import with_prior_mean

DISTANCE = np.geomspace(5, 500, 20)
LOSS = 38.5 + 27.0 * np.log10(DISTANCE)


def measured(path_loss_db, **columns):
    """Links at `DISTANCE` from one transmitter."""
    rx = np.stack([DISTANCE, 0 * DISTANCE, 0 * DISTANCE], axis=1)
    return Measurements(tx=np.zeros((20, 3)), rx=rx, path_loss_db=path_loss_db, **columns)


def objective(links, *terms, calibrated=None):
    """The objective of a study with some nuisances."""
    every = np.ones(len(links), dtype=bool)
    return make_objective(
        links, every, every if calibrated is None else calibrated, nuisance=Nuisance(len(links), terms)
    )


def test_a_log_distance_law_is_recovered_exactly():
    links = measured(LOSS)
    assert log_distance(links, objective(links), 3.5e9) == pytest.approx(LOSS)
    outlier = measured(np.where(np.arange(20) == 4, LOSS + 30, LOSS))
    left_out = objective(outlier, calibrated=np.arange(20) != 4)
    assert log_distance(outlier, left_out, 3.5e9) == pytest.approx(LOSS)


def test_the_law_is_fitted_by_weighted_least_squares():
    weight = np.random.default_rng(0).uniform(0.1, 2, 20)
    links = measured(np.where(np.arange(20) == 4, LOSS + 30, LOSS), weight=weight)
    reference = np.polyfit(np.log10(DISTANCE), links.path_loss_db, 1, w=np.sqrt(weight))
    law = log_distance(links, objective(links), 3.5e9)
    assert law == pytest.approx(np.polyval(reference, np.log10(DISTANCE)))
    assert abs(law - LOSS).max() > 0.1


def test_a_log_distance_law_needs_two_links():
    links = measured(LOSS)
    one = replace(objective(links), weight=np.where(np.arange(20) == 0, 1.0, 0.0))
    with pytest.raises(EngineError, match="at least two calibration links"):
        log_distance(links, one, 3.5e9)


def test_over_carriers_the_law_rises_as_in_free_space():
    frequency = np.where(np.arange(20) % 2, 28e9, 3.5e9)
    loss = LOSS + 20 * np.log10(frequency / 3.5e9)
    links = measured(loss, frequency=frequency)
    assert log_distance(links, objective(links), 3.5e9) == pytest.approx(loss)
    one_carrier = measured(loss)
    assert abs(log_distance(one_carrier, objective(one_carrier), 3.5e9) - loss).max() > 5


def test_the_law_has_the_nuisances_of_the_study():
    labels = np.where(np.arange(20) % 2, "a", "b")
    loss = LOSS + 15.0 * (labels == "a")
    links = measured(loss)
    bounded = make_term(links, "offset", labels=labels, bounds=(-10, 10))
    assert log_distance(links, objective(links, bounded), 3.5e9) == pytest.approx(loss)
    assert abs(log_distance(links, objective(links), 3.5e9) - loss).max() > 5
    slope = make_term(links, "log_distance", "log_distance", labels=labels)
    assert log_distance(links, objective(links, bounded, slope), 3.5e9) == pytest.approx(loss)
    # A group without calibration links gets the mean of the others.
    only_a = objective(links, bounded, calibrated=labels == "a")
    assert log_distance(links, only_a, 3.5e9) == pytest.approx(loss + 15.0 * (labels == "b"))


def test_losses_out_of_sight_and_per_wall_are_recovered():
    walls = np.arange(20) % 4
    links = measured(LOSS + 12.0 * (walls > 0) + 3.0 * walls, table=blocked(walls))
    assert obstructed(links, objective(links), 3.5e9) == pytest.approx(links.path_loss_db, abs=0.6)
    assert abs(log_distance(links, objective(links), 3.5e9) - links.path_loss_db).max() > 6.0


def test_links_in_sight_say_nothing_of_those_out_of_sight():
    """Where none was measured, the loss out of sight is that of the prior."""
    walls = np.where(np.arange(20) < 15, 0, 1)
    links = measured(LOSS, table=blocked(walls))
    law = obstructed(links, objective(links, calibrated=walls == 0), 3.5e9)
    assert law == pytest.approx(LOSS + OUT_OF_SIGHT_DB[0] * walls, abs=1e-6)
    assert has_obstruction(links)
    assert not has_obstruction(links.select(walls == 0))


def blocked(walls):
    """Columns of links whose direct lines cross some walls."""
    return SourceTable(pd.DataFrame({"out_of_sight": 1.0 * (walls > 0), "walls_crossed": 1.0 * walls}))


def test_a_nuisance_of_the_study_keeps_its_name_and_has_no_prior_mean():
    """A study's own loss out of sight is not shifted, and its names are not taken."""
    walls = np.arange(20) % 4
    links = measured(LOSS + 12.0 * (walls > 0), table=blocked(walls))
    own = make_term(links, "out of sight", "out_of_sight")
    taken = make_term(links, "walls crossed")
    model, known_db = obstructed_objective(links, objective(links, own, taken), 3.5e9)
    assert [term.name for term in model.nuisance.terms][:2] == ["out of sight", "walls crossed"]
    assert "walls crossed of all" in [term.name for term in model.nuisance.terms]
    assert (known_db == 0).all()
    fitted = (FittedTerm("out of sight", "out_of_sight", "", {"": 12.0}),)
    content = planted.content("links.csv", nuisance={"out of sight": {"by": "out_of_sight"}})
    assert with_prior_mean(fitted, Study.from_content(content)) == fitted
    (shifted,) = with_prior_mean(fitted, Study.from_content(planted.content("links.csv")))
    assert shifted.coefficients == {"": 12.0 + OUT_OF_SIGHT_DB[0]}
