"""An external program, run for one candidate: its files, its time limit, its attempts."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.exchange import Request, Unusable, read_answer

PLACEHOLDERS: Final = ("{request}", "{response}")
TAIL: Final = 2000  # characters of the program's messages that are shown
GLANCE: Final = 0.5  # how often a waiting thread looks whether it shall stop [s]


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
class Program:
    """How an external program is called. It can be sent to other processes and machines.

    Attributes:
        words: The program and its arguments; `{request}` and `{response}` stand for the files' paths, and are
            appended where absent.
        folder: Folder to run it in.
        timeout: Time that one attempt may take [s].
        retries: How often to try again after a failure.
        file_format: "json" or "hdf5".
    """

    words: tuple[str, ...]
    folder: Path
    timeout: float
    retries: int
    file_format: str

    def run(self, request: Request, stop: Event | None = None) -> Outcome:
        """Ask the program for one candidate, again after every failure while attempts are left.

        Args:
            request: What is asked.
            stop: Set from outside to kill the program.

        Returns:
            How it ended; a failure is told, not raised, so that it costs one candidate and not the batch.
        """
        num_links = len(request.surroundings.tx)
        started, failure, attempt = time.perf_counter(), "", 0
        while attempt <= self.retries and not (stop is not None and stop.is_set()):
            attempt += 1
            try:
                loss = self._attempt(request, num_links, stop)
            except OSError as error:  # it is not there, or cannot be executed: no attempt will differ
                failure = f"cannot be started ({error.strerror or error})"
                break
            except Unusable as error:
                failure = str(error)
            else:
                return Outcome(loss, time.perf_counter() - started)
        tries = "" if attempt < 2 else f" (attempt {attempt} of {self.retries + 1})"
        lost = np.full(num_links, np.inf)
        return Outcome(lost, time.perf_counter() - started, (failure or "was stopped") + tries)

    def _attempt(self, request: Request, num_links: int, stop: Event | None) -> NDArray[np.float64]:
        with tempfile.TemporaryDirectory(prefix="calibray-", ignore_cleanup_errors=True) as folder:
            place, ending = Path(folder), "json" if self.file_format == "json" else "h5"
            files = place / f"request.{ending}", place / f"response.{ending}"
            request.write(files[0], self.file_format)
            # Messages go to files and not through pipes, which a grandchild that lives on would keep open.
            with (place / "stdout").open("wb") as output, (place / "stderr").open("wb") as errors:
                status = self._wait(self._arguments(files), output, errors, stop)
            said = _tail(place / "stderr") or _tail(place / "stdout")
            try:
                if status is None:
                    raise Unusable(f"gave no answer within timeout = {self.timeout:g} s and was killed")
                if status:
                    raise Unusable(f"ended with {_status(status)}")
                return read_answer(files[1], self.file_format, num_links)
            except Unusable as error:
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

    def _wait(self, arguments: list[str], output: object, errors: object, stop: Event | None) -> int | None:
        """The exit status, or None if time ran out."""
        process = subprocess.Popen(
            arguments,
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=errors,
            start_new_session=True,  # its children are killed with it
        )
        deadline = time.monotonic() + self.timeout
        try:
            while (left := deadline - time.monotonic()) > 0:
                try:
                    return process.wait(min(left, GLANCE))
                except subprocess.TimeoutExpired:
                    if stop is not None and stop.is_set():
                        raise Unusable("was stopped") from None
            return None
        finally:
            if process.returncode is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def _status(status: int) -> str:
    return f"exit status {status}" if status > 0 else f"signal {signal.Signals(-status).name}"


def _tail(path: Path) -> str:
    text = path.read_text(encoding="utf-8", errors="replace").strip()
    return text if len(text) <= TAIL else f"... {text[-TAIL:]}"
