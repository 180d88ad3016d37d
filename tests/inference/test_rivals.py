"""The log-distance model against planted laws and NumPy's fit."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.errors import EngineError
from calibray.inference.rivals import LogDistance, log_distance
from calibray.measurements import Measurements


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
    assert log_distance(links, loss, np.ones(20), 3.5e9) == pytest.approx(loss)
    one = Measurements(tx=links.tx, rx=links.rx, path_loss_db=loss)
    assert abs(log_distance(one, loss, np.ones(20), 3.5e9) - loss).max() > 5
