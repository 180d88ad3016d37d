"""One run of an algorithm, turned from a loop into ask and tell.

An algorithm is written as in its paper: a generator that yields the candidates [n, d] of each iteration and receives
their evaluations. The session holds it between `ask` and `tell`, checks the evaluations, keeps the archive, and
collects the answers of a batch in any order and in portions.
"""

from __future__ import annotations

from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.box import Box
from calibray.optimizers.evaluations import (
    Archive,
    Evaluations,
    Objective,
    check_order,
    checked_evaluations,
    root_mean_square,
)

Search = Generator[NDArray[np.float64], Evaluations, None]
"""An algorithm: yields candidates [n, d] inside the box, receives their evaluations in the same order."""


class Session:
    """A search in progress.

    Args:
        box: The box searched.
        uses: Parts of an evaluation that the algorithm uses: "value", "residuals", "jacobian".
        search: Starts the algorithm on the archive; nothing of it runs before the first `ask`.
        objective: Residuals to the value, if residuals are used.

    Attributes:
        minima: Distinct minima of the algorithm other than the best [k, d]; empty until it sets them.
    """

    def __init__(
        self,
        box: Box,
        uses: frozenset[str],
        search: Callable[[Archive], Search],
        objective: Objective | None = None,
    ) -> None:
        self.archive = Archive(box)
        self._uses, self._objective = uses, objective
        self._search = search(self.archive)
        self._asked: NDArray[np.float64] | None = None
        self._answers: list[Evaluations | None] = []
        self._links: int | None = None
        self._finished = False
        self.minima = np.empty((0, box.dimension))

    @property
    def done(self) -> bool:
        """Whether the algorithm has ended; to know that, it works out the next candidates."""
        # Nothing starts before the first ask, so that earlier evaluations can still be told.
        if self._asked is not None:
            self._advance()
        return self._finished

    def ask(self) -> NDArray[np.float64]:
        """See `Optimizer.ask`."""
        self._advance()
        if self._asked is None:
            raise InputError(f"done after {len(self.archive)} evaluations; start a new optimizer to go on")
        return self._asked[self._open()]

    def tell(
        self,
        x: ArrayLike,
        y: ArrayLike,
        residuals: ArrayLike | None = None,
        jacobian: ArrayLike | None = None,
    ) -> None:
        """See `Optimizer.tell`."""
        evaluations = checked_evaluations(
            self.archive.box, x, y, residuals, jacobian, self._uses, self._objective
        )
        if evaluations.residuals is not None:
            links = evaluations.residuals.shape[1]
            if self._links not in (None, links):
                raise InputError(
                    f"residuals have {links} columns, earlier ones {self._links}; tell the same links"
                )
            if self._objective is not root_mean_square:
                check_order(evaluations, self.archive)
            self._links = links
        self.archive.add(evaluations)
        if self._asked is None:
            return
        for row in range(len(evaluations)):
            waiting = self._open()
            same = waiting[(self._asked[waiting] == evaluations.x[row]).all(axis=1)]
            if same.size:
                self._answers[same[0]] = evaluations.rows(np.array([row]))

    def _open(self) -> NDArray[np.intp]:
        """Rows of the batch without an answer."""
        return np.array([row for row, answer in enumerate(self._answers) if answer is None], dtype=np.intp)

    def _advance(self) -> None:
        """Go on to the next batch once this one is complete."""
        answers = [answer for answer in self._answers if answer is not None]
        if self._finished or len(answers) < len(self._answers):
            return
        try:
            self._asked = self._search.send(Evaluations.joined(answers)) if answers else next(self._search)
            self._answers = [None] * len(self._asked)
        except StopIteration:
            self._asked, self._answers, self._finished = None, [], True
