"""Recorded: an engine whose answers are stored in a ledger."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from threading import Event
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.ledger.database import LedgerEntry, key
from calibray.engines.ledger.ledger import Ledger
from calibray.engines.protocol import Answer, Answering, Responses, check_candidates, gather, gather_responses
from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.measurements.observables import Statistic
from calibray.parameters import Parameters
from calibray.support.messages import command, printable
from calibray.support.progress import Progress

_LOG: Final = logging.getLogger(__name__)
SHORTEST_WAIT: Final = 0.02
LONGEST_WAIT: Final = 1.0
"""Minimum and maximum interval [s] between checks for answers from another run."""


@final
class Recorded:
    """An engine with a ledger, so that a candidate completed by any run is not run again.

    Args:
        engine: The engine.
        ledger: The ledger.
        problem: Fingerprint of everything that determines the engine's answers, except the candidate.
        name: Name of the engine.
        progress: Called with "waiting", the number of answers received from other runs, and the total number of answers
            expected from them.
        program_files: SHA-256 of the files of the engine's program, by file name, if the program has files.

    Attributes:
        hits: Number of candidates so far that required no RT call, because the candidate was in the ledger or occurred
            earlier in the same batch.
    """

    def __init__(
        self,
        engine: Answering,
        ledger: Ledger,
        problem: str,
        name: str,
        progress: Progress | None = None,
        program_files: Mapping[str, str] | None = None,
    ) -> None:
        self.hits = 0
        self._engine, self._ledger, self._problem, self._name = engine, ledger, problem, name
        self._progress, self._described, self._warned = progress, False, False
        self._unchecked_files = dict(program_files or {})

    @property
    def calls(self) -> int:
        """Number of RT calls so far: one for each candidate that the engine itself has run."""
        return self._engine.calls

    @property
    def num_links(self) -> int:
        """Number of links L."""
        return self._engine.num_links

    @property
    def parameters(self) -> Parameters:
        """The parameters whose values a candidate contains."""
        return self._engine.parameters

    @property
    def materials(self) -> dict[str, Material]:
        """The scene's materials before calibration."""
        return self._engine.materials

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates, from the ledger or otherwise from the engine; see `Answering`."""
        answers, first = self._all_answers(candidates)
        return gather(answers, (len(candidates), self._engine.num_links), first)

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """Path loss and the requested further observables; see `Observing.respond`.

        Raises:
            InputError: Derivatives are requested.
        """
        if derivatives:
            raise InputError(
                f"engine {self._name!r}: provides no derivatives; use a method without derivatives, such as 'auto'"
            )
        answers, first = self._all_answers(candidates)
        return gather_responses(answers, (len(candidates), self._engine.num_links), len(wanted), first)

    def _all_answers(self, candidates: NDArray[np.float64]) -> tuple[list[Answer], bool]:
        """The answers to candidates, and whether these candidates are the first batch."""
        first = self.calls + self.hits == 0
        answers = list(self.answers(check_candidates(candidates, len(self.parameters))))
        failures = [answer.failure for answer in answers if answer.failure]
        if first and len(failures) == len(answers):  # the caller ends the run with the reason
            self.forget_failures()
        elif failures and not self._warned:
            self._warned = True
            _LOG.warning(
                "an RT call failed, so all links count as links without a path for its candidate; list failed calls "
                "with %s, or add --forget-failed to delete them and run them again. The failed call: %s",
                command("ledger", self._ledger.path.parent), printable(failures[0], keep="\n\t"),
            )  # fmt: skip
        return answers, first

    def forget_failures(self) -> None:
        """If the ledger can be written, delete the failed calls of the problem, so that the next run repeats them."""
        if not self._ledger.read_only:
            self._ledger.forget_failures(self._problem)

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """Yield answers from the ledger, or otherwise from the engine, until `stop` is set; see `Answering.answers`."""
        values, stop = candidates, stop or Event()
        self._warn_of_changed_files()
        # A candidate that occurs several times in one batch is run only once.
        missing: dict[bytes, list[int]] = {}
        for index, value in enumerate(values):
            missing.setdefault(key(value), []).append(index)
        yield from self._from_ledger(missing)
        pause, awaited = SHORTEST_WAIT, 0
        while missing and not stop.is_set():
            if not self._described and not self._ledger.read_only:
                self._ledger.describe(self._problem, self._name, self.parameters.names)
                self._described = True
            if claimed := self._ledger.claim(self._problem, list(missing), self._engine.num_links):
                yield from self._from_engine(
                    values, {candidate: missing.pop(candidate) for candidate in claimed}, stop
                )
                pause, awaited = SHORTEST_WAIT, len(missing)
            before = len(missing)
            yield from self._from_ledger(missing)
            if len(missing) == before and missing:
                # Another run has claimed the missing candidates and is computing them.
                if self._progress is not None:
                    self._progress("waiting", max(0, awaited - len(missing)), max(awaited, len(missing)))
                time.sleep(pause)
                pause = min(2 * pause, LONGEST_WAIT)

    def _warn_of_changed_files(self) -> None:
        """Before the first answer, warn if the program's files have changed since the stored calls."""
        files, self._unchecked_files = self._unchecked_files, {}
        if files and (changed := self._ledger.changed_program_files(self._problem, files)):
            _LOG.warning(
                "%s: %s changed after the RT calls of this study were stored; the stored calls are used again. If the "
                "change affects their answers, use another folder, or delete the ledger",
                self._ledger.path, ", ".join(changed),
            )  # fmt: skip

    def _from_ledger(self, missing: dict[bytes, list[int]]) -> Iterator[Answer]:
        """Yield the answers that are in the ledger, and remove their candidates from `missing`."""
        for candidate in list(missing):
            entry = self._ledger.find(self._problem, candidate, self._engine.num_links)
            if entry is not None:
                indices = missing.pop(candidate)
                self.hits += len(indices)
                yield from (_answer(index, entry) for index in indices)

    def _from_engine(
        self, values: NDArray[np.float64], indices: dict[bytes, list[int]], stop: Event
    ) -> Iterator[Answer]:
        """Yield the engine's answers to claimed candidates; `indices` contains their positions in the batch."""
        keys = list(indices)
        with self._ledger.working():
            answers = self._engine.answers(values[[indices[candidate][0] for candidate in keys]], stop)
            for answer in answers:
                candidate, entry = keys[answer.index], _entry(answer)
                if answer.lost:  # not stored, so that the next run repeats the call
                    self.hits += len(indices[candidate]) - 1
                    yield from (replace(answer, index=index) for index in indices[candidate])
                    continue
                try:
                    entry = self._ledger.commit(self._problem, candidate, entry)
                except (EngineError, KeyboardInterrupt) as error:
                    # Before the run ends, collect the answers of the calls in progress, so that they are not lost.
                    stop.set()
                    unsaved = [(candidate, entry)]
                    with suppress(EngineError):
                        for other in answers:  # one by one, because the engine may fail midway
                            if not other.lost:
                                unsaved.append((keys[other.index], _entry(other)))
                    if isinstance(error, KeyboardInterrupt):
                        for paid in unsaved:
                            self._ledger.commit(self._problem, *paid)
                        raise
                    rescued = self._ledger.rescue(self._problem, self._name, self.parameters.names, unsaved)
                    raise EngineError(f"{error}. {rescued}") from None
                # The first occurrence of the candidate required an RT call; its repetitions in the batch did not.
                self.hits += len(indices[candidate]) - 1
                yield from (_answer(index, entry) for index in indices[candidate])


def _entry(answer: Answer) -> LedgerEntry:
    return LedgerEntry(answer.path_loss_db, float(answer.seconds), answer.failure, answer.rays)


def _answer(index: int, entry: LedgerEntry) -> Answer:
    return Answer(index, entry.path_loss_db, entry.seconds, entry.failure, entry.rays)
