"""Converts minimisers of libraries, which call an objective, to ask-and-tell searches.

The minimiser runs in a separate thread and waits inside its objective for the evaluation. Only one side runs at a time,
so a run is as reproducible as the library. If a search is dropped before its end, the objective raises an exception
inside the library, which ends the thread.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from queue import SimpleQueue
from threading import Thread

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.evaluations import Evaluations
from calibray.optimizers.protocol import Search

Evaluate = Callable[[NDArray[np.float64]], Evaluations]
"""The function that a minimiser calls: it maps candidates [n, d] to their evaluations."""


class _AbandonedError(BaseException):
    """Ends a minimiser whose search was dropped; not an `Exception`, so that no library catches it."""


def inverted(minimise: Callable[[Evaluate], None]) -> Search:
    """Run a minimiser in a thread and yield the candidates [n, d] that it needs evaluated.

    Raises:
        Exception: Whatever `minimise` raises.
    """
    questions: SimpleQueue[NDArray[np.float64] | BaseException | None] = SimpleQueue()
    answers: SimpleQueue[Evaluations | None] = SimpleQueue()

    def evaluate(x: NDArray[np.float64]) -> Evaluations:
        questions.put(x)
        answer = answers.get()
        if answer is None:
            answers.put(None)  # for the next call, should the library have caught the exception
            raise _AbandonedError
        return answer

    def work() -> None:
        try:
            minimise(evaluate)
            questions.put(None)
        except _AbandonedError:
            pass
        except BaseException as error:
            questions.put(error)

    thread = Thread(target=work, name="minimiser", daemon=True)
    thread.start()
    try:
        while (question := questions.get()) is not None:
            if isinstance(question, BaseException):
                raise question
            answers.put((yield question))
    finally:
        answers.put(None)
        thread.join()


def limited(search: Search, budget: int) -> Search:
    """End a search when it has used its budget, and shorten the last batch; the search must not end earlier."""
    with closing(search):
        x = next(search)
        while True:
            answers = yield x[:budget]
            budget -= len(answers)
            if budget == 0:
                return
            x = search.send(answers)
