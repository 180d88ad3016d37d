"""Traces, predictions and validations in blocks are those of all links at once. Worker processes: `test_dask.py`."""

from __future__ import annotations

import re
from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import planted
import two_ray
from calibray import Paths
from calibray.calibration import calibrate
from calibray.calibration.validate import validate
from calibray.cli.app import app
from calibray.engines.crew import Here
from calibray.engines.parts import cut
from calibray.engines.traced import traced_in_blocks
from calibray.inference.shared_out import predicted
from calibray.measurements import links_from_frame
from calibray.result import Result
from calibray.study import Setup

OPTIONS = {"starts": 4}
SECTIONS = {"method": {"name": "least-squares", "options": OPTIONS}, "offset": {"bounds": [-5.0, 5.0]}}
PARTED = {**SECTIONS, "engine": {"name": "replay", "block_links": 7}}


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> Result:
    """A calibration whose study asks for blocks of 7 links."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", "")
        folder = tmp_path_factory.mktemp("found")
        return calibrate(Setup.open(two_ray.study(folder, noise_db=1.0, **PARTED), two_ray.TwoRay))


def new_links(count: int = 40) -> pd.DataFrame:
    """Links from four transmitters, mixed, so that blocks take them in another order than the table has them."""
    random = np.random.default_rng(11)
    tx = np.array([[0.0, 0, 10], [40, 0, 12], [0, 40, 8], [-30, 5, 15]])[random.integers(0, 4, count)]
    rx = np.column_stack([random.uniform(-150, 150, (count, 2)), random.uniform(1, 3, count)])
    rx[3, 2] = -1.0
    return pd.DataFrame(np.hstack([tx, rx]), columns=two_ray.COLUMNS)


@pytest.mark.parametrize("level", [None, 0.9])
def test_predictions_in_blocks_are_those_of_one_piece(found, level):
    setup = Setup.open(found.study, two_ray.TwoRay, links_from_frame(new_links()))
    told: list[tuple[str, int, int | None]] = []
    whole = predicted(found, setup, level, remarked=True)
    parts = predicted(found, setup, level, lambda *each: told.append(each), Here(at_most=1), remarked=True)
    assert any(np.diff(np.concatenate(cut(setup.links, 7))) < 0)
    assert list(parts) == list(whole)
    numbers = [name for name in whole if name.endswith("_db")]
    assert parts[numbers].to_numpy() == pytest.approx(whole[numbers].to_numpy(), rel=1e-9, nan_ok=True)
    words = [name for name in whole if name not in numbers]
    assert (parts[words] == whole[words]).all(axis=None)
    assert parts.remark[3] == "receiver under the ground"
    assert told[-1] == ("tracing", 40, 40)
    assert len(told) == 6


def test_a_trace_in_blocks_is_that_of_one_piece(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    setup = Setup.open(two_ray.study(tmp_path, **PARTED), two_ray.TwoRay, links_from_frame(new_links()))
    parts, unchecked = traced_in_blocks(setup, Here())
    assert (tmp_path / two_ray.TRACED).read_text().split() == ["7", "7", "7", "7", "6", "6"]
    whole = setup.tracer.trace(setup.links)
    for each in fields(Paths):
        if isinstance(getattr(whole, each.name), np.ndarray):
            assert np.array_equal(getattr(parts, each.name), getattr(whole, each.name)), each.name
    assert (parts.materials, unchecked) == (whole.materials, None)


def test_rounds_of_the_worst_block_are_told(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    setup = Setup.open(two_ray.study(tmp_path, **PARTED), two_ray.TwoRay)
    plain = Setup.trace

    def rounds(self, *given):
        height = float(self.links.distance.max())
        return replace(plain(self, *given), settings={"rays": int(height), "last_round_db": 1 / height})

    monkeypatch.setattr(Setup, "trace", rounds)
    distance = setup.links.distance
    paths, _ = traced_in_blocks(setup, Here())
    nearest = max(distance[block].max() for block in cut(setup.links, 7))
    assert paths.settings["rays"] == int(nearest)
    assert paths.settings["last_round_db"] == max(1 / distance[block].max() for block in cut(setup.links, 7))


def test_a_validation_in_blocks_is_that_of_one_piece(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    study = two_ray.study(tmp_path, noise_db=1.0, **SECTIONS)
    whole = validate(Setup.open(study, two_ray.TwoRay), blocks=2)
    (tmp_path / two_ray.TRACED).unlink()
    parted = two_ray.study(tmp_path, noise_db=1.0, **PARTED)
    found = validate(Setup.open(parted, two_ray.TwoRay), blocks=2, crew=Here())
    assert len((tmp_path / two_ray.TRACED).read_text().split()) == 5
    assert set(found.errors) == set(whole.errors)
    for name, errors in whole.errors.items():
        assert found.errors[name] == pytest.approx(errors, rel=1e-9, abs=1e-9, nan_ok=True), name


def test_the_command_stores_a_trace_in_blocks_and_checks_it(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    (tmp_path / "parted.toml").write_text(
        f"""
version = 1
scene = {{ file = "sionna:simple_street_canyon", frequency = 3.5e9 }}
links = {{ file = "links.csv", tx = {list(planted.COLUMNS[:3])}, rx = {list(planted.COLUMNS[3:])}, value = "loss" }}
trace = {{ max_depth = 1, samples = 5_000, line_of_sight = true }}
engine = {{ name = "replay", block_links = 6 }}
parameters = {{ "concrete.relative_permittivity" = {{ bounds = [1.5, 12.0] }} }}
"""
    )
    planted.links().assign(loss=90.0).to_csv(tmp_path / "links.csv", index=False)
    out = tmp_path / "paths.h5"
    outcome = CliRunner().invoke(app, ["trace", str(tmp_path / "parted.toml"), "-o", str(out), "--check"])
    assert outcome.exit_code == 0, outcome.output
    paths = Paths.load(out)
    assert paths.num_links == planted.LINKS
    assert paths.rx_position[:, 0] == pytest.approx(planted.links().rx_x.to_numpy())
    assert "Change from 5,000 to 10,000 samples" in outcome.stdout
    assert re.search(rf"^links +{planted.LINKS}$", outcome.stdout, re.MULTILINE)
