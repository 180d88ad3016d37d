"""Recorded: an engine whose answers go through a ledger."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from calibray.engines.ledger import Entry, Ledger, key
from calibray.engines.protocol import Answer, Answering, check_candidates, gather
from calibray.materials import Material
from calibray.parameters import Parameters


class Recorded:
    """An engine behind a ledger: what was run once, by any run, is not run again.

    Args:
        engine: The engine.
        ledger: The ledger.
        problem: Fingerprint of all that the engine's answers depend on besides the candidate.
        name: Name of the engine.

    Attributes:
        hits: Candidates that the ledger answered so far; they are no RT calls.
    """

    def __init__(self, engine: Answering, ledger: Ledger, problem: str, name: str) -> None:
        self.hits = 0
        self._engine, self._ledger, self._problem = engine, ledger, problem
        ledger.describe(problem, name, engine.parameters.names)

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
            InputError: The candidates have another width, or a value is outside physics.
            EngineError: Every candidate of the first batch failed; these failures are taken out of the ledger.
        """
        values = check_candidates(candidates, len(self.parameters))
        first = self.calls + self.hits == 0
        answers = list(self._answers(values))
        if first and all(answer.failure for answer in answers):
            self._ledger.forget_failures(self._problem)
        return gather(answers, (len(values), self._engine.num_links), first)

    def _answers(self, values: NDArray[np.float64]) -> Iterator[Answer]:
        missing: dict[bytes, list[int]] = {}
        for index, value in enumerate(values):
            entry = self._ledger.find(self._problem, key(value))
            if entry is None:
                missing.setdefault(key(value), []).append(index)
            else:
                self.hits += 1
                yield _answer(index, entry)
        places = list(missing.values())
        if not places:
            return
        for answer in self._engine.answers(values[[indices[0] for indices in places]]):
            indices = places[answer.index]
            entry = Entry(answer.path_loss_db, answer.seconds, answer.failure)
            entry = self._ledger.commit(self._problem, key(values[indices[0]]), entry)
            self.hits += len(indices) - 1  # asked for twice in one batch
            for index in indices:
                yield _answer(index, entry)


def _answer(index: int, entry: Entry) -> Answer:
    return Answer(index, entry.path_loss_db, entry.seconds, entry.failure)
