"""`calibray run`, `trace` and `predict`: what stands on stdout, on stderr and in the files."""

from __future__ import annotations

import io
import json
import re
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from typer.testing import CliRunner

import planted
import programs
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.cli.progress_bars import progress_bars
from calibray.paths import Paths
from calibray.reporting import result_tables
from calibray.result import FILES
from calibray.support.output_files import SIGNATURES
from calibray.tables.text import render
from calibray.tracing.positions import EnclosedAntennas
from changed import changed

LOST_ROW = planted.INSIDE + 2  # the header is row 1


def calibray(*arguments: object):
    """Run a command in this process."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module", autouse=True)
def _no_cache():
    """Nothing is taken from, or left in, the user's cache of traces."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", "")
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a study file whose links have one offset per half, one of them without a path."""
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


def write_study(folder: Path, content: dict) -> None:
    """Write a study's content as a TOML file."""
    sections = dict(content)
    parameters = sections.pop("parameters")
    lines = ["version = 1"]
    for name, section in sections.items():
        if isinstance(section, dict) and section:
            lines += [f"[{name}]", *(f"{key} = {toml(value)}" for key, value in section.items())]
    lines += ["[parameters]", *(f'"{key}" = {toml(value)}' for key, value in parameters.items())]
    (folder / "study.toml").write_text("\n".join(lines))


def toml(value: object) -> str:
    """A value as TOML writes it."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(each)}" for key, each in value.items()) + " }"
    return json.dumps(value)


@pytest.fixture(scope="module")
def ran(folder):
    """The outcome of `calibray run`."""
    outcome = calibray("run", folder / "study.toml", "--out", folder / "out")
    assert outcome.exit_code == 0, outcome.output
    return outcome


def test_run_writes_its_files_and_says_so_on_stderr(folder, ran):
    assert sorted(path.name for path in (folder / "out").iterdir()) == sorted(
        [*FILES, "report.html", SIGNATURES]
    )
    warning, *rest = ran.stderr.splitlines(keepends=True)
    assert "1 of 12 receivers are inside buildings" in warning
    assert "".join(rest) == f"Written to {folder / 'out'}: {', '.join(FILES)}, report.html\n"
    assert Result.load(folder / "out").parameters == pytest.approx(planted.TRUTH, abs=1e-3)


def test_run_prints_what_it_found(folder, ran):
    result, lines = Result.load(folder / "out"), ran.stdout.splitlines()
    # Of the lines of a parameter the first: a later one says why.
    cells = {line.split("  ")[0]: line.split() for line in reversed(lines) if line}
    assert lines[0] == "study.toml: method auto, engine replay, seed 3"
    assert cells["calibrated on"][-1] == "9"
    assert cells["held out"][-1] == "2"
    assert cells["without a path"][-5:] == ["1", "row", f"{LOST_ROW},", "left", "out"]
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
    """The program is all that is asked; every call is in the ledger, and started again the run asks nothing."""
    write_study(
        tmp_path,
        programs.content(tmp_path) | {"method": {"name": "auto", "model": "none", "options": {"budget": 18}}},
    )

    def refuse(*_: object) -> None:
        pytest.fail("the ray tracer was loaded")

    monkeypatch.setattr("calibray.tracing.default_tracer.SionnaFactory.__call__", refuse)
    arguments = ("run", tmp_path / "study.toml", "--out", tmp_path / "out", "--workers", "2")
    first = calibray(*arguments)
    assert first.exit_code == 0, first.output
    assert "RT calls" in first.stdout
    assert len(programs.calls(tmp_path)) == 19  # with the values before calibration
    parameters = Result.load(tmp_path / "out").parameters
    assert list(parameters.values()) == pytest.approx(programs.TRUTH, abs=0.5)
    assert calibray(*arguments).exit_code == 0
    assert len(programs.calls(tmp_path)) == 19
    assert Result.load(tmp_path / "out").parameters == parameters
    listed = calibray("ledger", tmp_path / "out")
    assert listed.exit_code == 0
    assert "19" in listed.stdout


def test_run_prints_json_on_demand_and_takes_method_and_seed(folder):
    arguments = ("--json", "--method", "sgwo-im", "--seed", 7)
    outcome = calibray("run", folder / "study.toml", "--out", folder / "other", *arguments)
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
    assert content == json.loads((folder / "other" / "result.json").read_text())


def test_trace_stores_a_path_program(folder):
    outcome = calibray("trace", folder / "study.toml", "-o", folder / "paths.h5")
    assert outcome.exit_code == 0, outcome.output
    paths, engine = Paths.load(folder / "paths.h5"), planted.engine(blocked=True)
    assert (paths.num_paths, paths.num_links) == (engine.paths.num_paths, planted.LINKS)
    cells = {line.split("  ")[0]: line.split() for line in outcome.stdout.splitlines() if line}
    assert cells["paths"] == ["paths", f"{paths.num_paths:,}"]
    assert cells["without a path"][-3:] == ["1", "row", str(LOST_ROW)]
    assert outcome.stderr == f"Written to {folder / 'paths.h5'}\n"


def test_trace_check_needs_no_file_and_tells_that_nothing_changes(folder):
    before = sorted(folder.rglob("*"))
    outcome = calibray("trace", folder / "study.toml", "--check")
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
    outcome = calibray("trace", folder / "study.toml", "-o", tmp_path / "paths.h5")
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stderr.startswith(
        "Tracing 12 links in 3 launches of up to 160,000 rays x interactions x rec"
    )
    assert "launches" not in outcome.stdout


def test_predict_adds_a_column_to_the_table(folder, ran, tmp_path):
    table = planted.links(blocked=True).assign(name=[f"link {k}" for k in range(planted.LINKS)])
    table.to_csv(tmp_path / "new.csv", index=False)
    outcome = calibray("predict", folder / "out", tmp_path / "new.csv")
    assert outcome.exit_code == 0, outcome.output
    predicted = pd.read_csv(io.StringIO(outcome.stdout))
    assert predicted.columns.tolist() == [*table.columns, "path_loss_db"]
    pd.testing.assert_frame_equal(predicted[table.columns], table)
    expected = Result.load(folder / "out").links.after_db
    assert predicted.path_loss_db.to_numpy() == pytest.approx(expected.to_numpy(), abs=1e-3)
    lost = f"1 of 12 links, row {LOST_ROW}\n"
    assert outcome.stderr == f"Warning: no path leads to {lost}Warning: receiver inside a building: {lost}"


@pytest.mark.parametrize("name", ["out.csv", "out.parquet"])
def test_predict_writes_a_file_instead(folder, ran, tmp_path, name):
    planted.links().iloc[:3].to_parquet(tmp_path / "new.parquet")
    outcome = calibray("predict", folder / "out", tmp_path / "new.parquet", "-o", tmp_path / name)
    assert (outcome.exit_code, outcome.stdout) == (0, "")
    read = pd.read_csv if name.endswith("csv") else pd.read_parquet
    assert np.isfinite(read(tmp_path / name).path_loss_db).tolist() == [True] * 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "{study}", "--out", "{file}"), "is a file; name another folder"),
        (("run", "{study}", "--out", "{file}/deeper/still"), "is a file; name another folder"),
        (("run", "{study}", "--out", "{out}", "--method", "sgwoim"), "did you mean 'sgwo-im'?"),
        (("run", "{study}", "--out", "{out}", "--engine", "replya"), "engine"),
        (("run", "{folder}/absent.toml", "--out", "{out}"), "absent.toml: no such study file"),
        (("trace", "{study}", "-o", "{folder}/absent/paths.h5"), "there is no folder"),
        (("trace", "{study}", "-o", "{folder}"), "is a folder; name a file in it"),
        (("trace", "{study}"), "trace: give -o FILE to store the paths, --check to check them, or both"),
        (("predict", "{folder}", "{file}"), "is no result of `calibray run`"),
        (("predict", "{result}", "{file}"), "has a column 'path_loss_db' already; rename or remove it"),
        (("predict", "{result}", "{folder}/absent.csv"), "absent.csv: no such file"),
        (("predict", "{result}", "{bare}", "-o", "{folder}/out.xlsx"), "tables end in .csv or .parquet"),
    ],
)
def test_bad_arguments_are_one_message_and_leave_nothing(folder, ran, tmp_path, arguments, message):
    planted.links().to_csv(tmp_path / "bare.csv", index=False)
    places = {
        "study": folder / "study.toml",
        "file": folder / "links.csv",
        "folder": folder,
        "out": folder / "never",
        "result": folder / "out",
        "bare": tmp_path / "bare.csv",
    }
    before = sorted(folder.rglob("*"))
    outcome = calibray(*(argument.format(**places) for argument in arguments))
    assert (outcome.exit_code, outcome.stdout) == (2, "")
    assert outcome.stderr.startswith("Error: ")
    assert message in outcome.stderr
    assert sorted(folder.rglob("*")) == before


def test_antennas_inside_buildings_are_told_unless_all_are_indoors(folder, ran):
    result = Result.load(folder / "out")
    row, none = np.arange(2, 14), np.zeros(12, dtype=bool)
    few, most = np.arange(12) < 2, np.arange(12) < 11
    told = render(*result_tables.tables(changed(result, enclosed=EnclosedAntennas.of(row, none, few))))
    assert re.search(
        r"transmitter inside a building +0\nreceiver inside a building +2 +rows 2, 3: check", told
    )
    indoors = render(*result_tables.tables(changed(result, enclosed=EnclosedAntennas.of(row, most, most))))
    assert re.search(r"receiver inside a building +11 +as most are: taken for an indoor scene\n", indoors)
    assert changed(result, enclosed=EnclosedAntennas.of(row, none, few)).counts["rows_with_enclosed_rx"] == [
        2,
        3,
    ]


def test_tables_fit_what_there_is(folder, ran):
    result = Result.load(folder / "out")
    bare = changed(result, coefficients={}, nuisance_only_rmse_db=None, holdout_rmse_db=None, intervals={})
    text = render(*result_tables.tables(bare))
    assert "Offsets" not in text
    assert "offset only" not in text
    assert "not known" in text


def test_progress_is_a_bar_where_somebody_watches():
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    with progress_bars(console) as progress:
        progress("tracing", 0, 12)
        progress("calibrating", 60, 225)
    drawn = console.file.getvalue()
    assert "calibrating" in drawn
    assert "0/12" in drawn
    assert "0/?" not in drawn


def test_progress_is_lines_elsewhere_even_while_nothing_is_reported():
    console = Console(file=io.StringIO(), force_terminal=False, width=20)
    with progress_bars(console, every=0.02) as progress:
        while "starting" not in console.file.getvalue():
            time.sleep(0.01)
        progress("tracing", 0, 12)
        progress("tracing", 5, 12)
        while "tracing 5/12" not in console.file.getvalue():
            time.sleep(0.01)
        told = len(console.file.getvalue().splitlines())
        while len(console.file.getvalue().splitlines()) < told + 3:
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
    listed = calibray("cache")
    assert re.search(rf"folder +{tmp_path}\ntraces +1, 2.0 MB", listed.stdout)
    assert "Removed 1 traces, 0 compiled programs" in calibray("cache", "--clear").stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.h5"]
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    assert "CALIBRAY_CACHE is empty" in calibray("cache").stdout
