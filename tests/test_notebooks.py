"""The notebooks run, and what they promise comes out; their cells are run here, without a kernel."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator

NOTEBOOKS = Path(__file__).parents[1] / "examples" / "notebooks"


def run(name: str, monkeypatch: pytest.MonkeyPatch, cache: Path) -> dict:
    """Run the cells of a notebook; what they left behind."""
    monkeypatch.chdir(NOTEBOOKS)
    monkeypatch.setenv("CALIBRAY_CACHE", str(cache))
    left: dict = {"__name__": "__main__"}
    for cell in json.loads((NOTEBOOKS / name).read_text())["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile("".join(cell["source"]), name, "exec"), left)
    return left


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    """One cache for all: two notebooks trace the same links."""
    return tmp_path_factory.mktemp("cache")


def test_every_notebook_is_run():
    assert [file.name[0] for file in sorted(NOTEBOOKS.glob("*.ipynb"))] == ["1", "2", "3", "4"]


def test_the_first_finds_what_it_planted(monkeypatch, cache, capsys):
    left = run("1-first-calibration.ipynb", monkeypatch, cache)
    interval = left["result"].intervals["marble.relative_permittivity"]
    assert interval.lower < left["planted"]["marble"] < interval.upper
    assert np.isfinite(left["predicted"].path_loss_db).all()
    assert "planted 8.1" in capsys.readouterr().out


def test_the_second_drafts_a_study_of_a_map_and_a_log(monkeypatch, cache, capsys):
    left = run("2-bring-your-own-scene.ipynb", monkeypatch, cache)
    assert left["drafted"].study.links.quantity == "rsrp"
    assert "11 buildings" in capsys.readouterr().out


def test_the_third_finds_the_offset_that_was_not_declared(monkeypatch, cache, capsys):
    left = run("3-what-the-data-can-tell.ipynb", monkeypatch, cache)
    assert left["offset"] == pytest.approx(left["cable"], abs=3 * left["error"])
    assert left["result"].nuisance.offsets_db[""] == pytest.approx(left["cable"], abs=1.0)
    assert len(left["suggested"]) == 2
    assert left["result"].rmse_db < left["without"].rmse_db
    assert "offset" in capsys.readouterr().out


def test_the_fourth_finds_the_planted_material_and_sets_it(monkeypatch, cache, capsys):
    left = run("4-sionna-notebook.ipynb", monkeypatch, cache)
    assert left["result"].parameters["marble.relative_permittivity"] == pytest.approx(9.2, rel=1e-4)
    assert np.array(left["marble"].relative_permittivity).item() == pytest.approx(9.2, rel=1e-4)
    assert np.abs(left["difference"]).max() < 0.001
    assert "planted 9.2" in capsys.readouterr().out
    # Sionna's own table of hashes loses paths, and with them the agreement.
    monkeypatch.setattr(SBCandidateGenerator, "MIN_SPEC_COUNT_SIZE", 1_000_000)
    assert np.abs(left["path_loss_db"](left["scene"]) - left["measured"]).max() > 0.01
