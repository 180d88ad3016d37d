"""Files of the version before the rooms still load, and mean the same; `legacy/README.md` tells how they were made."""

from __future__ import annotations

import hashlib
import json
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import calibray as cb
from calibray import engines
from calibray.comparison import compare as comparison
from calibray.comparison.method_runs import BudgetedMethod, RunFile
from calibray.comparison.problem import study_problem

LEGACY = Path(__file__).parent / "legacy"
EXPECTED = json.loads((LEGACY / "expected.json").read_text())
MADE_IN = "/srv/calibray-legacy"

# Losses on paths that are traced anew: the tracer computes in single precision.
TRACED_DB = 1e-3


def holds(new, old):
    """Whether all that was there is there still; tables may have gained keys."""
    if isinstance(old, dict):
        return isinstance(new, dict) and all(
            key in new and holds(new[key], each) for key, each in old.items()
        )
    return new == old


@pytest.fixture
def folder(tmp_path):
    """A copy of the files, which believes to have been made where it lies."""
    copy = tmp_path / "legacy"
    shutil.copytree(LEGACY, copy)
    for result in copy.glob("*/result.json"):
        result.write_text(result.read_text().replace(MADE_IN, str(copy)))
    return copy


@pytest.mark.parametrize("name", sorted(EXPECTED["studies"]))
def test_a_study_file_means_the_same(name):
    study = cb.Study.load(LEGACY / f"{name}.toml")
    expected = dict(EXPECTED["studies"][name]["content"])
    # Each engine has keys of its own now; those of others were written with their defaults.
    engine = expected.pop("engine")
    assert holds(study.content(), expected)
    assert study.engine == cb.Study.from_content({**expected, "engine": engine}, study.path).engine
    assert study.content()["engine"].items() <= engine.items()
    study.measurements()


@pytest.mark.parametrize("name", ["replay", "program"])
def test_a_result_holds_what_was_written(name, folder):
    written = json.loads((LEGACY / name / "result.json").read_text())
    result = cb.Result.load(folder / name)
    content = result.content()
    # What later versions add is theirs; what was there must be there.
    for key in ("study", "study_file"):
        del written[key]
    assert holds(content, written)
    assert holds(result.study.content(), EXPECTED["studies"][name]["content"])
    assert len(result.history) == result.rt_calls
    assert result.links.held_out.sum() > 0
    assert result.links.retrace_gap_db.isna().all()


def test_a_result_predicts_the_same(folder):
    result = cb.Result.load(folder / "replay")
    predicted = result.predict(pd.read_csv(folder / "new-links.csv"))
    assert predicted == pytest.approx(EXPECTED["predicted_db"], abs=TRACED_DB)
    assert np.isfinite(predicted).all()


def test_a_ledger_answers_every_call(folder):
    written = cb.Result.load(folder / "program")
    with closing(engines.open_ledger(folder / "program")) as ledger:
        calls = len(ledger.table())
    (folder / "model.py").unlink()  # a call would fail
    again = cb.calibrate(cb.Study.load(folder / "program.toml"), out=folder / "program")
    assert (again.rt_calls, again.cost.ledger_hits) == (written.rt_calls, written.rt_calls)
    assert again.parameters == written.parameters
    assert again.nuisance.offsets_db == pytest.approx(written.offsets_db, rel=1e-12)
    assert again.holdout_rmse_db == pytest.approx(written.holdout_rmse_db, rel=1e-12)
    with closing(engines.open_ledger(folder / "program")) as ledger:
        assert len(ledger.table()) == calls


def test_a_comparison_finds_its_runs(folder, monkeypatch):
    """What a run depends on is named anew by later code, which runs it again; under its old name it is found."""
    path = folder / "compare" / "runs.jsonl"
    problem, code = json.loads(path.read_text().splitlines()[0])["problem"].split("-")
    opened = study_problem(folder / "replay.toml")
    earlier = RunFile(path, f"{problem}-{code}").find(("random", 24, 1))
    again = BudgetedMethod.parse("random", 24).run(opened, 1)
    assert again.calls == earlier.calls
    assert again.best == pytest.approx(earlier.best, abs=TRACED_DB)

    monkeypatch.setattr(comparison, "code_fingerprint", lambda: code)
    monkeypatch.setattr(BudgetedMethod, "run", None)
    monkeypatch.setattr(comparison, "_search_optimum", None)
    finished = comparison.compare(
        lambda: replace(opened, fingerprint=problem),
        ["random", "sgwo-im"],
        seeds=2,
        budget=24,
        out=folder / "compare",
    )
    table, written = finished.table(), pd.read_csv(folder / "compare" / "compare.csv")
    shared = ["method", "rt_calls", "median_excess_db_end", "optimum_db"]
    pd.testing.assert_frame_equal(table[shared], written[shared], rtol=1e-4)


def test_the_optimizers_code_has_a_fingerprint():
    assert comparison.code() != hashlib.sha256().hexdigest()[:16]
