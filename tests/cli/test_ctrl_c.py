"""Ctrl-C in a terminal: the kept RT calls are printed, the status is 130, and the same command continues from there."""

from __future__ import annotations

import contextlib
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
from typer.testing import CliRunner

import programs
from calibray import calibrate
from calibray.cli.app import app
from calibray.engines import open_ledger
from calibray.errors import EngineError
from calibray.study import Study
from commands import write_study

# Its standard input becomes the controlling terminal. A background job inherits that Ctrl-C is ignored: reset.
COMMAND = [
    sys.executable,
    "-c",
    "import fcntl, signal, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
    "signal.signal(signal.SIGINT, signal.default_int_handler); from calibray.cli import main; main()",
]
PATIENCE = 120.0  # [s]


@pytest.fixture(autouse=True)
def _default_handler():
    """Ctrl-C raises, even if the tests run in the background and inherited a handler that ignores it."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


def kept_calls(folder: Path) -> int:
    """RT calls in the ledger of a folder."""
    if not (folder / "ledger.sqlite").is_file():
        return 0
    with closing(open_ledger(folder)) as ledger:
        return len(ledger.table())


def in_terminal(words: list[object], out: Path, until: int) -> tuple[int, str]:
    """Status and screen of a command in a pseudo-terminal; Ctrl-C is pressed once after `until` RT calls."""
    own, theirs = pty.openpty()
    environment = {**os.environ, "CALIBRAY_CACHE": "", "TERM": "xterm"}
    process = subprocess.Popen(
        [*COMMAND, *map(str, words)], stdin=theirs, stdout=theirs, stderr=theirs, env=environment,
        start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    screen, pressed, deadline = b"", False, time.monotonic() + PATIENCE
    try:
        while time.monotonic() < deadline:
            if select.select([own], [], [], 0.1)[0]:
                try:
                    screen += os.read(own, 65536)
                except OSError:
                    break
            if not pressed and kept_calls(out) >= until:
                os.write(own, b"\x03")
                pressed = True
            if process.poll() is not None and not select.select([own], [], [], 0)[0]:
                break
        return process.wait(timeout=PATIENCE), screen.decode()
    finally:
        process.kill()
        os.close(own)


def test_an_import_that_dropped_ctrl_c_interrupts_a_calibration(monkeypatch, tmp_path):
    """Mitsuba's import does at times; its module then lacks attributes."""

    def opened(*_):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise AttributeError("Module 'mitsuba' has no attribute 'Scene'")

    write_study(tmp_path, programs.content(tmp_path))
    study = Study.load(tmp_path / "study.toml")
    monkeypatch.setattr("calibray.study.Setup.open", opened)
    with pytest.raises(KeyboardInterrupt):
        calibrate(study)


def test_an_error_that_follows_ctrl_c_is_printed(monkeypatch, tmp_path):
    def fails(_):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise EngineError("the answer lies in rescue.json")

    monkeypatch.setattr("calibray.study.Study.load", fails)
    ended = CliRunner().invoke(app, ["run", "study.toml", "--out", str(tmp_path / "out")])
    assert ended.exit_code == 130
    assert "Error: the answer lies in rescue.json\nInterrupted" in ended.stderr


def test_ctrl_c_prints_the_kept_calls_and_the_same_command_continues(monkeypatch, tmp_path):
    method = {"name": "random", "options": {"budget": 8}}
    content = programs.content(tmp_path, before="import time; time.sleep(0.3)")
    write_study(tmp_path, content | {"method": method})
    out = tmp_path / "out"
    words = ["run", str(tmp_path / "study.toml"), "--out", str(out)]
    status, screen = in_terminal(words, out, until=3)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|\s+", " ", screen)
    assert status == 130, plain
    kept = kept_calls(out)
    assert kept >= 3
    assert f"Kept: {kept} RT calls in" in plain
    assert "Start the same command again to continue" in plain
    assert "Traceback" not in plain
    calls_before = len(programs.calls(tmp_path))
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0, again.stderr
    # The first call is the uncalibrated scene, which the method's budget of 8 does not count.
    assert re.search(rf"found in the ledger +{kept - 1}\n", again.stdout)
    assert len(programs.calls(tmp_path)) == calls_before + 9 - kept
    assert "\x1b" not in again.stderr  # no terminal, no bars


def test_sigterm_prints_the_kept_calls_even_if_ctrl_c_is_ignored(tmp_path):
    """A scheduler sends it to a job in the background; the status is 143, and no program is left."""
    content = programs.content(tmp_path, before="import time; time.sleep(0.3)")
    write_study(tmp_path, content | {"method": {"name": "random", "options": {"budget": 200}}})
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); from calibray.cli import main; main()"
    )
    words = [sys.executable, "-c", code, "run", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out")]
    environment = {**os.environ, "CALIBRAY_CACHE": ""}
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    try:
        deadline = time.monotonic() + PATIENCE
        while kept_calls(tmp_path / "out") < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
        process.terminate()
        _, printed = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 143, printed
    assert f"Kept: {kept_calls(tmp_path / 'out')} RT calls in" in printed
    assert "Start the same command again to continue" in printed
    assert "Traceback" not in printed
    started = len(programs.calls(tmp_path))
    time.sleep(1.0)
    assert len(programs.calls(tmp_path)) == started
