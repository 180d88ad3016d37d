"""One `calibray run` reads every file once, and makes scene and parameters once."""

from __future__ import annotations

import shutil
import sys
from collections import Counter
from pathlib import Path

import pytest
import sionna.rt
from typer.testing import CliRunner

from calibray.cli.app import app
from calibray.study import Study

STUDY = Path(__file__).parents[1] / "golden" / "study"
WATCHED: Counter[str] = Counter()
_inside: list[Path] = []


def _watch(event: str, arguments: tuple) -> None:
    """Count what is read inside the folder watched; a hook cannot be taken out again, so it is idle without one."""
    if _inside and event == "open" and isinstance(arguments[0], str) and "r" in (arguments[1] or ""):
        path = Path(arguments[0])
        if path.is_relative_to(_inside[0]) and "out" not in path.parts:
            WATCHED[path.name] += 1


sys.addaudithook(_watch)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A small study with every section, its folder watched, and nothing in the cache."""
    shutil.copytree(STUDY, tmp_path, dirs_exist_ok=True)
    study = tmp_path / "study.toml"
    quick = study.read_text().replace("starts = 16, iterations = 50", "starts = 1, iterations = 2")
    study.write_text(quick + '\n[noise]\nkind = "gaussian"\nrange_m = 0\n')
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    WATCHED.clear()
    _inside.append(tmp_path)
    yield tmp_path
    _inside.clear()


def test_one_run_reads_each_file_and_makes_each_thing_once(folder, monkeypatch):
    made: Counter[str] = Counter()

    def counted(owner, name, label):
        function = getattr(owner, name)

        def count(*arguments, **settings):
            made[label] += 1
            return function(*arguments, **settings)

        monkeypatch.setattr(owner, name, count)

    counted(sionna.rt.Scene, "__init__", "Sionna scenes")
    counted(Study, "parameter_set", "parameters")
    done = CliRunner().invoke(app, ["run", str(folder / "study.toml"), "--out", str(folder / "out")])
    assert done.exit_code == 0, done.output
    assert {name: WATCHED[name] for name in ("study.toml", "links.csv", "scene.xml")} == {
        "study.toml": 1,
        "links.csv": 1,
        "scene.xml": 1,
    }
    assert made == {"Sionna scenes": 1, "parameters": 1}
