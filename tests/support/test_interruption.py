"""Ctrl-C in a terminal: what was kept is told, the status is 130, and the same command goes on from there."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
from rich.console import Console
from test_cli_run import write_study
from typer.testing import CliRunner

import programs
from calibray.calibration import calibrate
from calibray.cli.app import app
from calibray.cli.progress_bars import progress_bars
from calibray.engines import open_ledger
from calibray.errors import EngineError
from calibray.study import Study
from calibray.support import interruption

# Its standard input becomes the terminal that Ctrl-C is typed in, which jobs in the background ignore by inheritance.
TERMINAL = (
    "import fcntl, signal, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
    "signal.signal(signal.SIGINT, signal.default_int_handler); "
)
MAIN = "from calibray.cli import main; main()"
COMMAND, IN_TERMINAL = ([sys.executable, "-c", code] for code in (MAIN, TERMINAL + MAIN))
PATIENCE = 120.0  # [s]


@pytest.fixture(autouse=True)
def heard():
    """Ctrl-C is heard here, too, where the tests run in the background and inherited that it is not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def paid(folder: Path) -> int:
    """RT calls in the ledger of a folder."""
    if not (folder / "ledger.sqlite").is_file():
        return 0
    with closing(open_ledger(folder)) as ledger:
        return len(ledger.table())


def in_terminal(words: list[object], out: Path, until: int) -> tuple[int, str]:
    """Status and screen of a command in a pseudo-terminal, Ctrl-C pressed once so many RT calls are paid for."""
    own, theirs = pty.openpty()
    environment = {**os.environ, "CALIBRAY_CACHE": "", "TERM": "xterm"}
    process = subprocess.Popen(
        [*IN_TERMINAL, *map(str, words)], stdin=theirs, stdout=theirs, stderr=theirs, env=environment,
        start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    screen, pressed, deadline = b"", False, time.monotonic() + PATIENCE
    try:
        while time.monotonic() < deadline:
            if select.select([own], [], [], 0.1)[0]:
                try:
                    read = os.read(own, 65536)
                except OSError:
                    break
                screen += read
            if not pressed and paid(out) >= until:
                os.write(own, b"\x03")
                pressed = True
            if process.poll() is not None and not select.select([own], [], [], 0)[0]:
                break
        return process.wait(timeout=PATIENCE), screen.decode()
    finally:
        process.kill()
        os.close(own)


@pytest.mark.parametrize("terminal", [True, False])
def test_an_interruption_that_a_library_drops_comes_at_the_next_step(terminal, monkeypatch):
    monkeypatch.setattr(interruption, "GRACE", 0.0)
    console = Console(file=io.StringIO(), force_terminal=terminal)

    def work():
        with progress_bars(console) as progress:
            progress("tracing", 0, 2)
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            progress("tracing", 1, 2)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("failure", [RuntimeError, SystemError, ImportError])
def test_an_interruption_that_a_library_took_for_its_own_failure_is_one(failure):
    @interruption.unwrap_interruption()
    def work():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise failure("while initializing") from error

    with pytest.raises(KeyboardInterrupt):
        work()


@pytest.mark.parametrize("pressed", [True, False])
def test_what_fails_after_ctrl_c_is_an_interruption_and_nothing_else_is(pressed):
    def work():
        with interruption.ensure_interruption():
            with contextlib.suppress(KeyboardInterrupt):
                if pressed:
                    signal.raise_signal(signal.SIGINT)
            raise ValueError("of a library that was cut short")

    with pytest.raises(KeyboardInterrupt if pressed else ValueError):
        work()


def test_an_import_that_dropped_ctrl_c_is_an_interruption_of_a_calibration(monkeypatch, tmp_path):
    """Mitsuba's does at times: its module then lacks what others look for in it."""

    def opened(*_):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise AttributeError("Module 'mitsuba' has no attribute 'Scene'")

    write_study(tmp_path, programs.content(tmp_path))
    study = Study.load(tmp_path / "study.toml")
    monkeypatch.setattr("calibray.study.Setup.open", opened)
    with pytest.raises(KeyboardInterrupt):
        calibrate(study)


def test_what_went_wrong_when_ctrl_c_was_pressed_is_told(monkeypatch, tmp_path):
    def fails(_):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise EngineError("the answer lies in rescue.json")

    monkeypatch.setattr("calibray.study.Study.load", fails)
    ended = CliRunner().invoke(app, ["run", "study.toml", "--out", str(tmp_path / "out")])
    assert ended.exit_code == 130
    assert "Error: the answer lies in rescue.json\nInterrupted" in ended.stderr


def test_an_interruption_waits_for_what_must_not_be_left_half_made():
    done = []

    def work():
        with interruption.defer_interruption():
            signal.raise_signal(signal.SIGINT)
            done.append("whole")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["whole"]


def test_ctrl_c_tells_what_was_kept_and_how_to_go_on(tmp_path):
    method = {"name": "auto", "options": {"budget": 18}}
    write_study(
        tmp_path, programs.content(tmp_path, before="import time; time.sleep(0.3)") | {"method": method}
    )
    out = tmp_path / "out"
    status, screen = in_terminal(["run", tmp_path / "study.toml", "--out", out], out, until=3)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|\s+", " ", screen)
    assert status == 130, plain
    kept = paid(out)
    assert kept >= 3
    assert f"Kept: {kept} RT calls in" in plain
    assert "Start the same command again to go on" in plain
    assert "Traceback" not in plain
    asked = len(programs.calls(tmp_path))
    again = subprocess.run(
        [*COMMAND, "run", tmp_path / "study.toml", "--out", out],
        env={**os.environ, "CALIBRAY_CACHE": ""}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert again.returncode == 0, again.stderr
    # The first call is the scene as it was, which the method's budget of 18 does not count.
    assert re.search(rf"answered by the ledger +{kept - 1}\n", again.stdout)
    assert len(programs.calls(tmp_path)) == asked + 19 - kept
    # The second run took seconds without a terminal.
    assert "\x1b" not in again.stderr
