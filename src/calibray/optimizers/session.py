"""One run of an algorithm, turned from a loop into ask and tell.

An algorithm is written as it stands in its paper: a generator that yields the candidates [n, d] of each
iteration and receives their evaluations. The session holds it between `ask` and `tell`, checks what is
told, keeps the archive, and collects the answers of a batch in whatever order and portions they come.
"""

from __future__ import annotations

from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.box import Box
from calibray.optimizers.evaluations import (
    Archive,
    Best,
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
        uses: What the algorithm uses of an evaluation: "value", "residuals", "jacobian".
        search: Starts the algorithm on the archive; nothing of it runs before the first `ask`.
        objective: The value that belongs to residuals, where they are used.

    Attributes:
        minima: Distinct minima that the algorithm found beside the best [k, d]; none until it leaves some.
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
        """Whether the algorithm has ended; the next candidates are worked out for it."""
        # Nothing begins before the first ask, so that earlier evaluations can still be told.
        if self._asked is not None:
            self._advance()
        return self._finished

    @property
    def best(self) -> Best:
        """The best evaluation so far."""
        return self.archive.best

    def ask(self) -> NDArray[np.float64]:
        """The candidates that wait for their evaluation.

        Returns:
            Points [n, d]; the same again until they are told.

        Raises:
            InputError: The search has ended.
        """
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
        """Take evaluations; those of the candidates asked for answer them, others only join the archive.

        Args:
            x: Points [n, d].
            y: Value [n], +inf for a failed evaluation.
            residuals: Residuals [n, m].
            jacobian: Derivatives of the residuals [n, m, d].

        Raises:
            InputError: What is told is malformed; nothing of it is kept.
        """
        told = checked_evaluations(self.archive.box, x, y, residuals, jacobian, self._uses, self._objective)
        if told.residuals is not None:
            links = told.residuals.shape[1]
            if self._links not in (None, links):
                raise InputError(
                    f"residuals have {links} columns, earlier ones {self._links}; tell the same links"
                )
            if self._objective is not root_mean_square:
                check_order(told, self.archive)
            self._links = links
        self.archive.add(told)
        if self._asked is None:
            return
        for row in range(len(told)):
            waiting = self._open()
            same = waiting[(self._asked[waiting] == told.x[row]).all(axis=1)]
            if same.size:
                self._answers[same[0]] = told.rows(np.array([row]))

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
