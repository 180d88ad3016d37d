"""Streams, exit status and messages of the command line."""

from __future__ import annotations

import subprocess
import sys
import warnings
from importlib import metadata

import pytest
import typer
from typer.testing import CliRunner

from calibray import doctor as diagnosis
from calibray.cli import main
from calibray.cli.app import Commands, app
from calibray.errors import EngineError, InputError
from calibray.tables import render

HEAVY = (
    "numpy",
    "scipy",
    "pandas",
    "jax",
    "matplotlib",
    "pydantic",
    "h5py",
    "drjit",
    "mitsuba",
    "sionna",
    "rich",
)


def calibray(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the installed command."""
    code = "import sys; sys.argv[0] = 'calibray'; from calibray.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )


@pytest.fixture
def failing_app():
    """A command line like Calibray's, with commands that fail."""
    commands = typer.Typer(cls=Commands, pretty_exceptions_enable=False)

    @commands.command()
    def bad_input() -> None:
        raise InputError("links.csv, row 3: path_loss is -4")

    @commands.command()
    def engine_failure() -> None:
        raise EngineError("the engine ended with 9")

    @commands.command()
    def missing() -> None:
        raise FileNotFoundError(2, "No such file or directory", "a.msi")

    @commands.command()
    def mistake() -> None:
        raise ZeroDivisionError

    return commands


def test_the_version_is_that_of_the_package():
    run = calibray("--version")
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout == f"calibray {metadata.version('calibray')}\n"


def test_nothing_heavy_is_imported_before_a_command_runs():
    code = f"import sys, calibray.cli.app; print([name for name in {HEAVY} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("[]\n", "")


def test_help_lists_the_commands_on_stdout():
    for option in ("-h", "--help"):
        run = CliRunner().invoke(app, [option])
        assert (run.exit_code, run.stderr) == (0, "")
        assert "doctor" in run.stdout
        # Every summary is complete.
        assert "..." not in run.stdout.replace("[ARGS]...", "")


@pytest.mark.parametrize("arguments", [["no-such-command"], ["doctor", "--no-such-option"]])
def test_a_wrong_command_line_is_bad_input(arguments):
    run = CliRunner().invoke(app, arguments)
    assert (run.exit_code, run.stdout) == (2, "")
    assert arguments[-1] in run.stderr


@pytest.mark.parametrize(
    ("command", "status", "message"),
    [
        ("bad-input", 2, "Error: links.csv, row 3: path_loss is -4\n"),
        ("engine-failure", 1, "Error: the engine ended with 9\n"),
        ("missing", 1, "Error: a.msi: file not found; restore it, or correct its path\n"),
    ],
)
def test_an_expected_failure_is_one_message(failing_app, command, status, message):
    result = CliRunner().invoke(failing_app, [command])
    assert (result.exit_code, result.stdout, result.stderr) == (status, "", message)


def test_an_unexpected_error_is_not_hidden(failing_app):
    result = CliRunner().invoke(failing_app, ["mistake"])
    assert isinstance(result.exception, ZeroDivisionError)


def test_the_real_app_reports_failures_the_same_way(monkeypatch):
    def refuse() -> None:
        raise InputError("no")

    monkeypatch.setattr(diagnosis, "examine", refuse)
    result = CliRunner().invoke(app, ["doctor"])
    assert (result.exit_code, result.stdout, result.stderr) == (2, "", "Error: no\n")


@pytest.mark.parametrize(("passed", "status"), [(True, 0), (False, 1)])
def test_doctor_prints_its_table_and_fails_if_a_check_failed(monkeypatch, passed, status):
    check = diagnosis.Check("JAX", passed, "cpu:0", "install JAX")
    found = diagnosis.Diagnosis((("python", "3.11"),), "llvm_ad_mono_polarized", 0, (), (check,))
    monkeypatch.setattr(diagnosis, "examine", lambda: found)
    result = CliRunner().invoke(app, ["doctor"])
    assert (result.exit_code, result.stderr) == (status, "")
    assert result.stdout == render(found.table()) + "\n"


def test_warnings_of_libraries_do_not_reach_the_user(monkeypatch, capsys):
    monkeypatch.setattr(
        "calibray.cli.app.app", lambda: warnings.warn("deep inside", UserWarning, stacklevel=1)
    )
    monkeypatch.setattr(sys, "warnoptions", [])
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        main()
    assert capsys.readouterr().err == ""
