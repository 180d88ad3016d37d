"""An external program: it reads a request file for every candidate and writes a response file.

`ExternalProgram` runs it for one candidate, with its files, time limit and attempts; `Command` is the engine.
"""

from __future__ import annotations

import json
import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import Event
from typing import Final, final

import numpy as np
import psutil
from numpy.typing import NDArray

from calibray.engines.external.exchange import Request, Unusable, read_answer, read_rays
from calibray.engines.process_owner import ProcessOwner
from calibray.engines.protocol import Answer, check_candidates, gather
from calibray.engines.section import OpenedStudy
from calibray.errors import EngineError, InputError
from calibray.support.messages import printable
from calibray.support.progress import Progress

PLACEHOLDERS: Final = ("{request}", "{response}")
POLL: Final = 0.5  # interval at which a waiting thread checks whether to stop [s]
GUARD_WAIT: Final = 10.0  # longest wait for a guard that kills its program [s]; twice its own limit
PREFIX: Final = "calibray-call-"  # of the temporary folders of calls
OWNER_FILE: Final = "owner.json"

# `python -I -S guard.py LIBRARIES`: see `guard`.
GUARD: Final = (
    "-I",
    "-S",
    str(Path(__file__).resolve().with_name("guard.py")),
    str(Path(psutil.__file__).parents[1]),
)


class Unstartable(Unusable):
    """A program that does not exist or cannot be executed: another attempt would fail too."""


class Stopped(Exception):
    """A call that was ended from outside before it answered."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """How the attempts at one candidate ended.

    Attributes:
        path_loss_db: Path loss [L], [dB]; +inf without a path, and for all links if the attempts failed.
        seconds: Time of all attempts together [s].
        failure: Error of the last attempt; empty if it succeeded.
        rays: The response of a program that answers with rays, from which path loss follows; else empty.
    """

    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""
    rays: bytes = b""


@dataclass(frozen=True)
class ExternalProgram:
    """How an external program is called; it can be sent to other processes and machines.

    Attributes:
        words: The program and its arguments. `{request}` and `{response}` are replaced by the files' paths, and
            appended if absent.
        folder: Folder to run it in.
        timeout: Time limit of one attempt [s].
        retries: How often to try again after a failure.
        file_format: "json" or "hdf5".
        rays: Whether it answers with a ray table in place of path loss.

    Raises:
        InputError: A word contains a NUL character, which the system does not pass to programs.
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
        """Call the program for one candidate, and again after a failure until no attempts are left.

        A failure is returned, not raised, so that it costs one candidate and not the batch. `stop` is set from outside
        to kill the program.

        Raises:
            Stopped: `stop` was set before there was an answer.
            EngineError: The files cannot be written, which is not the program's fault.
        """
        num_links = len(request.tx)
        started, failure, attempt = time.perf_counter(), "", 0
        no_path = np.full(num_links, np.inf)
        while attempt <= self.retries:
            if stop is not None and stop.is_set():
                raise Stopped
            attempt += 1
            try:
                response = self._attempt(request, num_links, stop)
            except Unstartable as error:
                failure = str(error)
                break
            except Unusable as error:
                failure = str(error)
            else:
                seconds = time.perf_counter() - started
                if isinstance(response, bytes):
                    return Outcome(no_path, seconds, rays=response)
                return Outcome(response, seconds)
        attempts = "" if attempt < 2 else f" (attempt {attempt} of {self.retries + 1})"
        return Outcome(no_path, time.perf_counter() - started, failure + attempts)

    def _attempt(self, request: Request, num_links: int, stop: Event | None) -> NDArray[np.float64] | bytes:
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
            try:
                if report["ended"] == "stopped":
                    raise Unusable("was stopped from outside")
                if report["ended"] == "timeout":
                    raise Unusable(f"gave no answer within timeout = {self.timeout:g} s and was killed")
                if report["status"]:
                    raise Unusable(f"ended with {_describe_status(report['status'])}")
                if self.rays:
                    return read_rays(response_file, num_links)
                return read_answer(response_file, self.file_format, num_links)
            except Unusable as error:
                output = report["output"]
                raise Unusable(
                    f"{error}; its output:\n{output}" if output else f"{error}; it gave no output"
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
        # The guard kills the program once the other end of its standard input is closed.
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
            raise Unusable(
                f"was lost with its guard, which ended with {_describe_status(process.returncode)}"
            ) from None


def _last_report(guard: subprocess.Popen) -> bytes:
    """The report of a guard that was asked to end; it kills its program first."""
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
    """A temporary folder for one call, with a file that names its owner; folders of ended processes are removed."""
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
        f"({error.strerror or error}); make room, or name another folder with the variable TMPDIR"
    )


@cache
def _remove_abandoned(parent: Path) -> None:
    """Remove, once per process, folders of calls whose process was killed together with its guard."""
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


_LOG: Final = logging.getLogger(__name__)


@final
class Command:
    """An external program, called once for every candidate.

    If all attempts of a call fail, only that candidate is lost: its links count as links without a path. If every
    candidate of the first batch fails, or many successive calls fail, the run ends, because the program must be at
    fault.

    Args:
        program: How the program is called.
        study: The opened study.
        give_up_after: Number of successive failed calls that ends the run.
        executor: Runs the calls of a batch; one call after the other if None.
        progress: Called with "running" after every candidate of a batch.
    """

    def __init__(
        self,
        program: ExternalProgram,
        study: OpenedStudy,
        give_up_after: int,
        executor: Executor | None = None,
        progress: Progress | None = None,
    ) -> None:
        links = study.links
        self.parameters, self.materials, self.calls = study.parameters, dict(study.scene.materials), 0
        self.num_links = len(links)
        self._program, self._carriers, self._source = program, study.carriers, study.source
        self._study = study
        self._blank_request = Request(study.radio, links.tx, links.rx, link_frequency=links.frequency)
        self._executor, self._progress = executor, progress
        self._successive_failures, self._give_up_after = 0, give_up_after

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates, as the program answers; see `Answering`."""
        first = not self.calls
        values = check_candidates(candidates, len(self.parameters))
        return gather(self.answers(values), (len(values), self.num_links), first)

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """Answer candidates, each as soon as its call ends; see `Answering.answers`."""
        if not self.calls:
            # A study comes from somebody: whoever starts it sees what runs on this machine.
            _LOG.warning(
                "%s runs a program in %s: %s", printable(str(self._source)), printable(str(self._program.folder)),
                printable(shlex.join(self._program.words)),
            )  # fmt: skip
        stop = stop or Event()
        requests = [self._request(candidate) for candidate in candidates]
        executor = self._executor
        outcomes = (
            self._sequential(requests, stop) if executor is None else self._parallel(requests, stop, executor)
        )
        for done, (index, raw) in enumerate(outcomes, start=1):
            outcome = self._with_path_loss(raw) if raw.rays else raw
            self.calls += 1
            if self._progress is not None:
                self._progress("running", done, len(requests))
            failure = self._describe(requests[index], outcome.failure) if outcome.failure else ""
            yield Answer(index, outcome.path_loss_db, outcome.seconds, failure, outcome.rays)
            self._successive_failures = self._successive_failures + 1 if failure else 0
            if self._successive_failures >= self._give_up_after:
                raise EngineError(
                    f"{failure}; so did the {self._successive_failures - 1} calls before it. All answers are in the "
                    "ledger: correct the program, remove the failures with `calibray ledger DIR --forget-failed`, and "
                    "start again"
                )

    def _with_path_loss(self, outcome: Outcome) -> Outcome:
        """The outcome with the path loss of its rays, or with what is wrong with them."""
        from calibray.engines.rays.export import Export

        try:
            return replace(outcome, path_loss_db=Export.of(self._study, outcome.rays).path_loss_db)
        except InputError as error:
            return replace(outcome, failure=str(error), rays=b"")

    def _sequential(self, requests: list[Request], stop: Event) -> Iterator[tuple[int, Outcome]]:
        for index, request in enumerate(requests):
            if stop.is_set():
                return
            yield index, self._program.run(request)

    def _parallel(
        self, requests: list[Request], stop: Event, executor: Executor
    ) -> Iterator[tuple[int, Outcome]]:
        # An event reaches threads only; programs on other machines run until they end or exceed their time limit.
        local_stop = stop if isinstance(executor, ThreadPoolExecutor) else None
        futures = {
            executor.submit(self._program.run, request, local_stop): index
            for index, request in enumerate(requests)
        }
        pending, interruption = set(futures), None
        try:
            while pending and not stop.is_set():
                for future in wait(pending, POLL, FIRST_COMPLETED).done:
                    outcome = self._outcome(future)
                    pending.remove(future)
                    yield futures[future], outcome
        except (Exception, KeyboardInterrupt) as error:
            interruption = error
        finally:
            stop.set()
            for future in pending:
                future.cancel()
        # Calls that have ended by now were paid for: their answers are given before the run ends.
        for future in wait(pending, None if local_stop else 0).done:
            if not future.cancelled() and not future.exception():
                yield futures[future], future.result()
        if interruption is not None:
            raise interruption

    def _outcome(self, future: Future[Outcome]) -> Outcome:
        try:
            return future.result()
        except EngineError:
            raise
        except Exception as error:  # a worker that dies loses its candidates, not the whole batch
            no_path = np.full(self.num_links, np.inf)
            return Outcome(no_path, 0.0, f"was lost with its worker ({type(error).__name__}: {error})")

    def _request(self, candidate: NDArray[np.float64]) -> Request:
        return replace(
            self._blank_request,
            materials=self.parameters.materials(candidate, self.materials),
            parameters=dict(zip(self.parameters.names, candidate.tolist(), strict=True)),
            carriers={
                frequency: self.parameters.materials(candidate, base, frequency)
                for frequency, base in self._carriers.items()
            },
        )

    def _describe(self, request: Request, failure: str) -> str:
        values = ", ".join(f"{name} = {value:.6g}" for name, value in request.parameters.items())
        return f"{self._source}: engine.command `{shlex.join(self._program.words)}` at {values}: {failure}"
