"""Assessment of a calibration: intervals, undeclared offset, priors, held-out blocks, prediction errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import planted
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.optimizers import LeastSquares
from calibray.paths import take_links
from calibray.reporting import result_tables as tables
from calibray.result.held_out import Model
from calibray.result.wording import NOT_JUDGED, reason_text
from calibray.study import Setup, Study
from calibray.tables import render
from calibray.uncertainty.assessment import certainty
from calibray.validation import models
from calibray.validation.validate import validate_problem
from link_tables import links_from_frame

pytestmark = pytest.mark.usefixtures("own_cache")

CENSORED = planted.content("links.csv")["links"] | {
    "quantity": "received_power", "tx_power_dbm": 0.0, "noise_floor_dbm": -100.0, "below_floor": "censor",
}  # fmt: skip
STEPS = 21
"""Values per parameter of the grid for an exact posterior."""

MARBLE = "marble.relative_permittivity"


def run(folder, table: pd.DataFrame, **sections) -> Result:
    return calibrate(planted.study(folder, table, **sections), engine=planted.engine())


@pytest.fixture(scope="module")
def noisy() -> pd.DataFrame:
    return planted.campaign(noise_db=0.3)


@pytest.fixture(scope="module")
def result(tmp_path_factory, noisy) -> Result:
    """A calibration with noise, which compares all noise models."""
    return run(tmp_path_factory.mktemp("plain"), noisy, noise=None)


def test_intervals_come_from_draws_and_have_reasons(result):
    assert result.cost.uncertainty_replays > 100
    for name, found in result.intervals.items():
        assert (
            found.pieces[0][0] == found.lower <= result.parameters[name] <= found.upper == found.pieces[-1][1]
        )
        assert found.reason
    assert result.intervals[MARBLE].lower <= planted.TRUTH[MARBLE] <= result.intervals[MARBLE].upper
    text = render(*tables.tables(result))
    assert reason_text(result.intervals[MARBLE].reason) in text
    assert f"{result.cost.uncertainty_replays:,} in" in text


@pytest.mark.usefixtures("all_draws")
def test_draws_fit_the_links_about_as_well_as_the_optimum(tmp_path, noisy):
    result = run(tmp_path, noisy)
    names = list(result.parameters)
    points = np.stack([result.uncertainty.draws[name] for name in names], axis=1)
    measured = result.links.measured_db.to_numpy()
    rmse = np.sqrt(np.mean((planted.engine().path_loss(points) - measured) ** 2, axis=1))
    # A search from few points may miss the lowest minimum by a little, which draws then find.
    assert 0.9 * result.rmse_db < rmse.min() < np.median(rmse) < 1.5 * result.rmse_db
    assert np.median(np.std(points, axis=0)) > 1e-3


@pytest.mark.parametrize(
    ("stated", "kind"),
    [
        ({}, "gaussian"),
        ({"kind": "student-t"}, "student-t"),
        ({"range_m": 20.0}, "correlated"),
        ({"heterogeneity": 0.5}, "heterogeneous"),
    ],
)
def test_few_links_follow_the_noise_that_the_study_states(tmp_path, noisy, stated, kind):
    """Seven links cannot show which noise they have."""
    parameters = {MARBLE: {"bounds": planted.BOUNDS}}
    found = calibrate(planted.study(tmp_path, noisy.iloc[:7], parameters=parameters, noise=stated))
    assert found.uncertainty.noise[kind] == pytest.approx(1.0)
    others = found.uncertainty.noise.keys() - {kind, "offset"}
    assert others <= ({"gaussian"} if kind == "heterogeneous" else set())


def test_as_many_unknowns_as_links_leave_the_whole_range(tmp_path, noisy):
    """Each link has its offset, so that all residuals are 0, which says nothing about errors."""
    devices = {"device": {"by": "constant", "per": "rx_x"}}
    found = run(tmp_path, noisy, nuisance=devices)
    assert found.rmse_db < 1e-9
    for interval in found.intervals.values():
        assert [interval.lower, interval.upper] == planted.BOUNDS
        assert interval.standard_error == pytest.approx(np.ptp(planted.BOUNDS) / np.sqrt(12.0))
        assert interval.label == "not identifiable"
        assert reason_text(interval.reason) == "too few links (12) for this number of unknowns"


def test_an_undeclared_offset_gives_a_warning(tmp_path, noisy, result):
    offset = 8.0  # 4 dB can be put on the materials: 0.66 instead of 0.58 dB is no evidence of an offset
    shifted = run(tmp_path, noisy.assign(path_loss_db=noisy.path_loss_db + offset))
    assert shifted.uncertainty.undeclared_offset_db == pytest.approx(
        offset, abs=4 * shifted.uncertainty.undeclared_offset_error_db
    )
    assert any("undeclared offset of +" in remark for remark in shifted.remarks)
    assert "undeclared offset" in render(*tables.tables(shifted))
    # Negative controls: none planted, or one declared.
    assert abs(result.uncertainty.undeclared_offset_db) < 3 * result.uncertainty.undeclared_offset_error_db
    assert not any("undeclared offset" in remark for remark in result.remarks)
    declared = run(tmp_path, noisy.assign(path_loss_db=noisy.path_loss_db + offset), offset={})
    assert declared.uncertainty.undeclared_offset_db is None


def test_a_prior_shifts_the_optimum_according_to_the_noise(tmp_path, noisy, result):
    def found(spread, **sections):
        entry = {"bounds": planted.BOUNDS, "prior": {"value": 4.0, "spread": spread}}
        bounds = {name: {"bounds": planted.BOUNDS} for name in planted.TRUTH}
        return run(tmp_path, noisy, parameters={**bounds, MARBLE: entry}, **sections)

    free, tight, loud = found(5.0), found(0.01), found(0.1, noise={"std_db": 30.0})
    assert free.parameters == pytest.approx(result.parameters, rel=2e-2)
    assert tight.parameters[MARBLE] == pytest.approx(4.0, rel=0.1)
    assert loud.parameters[MARBLE] == pytest.approx(4.0, rel=0.05)
    # The RMSE stays the paper's, of the links alone.
    assert tight.rmse_db > result.rmse_db
    assert tight.rmse_db == tight.history.best_db.iloc[-1]
    loss = planted.path_loss(tight.parameters)
    assert np.sqrt(np.mean((loss - noisy.path_loss_db) ** 2)) == pytest.approx(tight.rmse_db)


def test_a_planted_slope_is_recovered_reported_and_used_for_prediction(tmp_path, noisy):
    distance = np.linalg.norm(noisy[["rx_x", "rx_y"]].assign(z=-1.5), axis=1)
    table = noisy.assign(path_loss_db=planted.path_loss() + 9.0 * np.log10(distance), level=np.arange(12.0))
    sections = {"offset": {}, "nuisance": {"clutter": {"by": "log_distance"}}}
    found = run(tmp_path, table, **sections)
    assert found.nuisance.coefficients["clutter"][""] == pytest.approx(9.0, abs=0.1)
    assert found.parameters == pytest.approx(planted.TRUTH, rel=0.05)
    found.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.content() == found.content()
    again = loaded.predict(planted.links())
    assert again == pytest.approx(found.links.after_db.to_numpy(), abs=1e-6)
    assert "clutter" in render(*tables.tables(found))


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"nuisance": {"offset": {"by": "constant"}}}, "nuisance.offset"),
        ({"nuisance": {"free offset": {"by": "constant"}}}, "nuisance.free offset: Calibray itself uses"),
        (
            {"nuisance": {"offset of the transmitter": {"by": "constant"}}},
            "Calibray itself uses this name",
        ),
        (
            {"nuisance": {"constant of all links": {"by": "log_distance"}}},
            "Calibray itself uses this name",
        ),
        ({"nuisance": {"a": {"by": "constant", "prior": 0}}}, "prior"),
        ({"holdout": {"blocks": 4, "by": "half"}}, "one of where, blocks and by"),
        ({"holdout": {}}, "one of where, blocks and by"),
        ({"links": CENSORED | {"noise_floor_dbm": None}}, "needs noise_floor_dbm"),
        ({"links": CENSORED | {"average": {"by": "cell", "size": 5.0}}}, "remove one of these"),
        ({"links": CENSORED, "noise": {"range_m": 30.0}}, "remove one of these"),
        (
            {"parameters": {MARBLE: {"bounds": [1.5, 12], "prior": {"spread": 0.3}}}},
            "one of itu, value and like",
        ),
        ({"parameters": {MARBLE: {"bounds": [1.5, 12], "prior": {"itu": "bread", "spread": 1}}}}, "bread"),
    ],
)
def test_inapplicable_keys_are_refused(tmp_path, noisy, sections, message):
    with pytest.raises(InputError, match=message):
        planted.study(tmp_path, noisy, **sections)


def test_the_noise_must_be_declared_if_it_cannot_be_estimated(tmp_path, noisy):
    entry = {
        name: {"bounds": planted.BOUNDS, "prior": {"value": 4.0, "spread": 0.3}} for name in planted.TRUTH
    }
    table = noisy.head(3)
    study = planted.study(tmp_path, table, parameters=entry)
    few = engines.Replay(take_links(planted.engine().paths, np.arange(3)), planted.engine().parameters)
    with pytest.raises(InputError, match=r"noise\.std_db: is required"):
        calibrate(study, engine=few)


def validation(folder, table, **sections):
    """Validation by blocks on paths traced once."""
    setup = Setup.open(planted.study(folder, table, **sections))
    return validate_problem(Problem.of(setup, planted.engine()), **({} if sections else {"blocks": 3}))


def test_calibration_improves_predictions_of_planted_data(tmp_path, noisy):
    found = validation(tmp_path, noisy)
    assert found.table.loc[Model.CALIBRATED, "rmse_db"] < found.table.loc[Model.LOG_DISTANCE, "rmse_db"]
    assert "did not help" not in found.sentence
    assert found.best.startswith("calibrated")


def test_a_hopeless_variant_is_reported(tmp_path, noisy):
    distance = np.linalg.norm(noisy[["rx_x", "rx_y"]].assign(z=-1.5), axis=1)
    noise = 0.5 * np.random.default_rng(5).standard_normal(12)
    law = noisy.assign(path_loss_db=30 + 35 * np.log10(distance) + noise)
    found = validation(tmp_path, law, offset={}, holdout={"blocks": 3})
    assert found.sentence.startswith("Calibration did not help")
    assert found.best not in ("calibrated", "calibrated with prior")


def test_searches_away_from_known_minima_end_early(tmp_path, noisy, monkeypatch):
    """The models are the same and cost fewer replays."""
    problem = Problem.of(Setup.open(planted.study(tmp_path, noisy)), planted.engine())
    known = {Model.CALIBRATED: models.find_minima(problem, np.zeros((0, 3)), 64)}

    def judged():
        before = problem.engine.calls
        return validate_problem(problem, 3, known_minima=known), problem.engine.calls - before

    quick, spent = judged()
    monkeypatch.setattr(models, "NEARER", 1e6)
    patient, more = judged()
    assert spent < 0.95 * more
    for name, errors in patient.errors.items():
        assert quick.errors[name] == pytest.approx(errors, abs=0.05, nan_ok=True)


def test_a_run_with_blocks_is_validated_by_them(tmp_path, noisy):
    found = run(tmp_path, noisy, holdout={"by": "half"})
    assert not found.links.held_out.any()
    assert found.holdout_rmse_db > found.rmse_db
    assert found.prediction.model.basis.endswith("errors on 2 blocks held out in turn")
    assert any(remark.startswith("Calibration ") for remark in found.remarks)
    assert found.prediction.model.name == Model.AVERAGE_CALIBRATED


def test_groups_that_are_held_out_as_a_whole_are_announced(tmp_path, noisy, caplog):
    problem = Problem.of(Setup.open(planted.study(tmp_path, noisy, offset={"per": "half"})), planted.engine())
    with caplog.at_level("WARNING"):
        validate_problem(problem, by="half")
    (message,) = caplog.messages
    assert message.startswith("offset: 12 of 12 links are held out together with all links of their group")
    caplog.clear()
    with caplog.at_level("WARNING"):
        validate_problem(problem, 4)
    assert not caplog.messages


def test_a_run_without_validation_says_how_to_validate(result, tmp_path, noisy):
    assert NOT_JUDGED in result.remarks
    assert NOT_JUDGED not in run(tmp_path, noisy, holdout={"where": "half == 'east'"}).remarks


def test_predictions_use_the_model_that_validation_chooses(tmp_path, noisy):
    """With path loss planted by distance only, that is the distance law."""
    distance = np.linalg.norm(noisy[["rx_x", "rx_y"]].assign(z=-1.5), axis=1)
    noise = 0.5 * np.random.default_rng(5).standard_normal(12)
    table = noisy.assign(path_loss_db=30 + 35 * np.log10(distance) + noise)
    law = run(tmp_path, table, holdout={"blocks": 3})
    assert law.prediction.model.name == Model.LOG_DISTANCE
    assert law.prediction.model.parameters is None
    assert any("The chosen model is 'log-distance'" in remark for remark in law.remarks)
    told = law.predict_interval(planted.links())
    assert told.path_loss_db.to_numpy() == pytest.approx(30 + 35 * np.log10(distance), abs=1.0)
    assert told.path_loss_db.to_numpy() == pytest.approx(law.predict(planted.links()))
    assert ((told.lower_db < table.path_loss_db) & (table.path_loss_db < told.upper_db)).mean() > 0.8
    assert "log-distance, errors on 3 blocks" in told.basis[0]
    law.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.prediction.model == law.prediction.model
    assert loaded.predict_interval(planted.links()).equals(told)


def test_the_log_distance_model_with_obstruction_predicts_where_it_is_best(tmp_path, noisy):
    """Columns of the table take the place of those that the scene gives."""
    distance = np.linalg.norm(noisy[["rx_x", "rx_y"]].assign(z=-1.5), axis=1)
    walls = np.arange(12) % 3
    loss = 30 + 25 * np.log10(distance) + 12.0 * (walls > 0) + 0.5 * walls
    table = noisy.assign(path_loss_db=loss, out_of_sight=1.0 * (walls > 0), walls_crossed=1.0 * walls)
    law = run(tmp_path, table, holdout={"blocks": 3})
    assert law.prediction.model.name == Model.OBSTRUCTION
    assert law.prediction.model.parameters is None
    assert law.predict(table) == pytest.approx(loss, abs=1.5)
    assert law.links.predicted_db.to_numpy() == pytest.approx(law.predict(table))
    # Without these columns the scene gives them: all links are in sight.
    in_sight = law.predict(planted.links())
    assert in_sight[walls > 0] == pytest.approx(loss[walls > 0] - 12.0 - 0.5 * walls[walls > 0], abs=1.5)


def test_predictions_have_standard_errors(tmp_path, noisy, result):
    table = result.predict_interval(planted.links(), 0.9)
    truth = planted.path_loss()
    assert table.path_loss_db.to_numpy() == pytest.approx(result.predict(planted.links()), abs=1e-6)
    assert ((table.lower_db < truth) & (truth < table.upper_db)).mean() > 0.8
    wider = result.predict_interval(planted.links(), 0.99)
    assert (wider.upper_db > table.upper_db).all()
    assert set(table.basis) == {"errors of 12 calibration links"}
    blocked = result.predict_interval(planted.links(blocked=True))
    assert blocked.basis[planted.INSIDE].startswith("no path: log-distance")
    assert blocked.lower_db[planted.INSIDE] < blocked.path_loss_db[planted.INSIDE]
    with pytest.raises(InputError, match=r"level = 1\.5"):
        result.predict_interval(planted.links(), 1.5)


def test_an_unmeasured_group_gets_the_spread_of_the_others(tmp_path, noisy):
    shift = noisy.half.map({"west": -6.0, "east": 6.0})
    found = run(tmp_path, noisy.assign(path_loss_db=noisy.path_loss_db + shift), offset={"per": "half"})
    seen = found.predict_interval(planted.links())
    unseen = found.predict_interval(planted.links().assign(half="north"))
    width = (unseen.upper_db - unseen.lower_db) / (seen.upper_db - seen.lower_db)
    assert (width > 3).all()
    assert all("group without measurements" in basis for basis in unseen.basis)
    middle = found.predict(planted.links().assign(half="west")) + found.predict(
        planted.links().assign(half="east")
    )
    assert unseen.path_loss_db.to_numpy() == pytest.approx(middle / 2, abs=1e-6)


@pytest.mark.usefixtures("all_draws")
def test_a_well_determined_parameter_is_never_not_identifiable():
    """Against the exact posterior on a grid with known noise; overwhelming noise is the control."""
    study = Study.from_content(planted.content("links.csv", offset={}))
    problem = Problem.of(Setup.open(study, links=links_from_frame(planted.links())), planted.engine())
    lower, upper = problem.parameters.search_bounds
    axis = np.linspace(0.0, 1.0, STEPS)
    unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    loss = problem.modelled(lower + unit * (upper - lower))
    random = np.random.default_rng(11)
    well = 0
    for noise_db in (0.1, 30.0):
        truth = lower + random.uniform(0.1, 0.9, 3) * (upper - lower)
        measured = problem.modelled(truth[None])[0] + noise_db * random.standard_normal(planted.LINKS)
        gap = measured - loss
        gap -= gap.mean(axis=1, keepdims=True)  # The offset has no prior.
        density = np.exp(-0.5 * np.sum(gap**2, axis=1) / noise_db**2).reshape(3 * (STEPS,))
        here = replace(problem, objective=replace(problem.objective, measured=measured))
        told = certainty(here, search(here, LeastSquares(lower, upper, starts=32)))
        for k, interval in enumerate(told.record.intervals.values()):
            share = np.sort(density.sum(axis=tuple({0, 1, 2} - {k})))[::-1]
            held = 1 + np.searchsorted(np.cumsum(share) / share.sum(), 0.9)
            if held <= 0.1 * STEPS:
                well += 1
                assert interval.verdict != "not identifiable"
            elif noise_db == 30.0:
                assert interval.verdict == "not identifiable"
    assert well >= 2
