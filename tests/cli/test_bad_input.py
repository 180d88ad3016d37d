"""Bad input: exit status 2, one message with file, value and remedy, no traceback, no files."""

import subprocess
import sys
import tomllib

import pytest

from commands import STUDY, run, write_wall_study

CASES = {
    "no scene": ("study.toml", ('"scene.xml"', '"absent.xml"'), ["absent.xml", "no such file"]),
    "malformed scene": ("scene.xml", ("</scene>", "</scen"), ["scene.xml", "not well-formed XML", "export"]),
    "not a scene": ("scene.xml", ("scene", "window"), ["scene.xml", "<window>", "<scene>"]),
    "missing mesh": (
        "scene.xml",
        ("house.ply", "home.ply"),
        ["home.ply", "house", "does not exist", "meshes"],
    ),
    "material without constants": ("scene.xml", ("itu-radio-material", "diffuse"), ["walls", "[materials]"]),
    "unknown key": ("study.toml", ("max_depth", "max_deph"), ["trace.max_deph", "did you mean 'max_depth'?"]),
    "unknown section": ("study.toml", ("[trace]", "[tracing]"), ["tracing", "did you mean 'trace'?"]),
    "not TOML": ("study.toml", ("version = 1", "version = "), ["study.toml", "not valid TOML", "line 1"]),
    "other version": ("study.toml", ("version = 1", "version = 7"), ["version", "7", "1"]),
    "unknown material": (
        "study.toml",
        ("walls.", "wall."),
        ["wall.relative_permittivity", "did you mean 'walls'?"],
    ),
    "unknown field": ("study.toml", ("relative_permittivity", "permittivity"), ["no field 'permittivity'"]),
    "reversed bounds": (
        "study.toml",
        ("[1.5, 12.0]", "[12.0, 1.5]"),
        ["walls.relative_permittivity", "reversed"],
    ),
    "unphysical bounds": (
        "study.toml",
        ("[1.5, 12.0]", "[0.5, 12.0]"),
        ["walls.relative_permittivity", "0.5", "1"],
    ),
    "start outside bounds": (
        "study.toml",
        ("[1.5, 12.0]", "[5.5, 12.0]"),
        ["start = 3.91", "outside bounds"],
    ),
    "frequency outside ITU": ("study.toml", ("3.5e9", "60e9"), ["brick", "60 GHz", "1 to 40 GHz"]),
    "frequency in GHz": ("study.toml", ("3.5e9", "3.5"), ["scene.frequency", "Hz"]),
    "negative depth": (
        "study.toml",
        ("max_depth = 1", "max_depth = -1"),
        ["trace.max_depth", "-1", "from 0 to 100"],
    ),
    "no links file": ("study.toml", ("links.csv", "absent.csv"), ["absent.csv", "no such file"]),
    "missing column": ("study.toml", ('"loss"', '"los"'), ["links.csv", "'los'", "did you mean 'loss'?"]),
    "not a number": ("links.csv", ("76.0", "n/k"), ["links.csv", "row 3", "loss", "n/k"]),
    "empty cell": ("links.csv", ("76.0", ""), ["links.csv", "row 3", "loss"]),
    "negative path loss": ("links.csv", ("76.0", "-76.0"), ["links.csv", "row 3", "-76", "path_gain"]),
    "empty after filter": ("study.toml", ('"loss"', '"loss"\nwhere = "x > 99"'), ["links.csv", "x > 99"]),
    "bad filter": (
        "study.toml",
        ('"loss"', '"loss"\nwhere = "xx > 9"'),
        ["links.csv", "no column 'xx'", "did you mean 'x'?"],
    ),
    "hold-out of everything": (
        "study.toml",
        ("[trace]", '[holdout]\nwhere = "x > 0"\n[trace]'),
        ["x > 0", "no link"],
    ),
    "unknown method": (
        "study.toml",
        ("[trace]", '[method]\nname = "sgwoim"\n[trace]'),
        ["sgwoim", "sgwo-im"],
    ),
    "unknown option": (
        "study.toml",
        ("[trace]", '[method]\nname = "gwo"\noptions = { wolves = 3 }\n[trace]'),
        ["method.options", "wolves"],
    ),
    "unknown engine": (
        "study.toml",
        ("[trace]", '[engine]\nname = "rerun"\n[trace]'),
        ["engine.name", "rerun"],
    ),
    "link onto itself": ("links.csv", ("10,0,70.0,a", "0,0,70.0,a"), None),
}


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    return write_wall_study(tmp_path)


def test_the_study_runs_without_faults(study):
    assert tomllib.loads(STUDY)["version"] == 1
    outcome = run("run", study, "--out", study.parent / "out")
    assert outcome.exit_code == 0, outcome.output
    assert (study.parent / "out" / "result.json").is_file()


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case[2] is not None])
def test_every_fault_is_one_message_with_file_and_remedy(study, name):
    file, (old, new), words = CASES[name]
    path = study.with_name(file)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    before = sorted(study.parent.rglob("*"))
    outcome = run("run", study, "--out", study.parent / "out")
    assert outcome.exit_code == 2, outcome.output
    assert outcome.stdout == ""
    assert [word for word in words if word not in outcome.stderr] == [], outcome.stderr
    assert outcome.stderr.startswith("Error: ")
    assert "Traceback" not in outcome.stderr
    assert sorted(study.parent.rglob("*")) == before


def test_an_invalid_output_folder_is_refused_first(study):
    outcome = run("run", study, "--out", study.parent / "links.csv" / "out")
    assert outcome.exit_code == 2
    assert "output folder" in outcome.stderr


@pytest.mark.parametrize(
    "arguments", [("run", "{study}", "--out", "{out}", "--engine", "rerun"), ("predict", "{out}", "{study}")]
)
def test_bad_arguments(study, arguments):
    paths = {"study": study, "out": study.parent / "out"}
    outcome = run(*(argument.format(**paths) for argument in arguments))
    assert outcome.exit_code == 2
    assert outcome.stderr.startswith("Error: ")


def test_the_process_exits_with_2_and_no_traceback(study):
    study.write_text(STUDY.replace("version = 1", "version = 2"))
    program = [sys.executable, "-c", "from calibray.cli import main; main()"]
    finished = subprocess.run(
        [*program, "run", str(study), "--out", str(study.parent / "out")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 2
    assert finished.stdout == ""
    # On a busy machine, a line of progress precedes the message.
    assert finished.stderr.splitlines()[-1].startswith("Error: ")
    assert "Traceback" not in finished.stderr


@pytest.mark.parametrize("empty", ["", " "])
def test_an_empty_folder_name_is_not_the_current_folder(tmp_path, monkeypatch, empty):
    write_wall_study(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    done = run("run", "study.toml", "-o", empty)
    assert done.exit_code == 2
    assert "an argument is empty" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_small_address_space_is_named(tmp_path):
    """Libraries that find no memory end the process, or look as if they were not installed."""
    # The shell limits itself: this process may be larger than the limit.
    limited = 'ulimit -v 1048576; exec "$0" -m calibray run study.toml'
    done = subprocess.run(
        ["sh", "-c", limited, sys.executable], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert "too little memory: the address space of this process is limited to 1.0 GiB" in done.stderr
