"""Library minimisers that call an objective, turned into searches that are asked and told.

The minimiser runs in a thread of its own and waits inside its objective for the evaluation; one side runs
at a time, so a run is as reproducible as the library. A search that is dropped before its end takes its
thread with it: the objective then raises inside the library, which ends the thread.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from importlib import import_module
from queue import SimpleQueue
from threading import Thread
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.optimizers.evaluations import Evaluations
from calibray.optimizers.session import Search

Evaluate = Callable[[NDArray[np.float64]], Evaluations]
"""What a minimiser calls: candidates [n, d] to their evaluations."""


class _AbandonedError(BaseException):
    """What ends a minimiser whose search was dropped; not an `Exception`, so that no library swallows it."""


def inverted(minimise: Callable[[Evaluate], None]) -> Search:
    """Run a minimiser in a thread and yield the candidates that it wants evaluated.

    Args:
        minimise: Calls its argument as often as it likes, then returns.

    Yields:
        Candidates [n, d].

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
    """End a search when it has used its budget, shortening the last batch.

    Args:
        search: The search; it must not end before.
        budget: Number of evaluations.

    Yields:
        The search's candidates.
    """
    with closing(search):
        x = next(search)
        while True:
            told = yield x[:budget]
            budget -= len(told)
            if budget == 0:
                return
            x = search.send(told)


def library(name: str, package: str, extra: str = "optimizers") -> ModuleType:
    """Import an optional library.

    Args:
        name: Name of its module.
        package: Its name where packages are installed from.
        extra: The extra of Calibray that brings it.

    Returns:
        The module.

    Raises:
        InputError: It is not installed; the message names the command.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(
            f"{package} is not installed ({error}); install it with: pip install 'calibray[{extra}]'"
        ) from None
