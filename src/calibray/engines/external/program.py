"""Calls of an external program for one candidate, with request and response files, a time limit and retries."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Event
from typing import Final

import numpy as np
import psutil
from numpy.typing import NDArray

from calibray.engines.external.exchange import Request, Unusable, read_answer, read_rays
from calibray.engines.external.guard import KILL_TIME, POLL
from calibray.engines.process_owner import ProcessOwner
from calibray.errors import EngineError, InputError

PLACEHOLDERS: Final = ("{request}", "{response}")
GUARD_WAIT: Final = 2 * KILL_TIME  # maximum time to wait for a guard to kill its program [s]
PREFIX: Final = "calibray-call-"  # prefix of the names of temporary folders of calls
OWNER_FILE: Final = "owner.json"

# `python -I -S guard.py LIBRARIES`: see `guard`.
GUARD: Final = (
    "-I",
    "-S",
    str(Path(__file__).resolve().with_name("guard.py")),
    str(Path(psutil.__file__).parents[1]),
)


Response = tuple[NDArray[np.float64], NDArray[np.float64]] | bytes
"""The content of a response: either path loss [L], [dB], and further observables [K, L] in SI units, or a ray table."""


class Unstartable(Unusable):
    """The program does not exist or cannot be executed, so another attempt would also fail."""


class Lost(Unusable):
    """The guard ended unexpectedly, which is not the program's fault."""


class Stopped(Exception):
    """The call was stopped from outside before the program answered."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of a program's call for one candidate, after all attempts.

    Attributes:
        path_loss_db: Path loss [L], [dB]; +inf for a link without a path, and for every link if all attempts failed.
        seconds: Total duration of all attempts [s].
        failure: Error message of the last attempt; empty if this attempt succeeded.
        rays: The response of a program that returns rays; otherwise further observables [K, L] in SI units as
            little-endian doubles, or empty.
        lost: Whether the last attempt failed because a worker or the guard ended, which is not the program's fault.
    """

    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""
    rays: bytes = b""
    lost: bool = False


@dataclass(frozen=True)
class ExternalProgram:
    """An external program with the settings of its calls; picklable, so that other machines can call it.

    Attributes:
        words: The program and its arguments. The file paths replace the placeholders `{request}` and `{response}`; a
            path whose placeholder is missing is appended.
        folder: Folder in which the program runs.
        timeout: Time limit for one attempt [s].
        retries: Number of further attempts after a failure.
        file_format: "json" or "hdf5".
        rays: Whether the program returns a ray table instead of path loss.

    Raises:
        InputError: A word contains a NUL character, which cannot be passed to a program.
    """

    words: tuple[str, ...]
    folder: Path
    timeout: float
    retries: int
    file_format: str
    rays: bool = False

    def __post_init__(self) -> None:
        for index, word in enumerate(self.words):
            if "\0" in word:
                raise InputError(
                    f"engine.command[{index}] = {word[:80]!r}: contains a NUL character, which cannot be passed to a "
                    "program; remove it"
                )

    def run(self, request: Request, stop: Event | None = None) -> Outcome:
        """Call the program for one candidate, and repeat a failed call until no attempts are left.

        A failure is returned rather than raised, so that only one candidate is lost instead of the whole batch. Another
        thread can set `stop` to kill the program.

        Raises:
            Stopped: `stop` was set before the program had answered.
            EngineError: The files cannot be written, which is not the program's fault.
        """
        num_links = len(request.tx)
        started, failure, lost, attempt = time.perf_counter(), "", False, 0
        no_path = np.full(num_links, np.inf)
        while attempt <= self.retries:
            if stop is not None and stop.is_set():
                raise Stopped
            attempt += 1
            try:
                response = self._attempt(request, num_links, stop)
            except Unstartable as error:
                failure, lost = str(error), False
                break
            except Unusable as error:
                failure, lost = str(error), isinstance(error, Lost)
            else:
                seconds = time.perf_counter() - started
                if isinstance(response, bytes):
                    return Outcome(no_path, seconds, rays=response)
                loss, observed = response
                return Outcome(loss, seconds, rays=observed.astype("<f8").tobytes())
        attempts = "" if attempt < 2 else f" (attempt {attempt} of {self.retries + 1})"
        return Outcome(no_path, time.perf_counter() - started, failure + attempts, lost=lost)

    def _attempt(self, request: Request, num_links: int, stop: Event | None) -> Response:
        ending = "json" if self.file_format == "json" else "h5"
        with _call_folder() as folder:
            request_file, response_file = folder / f"request.{ending}", folder / f"response.{ending}"
            try:
                request.write(request_file, self.file_format)
            except OSError as error:
                raise _unwritable(error) from None
            report = self._run_guarded(folder, self._command_line(request_file, response_file), stop)
            if report["ended"] == "unstarted":
                raise Unstartable(f"cannot be started ({report['output']})")
            if report["ended"] == "stopped" and stop is not None and stop.is_set():
                raise Stopped
            if report["ended"] == "stopped":
                raise Lost("was lost with its guard, which was stopped from outside")
            try:
                if report["ended"] == "timeout":
                    raise Unusable(f"gave no answer within timeout = {self.timeout:g} s and was killed")
                if report["status"]:
                    raise Unusable(f"ended with {_describe_status(report['status'])}")
                if self.rays:
                    return read_rays(response_file, num_links)
                wanted = request.radio.observables
                loss, observed = read_answer(response_file, self.file_format, num_links, len(wanted))
                # Programs return observables in the units of the study.
                scale = np.array([each.scale for each in wanted])[:, None]
                return loss, observed * scale if wanted else observed
            except Unusable as error:
                output = report["output"]
                raise Unusable(
                    f"{error}; its output:\n{output}" if output else f"{error}; the program printed no output"
                ) from None

    def _command_line(self, request_file: Path, response_file: Path) -> list[str]:
        words = [
            *self.words,
            *(mark for mark in PLACEHOLDERS if not any(mark in word for word in self.words)),
        ]
        for mark, file in zip(PLACEHOLDERS, (request_file, response_file), strict=True):
            words = [word.replace(mark, str(file)) for word in words]
        return words

    def _run_guarded(self, folder: Path, words: list[str], stop: Event | None) -> dict:
        """Run the program under its guard (see `guard`), and return the guard's report."""
        # The guard kills the program when the other end of the guard's standard input is closed.
        guard_input, leash = os.pipe()
        try:
            process = subprocess.Popen(
                [sys.executable, *GUARD, repr(float(self.timeout)), str(folder), *words],
                cwd=self.folder,
                stdin=guard_input,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is meant for Calibray, not for the guard
            )
        except OSError as error:
            os.close(leash)
            raise Unstartable(f"cannot be started ({error.strerror or error})") from None
        finally:
            os.close(guard_input)
        report = None
        try:
            while report is None and not (stop is not None and stop.is_set()):
                with suppress(subprocess.TimeoutExpired):
                    report, _ = process.communicate(timeout=POLL)
        finally:
            os.close(leash)
            if report is None:
                report = _last_report(process)
        try:
            return json.loads(report)
        except ValueError:
            raise Lost(
                f"was lost with its guard, which ended with {_describe_status(process.returncode)}"
            ) from None


def _last_report(guard: subprocess.Popen) -> bytes:
    """The report of a guard whose standard input has been closed; the guard kills its program before it reports."""
    try:
        return guard.communicate(timeout=GUARD_WAIT)[0]
    except subprocess.TimeoutExpired:
        guard.kill()
        return guard.communicate()[0]


def _describe_status(status: int) -> str:
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"signal {signal.Signals(-status).name}"
    except ValueError:  # only the first and the last real-time signal have names
        return f"signal SIGRTMIN+{-status - signal.SIGRTMIN}"


@contextmanager
def _call_folder() -> Iterator[Path]:
    """A temporary folder for one call, with a file that names its owner; folders whose owner has ended are removed."""
    try:
        parent = Path(tempfile.gettempdir())
        _remove_abandoned(parent)
        folder = tempfile.TemporaryDirectory(prefix=PREFIX, dir=parent, ignore_cleanup_errors=True)
    except OSError as error:
        raise _unwritable(error) from None
    with folder as name:
        try:
            owner = json.dumps(ProcessOwner.current().record())
            (Path(name) / OWNER_FILE).write_text(owner, encoding="utf-8")
        except OSError as error:
            raise _unwritable(error) from None
        yield Path(name)


def _unwritable(error: OSError) -> EngineError:
    return EngineError(
        f"temporary folder {error.filename or 'of the system'}: the files of a call cannot be written "
        f"({error.strerror or error}); free disk space, or set the environment variable TMPDIR to another folder"
    )


@cache
def _remove_abandoned(parent: Path) -> None:
    """Remove, once per process, the folders of calls whose processes were killed together with their guards."""
    for folder in parent.glob(f"{PREFIX}*"):
        try:
            mark = folder / OWNER_FILE
            if mark.is_symlink() or folder.is_symlink() or folder.stat().st_uid != os.geteuid():
                continue
            owner = ProcessOwner.from_record(json.loads(mark.read_text(encoding="utf-8")))
        except (OSError, ValueError, RecursionError):
            continue
        if owner is not None and owner.is_gone:
            shutil.rmtree(folder, ignore_errors=True)
