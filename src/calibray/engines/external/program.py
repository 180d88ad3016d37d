"""An external program, run for one candidate: its files, its time limit, its attempts."""

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
from numpy.typing import NDArray

from calibray.engines.external import guard
from calibray.engines.external.exchange import Request, Unusable, read_answer
from calibray.engines.ledger.owner import Owner
from calibray.errors import EngineError, InputError

PLACEHOLDERS: Final = ("{request}", "{response}")
GLANCE: Final = 0.5  # how often a waiting thread looks whether it shall stop [s]
GUARD: Final = str(Path(guard.__file__).resolve())
PREFIX: Final = "calibray-call-"  # of the temporary folders of calls
OWNER_FILE: Final = "owner.json"


class Unstartable(Unusable):
    """A program that is not there, or cannot be executed: no attempt will differ."""


class Stopped(Exception):
    """A call that was ended from outside before it answered."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """How the attempts at one candidate ended.

    Attributes:
        path_loss_db: Path loss [L], [dB], +inf without a path; all of it where the attempts failed.
        seconds: Time that all attempts took together.
        failure: What went wrong in the last attempt; empty if it succeeded.
    """

    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""


@dataclass(frozen=True)
class ExternalProgram:
    """How an external program is called. It can be sent to other processes and machines.

    Attributes:
        words: The program and its arguments; `{request}` and `{response}` stand for the files' paths, and are
            appended where absent.
        folder: Folder to run it in.
        timeout: Time that one attempt may take [s].
        retries: How often to try again after a failure.
        file_format: "json" or "hdf5".

    Raises:
        InputError: A word holds a NUL character, which no program can be given.
    """

    words: tuple[str, ...]
    folder: Path
    timeout: float
    retries: int
    file_format: str

    def __post_init__(self) -> None:
        for place, word in enumerate(self.words):
            if "\0" in word:
                raise InputError(
                    f"engine.command[{place}] = {word[:80]!r}: holds a NUL character, which no program can be given; "
                    "remove it"
                )

    def run(self, request: Request, stop: Event | None = None) -> Outcome:
        """Ask the program for one candidate, again after every failure while attempts are left.

        Args:
            request: What is asked.
            stop: Set from outside to kill the program.

        Returns:
            How it ended; a failure is told, not raised, so that it costs one candidate and not the batch.

        Raises:
            Stopped: `stop` was set before there was an answer.
            EngineError: The files cannot be written, which is not the program's fault.
        """
        num_links = len(request.surroundings.tx)
        started, failure, attempt = time.perf_counter(), "", 0
        while attempt <= self.retries:
            if stop is not None and stop.is_set():
                raise Stopped
            attempt += 1
            try:
                loss = self._attempt(request, num_links, stop)
            except Unstartable as error:
                failure = str(error)
                break
            except Unusable as error:
                failure = str(error)
            else:
                return Outcome(loss, time.perf_counter() - started)
        tries = "" if attempt < 2 else f" (attempt {attempt} of {self.retries + 1})"
        lost = np.full(num_links, np.inf)
        return Outcome(lost, time.perf_counter() - started, failure + tries)

    def _attempt(self, request: Request, num_links: int, stop: Event | None) -> NDArray[np.float64]:
        ending = "json" if self.file_format == "json" else "h5"
        with _call_folder() as place:
            files = place / f"request.{ending}", place / f"response.{ending}"
            try:
                request.write(files[0], self.file_format)
            except OSError as error:
                raise _unwritable(error) from None
            told = self._guarded(place, self._arguments(files), stop)
            if told["ended"] == "unstarted":
                raise Unstartable(f"cannot be started ({told['said']})")
            if told["ended"] == "stopped" and stop is not None and stop.is_set():
                raise Stopped
            try:
                if told["ended"] == "stopped":
                    raise Unusable("was stopped from outside")
                if told["ended"] == "timeout":
                    raise Unusable(f"gave no answer within timeout = {self.timeout:g} s and was killed")
                if told["status"]:
                    raise Unusable(f"ended with {_status(told['status'])}")
                return read_answer(files[1], self.file_format, num_links)
            except Unusable as error:
                said = told["said"]
                raise Unusable(
                    f"{error}; it said:\n{said}" if said else f"{error}; it said nothing"
                ) from None

    def _arguments(self, files: tuple[Path, Path]) -> list[str]:
        words = [
            *self.words,
            *(mark for mark in PLACEHOLDERS if not any(mark in word for word in self.words)),
        ]
        for mark, file in zip(PLACEHOLDERS, files, strict=True):
            words = [word.replace(mark, str(file)) for word in words]
        return words

    def _guarded(self, place: Path, arguments: list[str], stop: Event | None) -> dict:
        """Run the program under its guard (see `guard`), and give what that tells."""
        words = [sys.executable, "-I", "-S", GUARD, repr(float(self.timeout)), str(place), *arguments]
        # The guard ends the program when nobody holds the other end of its standard input any more.
        held, leash = os.pipe()
        try:
            process = subprocess.Popen(
                words,
                cwd=self.folder,
                stdin=held,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # an interrupt from the keyboard is for Calibray, not for the guard
            )
        except OSError as error:
            os.close(leash)
            raise Unstartable(f"cannot be started ({error.strerror or error})") from None
        finally:
            os.close(held)
        output = None
        try:
            while output is None and not (stop is not None and stop.is_set()):
                with suppress(subprocess.TimeoutExpired):
                    output, _ = process.communicate(timeout=GLANCE)
        finally:
            os.close(leash)
            if output is None:
                output = _last_words(process)
        try:
            return json.loads(output)
        except ValueError:
            raise Unusable(
                f"was lost with its guard, which ended with {_status(process.returncode)}"
            ) from None


def _last_words(process: subprocess.Popen) -> bytes:
    """What a guard says that was let loose; it has killed its program by then."""
    try:
        return process.communicate(timeout=2 * guard.PATIENCE)[0]
    except subprocess.TimeoutExpired:
        process.kill()
        return process.communicate()[0]


def _status(status: int) -> str:
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"signal {signal.Signals(-status).name}"
    except ValueError:  # real-time signals have no names but the first and the last
        return f"signal SIGRTMIN+{-status - signal.SIGRTMIN}"


@contextmanager
def _call_folder() -> Iterator[Path]:
    """A temporary folder for one call, with the mark of its owner; those of processes that are gone are removed."""
    try:
        parent = Path(tempfile.gettempdir())
        _sweep(parent)
        folder = tempfile.TemporaryDirectory(prefix=PREFIX, dir=parent, ignore_cleanup_errors=True)
    except OSError as error:
        raise _unwritable(error) from None
    with folder as name:
        try:
            (Path(name) / OWNER_FILE).write_text(json.dumps(Owner.here().record()), encoding="utf-8")
        except OSError as error:
            raise _unwritable(error) from None
        yield Path(name)


def _unwritable(error: OSError) -> EngineError:
    return EngineError(
        f"temporary folder {error.filename or 'of the system'}: the files of a call cannot be written "
        f"({error.strerror or error}); make room, or name another folder with the variable TMPDIR"
    )


@cache
def _sweep(parent: Path) -> None:
    """Remove, once a process, the folders of calls that were left by processes that were killed with their guards."""
    for folder in parent.glob(f"{PREFIX}*"):
        try:
            mark = folder / OWNER_FILE
            if mark.is_symlink() or folder.is_symlink() or folder.stat().st_uid != os.geteuid():
                continue
            owner = Owner.from_record(json.loads(mark.read_text(encoding="utf-8")))
        except (OSError, ValueError, RecursionError):
            continue
        if owner is not None and owner.gone:
            shutil.rmtree(folder, ignore_errors=True)
