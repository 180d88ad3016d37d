"""`calibray run`, `trace` and `predict`: stdout, stderr and files."""

from __future__ import annotations

import io
import json
import re
import time

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import planted
import programs
from calibray.calibration.result import Result
from calibray.cli.console import progress_bars
from calibray.cli.predict import _columns
from calibray.cli.validate import _unused_text
from calibray.errors import InputError
from calibray.paths import Paths
from calibray.reporting import result_tables
from calibray.result.files import FILES
from calibray.result.held_out import Model
from calibray.support.output_files import SIGNATURES, write_text
from calibray.tables import render
from calibray.tracing.protocol import EnclosedAntennas
from changed import changed
from commands import run, write_study

LOST_ROW = planted.INSIDE + 2  # the header is row 1


@pytest.fixture(scope="module", autouse=True)
def _no_cache():
    """The user's cache of traces is not used."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", "")
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a study file; its links have an offset per half, and one has no path."""
    folder = tmp_path_factory.mktemp("study")
    table = planted.campaign(blocked=True).replace(np.inf, 75.0)
    study = planted.study(
        folder,
        table.assign(path_loss_db=table.path_loss_db + table.half.map({"west": 0.0, "east": 4.0})),
        offset={"per": "half"},
        holdout={"where": "rx_x > 20"},
        method={"name": "auto", "seed": 3},
    )
    write_study(folder, study.content())
    return folder


@pytest.fixture(scope="module")
def ran(folder):
    """The outcome of `calibray run`."""
    outcome = run("run", folder / "study.toml", "--out", folder / "out")
    assert outcome.exit_code == 0, outcome.output
    return outcome


def test_run_writes_its_files_and_lists_them_on_stderr(folder, ran):
    assert sorted(path.name for path in (folder / "out").iterdir()) == sorted(
        [*FILES, "report.html", SIGNATURES]
    )
    warning, *rest = ran.stderr.splitlines(keepends=True)
    assert "1 of 12 receivers are inside buildings" in warning
    written = f"Written to {folder / 'out'}: {', '.join(FILES)}, report.html"
    assert "".join(rest) == f"{written}; next: calibray predict {folder / 'out'} LINKS\n"
    assert Result.load(folder / "out").parameters == pytest.approx(planted.TRUTH, abs=1e-3)


def test_run_prints_the_result(folder, ran):
    result, lines = Result.load(folder / "out"), ran.stdout.splitlines()
    # The first line of a parameter; a later one has the reason.
    cells = {line.split("  ")[0]: line.split() for line in reversed(lines) if line}
    assert lines[0] == "study.toml: method auto, engine replay, seed 3"
    assert cells["calibration links"][-1] == "9"
    assert cells["held out"][-1] == "2"
    assert " ".join(cells["without a path"]).endswith(
        f"1 row {LOST_ROW}, left out, predicted by the log-distance model"
    )
    assert f"row {LOST_ROW}: check the positions" in next(line for line in lines if "receiver inside" in line)
    for name, value in result.parameters.items():
        assert cells[name][2] == f"{value:.4g}"
        assert cells[name][-1] == "identified"
    assert cells["east"] == ["east", f"{result.nuisance.offsets_db['east']:+.2f}"]
    for name, scores in {
        "before": (result.initial_rmse_db, result.accuracy.initial_holdout_rmse_db),
        "offset only": (result.fit.nuisance_only_rmse_db, result.accuracy.nuisance_only_holdout_rmse_db),
        "after": (result.rmse_db, result.holdout_rmse_db),
        "log-distance model": (result.fit.log_distance_rmse_db, result.accuracy.log_distance_holdout_rmse_db),
    }.items():
        assert cells[name][-2:] == [f"{score:.2f}" for score in scores]
    assert cells["RT calls"][-1] == f"{result.rt_calls:,}"


def test_output_is_plain_text(ran):
    assert "\x1b" not in ran.stdout + ran.stderr
    assert [line for line in ran.stdout.splitlines() if line != line.rstrip()] == []


def test_run_with_an_external_program_needs_no_ray_tracer_here(tmp_path, monkeypatch):
    """Only the program is called; every call is in the ledger, and a second run calls nothing."""
    write_study(
        tmp_path,
        programs.content(tmp_path) | {"method": {"name": "auto", "model": "none", "options": {"budget": 18}}},
    )

    def refuse(*_: object) -> None:
        pytest.fail("the ray tracer was loaded")

    monkeypatch.setattr("calibray.tracing.SionnaFactory.__call__", refuse)
    arguments = ("run", tmp_path / "study.toml", "--out", tmp_path / "out", "--workers", "2")
    first = run(*arguments)
    assert first.exit_code == 0, first.output
    assert "RT calls" in first.stdout
    assert len(programs.calls(tmp_path)) == 19  # with the values before calibration
    parameters = Result.load(tmp_path / "out").parameters
    assert list(parameters.values()) == pytest.approx(programs.TRUTH, abs=0.5)
    assert "map" not in first.stderr
    write_text(tmp_path / "out" / "map.csv", "of the first run")
    second = run(*arguments)
    assert second.exit_code == 0
    assert f"the map in {tmp_path / 'out'} (map.csv) belongs to an earlier run" in second.stderr
    assert len(programs.calls(tmp_path)) == 19
    assert Result.load(tmp_path / "out").parameters == parameters
    listed = run("ledger", tmp_path / "out")
    assert listed.exit_code == 0
    assert "19" in listed.stdout


def test_run_prints_json_on_demand_and_takes_method_and_seed(folder):
    arguments = ("--json", "--method", "sgwo-im", "--seed", 7)
    outcome = run("run", folder / "study.toml", "--out", folder / "other", *arguments)
    assert outcome.exit_code == 0, outcome.output
    content = json.loads(outcome.stdout)
    assert content["cost"]["rt_calls"] == 225
    assert content["study"]["method"] == {
        "name": "sgwo-im", "seed": 7, "model": "replay", "options": {},
    }  # fmt: skip
    assert content["links"] == {
        "calibrated_on": 9,
        "held_out": 2,
        "rows_without_path": [LOST_ROW],
        "rows_with_enclosed_tx": [],
        "rows_with_enclosed_rx": [LOST_ROW],
    } | {key: value for key, value in content["links"].items() if key.startswith("rows_lost")}
    stored = json.loads((folder / "other" / "result.json").read_text())
    assert set(stored["files"]) == {"result-links.csv", "result-history.csv", "result-scene.xml"}
    assert stored.pop("study_from_here") == "../study.toml"
    assert content == {**stored, "files": {}}  # printed without what depends on the folder


def test_trace_stores_a_path_program(folder):
    outcome = run("trace", folder / "study.toml", "-o", folder / "paths.h5")
    assert outcome.exit_code == 0, outcome.output
    paths, engine = Paths.load(folder / "paths.h5"), planted.engine(blocked=True)
    assert (paths.num_paths, paths.num_links) == (engine.paths.num_paths, planted.LINKS)
    cells = {line.split("  ")[0]: line.split() for line in outcome.stdout.splitlines() if line}
    assert cells["paths"] == ["paths", f"{paths.num_paths:,}"]
    assert cells["without a path"][-3:] == ["1", "row", str(LOST_ROW)]
    assert outcome.stderr == f"Written to {folder / 'paths.h5'}\n"


def test_trace_check_needs_no_file_and_reports_no_change(folder):
    before = sorted(folder.rglob("*"))
    outcome = run("trace", folder / "study.toml", "--check")
    assert (outcome.exit_code, outcome.stderr) == (0, "")
    assert re.search(r"^Change from 20,000 to 40,000 samples", outcome.stdout, re.MULTILINE)
    assert re.search(r"^largest +0\.00 dB$", outcome.stdout, re.MULTILINE)
    assert outcome.stdout.endswith(
        "Converged: no link changed by more than 0.5 dB (fidelity.tolerance_db).\n"
    )
    assert sorted(folder.rglob("*")) == before


def test_a_long_trace_is_announced_on_stderr(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "calibray.tracing.sionna.tracer.LANES", 200_000
    )  # 20,000 samples x 2 interactions x 5 receivers
    outcome = run("trace", folder / "study.toml", "-o", tmp_path / "paths.h5")
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stderr.startswith(
        "Tracing 12 links in 3 launches of up to 160,000 rays x interactions x rec"
    )
    assert "launches" not in outcome.stdout


def test_predict_adds_a_column_to_the_table(folder, ran, tmp_path):
    table = planted.links(blocked=True).assign(name=[f"link {k}" for k in range(planted.LINKS)])
    table.to_csv(tmp_path / "new.csv", index=False)
    outcome = run("predict", folder / "out", tmp_path / "new.csv")
    assert outcome.exit_code == 0, outcome.output
    predicted = pd.read_csv(io.StringIO(outcome.stdout))
    assert predicted.columns.tolist() == [*table.columns, "path_loss_db", "basis"]
    pd.testing.assert_frame_equal(predicted[table.columns], table)
    expected = Result.load(folder / "out").links.predicted_db
    assert predicted.path_loss_db.to_numpy() == pytest.approx(expected.to_numpy(), abs=1e-3)
    lost = f"1 of 12 links, row {LOST_ROW}\n"
    cost, _, warnings = outcome.stderr.partition("\n")
    assert cost.startswith("Tracing 12 links: ")
    assert warnings == (
        f"Warning: no path: {lost}Warning: receiver inside a building: {lost}"
        "For links without a path, the log-distance model predicts path loss; see the column basis\n"
    )


@pytest.mark.parametrize("name", ["out.csv", "out.parquet"])
def test_predict_writes_a_file_instead(folder, ran, tmp_path, name):
    planted.links().iloc[:3].to_parquet(tmp_path / "new.parquet")
    outcome = run("predict", folder / "out", tmp_path / "new.parquet", "-o", tmp_path / name)
    assert (outcome.exit_code, outcome.stdout) == (0, "")
    read = pd.read_csv if name.endswith("csv") else pd.read_parquet
    assert np.isfinite(read(tmp_path / name).path_loss_db).tolist() == [True] * 3


@pytest.mark.parametrize("table", ["links.csv", "out/result-links.csv"])
def test_predict_takes_the_measured_table_and_the_results_own(folder, ran, tmp_path, table):
    links = pd.read_csv(folder / table)
    # The index that pandas writes as a column without a name.
    links.to_csv(tmp_path / "links.csv")
    outcome = run("predict", folder / "out", tmp_path / "links.csv", "-o", tmp_path / "new.csv")
    assert outcome.exit_code == 0, outcome.stderr
    predicted = pd.read_csv(tmp_path / "new.csv")
    after = pd.read_csv(folder / "out" / "result-links.csv").predicted_db
    np.testing.assert_allclose(predicted.path_loss_db, after, atol=0.01)
    if "path_loss_db" in links:
        assert predicted.input_path_loss_db.tolist() == links.path_loss_db.tolist()
        assert "its column 'path_loss_db' is written as 'input_path_loss_db'" in outcome.stderr


def test_a_validation_is_not_written_into_a_result_of_changed_links(folder, ran):
    """The refusal comes before the validation, even if the measured values are the same."""
    file = folder / "links.csv"
    before = file.read_text()
    try:
        pd.read_csv(file).eval("rx_y = rx_y + 0.1").to_csv(file, index=False)
        outcome = run("validate", folder / "study.toml", "--out", folder / "out")
    finally:
        file.write_text(before)
    assert (outcome.exit_code, outcome.stdout) == (2, "")
    assert (
        "links.csv changed since the result in this folder was calibrated; run the study again"
        in outcome.stderr
    )


def test_a_model_that_predictions_do_not_use_yet_is_named(folder, ran, tmp_path):
    out = folder / "out"
    used = Result.load(out).prediction.model.name
    other = next(name for name in (Model.INITIAL, Model.LOG_DISTANCE) if name != used)
    assert f"the model {str(other)!r} is chosen, but predictions do not use this model yet" in _unused_text(
        out, other
    )
    assert _unused_text(out, used) == _unused_text(tmp_path, other) == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "{study}", "--out", "{file}"), "is a file; name another folder"),
        (("run", "{study}", "--out", "{file}/deeper/still"), "is a file; name another folder"),
        (("run", "{study}", "--out", "{out}", "--method", "sgwoim"), "did you mean 'sgwo-im'?"),
        (("run", "{study}", "--out", "{out}", "--engine", "replya"), "engine"),
        (("run", "{folder}/absent.toml", "--out", "{out}"), "absent.toml: no such study file"),
        (("trace", "{study}", "-o", "{folder}/absent/paths.h5"), "there is no folder"),
        (("trace", "{study}", "-o", "{folder}"), "is a folder; name a file in this folder"),
        (("trace", "{study}"), "trace: give -o FILE to store the paths, --check to check them, or both"),
        (("validate", "{study}", "--out", "{damaged}"), "result.json: is not a result"),
        (("predict", "{folder}", "{file}"), "is not a result written by `calibray run`"),
        (("predict", "{result}", "{twice}"), "has the columns 'path_loss_db' and 'input_path_loss_db'"),
        (("predict", "{result}", "{folder}/absent.csv"), "absent.csv: no such file"),
        (
            ("predict", "{result}", "{bare}", "-o", "{folder}/out.xlsx"),
            "the name of a table must end in .csv or .parquet",
        ),
    ],
)
def test_bad_arguments_are_one_message_and_leave_nothing(folder, ran, tmp_path, arguments, message):
    planted.links().to_csv(tmp_path / "bare.csv", index=False)
    planted.links().assign(path_loss_db=80.0, input_path_loss_db=80.0).to_csv(
        tmp_path / "twice.csv", index=False
    )
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "result.json").write_text("{")
    paths = {
        "damaged": tmp_path / "damaged",
        "study": folder / "study.toml",
        "file": folder / "links.csv",
        "folder": folder,
        "out": folder / "never",
        "result": folder / "out",
        "bare": tmp_path / "bare.csv",
        "twice": tmp_path / "twice.csv",
    }
    before = sorted(folder.rglob("*"))
    outcome = run(*(argument.format(**paths) for argument in arguments))
    assert (outcome.exit_code, outcome.stdout) == (2, "")
    assert outcome.stderr.startswith("Error: ")
    assert message in outcome.stderr
    assert sorted(folder.rglob("*")) == before


def test_antennas_inside_buildings_are_listed_unless_most_are_inside(folder, ran):
    result = Result.load(folder / "out")
    row, none = np.arange(2, 14), np.zeros(12, dtype=bool)
    few, most = np.arange(12) < 2, np.arange(12) < 11
    text = render(*result_tables.tables(changed(result, enclosed=EnclosedAntennas.of(row, none, few))))
    assert re.search(
        r"transmitter inside a building +0\nreceiver inside a building +2 +rows 2, 3: check", text
    )
    indoors = render(*result_tables.tables(changed(result, enclosed=EnclosedAntennas.of(row, most, most))))
    assert re.search(
        r"receiver inside a building +11 +like most receivers: the scene is assumed to be indoors\n", indoors
    )
    assert changed(result, enclosed=EnclosedAntennas.of(row, none, few)).counts["rows_with_enclosed_rx"] == [
        2,
        3,
    ]


def test_tables_leave_out_what_is_absent(folder, ran):
    result = Result.load(folder / "out")
    bare = changed(result, coefficients={}, nuisance_only_rmse_db=None, holdout_rmse_db=None, intervals={})
    text = render(*result_tables.tables(bare))
    assert "Offsets" not in text
    assert "offset only" not in text
    assert "unknown" in text


def test_progress_is_a_bar_on_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    with progress_bars(console) as progress:
        progress("tracing", 0, 12)
        progress("calibrating", 60, 225)
    drawn = console.file.getvalue()
    assert "calibrating" in drawn
    assert "0/12" in drawn
    assert "0/?" not in drawn


def test_progress_is_lines_elsewhere_even_during_silent_work():
    console = Console(file=io.StringIO(), force_terminal=False, width=20)
    with progress_bars(console, every=0.02) as progress:
        while "starting" not in console.file.getvalue():
            time.sleep(0.01)
        progress("tracing", 0, 12)
        progress("tracing", 5, 12)
        while "tracing 5/12" not in console.file.getvalue():
            time.sleep(0.01)
        count = len(console.file.getvalue().splitlines())
        while len(console.file.getvalue().splitlines()) < count + 3:
            time.sleep(0.01)
    lines = console.file.getvalue().splitlines()
    assert "\x1b" not in console.file.getvalue()
    assert re.fullmatch(r"tracing 5/12, 42 %, [0-9.e+]+/s, \d+ s, about \d+ s left", lines[-1])


def test_short_work_prints_no_line():
    console = Console(file=io.StringIO(), force_terminal=False)
    with progress_bars(console) as progress:
        progress("tracing", 5, 12)
    assert console.file.getvalue() == ""


def test_the_cache_is_listed_and_cleared(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", str(tmp_path))
    (tmp_path / f"{'a' * 64}.h5").write_bytes(b"0" * 2_000_000)
    (tmp_path / "mine.h5").write_bytes(b"0")
    listed = run("cache")
    assert re.search(rf"folder +{tmp_path}\ntraces +1, 2.0 MB", listed.stdout)
    assert "Removed 1 trace, 0 compiled programs" in run("cache", "--clear").stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.h5"]
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    assert "CALIBRAY_CACHE is empty" in run("cache").stdout


def test_names_with_underscores_are_not_numbers():
    """Python reads 1_2 as 12; a map would take the offset of another sector."""
    assert _columns(["sector=1_2", "carrier=3.5e9", "side=east"]) == {
        "sector": "1_2", "carrier": 3.5e9, "side": "east",
    }  # fmt: skip


def test_a_column_has_one_value():
    with pytest.raises(InputError, match="side=west: side is given twice"):
        _columns(["side=east", "side=west"])
