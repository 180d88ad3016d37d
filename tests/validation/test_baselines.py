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
from calibray.prediction.corrections import fill_missing, model_terms, nuisance_shift
from calibray.result.held_out import FittedTerm, Model, PredictionModel
from calibray.result.record import Prediction
from calibray.study import Study
from calibray.validation.choice import fitted_terms, with_prior_mean
from calibray.validation.models import (
    OUT_OF_SIGHT_DB,
    has_obstruction,
    kriging,
    log_distance,
    obstructed,
    without_scene,
)

DISTANCE = np.geomspace(5, 500, 20)
LOSS = 38.5 + 27.0 * np.log10(DISTANCE)


NOTHING = np.zeros(20)
"""No carriers and no antennas are known."""


def measured(path_loss_db, **columns):
    """Links at `DISTANCE` from one transmitter."""
    rx = np.stack([DISTANCE, 0 * DISTANCE, 0 * DISTANCE], axis=1)
    return Measurements(tx=np.zeros((20, 3)), rx=rx, path_loss_db=path_loss_db, **columns)


def objective(links, *terms, calibrated=None):
    """The objective of a study with some nuisances."""
    every = np.ones(len(links), dtype=bool)
    mask = every if calibrated is None else calibrated
    return make_objective(links, every, mask, nuisance=Nuisance(len(links), terms), noise_db=1.0)


def test_a_log_distance_law_is_recovered_exactly():
    links = measured(LOSS)
    assert log_distance(links, objective(links), NOTHING).path_loss_db() == pytest.approx(LOSS)
    outlier = measured(np.where(np.arange(20) == 4, LOSS + 30, LOSS))
    left_out = objective(outlier, calibrated=np.arange(20) != 4)
    assert log_distance(outlier, left_out, NOTHING).path_loss_db() == pytest.approx(LOSS)


def test_the_law_is_fitted_by_weighted_least_squares():
    weight = np.random.default_rng(0).uniform(0.1, 2, 20)
    links = measured(np.where(np.arange(20) == 4, LOSS + 30, LOSS), weight=weight)
    reference = np.polyfit(np.log10(DISTANCE), links.path_loss_db, 1, w=np.sqrt(weight))
    law = log_distance(links, objective(links), NOTHING).path_loss_db()
    assert law == pytest.approx(np.polyval(reference, np.log10(DISTANCE)))
    assert abs(law - LOSS).max() > 0.1


def test_a_log_distance_law_needs_two_links():
    links = measured(LOSS)
    one = replace(objective(links), weight=np.where(np.arange(20) == 0, 1.0, 0.0))
    with pytest.raises(EngineError, match="at least two calibration links"):
        log_distance(links, one, NOTHING)


@pytest.fixture
def sectors():
    """Links around two sectors, one tilted, the study that states them, and the gains of the upright ones [dBi]."""
    random = np.random.default_rng(3)
    frame = pd.DataFrame({"azimuth": np.repeat([30.0, 200.0], 20), "tilt": np.repeat([4.0, 0.0], 20)})
    bearing = frame["azimuth"] + random.uniform(-100, 100, 40)
    flat, height = random.uniform(20, 400, 40), 28.5
    rx = [flat * np.sin(np.radians(bearing)), flat * np.cos(np.radians(bearing)), np.full(40, 1.5)]
    links = Measurements(
        tx=np.tile([0.0, 0.0, 30.0], (40, 1)), rx=np.stack(rx, axis=1), path_loss_db=np.zeros(40),
        table=SourceTable(frame),
    )  # fmt: skip
    # Without tilt: 3GPP TR 38.901, Table 7.3-1.
    off, down = (bearing - frame["azimuth"]).to_numpy(), np.degrees(np.arctan2(height, flat))
    loss = np.minimum(12 * (off / 65) ** 2, 30) + np.minimum(12 * (down / 65) ** 2, 30)
    mounted = {"azimuth_deg": "azimuth", "downtilt_deg": "tilt"}
    content = planted.content("links.csv", antennas={"tx": {"pattern": "tr38901"}})
    content["links"] |= {"tx_antenna": mounted}
    return links, content, 8 - np.minimum(loss, 30)


def test_the_law_knows_the_gain_of_the_stated_antennas(sectors):
    links, content, gain = sectors
    study = Study.from_content(content)
    known = without_scene(study, links)
    assert known[20:] == pytest.approx(-gain[20:], abs=1e-9)
    assert 0.1 < abs(known + gain)[:20].max() < 3
    law = 38.5 + 27.0 * np.log10(links.distance)
    links = replace(links, path_loss_db=law + known)
    assert log_distance(links, objective(links), known).path_loss_db() == pytest.approx(law + known)
    assert abs(log_distance(links, objective(links), 0 * known).path_loss_db() - law - known).max() > 5
    # One antenna in one direction for all links.
    content["antennas"]["tx"]["orientation"] = [np.pi / 2 - np.radians(200.0), 0.0, 0.0]
    del content["links"]["tx_antenna"]
    assert without_scene(Study.from_content(content), links)[20:] == pytest.approx(-gain[20:], abs=1e-9)
    content["antennas"]["tx"]["pattern"] = "dipole"
    assert (without_scene(Study.from_content(content), links) == 0).all()


def test_predictions_without_a_path_know_the_antennas(sectors):
    links, content, _ = sectors
    study = Study.from_content(content)
    fallback = PredictionModel(
        Model.LOG_DISTANCE, None, (FittedTerm("constant", "constant", "", {"": 70.0}),), 5.0, "", 9, (5.0,)
    )
    prediction = Prediction(fallback, None, None, fallback)
    table = pd.DataFrame({"path_loss_db": np.full(40, np.inf), "basis": "", "lower_db": 0.0, "upper_db": 0.0})
    filled = fill_missing(prediction, study, links, table, 0.9)
    assert filled["path_loss_db"].to_numpy() == pytest.approx(70.0 + without_scene(study, links))


def test_over_carriers_the_law_rises_as_in_free_space():
    frequency = np.where(np.arange(20) % 2, 28e9, 3.5e9)
    loss = LOSS + 20 * np.log10(frequency / 3.5e9)
    links = measured(loss, frequency=frequency)
    study = Study.from_content(planted.content("links.csv"))
    assert log_distance(links, objective(links), without_scene(study, links)).path_loss_db() == pytest.approx(
        loss
    )
    one_carrier = measured(loss)
    assert abs(log_distance(one_carrier, objective(one_carrier), NOTHING).path_loss_db() - loss).max() > 5


def test_the_law_has_the_nuisances_of_the_study():
    labels = np.where(np.arange(20) % 2, "a", "b")
    loss = LOSS + 15.0 * (labels == "a")
    links = measured(loss)
    bounded = make_term(links, "offset", labels=labels, bounds=(-10, 10))
    assert log_distance(links, objective(links, bounded), NOTHING).path_loss_db() == pytest.approx(loss)
    assert abs(log_distance(links, objective(links), NOTHING).path_loss_db() - loss).max() > 5
    slope = make_term(links, "log_distance", "log_distance", labels=labels)
    assert log_distance(links, objective(links, bounded, slope), NOTHING).path_loss_db() == pytest.approx(
        loss
    )
    # A group without calibration links gets the mean of the others.
    only_a = objective(links, bounded, calibrated=labels == "a")
    assert log_distance(links, only_a, NOTHING).path_loss_db() == pytest.approx(loss + 15.0 * (labels == "b"))


@pytest.mark.parametrize("by", ["constant", "log_distance"])
def test_a_prior_of_the_study_does_not_draw_the_law_towards_zero(by):
    """A prior of 3 dB says that the twin's offset or slope is small, not that the law's intercept or slope is."""
    loss = LOSS + 5.0 * np.random.default_rng(1).standard_normal(20)
    links = measured(loss)
    plain = log_distance(links, objective(links), NOTHING).path_loss_db()
    term = make_term(links, "narrow", by, prior=3.0)
    narrow = log_distance(links, replace(objective(links, term), noise_db=5.0), NOTHING)
    assert narrow.path_loss_db() == pytest.approx(plain, abs=1e-6)
    # Groups deviate from a common intercept or slope, as in the twin.
    labels = np.where(np.arange(20) % 2, "a", "b")
    term = make_term(links, "narrow", by, labels=labels, prior=0.01)
    grouped = log_distance(links, replace(objective(links, term), noise_db=5.0), NOTHING)
    assert grouped.path_loss_db() == pytest.approx(plain, abs=0.01)


def test_receivers_on_a_circle_determine_no_slope_and_are_kriged():
    """Their distances are equal up to rounding, as on a turntable."""
    random, angle = np.random.default_rng(2), np.linspace(0.0, 6.0, 20)
    tx = np.array([123.4, 56.7, 10.0])
    rx = tx + np.stack([47.3 * np.cos(angle), 47.3 * np.sin(angle), np.full(20, -8.5)], axis=1)
    loss = 90.0 + 4.0 * np.sin(angle) + random.standard_normal(20)
    links = Measurements(tx=np.tile(tx, (20, 1)), rx=rx, path_loss_db=loss)
    assert 0 < np.ptp(links.distance) < 1e-12
    model, known_db = log_distance(links, objective(links), NOTHING)
    assert model.coefficients(known_db[None])[0] == pytest.approx([loss.mean(), 0.0])
    trend_db = model.with_nuisance(known_db)
    kriged = kriging(links, model.reweighted(np.where(np.arange(20) % 2, 1.0, 0.0)), trend_db)
    held_out = np.arange(20) % 2 == 0
    error_db = [np.std((each - loss)[held_out]) for each in (kriged, trend_db)]
    assert error_db[0] < 0.6 * error_db[1]


def test_a_further_nuisance_keeps_its_bounds():
    foliage = np.arange(20.0) % 3
    links = measured(LOSS - 6.0 * foliage, table=SourceTable(pd.DataFrame({"foliage": foliage})))
    term = make_term(links, "foliage", "foliage", bounds=(0.0, 2.0))
    model, known_db = log_distance(links, objective(links, term), NOTHING)
    assert model.coefficients(known_db[None])[0, 0] == 0.0


@pytest.mark.parametrize("bounds", [None, (3.0, 40.0)])
def test_a_group_whose_links_do_not_determine_its_slope_has_that_of_the_others(bounds):
    """One link gives an offset only; the link is predicted as it is fitted, and others with the common slope."""
    labels = np.array(["a"] * 10 + ["b"] * 10)
    labels[[4, 7]] = "c"
    shift_db = np.select([labels == "a", labels == "b"], [2.0, -3.0], 7.0)
    links = measured(
        90.0 + shift_db + 12.0 * np.log10(DISTANCE),
        group=labels,
        table=SourceTable(pd.DataFrame({"set": labels})),
    )
    terms = (
        make_term(links, "offset", labels=labels),
        make_term(links, "clutter", "log_distance", labels=labels, bounds=bounds),
    )
    fitted = objective(links, *terms, calibrated=np.arange(20) != 7)
    scene_db = np.full(20, 90.0)
    assert fitted.with_nuisance(scene_db) == pytest.approx(links.path_loss_db)
    content = planted.content(
        "links.csv", offset={"per": "set"}, nuisance={"clutter": {"by": "log_distance", "per": "set"}}
    )
    every = fitted_terms(fitted, scene_db, Study.from_content(content))
    predicting = PredictionModel(Model.CALIBRATED, {}, every, 1.0, "", 15)
    added_db = nuisance_shift(model_terms(predicting, links), links).value_db[0]
    assert scene_db + added_db == pytest.approx(links.path_loss_db)


def test_losses_out_of_sight_and_per_wall_are_recovered():
    walls = np.arange(20) % 4
    links = measured(LOSS + 12.0 * (walls > 0) + 3.0 * walls, table=blocked(walls))
    assert obstructed(links, objective(links), NOTHING).path_loss_db() == pytest.approx(
        links.path_loss_db, abs=0.6
    )
    assert abs(log_distance(links, objective(links), NOTHING).path_loss_db() - links.path_loss_db).max() > 6.0


def test_links_in_sight_say_nothing_of_those_out_of_sight():
    """Where none was measured, the loss out of sight is that of the prior."""
    walls = np.where(np.arange(20) < 15, 0, 1)
    links = measured(LOSS, table=blocked(walls))
    law = obstructed(links, objective(links, calibrated=walls == 0), NOTHING).path_loss_db()
    assert law == pytest.approx(LOSS + OUT_OF_SIGHT_DB[0] * walls, abs=1e-6)
    assert has_obstruction(links)
    assert not has_obstruction(links.select(walls == 0))
    study = Study.from_content(planted.content("links.csv"))
    model, known_db = obstructed(links, objective(links, calibrated=walls == 0), NOTHING)
    terms = with_prior_mean(fitted_terms(model, known_db, study), study)
    predicting = PredictionModel(Model.OBSTRUCTION, None, terms, 1.0, "", 15)
    new = nuisance_shift(model_terms(predicting, links), links).value_db[0]
    assert new == pytest.approx(law, abs=1e-6)


def blocked(walls):
    """Columns of links whose direct lines cross some walls."""
    return SourceTable(pd.DataFrame({"out_of_sight": 1.0 * (walls > 0), "walls_crossed": 1.0 * walls}))


def test_a_nuisance_of_the_study_keeps_its_name_and_has_no_prior_mean():
    """A study's own loss out of sight is not shifted, and its names are not taken."""
    walls = np.arange(20) % 4
    links = measured(LOSS + 12.0 * (walls > 0), table=blocked(walls))
    own = make_term(links, "out of sight", "out_of_sight")
    taken = make_term(links, "walls crossed")
    model, known_db = obstructed(links, objective(links, own, taken), NOTHING)
    assert [term.name for term in model.nuisance.terms][:2] == ["out of sight", "walls crossed"]
    assert "walls crossed of all" in [term.name for term in model.nuisance.terms]
    assert (known_db == 0).all()
    fitted = (FittedTerm("out of sight", "out_of_sight", "", {"": 12.0}),)
    content = planted.content("links.csv", nuisance={"out of sight": {"by": "out_of_sight"}})
    assert with_prior_mean(fitted, Study.from_content(content)) == fitted
    (shifted,) = with_prior_mean(fitted, Study.from_content(planted.content("links.csv")))
    assert shifted.coefficients == {"": 12.0 + OUT_OF_SIGHT_DB[0]}
