"""Recorded: an engine whose answers go through a ledger."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from threading import Event
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.ledger.entry import LedgerEntry, key
from calibray.engines.ledger.ledger import Ledger
from calibray.engines.ledger.rescue import Rescued
from calibray.engines.protocol import Answer, Answering, check_candidates, gather
from calibray.errors import EngineError
from calibray.materials import Material
from calibray.parameters import Parameters
from calibray.support.progress import Progress

GLANCES: Final = (0.02, 1.0)  # shortest and longest wait between two looks for another run's answers [s]


class Recorded:
    """An engine behind a ledger: what was run once, by any run, is not run again.

    Args:
        engine: The engine.
        ledger: The ledger.
        problem: Fingerprint of all that the engine's answers depend on besides the candidate.
        name: Name of the engine.
        progress: Called with "waiting", answers that another run gave and answers waited for.

    Attributes:
        hits: Candidates that the ledger answered so far; they are no RT calls.
    """

    def __init__(
        self, engine: Answering, ledger: Ledger, problem: str, name: str, progress: Progress | None = None
    ) -> None:
        self.hits = 0
        self._engine, self._ledger, self._problem, self._name = engine, ledger, problem, name
        self._progress, self._described = progress, False

    @property
    def calls(self) -> int:
        """RT calls so far: candidates that the engine itself has run."""
        return self._engine.calls

    @property
    def parameters(self) -> Parameters:
        """The parameters that a candidate's components stand for."""
        return self._engine.parameters

    @property
    def materials(self) -> dict[str, Material]:
        """The scene's materials before calibration."""
        return self._engine.materials

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates, from the ledger or else from the engine.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path, and for all links of a candidate that failed.

        Raises:
            InputError: The candidates have another width, a value is outside physics, or the ledger holds no answer
                and cannot be written.
            EngineError: Every candidate of the first batch failed; these failures are taken out of the ledger. Or the
                ledger could not be used; what was answered is kept elsewhere.
        """
        values = check_candidates(candidates, len(self.parameters))
        first = self.calls + self.hits == 0
        answers = list(self._answers(values))
        if first and all(answer.failure for answer in answers) and not self._ledger.read_only:
            self._ledger.forget_failures(self._problem)
        return gather(answers, (len(values), self._engine.num_links), first)

    def _answers(self, values: NDArray[np.float64]) -> Iterator[Answer]:
        places: dict[bytes, list[int]] = {}
        for index, value in enumerate(values):
            places.setdefault(key(value), []).append(index)
        yield from self._known(places)
        wait, awaited = GLANCES[0], 0
        while places:
            self._describe()
            if claimed := self._ledger.claim(self._problem, list(places), self._engine.num_links):
                yield from self._paid(values, {each: places.pop(each) for each in claimed})
                wait, awaited = GLANCES[0], len(places)
            before = len(places)
            yield from self._known(places)
            if len(places) == before and places:
                if self._progress is not None:
                    self._progress("waiting", max(0, awaited - len(places)), max(awaited, len(places)))
                time.sleep(wait)  # for another run that pays for them
                wait = min(2 * wait, GLANCES[1])

    def _describe(self) -> None:
        if not self._described and not self._ledger.read_only:
            self._ledger.describe(self._problem, self._name, self.parameters.names)
            self._described = True

    def _known(self, places: dict[bytes, list[int]]) -> Iterator[Answer]:
        """The answers that the ledger holds, which are taken out of `places`."""
        for candidate in list(places):
            entry = self._ledger.find(self._problem, candidate, self._engine.num_links)
            if entry is not None:
                indices = places.pop(candidate)
                self.hits += len(indices)
                yield from (_answer(index, entry) for index in indices)

    def _paid(self, values: NDArray[np.float64], places: dict[bytes, list[int]]) -> Iterator[Answer]:
        """The engine's answers to candidates that this run has claimed."""
        keys, stop = list(places), Event()
        with self._ledger.working():
            answers = self._engine.answers(values[[places[each][0] for each in keys]], stop)
            for answer in answers:
                candidate, entry = keys[answer.index], _entry(answer)
                try:
                    entry = self._ledger.commit(self._problem, candidate, entry)
                except (EngineError, KeyboardInterrupt) as error:
                    stop.set()
                    kept = [(candidate, entry)]
                    with suppress(EngineError):
                        kept += [(keys[other.index], _entry(other)) for other in answers]
                    if isinstance(error, KeyboardInterrupt):
                        for each in kept:
                            self._ledger.commit(self._problem, *each)
                        raise
                    raise EngineError(f"{error}. {self._rescue(kept)}") from None
                indices = places[candidate]
                self.hits += len(indices) - 1  # asked for twice in one batch
                yield from (_answer(index, entry) for index in indices)

    def _rescue(self, kept: list[tuple[bytes, LedgerEntry]]) -> str:
        names = self.parameters.names
        return self._ledger.rescue(
            [Rescued.of(self._problem, self._name, names, candidate, entry) for candidate, entry in kept]
        )


def _entry(answer: Answer) -> LedgerEntry:
    return LedgerEntry(answer.path_loss_db, float(answer.seconds), answer.failure)


def _answer(index: int, entry: LedgerEntry) -> Answer:
    return Answer(index, entry.path_loss_db, entry.seconds, entry.failure)
