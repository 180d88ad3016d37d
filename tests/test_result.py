"""What a calibration leaves behind: files that open again, predictions, and engines that agree."""

import numpy as np
import pytest
from typer.testing import CliRunner

import planted
from calibray import engines
from calibray.calibration import calibrate
from calibray.cli import app
from calibray.errors import InputError
from calibray.result import Result


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A calibrated study with an offset for each group, 2 dB on one of them, saved."""
    folder = tmp_path_factory.mktemp("saved")
    table = planted.campaign()
    table.loc[table["half"] == "west", "path_loss_db"] += 2.0
    study = planted.study(
        folder, table, offset={"per": "half"}, method={"name": "auto", "options": {"starts": 16}}
    )
    result = calibrate(study, out=folder / "out", engine=planted.engine())
    return result, folder / "out", table


def test_a_saved_result_loads_equal(saved):
    result, folder, _ = saved
    again = Result.load(folder)
    assert again.content() == result.content()
    np.testing.assert_allclose(again.links["after_db"], result.links["after_db"], rtol=1e-5)
    assert len(again.history) == result.rt_calls


def test_predictions_at_the_measured_links_are_what_was_fitted(saved, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    result, folder, table = saved
    predicted = Result.load(folder).predict(table[[*planted.COLUMNS, "half"]])
    np.testing.assert_allclose(predicted, result.links["after_db"], atol=0.01)
    wrong = Result.load(folder).predict(table[[*planted.COLUMNS]].assign(half="west"))
    east = (table["half"] == "east").to_numpy()
    assert np.abs(wrong - predicted)[east].min() > 1.0  # the offset of the group is in it


def test_a_group_without_an_offset_is_refused(saved):
    result, _, table = saved
    with pytest.raises(InputError, match=r"'north'.*known: east, west"):
        result.predict(table[list(planted.COLUMNS)].assign(half="north"))


def test_a_folder_without_a_result_is_refused(tmp_path):
    with pytest.raises(InputError, match="no result"):
        Result.load(tmp_path)


def test_the_command_predicts_and_adds_a_column(saved, tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    result, folder, table = saved
    table[[*planted.COLUMNS, "half"]].to_csv(tmp_path / "new.csv", index=False)
    outcome = CliRunner().invoke(app, ["predict", str(folder), str(tmp_path / "new.csv")])
    assert outcome.exit_code == 0, outcome.output
    lines = outcome.stdout.splitlines()
    assert lines[0].endswith(",path_loss_db")
    values = [float(line.rsplit(",", 1)[1]) for line in lines[1:]]
    np.testing.assert_allclose(values, result.links["after_db"], atol=0.01)


def test_retrace_and_replay_give_the_same_path_loss_and_count_their_calls(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    study = planted.study(tmp_path, planted.campaign())
    replay, retrace = planted.engine(), engines.make(study, "retrace")
    parameters = replay.parameters
    candidates = parameters.lower + np.array([[0.2, 0.5, 0.8], [0.9, 0.1, 0.4]]) * (
        parameters.upper - parameters.lower
    )
    before = replay.calls, retrace.calls
    np.testing.assert_allclose(retrace.path_loss(candidates), replay.path_loss(candidates), atol=0.01)
    assert (replay.calls - before[0], retrace.calls - before[1]) == (2, 2)
