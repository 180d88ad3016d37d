"""Traces, and a calibration, do not depend on names, order, place, direction or objects far away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import planted
from calibray.calibration.calibrate import calibrate
from invariance_cases import TOLERANCES, TRANSFORMATIONS, campaign, largest_changes, quantities


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The campaign, and what is traced of it."""
    folder = tmp_path_factory.mktemp("plain")
    untouched = campaign(folder)
    return untouched, quantities(untouched, folder, calibrated=False)


@pytest.mark.parametrize(
    "name", ["names changed", "turned by 33 degrees", "ends swapped", "a house 3 km away"]
)
def test_a_trace_is_invariant(plain, tmp_path, name):
    untouched, before = plain
    assert np.isfinite(before["traced path loss"]).all()
    after = quantities(TRANSFORMATIONS[name](untouched), tmp_path, calibrated=False)
    for quantity, change in largest_changes(before, after).items():
        assert change <= TOLERANCES[quantity], quantity


def test_a_constant_in_the_values_goes_into_the_offsets(tmp_path):
    """Here also: values in the order of other names of the groups."""
    measured = planted.campaign(noise_db=1.0)
    changed = measured.assign(
        path_loss_db=measured.path_loss_db + 7.3, half=measured["half"].map({"east": "1", "west": "2"})
    )
    before, after = (
        calibrate(planted.study(tmp_path, table, offset={"per": "half"}), engine=planted.engine())
        for table in (measured, changed)
    )
    assert after.rmse_db == pytest.approx(before.rmse_db, abs=1e-6)
    assert list(after.parameters.values()) == pytest.approx(list(before.parameters.values()), abs=1e-3)
    offsets = dict(zip(["east", "west"], map(after.nuisance.offsets_db.get, ["1", "2"]), strict=True))
    for name, offset in before.nuisance.offsets_db.items():
        assert offsets[name] == pytest.approx(offset + 7.3, abs=1e-3)


def test_changes_are_seen(plain, tmp_path):
    """A wall of another place, and a link without a path."""
    untouched, before = plain
    vertices, faces = untouched.objects["south"]
    objects = {**untouched.objects, "south": (vertices + np.array([0.0, 0.5, 0.0]), faces)}
    after = quantities(replace(untouched, objects=objects), tmp_path, calibrated=False)
    assert largest_changes(before, after)["traced path loss"] > 0.1
    after["traced path loss"].iloc[0] = np.inf
    assert largest_changes(before, after)["traced path loss"] == np.inf
