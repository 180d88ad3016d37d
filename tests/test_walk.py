"""A new user's walk: a map and a log, three commands, no edit and no line of code."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
from typer.testing import CliRunner

from calibray.cli.app import app
from calibray.result import Result

TOWN = Path(__file__).parents[1] / "examples" / "bring_your_own"


def typed(*words: object) -> str:
    done = CliRunner().invoke(app, list(map(str, words)))
    assert done.exit_code == 0, done.stderr
    return done.stdout


def test_scene_init_run(tmp_path, monkeypatch):
    """One phone at every second of its stops, so that it takes seconds; offsets of the cells are those planted."""
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    truth = json.loads((TOWN / "truth.json").read_text())
    log = pd.read_csv(TOWN / "rsrp.csv")
    stop = log.groupby(["longitude", "latitude"], sort=False).ngroup()
    log[(stop % 4 == 0) & (log["device"] == "phone-a")].to_csv(tmp_path / "rsrp.csv", index=False)
    typed("scene", "osm", TOWN / "town.osm", "--out", tmp_path / "town")
    told = typed(
        "init", tmp_path / "town" / "scene.xml", tmp_path / "rsrp.csv", "--transmitters", TOWN / "cells.csv",
        "--frequency", "3.6e9", "--out", tmp_path / "study.toml",
    )  # fmt: skip
    assert "not known: [offset] takes it" in told
    shown = typed("run", tmp_path / "study.toml", "--out", tmp_path / "result")
    assert "averages too near the noise floor, left out" in shown
    result = Result.load(tmp_path / "result")
    assert result.prepared["samples averaged"] == int(((stop % 4 == 0) & (log["device"] == "phone-a")).sum())
    # A level of the path loss less the received power: less what was transmitted.
    for cell, offset in result.offsets_db.items():
        assert abs(offset + truth["eirp_dbm"][cell.split()[0]]) < 1.5
    # As large as ten samples of fading leave it, and far below what nothing but distance explains.
    assert result.rmse_db < 1.6 < result.log_distance_rmse_db
    walls = result.intervals["walls.relative_permittivity"]
    assert walls.lower < truth["walls"]["relative_permittivity"] < walls.upper
