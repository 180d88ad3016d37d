"""The log-distance model against planted laws and NumPy's fit."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.errors import EngineError
from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.objective import make_objective
from calibray.measurements import Measurements
from calibray.validation.baselines import LogDistance, log_distance


def test_a_log_distance_law_is_recovered_exactly():
    distance = np.geomspace(5, 500, 20)
    loss, weight = 38.5 + 27.0 * np.log10(distance), np.random.default_rng(0).uniform(0.1, 2, 20)
    law = LogDistance.fit(distance, loss, weight)
    assert (law.intercept_db, law.slope_db) == pytest.approx((38.5, 27.0))
    assert law.path_loss(np.array([1.0, 10.0])) == pytest.approx([38.5, 65.5])
    spoilt = np.where(np.arange(20) == 4, loss + 30, loss)
    left_out = LogDistance.fit(distance, spoilt, np.where(np.arange(20) == 4, 0.0, weight))
    assert left_out.slope_db == pytest.approx(27.0)
    weighted = LogDistance.fit(distance, spoilt, weight)
    reference = np.polyfit(np.log10(distance), spoilt, 1, w=np.sqrt(weight))
    assert (weighted.slope_db, weighted.intercept_db) == pytest.approx(tuple(reference))
    assert weighted.slope_db != pytest.approx(27.0, abs=0.1)


def test_a_log_distance_law_needs_two_links():
    with pytest.raises(EngineError, match="at least two links"):
        LogDistance.fit(np.array([5.0, 9.0]), np.array([80.0, 90.0]), np.array([1.0, 0.0]))


def test_over_carriers_the_law_rises_as_in_free_space():
    distance = np.geomspace(5, 500, 20)
    frequency = np.where(np.arange(20) % 2, 28e9, 3.5e9)
    loss = 38.5 + 27.0 * np.log10(distance) + 20 * np.log10(frequency / 3.5e9)
    links = Measurements(
        tx=np.zeros((20, 3)),
        rx=np.stack([distance, 0 * distance, 0 * distance], axis=1),
        path_loss_db=loss,
        frequency=frequency,
    )
    assert log_distance(links, objective(links), 3.5e9) == pytest.approx(loss)
    one = Measurements(tx=links.tx, rx=links.rx, path_loss_db=loss)
    assert abs(log_distance(one, objective(one), 3.5e9) - loss).max() > 5


def objective(links, *terms, calibrated=None):
    """What a twin with some nuisances would be fitted by."""
    every = np.ones(len(links), dtype=bool)
    return make_objective(
        links, every, every if calibrated is None else calibrated, nuisance=Nuisance(len(links), terms)
    )


def test_it_has_the_nuisances_of_the_twin():
    distance = np.geomspace(5, 500, 20)
    labels = np.where(np.arange(20) % 2, "a", "b")
    loss = 38.5 + 27.0 * np.log10(distance) + 15.0 * (labels == "a")
    rx = np.stack([distance, 0 * distance, 0 * distance], axis=1)
    links = Measurements(tx=np.zeros((20, 3)), rx=rx, path_loss_db=loss)
    bounded = make_term(links, "offset", labels=labels, bounds=(-10, 10))
    assert log_distance(links, objective(links, bounded), 3.5e9) == pytest.approx(loss)
    assert abs(log_distance(links, objective(links), 3.5e9) - loss).max() > 5
    slope = make_term(links, "log_distance", "log_distance", labels=labels)
    assert log_distance(links, objective(links, bounded, slope), 3.5e9) == pytest.approx(loss)
    # A group that it was not fitted to has the mean of the others.
    seen = objective(links, bounded, calibrated=labels == "a")
    assert log_distance(links, seen, 3.5e9) == pytest.approx(loss + 15.0 * (labels == "b"))
