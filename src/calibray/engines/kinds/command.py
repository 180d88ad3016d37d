"""Command: an external program computes the path loss of candidates, one after another or in parallel."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from itertools import islice
from threading import Event
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, Self, final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from calibray.engines.external.exchange import Request
from calibray.engines.external.program import POLL, ExternalProgram, Outcome
from calibray.engines.protocol import Answer, Responses, check_candidates, gather, gather_responses
from calibray.engines.section import EngineSection, OpenedStudy
from calibray.errors import EngineError, InputError
from calibray.measurements.observables import Statistic
from calibray.support.interruption import acknowledge_interruption
from calibray.support.messages import counted, printable
from calibray.support.output_files import exists, file_digest
from calibray.support.progress import Progress
from calibray.support.strict_models import Text

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Workers
    from calibray.paths import Paths


@final
class CommandSection(EngineSection):
    """``[engine]`` with ``name = "command"``.

    Attributes:
        name: "command".
        command: The program to call, and its arguments.
        timeout: Time limit for one attempt [s].
        retries: Number of further attempts after a failed attempt.
        format: Format of the files exchanged with the program: "json" or "hdf5".
        give_up_after: Number of successive failed calls after which the run ends.
        rays: Whether the program returns a ray table instead of path loss.
    """

    expensive: ClassVar[bool] = True
    external: ClassVar[bool] = True

    # Sections are immutable, so a narrower type is safe.
    name: Literal["command"] = "command"  # pyright: ignore[reportIncompatibleVariableOverride]
    command: Annotated[tuple[Text, ...], Field(min_length=1)] = ()
    timeout: Annotated[float, Field(gt=0)] = 3600.0
    retries: Annotated[int, Field(ge=0)] = 2
    format: Literal["json", "hdf5"] = "json"
    give_up_after: Annotated[int, Field(ge=1)] = 10
    rays: bool = False

    @model_validator(mode="after")
    def _has_command(self) -> Self:
        if not self.command:
            raise InputError(
                'name = \'command\' requires command, the program and its arguments, such as ["octave-cli", "model.m"]'
            )
        return self

    def answers_by(self, study: OpenedStudy) -> list[str]:
        """The command line, followed by "rays" if the program returns rays; the program's version is unknown."""
        return [*self.command, *(["rays"] if self.rays else [])]

    def program_files(self, study: OpenedStudy) -> dict[str, str]:
        """SHA-256, by name, of each file on the command line that lies in the study's folder."""
        folder = study.source.resolve().parent
        files = {word: folder / word for word in self.command if exists(folder / word)}
        return {word: file_digest(file) for word, file in files.items() if file.is_relative_to(folder)}

    def open(
        self, study: OpenedStudy, paths: Paths | None, progress: Progress | None, workers: Workers | None
    ) -> Command:
        """The program as the engine of a study's links; see `EngineSection.open`."""
        folder = study.source.resolve().parent
        program = ExternalProgram(self.command, folder, self.timeout, self.retries, self.format, self.rays)
        executor = None if workers is None else workers.executor()
        return Command(program, study, self.give_up_after, executor, progress)


_LOG: Final = logging.getLogger(__name__)


@final
class Command:
    """An external program, called once for every candidate.

    If all attempts of a call fail, only the candidate of this call is lost: all its links count as links without a
    path. The run ends if every candidate of the first batch fails or if `give_up_after` successive calls fail, because
    the program is then probably faulty.

    Args:
        program: The program, with the settings of its calls.
        study: The opened study.
        give_up_after: Number of successive failed calls after which the run ends.
        executor: Executor for the calls of a batch; if None, calls run sequentially.
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
        """Path loss of every link for candidates, as answered by the program; see `Answering`."""
        first = not self.calls
        values = check_candidates(candidates, len(self.parameters))
        return gather(self.answers(values), (len(values), self.num_links), first)

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """Path loss and further observables of every link, as answered by the program; see `Observing.respond`.

        Raises:
            InputError: The program does not compute these observables, or derivatives are requested.
        """
        first = not self.calls
        values = check_candidates(candidates, len(self.parameters))
        if derivatives or wanted != tuple(each.statistic for each in self._study.radio.observables):
            raise InputError(
                f"{self._source}: the program returns only the observables that the study lists, but no "
                "derivatives"
            )
        return gather_responses(self.answers(values), (len(values), self.num_links), len(wanted), first)

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """Yield the answer to each candidate as soon as its call ends; see `Answering.answers`."""
        if not self.calls:
            # The study may come from someone else, so the user must see which program it runs on this machine.
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
            outcome = self._with_path_loss(raw) if self._program.rays and not raw.failure else raw
            self.calls += 1
            if self._progress is not None:
                self._progress("running", done, len(requests))
            failure = self._describe(requests[index], outcome.failure) if outcome.failure else ""
            yield Answer(index, outcome.path_loss_db, outcome.seconds, failure, outcome.rays, outcome.lost)
            # The failure is counted after the answer was yielded, so that the caller can store the answer before the
            # run ends.
            self._successive_failures = self._successive_failures + 1 if failure else 0
            if self._successive_failures >= self._give_up_after:
                raise EngineError(
                    f"{failure}; the run ends after {counted(self._successive_failures, 'successive failed call')}. "
                    "All answers are in the ledger. Correct the program, remove the failures with `calibray ledger DIR "
                    "--forget-failed`, and start the run again"
                )

    def _with_path_loss(self, outcome: Outcome) -> Outcome:
        """The outcome, completed by the path loss computed from its rays, or by the error if the rays are unusable."""
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
        # An event reaches only the threads of this process; programs on other machines run until they end or exceed
        # their time limit.
        threads = executor if isinstance(executor, ThreadPoolExecutor) else None
        local_stop = None if threads is None else stop
        waiting, interruption = iter(enumerate(requests)), None
        pending: dict[Future[Outcome], int] = {}

        def start(count: int | None) -> None:
            for index, request in islice(waiting, count):
                pending[executor.submit(self._program.run, request, local_stop)] = index

        try:
            start(None if threads is None else threads._max_workers)
            while pending and not stop.is_set():
                for future in wait(pending, POLL, FIRST_COMPLETED).done:
                    outcome = self._outcome(future)
                    yield pending.pop(future), outcome
                    # A new call starts only after an answer is stored, so a killed run loses at most one call per
                    # thread.
                    if not stop.is_set():
                        start(1)
        except (Exception, KeyboardInterrupt) as error:
            interruption = error
            acknowledge_interruption()
        finally:
            # If all calls have ended, `stop` remains unset, so that the caller can still wait for the answers of
            # another run.
            if pending:
                stop.set()
            for future in pending:
                future.cancel()
        # Before the run ends, the answers of calls that have already ended are yielded, so that they are not lost.
        for future in wait(pending, None if local_stop else 0).done:
            if not future.cancelled() and not future.exception():
                yield pending[future], future.result()
        if interruption is not None:
            raise interruption

    def _outcome(self, future: Future[Outcome]) -> Outcome:
        try:
            return future.result()
        except EngineError:
            raise
        except Exception as error:  # if a worker dies, only its candidates are lost, not the whole batch
            no_path = np.full(self.num_links, np.inf)
            failure = f"was lost with its worker ({type(error).__name__}: {error})"
            return Outcome(no_path, 0.0, failure, lost=True)

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
