"""A new user's walks: a map or a plan, and a log; three commands, no edit and no line of code."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.fields import path_loss
from calibray.study import Setup, Study

REPOSITORY = Path(__file__).parents[2]
TOWN = REPOSITORY / "examples" / "bring_your_own"
PAGE = (REPOSITORY / "docs" / "guides" / "plans-and-tracks.md").read_text(encoding="utf-8")


def typed(*words: object) -> str:
    done = CliRunner().invoke(app, list(map(str, words)))
    assert done.exit_code == 0, done.stderr
    return done.stdout


def test_scene_init_run(tmp_path, monkeypatch):
    """One phone at every fourth of its stops, so that it takes seconds; offsets of the cells are those planted."""
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    truth = json.loads((TOWN / "truth.json").read_text())
    log = pd.read_csv(TOWN / "rsrp.csv")
    stop = log.groupby(["longitude", "latitude"], sort=False).ngroup()
    log[(stop % 32 == 0) & (log["device"] == "phone-a")].to_csv(tmp_path / "rsrp.csv", index=False)
    typed("scene", "osm", TOWN / "town.osm", "--out", tmp_path / "town")
    told = typed(
        "init", tmp_path / "town" / "scene.xml", tmp_path / "rsrp.csv", "--transmitters", TOWN / "cells.csv",
        "--frequency", "3.6e9", "--out", tmp_path / "study.toml",
    )  # fmt: skip
    assert "the transmitted power is unknown" in told
    shown = typed("run", tmp_path / "study.toml", "--out", tmp_path / "result")
    assert "averages too near the noise floor, left out" in shown
    result = Result.load(tmp_path / "result")
    assert result.provenance.rows["samples averaged"] == int(
        ((stop % 32 == 0) & (log["device"] == "phone-a")).sum()
    )
    # A level of the path loss less the received power: less what was transmitted.
    for cell, offset in result.nuisance.offsets_db.items():
        assert abs(offset + truth["eirp_dbm"][cell.split()[0]]) < 1.5
    # As large as ten samples of fading leave it, and far below what nothing but distance explains.
    assert result.rmse_db < 1.6 < result.fit.log_distance_rmse_db
    walls = result.intervals["walls.relative_permittivity"]
    assert walls.lower < truth["walls"]["relative_permittivity"] < walls.upper


def planted(folder: Path) -> tuple[dict, dict]:
    """The truth of an example, and its materials."""
    truth = json.loads((folder / "truth.json").read_text())
    return truth, truth["materials"]


def spread_at_truth(study: Study, materials: dict) -> tuple[float, dict[str, float]]:
    """Standard deviation [dB] of the links about the planted materials, and the offset of every group [dB]."""
    setup = Setup.open(study)
    paths = setup.trace()
    truth = {name: replace(paths.materials[name], **constants) for name, constants in materials.items()}
    gap = setup.links.path_loss_db - path_loss(paths, {**paths.materials, **truth})
    groups = pd.Series(gap).groupby(setup.links.group_index)
    return float((gap - groups.transform("mean")).std()), dict(
        zip(setup.links.group_names, groups.mean().tolist(), strict=True)
    )


def test_a_plan_and_a_wide_table(tmp_path, monkeypatch):
    """On the drafted study, the planted materials explain what was measured."""
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    flat = TOWN / "flat"
    typed("scene", "plan", flat / "plan.csv", "--height", "2.6", "--out", tmp_path / "flat")
    told = typed(
        "init", tmp_path / "flat" / "scene.xml", flat / "rss.csv", "--transmitters", flat / "access_points.csv",
        "--frequency", "2.44e9", "--out", tmp_path / "study.toml",
    )  # fmt: skip
    assert set(told.splitlines()) <= set(PAGE.splitlines()), (
        "docs/guides/plans-and-tracks.md shows what is printed"
    )
    study = Study.load(tmp_path / "study.toml")
    assert list(study.links.wide) == ["rss_ap1", "rss_ap2", "rss_ap3"]
    assert study.trace.refraction
    assert study.trace.max_depth == 4
    truth, materials = planted(flat)
    spread, offsets = spread_at_truth(study, materials)
    assert spread < 0.8
    for name, offset in offsets.items():
        assert offset == pytest.approx(-truth["eirp_dbm"][name], abs=0.6)


def test_footprints_a_height_model_and_a_track(tmp_path, monkeypatch):
    """Every value gets its place by its time, every antenna stands above its ground."""
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    hill = TOWN / "hill"
    typed(
        "scene", "footprints", hill / "houses.geojson", "--height", "height_m", "--terrain", hill / "ground.tif",
        "--out", tmp_path / "hill",
    )  # fmt: skip
    told = typed(
        "init", tmp_path / "hill" / "scene.xml", hill / "power.csv", "--transmitters", hill / "masts.csv", "--track",
        hill / "walk.gpx", "--frequency", "2.1e9", "--out", tmp_path / "study.toml",
    )  # fmt: skip
    assert set(told.splitlines()) <= set(PAGE.splitlines()), (
        "docs/guides/plans-and-tracks.md shows what is printed"
    )
    study = Study.load(tmp_path / "study.toml")
    links = study.measurements()
    # Up to the north-east, as the ground rises.
    assert np.corrcoef(links.rx[:, 0], links.rx[:, 2])[0, 1] > 0.9
    assert np.ptp(links.rx[:, 2]) > 5.0
    truth, materials = planted(hill)
    spread, offsets = spread_at_truth(study, materials)
    assert spread < 1.5
    assert offsets["mast-1"] == pytest.approx(-truth["eirp_dbm"], abs=0.8)
