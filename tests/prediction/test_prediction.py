"""What predictions say beside path loss: what was measured, odd places, and what measured links nearby tell."""

from __future__ import annotations

import io

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import planted
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.prediction.position_checks import standing
from calibray.prediction.residual_field import carried, measured_errors
from calibray.prediction.suggestion import suggest
from calibray.result.prediction_model import ResidualField
from calibray.scenes import Triangles
from calibray.uncertainty.residuals import shared_errors
from calibray.validation.held_out_statistics import FEWEST_FOR_RANKS, interval_half_width
from changed import changed

FIELD = ResidualField(range_m=20.0, shared_db=3.0, own_db=1.0)


@pytest.fixture(autouse=True)
def _no_cache(monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")


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
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", "")
        plan = planted.study(tmp_path_factory.mktemp("received"), table, links=links, method=method)
        return calibrate(plan, engine=planted.engine())


def test_received_power_is_predicted_as_it_was_measured(received):
    table = planted.links(blocked=True).assign(sent_dbm=33.0)
    told = received.predict_interval(table)
    assert told.received_power_dbm.to_numpy() == pytest.approx(33.0 - told.path_loss_db.to_numpy())
    reached = np.isfinite(told.lower_db)
    ends = told[reached]
    assert (ends.received_power_lower_dbm < ends.received_power_dbm).all()
    assert ends.received_power_upper_dbm.to_numpy() == pytest.approx(33.0 - ends.lower_db.to_numpy())
    # Without the power there is path loss alone.
    assert "received_power_dbm" not in received.predict_interval(planted.links())
    assert (told.remark[planted.INSIDE], told.basis[planted.INSIDE]) == (
        "receiver inside a building",
        "no path",
    )
    assert set(told.remark[reached]) == {""}


def test_a_table_like_the_measured_one_is_predicted_at(tmp_path):
    """Columns that the study names, the transmitter's place with it: by Python, and by the command."""
    names = {"rx_x": "east", "rx_y": "north"}
    table = planted.campaign(noise_db=0.3).rename(columns=names)[["east", "north", "path_loss_db"]]
    links = {
        "file": "links.csv", "tx": [0.0, 0.0, 3.0], "rx": ["east", "north", 1.5], "value": "path_loss_db",
    }  # fmt: skip
    method = {"name": "auto", "options": {"starts": 16}}
    found = calibrate(planted.study(tmp_path, table, links=links, method=method), engine=planted.engine())
    standard = planted.links().iloc[::3]
    theirs = standard.rename(columns=names)[["east", "north"]]
    told = found.predict(standard)
    assert np.isfinite(told).all()
    assert found.predict(theirs) == pytest.approx(told)
    assert found.predict_interval(theirs).upper_db.to_numpy() == pytest.approx(
        found.predict_interval(standard).upper_db.to_numpy()
    )
    assert suggest(found, theirs, 1).row.tolist() == suggest(found, standard, 1).row.tolist()
    found.save(tmp_path / "out")
    theirs.to_csv(tmp_path / "new.csv", index=False)
    outcome = CliRunner().invoke(app, ["predict", str(tmp_path / "out"), str(tmp_path / "new.csv")])
    assert outcome.exit_code == 0, outcome.output
    printed = pd.read_csv(io.StringIO(outcome.stdout))
    assert printed.columns.tolist() == ["east", "north", "path_loss_db"]
    assert printed.path_loss_db.to_numpy() == pytest.approx(told)


def test_the_command_adds_the_columns_and_warns_of_odd_places(received, tmp_path):
    received.save(tmp_path / "out")
    table = planted.links().head(3).assign(sent_dbm=30.0)
    table.loc[1, "rx_z"], table.loc[2, "rx_x"] = -2.0, 5000.0
    table.to_csv(tmp_path / "new.csv", index=False)
    arguments = ["predict", str(tmp_path / "out"), str(tmp_path / "new.csv"), "--level", "0.9"]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    told = pd.read_csv(io.StringIO(outcome.stdout), keep_default_na=False)
    words = ["basis", "received_power_dbm", "received_power_lower_dbm", "received_power_upper_dbm", "remark"]
    assert told.columns.tolist() == [*table.columns, "path_loss_db", "lower_db", "upper_db", *words]
    assert told.remark.tolist() == ["", "receiver under the ground", "receiver beyond the scene"]
    assert "receiver under the ground: 1 of 3 links, row 3" in outcome.stderr
    assert "receiver beyond the scene: 1 of 3 links, row 4" in outcome.stderr


def test_where_a_point_stands():
    """A box on a wide sheet, with another sheet as a bridge of two surfaces beside it."""
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
    assert standing(scene, points).tolist() == [
        "inside a building", "", "", "inside a building", "", "under the ground", "beyond the scene"
    ]  # fmt: skip


def test_errors_are_carried_to_neighbours_and_no_further():
    random = np.random.default_rng(3)
    known = np.column_stack([random.uniform(0, 100, (200, 2)), np.zeros((200, 4))])
    place = np.column_stack([random.uniform(0, 100, (400, 2)), np.zeros((400, 4))])
    every = np.vstack([known, place])
    distance = np.linalg.norm(every[:, None, :2] - every[None, :, :2], axis=2)
    root = np.linalg.cholesky(np.exp(-distance / FIELD.range_m) + 1e-9 * np.eye(600))
    errors = FIELD.shared_db * root @ random.standard_normal(600) + FIELD.own_db * random.standard_normal(600)
    added, share = carried(FIELD, known, errors[:200], place)
    left = errors[200:] - added
    # What is left scatters as the share says.
    deviation = np.sqrt((1 - share) * (FIELD.shared_db**2 + FIELD.own_db**2) + share * FIELD.own_db**2)
    assert np.mean(np.abs(left) < 1.645 * deviation) == pytest.approx(0.9, abs=0.04)
    assert left.std() < 0.8 * errors[200:].std()
    far = carried(FIELD, known, errors[:200], place + 1e4)
    assert np.abs(far).max() < 1e-9
    few = carried(FIELD, known[:60], errors[:60], place[:5])
    many = carried(FIELD, np.vstack([known[:60], known[:60] + 1e4] * 10), np.tile(errors[:60], 20), place[:5])
    assert many[0] == pytest.approx(few[0], abs=1.5)
    found = shared_errors(errors, every)
    assert found is not None
    assert found.shared_db == pytest.approx(FIELD.shared_db, rel=0.5)


def test_predictions_lean_towards_measured_links_nearby_with_a_narrower_interval(received, tmp_path):
    assert received.residual_field is None
    table = planted.links().assign(sent_dbm=30.0)
    plain = received.predict_interval(table)
    field = ResidualField(
        range_m=20.0, shared_db=0.9 * received.residual_db, own_db=0.4 * received.residual_db
    )
    fielded = changed(received, residual_field=field)
    told = fielded.predict_interval(table)
    _, errors = measured_errors(received.links)
    moved = told.path_loss_db.to_numpy() - plain.path_loss_db.to_numpy()
    assert np.corrcoef(moved, errors)[0, 1] > 0.8
    assert ((told.upper_db - told.lower_db) < (plain.upper_db - plain.lower_db)).all()
    assert told.basis.str.endswith(", beside measured links").all()
    assert told.path_loss_db.to_numpy() == pytest.approx(fielded.predict(table), abs=1e-6)
    fielded.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.prediction.residual_field == field
    # The table of links is written with ten digits.
    pd.testing.assert_frame_equal(loaded.predict_interval(table), told, rtol=1e-6)


def test_of_many_errors_the_share_within_reach_is_what_was_asked_for():
    random = np.random.default_rng(1)
    held = []
    for _ in range(300):
        errors = np.abs(random.standard_t(3, 61))
        held.append(errors[-1] <= interval_half_width(np.sort(errors[:-1]), 0.9))
    assert np.mean(held) == pytest.approx(0.9, abs=0.05)
    few = np.abs(random.standard_normal(FEWEST_FOR_RANKS - 1))
    assert interval_half_width(np.sort(few), 0.9) == pytest.approx(1.685 * np.sqrt(np.mean(few**2)), rel=1e-2)
    assert interval_half_width(np.ones(50), 0.999) > 3.0
