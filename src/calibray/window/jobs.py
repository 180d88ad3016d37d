"""Commands that were started in a study's folder, from the window or from a terminal.

Each command of the window is a separate process with three files in `.calibray-window`: `0001.json` describes the
command, `0001.log` contains the output, and `0001.exit` contains the exit status. A command that has neither an exit
status nor a process has died; if it is started again, it resumes its work.

`python -m calibray.window.jobs` runs one command in its own session, so that the command outlives the server, and
records the exit status. Ctrl-C is passed to the command, which keeps finished work.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Final

import psutil

from calibray.errors import InputError
from calibray.support.messages import command
from calibray.support.output_files import write_text

FOLDER: Final = ".calibray-window"
WIDTH: Final = "80"
"""Number of characters per line in a command's tables."""

TAIL: Final = 16_384
"""Number of bytes shown at the end of a log, which is enough for a few screens of text."""


_LINE: Final = re.compile(
    r"(?P<name>[A-Za-z][^,/]*?)(?: (?P<done>\d+)(?:/(?P<total>\d+))?)?(?:, \d+ %)?(?:, [\d.e+-]+/s)?"
    r", (?P<seconds>\d+) s(?:, about (?P<left>\d+) s left)?(?:, (?P<found>.+))?"
)
"""Pattern of a progress line in a log (`calibray.cli.console.line`)."""


@dataclass(frozen=True)
class Job:
    """A command and its state.

    Attributes:
        number: Number of the command in the folder; 0 if it was started from a terminal.
        words: Arguments of the command.
        state: "running", "done", "failed", "stopped" or "died".
        pid: Process ID.
        log: End of the output.
    """

    number: int
    words: tuple[str, ...]
    state: str
    pid: int
    log: str = ""

    @property
    def command(self) -> str:
        """The command as typed in a terminal."""
        return command(*self.words)


class Jobs:
    """The commands of one study folder."""

    def __init__(self, study_folder: Path) -> None:
        self._study_folder = study_folder
        self._folder = study_folder / FOLDER

    def start(self, words: Sequence[str]) -> Job:
        """Start a command.

        Raises:
            InputError: Another command is running, or the folder cannot be written to.
        """
        if running := self.running():
            raise InputError(f"{running.command}: is running; wait until it ends, or stop it")
        if self._folder.is_symlink():
            raise InputError(f"{self._folder}: is a symbolic link; remove it")
        try:
            self._folder.mkdir(exist_ok=True)
            # All files are considered, because a command that was never recorded may have left a log.
            used = (int(file.stem) for file in self._folder.glob("[0-9]*.*") if file.stem.isdecimal())
            number = max(used, default=0) + 1
            stem = self._folder / f"{number:04d}"
            arguments = [sys.executable, "-m", "calibray.window.jobs", f"{stem}.exit", *words]
            # The command writes to the log while it runs. Creating the log exclusively follows no link and replaces no
            # file.
            output = os.fdopen(os.open(f"{stem}.log", os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb")
            with output as log, _held_back(signal.SIGINT):
                child = subprocess.Popen(
                    arguments, cwd=self._study_folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                    start_new_session=True, env={**os.environ, "COLUMNS": WIDTH},
                )  # fmt: skip
            created = psutil.Process(child.pid).create_time()
            # Without this wait, the ended process would stay in the process table. After the wait, `create_time` would
            # fail.
            Thread(target=child.wait, daemon=True).start()
            record = {"words": list(words), "pid": child.pid, "created": created}
            write_text(Path(f"{stem}.json"), json.dumps(record) + "\n")
        except OSError as error:
            raise InputError(f"{self._folder}: cannot be written ({error.strerror})") from None
        return Job(number, tuple(words), "running", child.pid)

    def list(self) -> list[Job]:
        """The commands started in the folder, with the most recent command first."""
        files = sorted(self._folder.glob("[0-9]*.json"), reverse=True)
        return [job for job in map(_read, files) if job is not None]

    def running(self) -> Job | None:
        """The command that is currently running; None if no command is running."""
        return next((job for job in self.list() if job.state == "running"), None)

    def elsewhere(self) -> list[Job]:
        """Commands that are running in the folder and were started from a terminal."""
        own = {job.pid for job in self.list() if job.state == "running"}
        commands = []
        for process in psutil.process_iter(["pid", "ppid", "cmdline", "cwd"]):
            line, parent = process.info["cmdline"] or [], process.info["ppid"]
            # The command line is `calibray`, `python .../calibray` or `python -m calibray`.
            start = next((k for k, word in enumerate(line[:3]) if Path(word).name == "calibray"), None)
            here = process.info["cwd"] == str(self._study_folder)
            if start is not None and here and parent not in own and line[start + 1 : start + 2] != ["open"]:
                commands.append(Job(0, tuple(line[start + 1 :]), "running", process.info["pid"]))
        return commands

    def stop(self, job: Job) -> None:
        """Interrupt a command as Ctrl-C would; finished work is kept."""
        with suppress(ProcessLookupError, PermissionError):
            if job.number:
                os.killpg(job.pid, signal.SIGINT)

    def wait(self, job: Job, seconds: float) -> Job:
        """Wait at most the given number of seconds for a command; return it with its final state, or unchanged."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            now = next(other for other in self.list() if other.number == job.number)
            if now.state != "running":
                return now
            time.sleep(0.05)
        return job


@contextmanager
def _held_back(number: signal.Signals) -> Iterator[None]:
    """Block a signal in this thread and in the processes that it starts, which inherit the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _read(file: Path) -> Job | None:
    """The command recorded in a file; None if the window did not write the file."""
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        words, pid = tuple(map(str, record["words"])), int(record["pid"])
        created = float(record["created"])
        number = int(file.stem)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    return Job(
        number, words, _state(file.with_suffix(".exit"), pid, created), pid, _tail(file.with_suffix(".log"))
    )


def _state(exit_file: Path, pid: int, created: float) -> str:
    # After Ctrl-C, a command exits with 130, or with -2 if the signal killed it or arrived before it started.
    with suppress(OSError, ValueError):
        return {0: "done", 130: "stopped", -2: "stopped"}.get(int(exit_file.read_text()[:20]), "failed")
    with suppress(psutil.Error, OverflowError, ValueError):
        process = psutil.Process(pid)
        # Another process may have received this ID since then; that process must not be mistaken for the command or
        # stopped.
        if abs(process.create_time() - created) < 1 and process.status() != psutil.STATUS_ZOMBIE:
            return "running"
    return "died"


def _tail(file: Path) -> str:
    try:
        with file.open("rb") as stream:
            stream.seek(max(0, file.stat().st_size - TAIL))
            return stream.read(TAIL).decode("utf-8", errors="replace")
    except OSError:
        return ""


@dataclass(frozen=True)
class Stage:
    """A stage of a command.

    Attributes:
        name: Name of the stage.
        share: Completed fraction of the stage, from 0 to 1; None if unknown.
        seconds: Elapsed time [s].
        left: Remaining time [s]; None if unknown.
        best: Best value so far, such as "best RMSE 3.10 dB"; empty if the log contains no value.
    """

    name: str
    share: float | None
    seconds: int
    left: int | None
    best: str


def stages(log: str) -> list[Stage]:
    r"""The stages in a log, in order; stages of less than a few seconds print no progress line and are missing.

    Example:
        >>> stages("tracing 3/4, 75 %, 1/s, 3 s, about 1 s left\nWritten to result")
        [Stage(name='tracing', share=0.75, seconds=3, left=1, best='')]
    """
    latest: dict[str, Stage] = {}
    for text in log.splitlines():
        if (match := _LINE.fullmatch(text.strip())) is None:
            continue
        name, done, total, seconds, left, value = match.groups()
        share = min(int(done) / int(total), 1.0) if total and int(total) else None
        latest.pop(name, None)
        latest[name] = Stage(name, share, int(seconds), int(left) if left else None, value or "")
    return list(latest.values())


def main() -> None:
    """Run the command given after the exit-status file in the arguments, unless it is stopped before it starts."""
    stopped: list[int] = []
    # Unlike SIG_IGN, a handler is not inherited by the command.
    signal.signal(signal.SIGINT, lambda number, _: stopped.append(number))
    # `Jobs.start` blocked this signal while Python started.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    _, status_file, *words = sys.argv
    status = -signal.SIGINT
    if not stopped:
        arguments = [sys.executable, "-m", "calibray", *words]
        status = subprocess.run(arguments, stdin=subprocess.DEVNULL, check=False).returncode
    write_text(Path(status_file), f"{status}\n")


if __name__ == "__main__":
    main()
