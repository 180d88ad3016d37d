"""Command: any external program, asked for every candidate with a file and answering with one."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from threading import Event

import numpy as np
from numpy.typing import NDArray

from calibray.engines.external.exchange import Request, Surroundings
from calibray.engines.external.program import GLANCE, ExternalProgram, Outcome
from calibray.engines.protocol import Answer, check_candidates, gather
from calibray.errors import EngineError
from calibray.materials import Material
from calibray.parameters import Parameters
from calibray.support.progress import Progress


class Command:
    """An external program, called once for every candidate.

    A call that fails in all its attempts costs that candidate alone: its links count as without a path. If every
    candidate of the first batch fails, or many fail one after the other, the program is taken to be at fault and the
    run ends.

    Args:
        program: How the program is called.
        surroundings: What is the same for all candidates.
        materials: The scene's materials before calibration.
        parameters: What the candidates' components stand for.
        executor: What runs the calls of a batch; one after the other if None.
        progress: Called with the stage "running" after every candidate of a batch.
        source: The study file, for messages.
        carriers: The scene's materials before calibration at each carrier of the links [Hz]; none where all links have
            the study's.
        give_up_after: Failures one after the other that end the run.
    """

    def __init__(
        self,
        program: ExternalProgram,
        surroundings: Surroundings,
        materials: dict[str, Material],
        parameters: Parameters,
        executor: Executor | None = None,
        progress: Progress | None = None,
        source: str = "study",
        carriers: Mapping[float, Mapping[str, Material]] | None = None,
        give_up_after: int = 10,
    ) -> None:
        self.parameters, self.materials, self.calls = parameters, dict(materials), 0
        self.num_links = len(surroundings.tx)
        self._program, self._surroundings = program, surroundings
        self._executor, self._progress, self._source = executor, progress, source
        self._carriers = carriers or {}
        self._failed, self._give_up_after = 0, give_up_after

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates, as the program answers.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path, and for all links of a candidate that failed.

        Raises:
            InputError: The candidates have another width, or a value is outside physics.
            EngineError: Every candidate of the first batch failed, or too many did one after the other.
        """
        first = not self.calls
        values = check_candidates(candidates, len(self.parameters))
        return gather(self.answers(values), (len(values), self.num_links), first)

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """The answers to candidates, each as soon as it is there.

        Args:
            candidates: Parameter values [n, d], in the fields' units.
            stop: Set from outside to begin no further call and to kill those under way; what was answered by then is
                still given.

        Yields:
            The answers, in the order in which they arrive.

        Raises:
            InputError: A value is outside physics.
            EngineError: Too many calls failed one after the other, or the files of a call could not be written; all
                answers were given before.
        """
        stop = stop or Event()
        requests = [self._request(candidate) for candidate in candidates]
        executor = self._executor
        outcomes = (
            self._in_turn(requests, stop) if executor is None else self._at_once(requests, stop, executor)
        )
        for done, (index, outcome) in enumerate(outcomes, start=1):
            self.calls += 1
            if self._progress is not None:
                self._progress("running", done, len(requests))
            failure = self._place(requests[index], outcome.failure) if outcome.failure else ""
            yield Answer(index, outcome.path_loss_db, outcome.seconds, failure)
            self._failed = self._failed + 1 if failure else 0
            if self._failed >= self._give_up_after:
                raise EngineError(
                    f"{failure}; so did the {self._failed - 1} calls before it. What was answered is in the ledger: "
                    "mend the program, take the failures out with `calibray ledger DIR --forget-failed`, and start "
                    "again"
                )

    def _in_turn(self, requests: list[Request], stop: Event) -> Iterator[tuple[int, Outcome]]:
        for index, request in enumerate(requests):
            if stop.is_set():
                return
            yield index, self._program.run(request)

    def _at_once(
        self, requests: list[Request], stop: Event, executor: Executor
    ) -> Iterator[tuple[int, Outcome]]:
        # An event reaches threads only; programs on other machines run on until their time is up.
        near = stop if isinstance(executor, ThreadPoolExecutor) else None
        futures = {executor.submit(self._program.run, request, near): k for k, request in enumerate(requests)}
        left, interruption = set(futures), None
        try:
            while left and not stop.is_set():
                for future in wait(left, GLANCE, FIRST_COMPLETED).done:
                    outcome = self._outcome(future)
                    left.remove(future)
                    yield futures[future], outcome
        except (Exception, KeyboardInterrupt) as error:
            interruption = error
        finally:
            stop.set()
            for future in left:
                future.cancel()
        # What others have answered by now is given before the run ends.
        for future in wait(left, None if near else 0).done:
            if not future.cancelled() and not future.exception():
                yield futures[future], future.result()
        if interruption is not None:
            raise interruption

    def _outcome(self, future: Future[Outcome]) -> Outcome:
        try:
            return future.result()
        except EngineError:
            raise
        except Exception as error:  # a worker that died costs the candidates it was on, not the batch
            lost = np.full(self.num_links, np.inf)
            return Outcome(lost, 0.0, f"was lost with its worker ({type(error).__name__}: {error})")

    def _request(self, candidate: NDArray[np.float64]) -> Request:
        return Request(
            self._surroundings,
            self.parameters.materials(candidate, self.materials),
            dict(zip(self.parameters.names, candidate.tolist(), strict=True)),
            {
                frequency: self.parameters.materials(candidate, base, frequency)
                for frequency, base in self._carriers.items()
            },
        )

    def _place(self, request: Request, failure: str) -> str:
        values = ", ".join(f"{name} = {value:.6g}" for name, value in request.parameters.items())
        return f"{self._source}: engine.command `{shlex.join(self._program.words)}` at {values}: {failure}"
