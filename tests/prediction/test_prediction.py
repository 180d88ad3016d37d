"""Predictions: the measured quantity, remarks on positions, and the residual field near measured links."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.special import stdtrit
from typer.testing import CliRunner

import planted
import programs
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.prediction.corrections import (
    TermAtLinks,
    calibration_residuals,
    krige_residuals,
    nuisance_shift,
)
from calibray.prediction.suggestion import suggest
from calibray.result.held_out import BlockErrors, ResidualField
from calibray.scenes import Triangles
from calibray.scenes.checks.positions import locate
from calibray.study import Study
from calibray.uncertainty.residual_correlation import shared_errors
from calibray.validation.held_out_statistics import FEWEST_FOR_RANKS, interval_half_width, two_levels
from calibray.validation.models import TX_OFFSET
from changed import changed
from link_tables import links_from_frame

pytestmark = pytest.mark.usefixtures("own_cache")

FIELD = ResidualField(range_m=20.0, shared_db=3.0, own_db=1.0)


@pytest.fixture(scope="module")
def received(tmp_path_factory) -> Result:
    """A calibration on received power, transmitted with 30 dBm at every link."""
    table = planted.campaign(noise_db=0.3)
    table = table.assign(power_dbm=30.0 - table.path_loss_db, sent_dbm=30.0)
    links = {
        "file": "links.csv", "tx": list(planted.COLUMNS[:3]), "rx": list(planted.COLUMNS[3:]), "value": "power_dbm",
        "quantity": "received_power", "tx_power_dbm": "sent_dbm",
    }  # fmt: skip
    method = {"name": "auto", "options": {"starts": 16}}
    plan = planted.study(tmp_path_factory.mktemp("received"), table, links=links, method=method)
    return calibrate(plan, engine=planted.engine())


def test_received_power_is_predicted_in_the_measured_quantity(received):
    table = planted.links(blocked=True).assign(sent_dbm=33.0)
    predictions = received.predict_interval(table)
    assert predictions.received_power_dbm.to_numpy() == pytest.approx(
        33.0 - predictions.path_loss_db.to_numpy()
    )
    reached = np.isfinite(predictions.lower_db)
    ends = predictions[reached]
    assert (ends.received_power_lower_dbm < ends.received_power_dbm).all()
    assert ends.received_power_upper_dbm.to_numpy() == pytest.approx(33.0 - ends.lower_db.to_numpy())
    some = table[table.index != 1][::-1]
    pd.testing.assert_frame_equal(received.predict_interval(some), predictions.loc[some.index])
    # Without the power there is path loss alone.
    assert "received_power_dbm" not in received.predict_interval(planted.links())
    assert predictions.remark[planted.INSIDE] == "receiver inside a building"
    assert predictions.basis[planted.INSIDE] == "no path: log-distance, errors of 12 calibration links"
    assert set(predictions.remark[~predictions.basis.str.startswith("no path")]) == {""}


def test_links_far_weaker_than_every_calibrated_one_have_a_remark(received):
    """Links near the noise floor do not count as calibrated; a remark on the position comes first."""
    links = received.links
    weakest_db = float(links.measured_db.max())
    table = planted.links(blocked=True).assign(sent_dbm=30.0)
    loss_db = received.predict_interval(table).path_loss_db.to_numpy()
    lowered = links.assign(measured_db=links.measured_db - weakest_db + np.median(loss_db) - 10.0)
    remarks = replace(received, links=lowered).predict_interval(table).remark
    weaker = loss_db > np.median(loss_db)
    weaker[planted.INSIDE] = False
    assert remarks[planted.INSIDE] == "receiver inside a building"
    assert (remarks == "over 10 dB weaker than all links used in the calibration").tolist() == weaker.tolist()
    assert 0 < weaker.sum() < len(weaker) - 1
    strong = lowered.assign(faint=lowered.measured_db < lowered.measured_db.max())
    weak = strong.assign(faint=~strong.faint)
    assert (replace(received, links=strong).predict_interval(table).remark == remarks).all()
    assert (replace(received, links=weak).predict_interval(table).remark != remarks).any()


def test_a_table_with_the_columns_of_the_measurements_is_predicted(tmp_path):
    """The study names the columns and gives the transmitter's position."""
    names = {"rx_x": "east", "rx_y": "north"}
    table = planted.campaign(noise_db=0.3).rename(columns=names)[["east", "north", "path_loss_db"]]
    links = {
        "file": "links.csv", "tx": [0.0, 0.0, 3.0], "rx": ["east", "north", 1.5], "value": "path_loss_db",
    }  # fmt: skip
    method = {"name": "auto", "options": {"starts": 16}}
    result = calibrate(planted.study(tmp_path, table, links=links, method=method), engine=planted.engine())
    standard = planted.links().iloc[::3]
    own_columns = standard.rename(columns=names)[["east", "north"]]
    predicted = result.predict(standard)
    assert np.isfinite(predicted).all()
    assert result.predict(own_columns) == pytest.approx(predicted)
    assert result.predict(own_columns.astype(object)) == pytest.approx(predicted)
    for wrong, message in (
        ("new.csv", "links: is a str, must be a pandas DataFrame, such as pandas.read_csv"),
        (own_columns.to_numpy(), r"links: is a numpy\.ndarray, must be a pandas DataFrame"),
        (pd.concat([own_columns, own_columns], axis=1), "links: several columns are named 'east'; keep one"),
    ):
        with pytest.raises(InputError, match=message):
            result.predict(wrong)
    assert result.predict_interval(own_columns).upper_db.to_numpy() == pytest.approx(
        result.predict_interval(standard).upper_db.to_numpy()
    )
    assert suggest(result, own_columns, 1).row.tolist() == suggest(result, standard, 1).row.tolist()
    result.save(tmp_path / "out")
    own_columns.to_csv(tmp_path / "new.csv", index=False)
    run = CliRunner().invoke(app, ["predict", str(tmp_path / "out"), str(tmp_path / "new.csv")])
    assert run.exit_code == 0, run.output
    printed = pd.read_csv(io.StringIO(run.stdout))
    assert printed.columns.tolist() == ["east", "north", "path_loss_db", "basis"]
    assert printed.path_loss_db.to_numpy() == pytest.approx(predicted)


def test_the_command_adds_columns_and_warns_of_implausible_positions(received, tmp_path):
    received.save(tmp_path / "out")
    table = planted.links().head(3).assign(sent_dbm=30.0)
    table.loc[1, "rx_z"], table.loc[2, "rx_x"] = -2.0, 5000.0
    table.to_csv(tmp_path / "new.csv", index=False)
    arguments = ["predict", str(tmp_path / "out"), str(tmp_path / "new.csv"), "--level", "0.9"]
    run = CliRunner().invoke(app, arguments)
    assert run.exit_code == 0, run.output
    predictions = pd.read_csv(io.StringIO(run.stdout), keep_default_na=False)
    added = ["basis", "received_power_dbm", "received_power_lower_dbm", "received_power_upper_dbm", "remark"]
    assert predictions.columns.tolist() == [*table.columns, "path_loss_db", "lower_db", "upper_db", *added]
    assert predictions.remark.tolist() == ["", "receiver under the ground", "receiver outside the scene"]
    assert "receiver under the ground: 1 of 3 links, row 3" in run.stderr
    assert "receiver outside the scene: 1 of 3 links, row 4" in run.stderr


def test_places_far_from_the_scene_are_refused(tmp_path):
    """The table swaps longitude and latitude; one place among others only has a remark."""
    frame, table = Frame.local(10.0, 50.0), planted.campaign(noise_db=0.3)
    degrees = frame.to_geographic(table[["rx_x", "rx_y", "rx_z"]].to_numpy())
    table = table.assign(lon=degrees[:, 0], lat=degrees[:, 1])[["lon", "lat", "path_loss_db"]]
    links = {
        "file": "links.csv", "tx": [10.0, 50.0, 3.0], "rx": ["lon", "lat", 1.5], "value": "path_loss_db",
        "position": "geographic",
    }  # fmt: skip
    scene = {"file": "sionna:simple_street_canyon", "frequency": 3.5e9, "origin": [10.0, 50.0]}
    method = {"name": "auto", "options": {"starts": 16}}
    study = planted.study(tmp_path, table, scene=scene, links=links, method=method)
    result = calibrate(study, engine=planted.engine())
    places = table[["lon", "lat"]].iloc[::3]
    swapped = places.rename(columns={"lon": "lat", "lat": "lon"})
    for refused in (result.predict, result.predict_interval, result.suggest):
        with pytest.raises(InputError, match=r"check links\.crs, the order of longitude and latitude"):
            refused(swapped)
    assert len(suggest(result, places, 1)) == 1
    far = planted.links().iloc[::3].assign(rx_x=1e6)
    with pytest.raises(InputError, match="relative to the scene's origin"):
        result.predict(far)
    mixed = result.predict_interval(pd.concat([places, places.head(1) + 0.1]))
    assert mixed.remark.tolist() == [*[""] * len(places), "receiver outside the scene"]
    result.save(tmp_path / "out")
    swapped.to_csv(tmp_path / "swapped.csv", index=False)
    run = CliRunner().invoke(app, ["predict", str(tmp_path / "out"), str(tmp_path / "swapped.csv")])
    assert run.exit_code == 2
    assert "swapped.csv: all receivers are more than" in run.stderr


def test_points_are_located():
    """A box on a wide sheet, next to a bridge of two surfaces."""
    x, y = np.array([[-50, -50], [50, -50], [50, 50], [-50, 50]]).T
    ground = np.column_stack([x, y, np.zeros(4)])

    def slab(east: float, heights: tuple[float, ...]) -> list[np.ndarray]:
        return [np.column_stack([x / 10 + east, y / 10, np.full(4, height)]) for height in heights]

    sheets = [ground, *slab(0.0, (10.0,)), *slab(20.0, (5.0, 6.0))]
    face = np.array([[0, 1, 2], [0, 2, 3]])
    faces = np.concatenate([face + 4 * k for k in range(len(sheets))])
    over = np.repeat([True, False, False, False], 2)
    scene = Triangles(np.concatenate(sheets), faces, np.zeros(len(faces), dtype=np.int64), over)
    points = np.array(
        [[0, 0, 1.5], [0, 0, 12], [20, 0, 1.5], [20, 0, 5.5], [30, 0, 1.5], [30, 0, -1], [90, 0, 1.5]]
    )
    assert locate(scene, points).tolist() == [
        "inside a building", "", "", "inside a building", "", "under the ground", "outside the scene"
    ]  # fmt: skip


def test_residuals_are_kriged_to_neighbours_only():
    random = np.random.default_rng(3)
    measured = np.column_stack([random.uniform(0, 100, (200, 2)), np.zeros((200, 4))])
    position = np.column_stack([random.uniform(0, 100, (400, 2)), np.zeros((400, 4))])
    all_positions = np.vstack([measured, position])
    distance = np.linalg.norm(all_positions[:, None, :2] - all_positions[None, :, :2], axis=2)
    root = np.linalg.cholesky(np.exp(-distance / FIELD.range_m) + 1e-9 * np.eye(600))
    errors = FIELD.shared_db * root @ random.standard_normal(600) + FIELD.own_db * random.standard_normal(600)
    correction, share = krige_residuals(FIELD, measured, errors[:200], position)
    remaining = errors[200:] - correction
    # The scatter of the remaining errors agrees with the share.
    deviation = np.sqrt((1 - share) * (FIELD.shared_db**2 + FIELD.own_db**2) + share * FIELD.own_db**2)
    assert np.mean(np.abs(remaining) < 1.645 * deviation) == pytest.approx(0.9, abs=0.04)
    assert remaining.std() < 0.8 * errors[200:].std()
    far = krige_residuals(FIELD, measured, errors[:200], position + 1e4)
    assert np.abs(far).max() < 1e-9
    few = krige_residuals(FIELD, measured[:60], errors[:60], position[:5])
    many = krige_residuals(
        FIELD, np.vstack([measured[:60], measured[:60] + 1e4] * 10), np.tile(errors[:60], 20), position[:5]
    )
    assert many[0] == pytest.approx(few[0], abs=1.5)
    correlation = shared_errors(errors, all_positions)
    assert correlation is not None
    assert correlation.shared_db == pytest.approx(FIELD.shared_db, rel=0.5)


def test_measured_links_nearby_correct_predictions_and_narrow_the_interval(received, tmp_path):
    assert received.prediction.residual_field is None
    table = planted.links().assign(sent_dbm=30.0)
    plain = received.predict_interval(table)
    size = received.prediction.model.residual_db
    field = ResidualField(range_m=20.0, shared_db=0.9 * size, own_db=0.4 * size)
    with_field = changed(received, residual_field=field)
    predictions = with_field.predict_interval(table)
    _, errors = calibration_residuals(received.links)
    correction = predictions.path_loss_db.to_numpy() - plain.path_loss_db.to_numpy()
    assert np.corrcoef(correction, errors)[0, 1] > 0.8
    assert ((predictions.upper_db - predictions.lower_db) < (plain.upper_db - plain.lower_db)).all()
    assert predictions.basis.str.endswith(", near measured links").all()
    assert predictions.path_loss_db.to_numpy() == pytest.approx(with_field.predict(table), abs=1e-6)
    with_field.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.prediction.residual_field == field
    # The table of links is written with ten digits.
    pd.testing.assert_frame_equal(loaded.predict_interval(table), predictions, rtol=1e-6)


def test_the_interval_of_many_errors_has_the_requested_coverage():
    random = np.random.default_rng(1)
    inside = []
    for _ in range(300):
        errors = np.abs(random.standard_t(3, 61))
        inside.append(errors[-1] <= interval_half_width(np.sort(errors[:-1]), 0.9))
    assert np.mean(inside) == pytest.approx(0.9, abs=0.05)
    few = np.abs(random.standard_normal(FEWEST_FOR_RANKS - 1))
    assert interval_half_width(np.sort(few), 0.9) == pytest.approx(1.685 * np.sqrt(np.mean(few**2)), rel=1e-2)
    assert interval_half_width(np.ones(50), 0.999) > 3.0


def half_width(levels: BlockErrors, links: int) -> float:
    """Half the 90 % interval from errors within and between blocks, each with its own Student's t."""
    within = stdtrit(links - levels.blocks, 0.95) * levels.within_db
    return float(np.hypot(within, stdtrit(levels.blocks, 0.95) * levels.between_db))


def test_a_new_block_lies_in_the_interval_as_often_as_stated():
    """Four blocks with errors of their own; by the size of single errors alone, too few links of a fifth one would."""
    random = np.random.default_rng(3)
    block, position = np.repeat(np.arange(4), 15), np.repeat(np.eye(4), 15, axis=0)
    inside, by_single_errors = [], []
    for _ in range(800):
        errors = np.repeat(random.normal(0.0, 3.0, 4), 15) + random.normal(0.0, 2.0, 60)
        levels = two_levels(errors, block, position)
        half = half_width(levels, 60)
        new = abs(random.normal(0.0, 3.0) + random.normal(0.0, 2.0))
        inside.append(new <= half)
        by_single_errors.append(new <= interval_half_width(np.sort(np.abs(errors)), 0.9))
    assert 0.88 < np.mean(inside) < 0.95
    assert np.mean(by_single_errors) < 0.89 < np.mean(inside) + 0.01
    assert two_levels(errors[:15], block[:15], position[:15]) is None
    # Without errors between blocks, the interval is that of independent errors.
    level = [two_levels(random.normal(0.0, 2.0, 60), block, position) for _ in range(200)]
    width = [half_width(each, 60) for each in level]
    assert np.median(width) == pytest.approx(1.645 * 2.0, rel=0.08)


def test_places_beyond_the_reach_of_held_out_links_get_wider_intervals(received):
    table = planted.links().assign(sent_dbm=30.0, rx_x=planted.links().rx_x - 0.5)
    model, variances = received.prediction.model, []
    for reach_m in (50.0, 0.1):
        levels = BlockErrors(within_db=1.0, between_db=2.0, blocks=4, reach_m=reach_m)
        predictions = changed(received, model=replace(model, links=60, blocks=levels)).predict_interval(table)
        half = (predictions.upper_db - predictions.path_loss_db).to_numpy()
        variances.append(half**2)
    assert (variances[0] > half_width(levels, 60) ** 2 - 1e-9).all()
    added = (stdtrit(4.0, 0.95) * 2.0) ** 2
    assert variances[1] - variances[0] == pytest.approx(np.full(len(table), added), rel=1e-6)


def test_links_out_of_sight_get_wider_intervals_where_their_errors_are_larger(received):
    blocked = np.arange(planted.LINKS) % 2
    table = planted.links().assign(sent_dbm=30.0, out_of_sight=blocked)
    levels = BlockErrors(within_db=1.0, between_db=0.5, blocks=4, reach_m=50.0)
    half = []
    for ratio in (1.0, 1.5):
        model = replace(received.prediction.model, links=60, blocks=replace(levels, out_of_sight=ratio))
        predictions = changed(received, model=model).predict_interval(table)
        half.append((predictions.upper_db - predictions.path_loss_db).to_numpy())
    # The draws' part of the variance does not change.
    added = np.where(blocked > 0, (1.5**2 - 1) * half_width(levels, 60) ** 2, 0.0)
    assert half[1] ** 2 - half[0] ** 2 == pytest.approx(added, rel=1e-6, abs=1e-9)


def test_the_draws_of_a_random_effect_are_its_mean_plus_the_deviations():
    links = links_from_frame(planted.links().iloc[:2])
    term = TermAtLinks("street", np.ones(2), np.array(["a", "b"]), {"a": 5.0, "b": 1.0}, spread_db=2.0)
    draws = {"street": [3.0, 4.0], "street, deviation[a]": [2.5, 1.0], "street, deviation[b]": [-1.0, -2.0]}
    shift = nuisance_shift(iter([term]), links, draws)
    assert shift.value_db.tolist() == [[5.0, 1.0], [5.5, 2.0], [5.0, 2.0]]


def test_a_new_transmitter_gets_the_mean_offset_without_a_request():
    """Its label is its position, which no user misspells; a new label of a study's column is refused."""
    links = links_from_frame(planted.links().iloc[:1])
    own, other = {"0.00,0.00,9.00": 3.0, "9.00,0.00,9.00": 5.0}, "0.00,0.00,3.00"
    term = TermAtLinks(TX_OFFSET, np.ones(1), np.array([other]), own, spread_db=None)
    shift = nuisance_shift(iter([term]), links)
    assert shift.value_db.tolist() == [[4.0]]
    assert shift.spread_db == pytest.approx(np.sqrt(2.0) * np.sqrt(1.5))
    with pytest.raises(InputError, match="has no calibrated street"):
        nuisance_shift(iter([replace(term, name="street")]), links)


@pytest.mark.parametrize("column", ["transmitter", "offset"])
def test_a_column_of_groups_may_have_any_name(tmp_path, column):
    table = planted.campaign(noise_db=0.3).assign(**{column: list("aabbccddaabb")})
    table["path_loss_db"] += 8 + table[column].map({"a": -4, "b": 1, "c": 5, "d": -2})
    nuisance = {"shift": {"by": "constant", "per": column}}
    result = calibrate(planted.study(tmp_path, table, nuisance=nuisance), engine=planted.engine())
    assert result.predict(table) == pytest.approx(result.links.predicted_db.to_numpy())
    assert set(result.predict_interval(table).basis) == {"errors of 12 calibration links"}


@pytest.mark.parametrize("prior", [None, "auto"])
def test_offsets_that_compensate_the_parameters_do_not_widen_intervals(tmp_path, prior):
    """Without links held out: Student's t has the degrees of freedom that all unknowns leave."""
    table = planted.campaign(noise_db=1.0).assign(street=list("aabbccddaabb"))
    table["path_loss_db"] += 8 + table.street.map({"a": -4, "b": 1, "c": 5, "d": -2})
    shift = {"by": "constant", "per": "street"} | ({} if prior is None else {"prior": prior})
    result = calibrate(planted.study(tmp_path, table, nuisance={"shift": shift}), engine=planted.engine())
    coefficients = 4 if prior is None else 5
    freedom = planted.LINKS - len(planted.TRUTH) - coefficients
    ends = result.predict_interval(table)
    half_width = (ends.upper_db - ends.lower_db) / 2
    assert half_width.min() > stdtrit(freedom, 0.95) * result.prediction.model.residual_db
    # A link's leverage is at most 1, so that of its error and of the fit there is at most the square root of 2.
    assert half_width.max() < np.sqrt(2) * stdtrit(freedom, 0.95) * result.prediction.model.residual_db


def test_an_offset_of_few_links_is_uncertain(tmp_path):
    """One link determines the offset of a phone, so its error is in the offset and in a further measurement."""
    table = planted.campaign(noise_db=0.5).assign(phone=["a"] + ["b"] * 11)
    study = planted.study(
        tmp_path,
        table,
        nuisance={"device": {"by": "constant", "per": "phone"}},
        parameters={"marble.relative_permittivity": {"bounds": planted.BOUNDS}},
    )
    result = calibrate(study)
    error_db, of_links = result.prediction.model.residual_db, stdtrit(planted.LINKS - 3, 0.95)
    assert np.std(result.uncertainty.draws["device[a]"]) == pytest.approx(error_db, rel=0.2)
    ends = result.predict_interval(table)
    half_width = ((ends.upper_db - ends.lower_db) / 2).to_numpy()
    assert half_width[0] == pytest.approx(np.sqrt(2) * of_links * error_db, rel=0.1)
    assert half_width[1:].mean() == pytest.approx(np.sqrt(1 + 2 / 11) * of_links * error_db, rel=0.1)


def test_intervals_cover_new_links_though_stated_errors_differ(tmp_path):
    """A few exact links say much of the parameters and nothing of the errors of others."""
    std, random = np.tile([0.1, 4.0], planted.LINKS // 2), np.random.default_rng(1)
    truth = planted.campaign().assign(std=std)
    table = truth.assign(path_loss_db=truth.path_loss_db + std * random.standard_normal(planted.LINKS))
    links = planted.content("links.csv")["links"] | {"std": "std"}
    result = calibrate(planted.study(tmp_path, table, links=links), engine=planted.engine())
    error_db = result.links.measured_db - result.links.after_db
    freedom = planted.LINKS - len(planted.TRUTH)
    assert result.prediction.model.residual_db == pytest.approx(np.sqrt(np.sum(error_db**2) / freedom))
    ends = result.predict_interval(truth)
    new_db = truth.path_loss_db.to_numpy() + std * random.standard_normal((1000, planted.LINKS))
    inside = (ends.lower_db.to_numpy() <= new_db) & (new_db <= ends.upper_db.to_numpy())
    assert 0.85 < inside.mean() < 0.99


def test_the_reach_of_links_held_out_by_a_filter_is_their_distance_from_the_calibration_links(tmp_path):
    table, marble = planted.campaign(noise_db=1.0), "marble.relative_permittivity"
    sections = {"holdout": {"where": "rx_x > -9"}, "parameters": {marble: {"bounds": planted.BOUNDS}}}
    result = calibrate(planted.study(tmp_path, table, **sections))
    receivers = table[["rx_x", "rx_y", "rx_z"]].to_numpy()
    held_out = table.rx_x.to_numpy() > -9
    apart = np.linalg.norm(receivers[held_out][:, None] - receivers[~held_out], axis=2).min(axis=1)
    assert result.prediction.model.blocks.reach_m == pytest.approx(np.quantile(apart, 0.9))


def test_constants_that_depend_on_frequency_keep_their_law_at_other_carriers(tmp_path, caplog):
    """Draws of a conductivity at the carrier of all measured links say nothing of another carrier."""
    table = planted.campaign(noise_db=0.3).assign(carrier_hz=3.5e9)
    links = planted.content("links.csv")["links"] | {"frequency": "carrier_hz"}
    noise = {"kind": "gaussian", "range_m": 0, "heterogeneity": 0}
    result = calibrate(planted.study(tmp_path, table, links=links, noise=noise))
    assert "marble.conductivity" in result.uncertainty.draws
    for carrier in (3.5e9, 28e9):
        new = table.assign(carrier_hz=carrier)
        ends = result.predict_interval(new)
        assert ends.path_loss_db.to_numpy() == pytest.approx(result.predict(new), abs=1e-6)
        assert (ends.lower_db < ends.path_loss_db).all()
        assert suggest(result, new, 1).path_loss_db[0] == pytest.approx(ends.path_loss_db.mean(), abs=5.0)
    assert "12 of 12 links have carriers other than the measured 3.5 GHz;" in caplog.text
    caplog.clear()
    suggest(result, new, 1)
    assert "12 of 12 links have carriers other than the measured 3.5 GHz;" in caplog.text
    suggest(result, new.drop(columns="carrier_hz"), 1)
    assert "lacks the column of carriers 'carrier_hz'" in caplog.text


def test_labels_that_read_as_numbers_alone_are_those_of_the_measured_links(tmp_path):
    """Beside 2b3 the label 1e5 is a text; in a table without other labels, it reads as 100000."""
    table = planted.campaign(noise_db=0.3).assign(
        cell=lambda rows: rows.half.map({"west": "1e5", "east": "2b3"})
    )
    table["path_loss_db"] += np.where(table.cell == "1e5", 5.0, -4.0)
    result = calibrate(planted.study(tmp_path, table, offset={"per": "cell"}))
    one = table[table.cell == "1e5"].drop(columns="path_loss_db")
    together = result.predict(table.drop(columns="path_loss_db"))[(table.cell == "1e5").to_numpy()]
    assert result.predict(one.assign(cell=100_000.0)) == pytest.approx(together)
    assert (suggest(result, one.assign(cell=100_000.0), 1).group == "1e5").all()


def test_a_program_that_changed_since_the_calibration_is_reported(tmp_path, caplog):
    """One calibration link is sent with the new links; it does not change their predictions."""
    method = {"name": "random", "model": "none", "options": {"budget": 6}}
    content = programs.content(tmp_path) | {"method": method}
    result = calibrate(Study.from_content(content, tmp_path / "study.toml"))
    new = planted.links().head(3)
    predicted = result.predict(new)
    values = np.array(list(result.parameters.values()))
    assert predicted == pytest.approx(programs.expected(values, new)[0])
    assert "changed since the calibration" not in caplog.text
    program = tmp_path / "model.py"
    program.write_text(program.read_text().replace("return 60 +", "return 60.5 +"))
    assert result.predict(new) == pytest.approx(predicted + 0.5)
    (message,) = [text for text in caplog.messages if "the program or its files changed" in text]
    assert "run the study again into a new folder" in message
