"""Results side by side: what changed in the study, and which predicts better by blocks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.result.held_out import HeldOutErrors
from calibray.window.result_steps import _facts, better, changes, predicted_text

LINKS, BLOCKS = 200, 4


def held_out(spread_db: float, seed: int) -> HeldOutErrors:
    random = np.random.default_rng(seed)
    x = np.linspace(0.0, 400.0, LINKS)
    return HeldOutErrors(
        labels=tuple("abcd"),
        block=np.arange(LINKS) // (LINKS // BLOCKS),
        errors={"calibrated": spread_db * random.standard_normal(LINKS)},
        position=np.stack([x, 0 * x, 0 * x], axis=1),
        measured_db=90 + x / 100,
        level=0.9,
    )


@pytest.fixture
def results(monkeypatch, tmp_path):
    """Results with planted held-out errors, by the name of their folder."""
    planted: dict[str, HeldOutErrors | None] = {}

    def read(folder, *, allow_changed_inputs):
        model = SimpleNamespace(model=SimpleNamespace(name="calibrated"))
        return {"held_out": planted[folder.name], "prediction": model}

    monkeypatch.setattr("calibray.window.result_steps.read", read)
    return planted, tmp_path


def test_the_result_of_less_error_in_the_blocks_predicts_better_in_either_order(results):
    planted, folder = results
    planted.update(old=held_out(6.0, 1), new=held_out(2.0, 2))
    said = better("old", "new", folder)
    assert said.partition(" The RMSE")[0] == better("new", "old", folder).partition(" The RMSE")[0]
    assert said.startswith("new predicts better than old: RMSE ")
    assert "on 200 held-out links" in said
    assert said.endswith("The RMSE is lower in 4 of 4 blocks of old.")


def test_equal_errors_are_not_called_better(results):
    planted, folder = results
    planted.update(old=held_out(3.0, 1), new=held_out(3.0, 2))
    assert "old does not predict significantly better than new" in better("old", "new", folder)


def test_results_without_links_in_common_are_not_compared(results):
    planted, folder = results
    planted.update(old=held_out(3.0, 1), new=None)
    assert better("old", "new", folder).startswith("new: not validated")
    other = held_out(3.0, 2)
    planted["new"] = replace(other, measured_db=other.measured_db + 1)
    assert "on different links" in better("old", "new", folder)
    planted["old"] = replace(other, block=np.where(other.block < 2, other.block, -1))
    planted["new"] = replace(other, block=np.where(other.block < 2, -1, other.block))
    assert "no held-out link in common" in better("old", "new", folder)


def test_a_result_is_not_compared_with_itself(results):
    planted, folder = results
    planted.update(old=held_out(3.0, 1))
    with pytest.raises(InputError, match="old: chosen twice; choose two different results"):
        better("old", "old", folder)


def test_the_changes_of_a_study_are_its_settings_that_differ():
    first = {"scene": {"frequency": 2e9}, "trace": {"max_depth": 3}, "links": {"tx": [0, 0, 9]}}
    second = {"scene": {"frequency": 2e9}, "trace": {"max_depth": 5}, "links": {"tx": [0, 0, 9]}, "seed": 1}
    assert changes([first, second]) == {"trace.max_depth": [3, 5], "seed": [None, 1]}
    assert changes([first, first]) == {}


def test_a_prediction_is_stated_in_the_measured_quantity():
    """Without a known transmitted power, path loss contains it: 38.5 dB can be less than in free space."""
    row = pd.Series(
        {
            "rx_x": 1.0,
            "rx_y": 2.0,
            "path_loss_db": 38.5,
            "lower_db": 31.5,
            "upper_db": 45.5,
            "basis": "calibrated",
        }
    )
    assert predicted_text(row) == (
        "At x 1.0 m, y 2.0 m: path loss 38.5 dB, 90 % interval 31.5 to 45.5 dB (calibrated)"
    )
    power = {"rsrp_dbm": -38.5, "rsrp_lower_dbm": -45.5, "rsrp_upper_dbm": -31.5}
    assert predicted_text(pd.concat([row, pd.Series(power)])) == (
        "At x 1.0 m, y 2.0 m: RSRP -38.5 dBm, 90 % interval -45.5 to -31.5 dBm (calibrated)"
    )


def test_a_prediction_outside_the_scene_says_so():
    row = pd.Series(
        {
            "rx_x": 1.0,
            "rx_y": 2.0,
            "path_loss_db": 77.2,
            "lower_db": 76.1,
            "upper_db": 78.3,
            "basis": "calibrated",
        }
    )
    said = predicted_text(pd.concat([row, pd.Series({"remark": "receiver outside the scene"})]))
    assert said.endswith("(calibrated); receiver outside the scene")
    # Of a table without remarks, the column is read as numbers.
    assert predicted_text(pd.concat([row, pd.Series({"remark": np.nan})])).endswith("(calibrated)")


def test_numbers_of_links_are_exact():
    record = {"links": {"calibrated_on": 12_345}}
    desk = SimpleNamespace(folder=SimpleNamespace(result=lambda name: record))
    assert _facts(desk, "result")["Links"] == "12,345"
