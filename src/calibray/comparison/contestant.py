"""Methods as they contend: each with its budget of RT calls, one run of it, and which code it was."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from calibray import optimizers
from calibray.comparison.problems import Arena
from calibray.comparison.run_log import MethodRun
from calibray.errors import InputError
from calibray.fitting.search import rounds
from calibray.optimizers import METHODS, Optimizer

MOST: Final = {"seeds": 10_000, "workers": 1_000, "budget": 1_000_000}  # beyond which no comparison ends


@dataclass(frozen=True)
class Contender:
    """A method in a comparison.

    Attributes:
        name: Its name in tables, as it was asked for.
        method: Its name in `METHODS`.
        budget: RT calls that it may use.
    """

    name: str
    method: str
    budget: int

    @property
    def endless(self) -> bool:
        """Whether the method has no budget to keep to, but stops by itself."""
        return METHODS[self.method].schedule is None

    @staticmethod
    def parse(name: str, budget: int) -> Contender:
        """Read a method as it is asked for.

        Args:
            name: A method, or `METHOD@CALLS` for a budget of its own.
            budget: RT calls of those without one.

        Returns:
            The contender.

        Raises:
            InputError: There is no such method, or the budget is no whole number, or too small.

        Example:
            >>> Contender.parse("gwo@600", 225)
            Contender(name='gwo@600', method='gwo', budget=600)
        """
        method, _, own = name.partition("@")
        schedule = optimizers.method(method).schedule
        if own:
            with suppress(ValueError):
                budget = int(own)
        least = 1 if schedule is None else schedule.least
        if (own and own != str(budget)) or not least <= budget <= MOST["budget"]:
            raise InputError(
                f"method {name!r}: a budget of {own or budget} RT calls; it must be a whole number of {least} to "
                f"{MOST['budget']:,}"
            )
        return Contender(name, method, budget)

    def key(self, seed: int) -> tuple[str, int, int]:
        """What a run of it is known by: method, budget and seed.

        Args:
            seed: The run's seed.
        """
        return self.method, self.budget, seed

    def optimizer(self, arena: Arena, seed: int) -> Optimizer:
        """The optimizer of a run.

        Args:
            arena: The problem.
            seed: The run's seed.

        Returns:
            An optimizer that asks for no more than the budget; least squares stops by itself.

        Raises:
            InputError: The method does not fit the problem, or its library is not installed.
        """
        return optimizers.make(
            self.method,
            arena.lower,
            arena.upper,
            seed,
            budget=self.budget,
            start=arena.start,
            starts=arena.starts,
            screen=arena.screen,
            model=None if arena.model is None else arena.model(),
        )


def run_contender(arena: Arena, contender: Contender, seed: int) -> MethodRun:
    """One run of a method.

    Args:
        arena: The problem.
        contender: The method.
        seed: Its seed.

    Returns:
        The run; a method or an engine that raised ends it there, with the message kept.
    """
    return recorded(arena, contender.key(seed), lambda: contender.optimizer(arena, seed))


def recorded(arena: Arena, key: tuple[str, int, int], make: Callable[[], Optimizer]) -> MethodRun:
    """Run an optimizer to its end.

    Args:
        arena: The problem.
        key: Method, budget and seed that the run is known by.
        make: Makes the optimizer.

    Returns:
        The run; whatever raised ends it there, with the message kept.
    """
    calls: list[int] = []
    best: list[float] = []
    evaluations, failure, started = 0, "", time.perf_counter()
    try:
        optimizer = make()
        for _, told in rounds(optimizer, arena.evaluate):
            for value in told.value.tolist():
                evaluations += 1
                if value < (best[-1] if best else np.inf):
                    calls.append(evaluations)
                    best.append(value)
    except Exception as error:  # a run that fails is a finding about its method
        failure = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - started
    return MethodRun(*key, evaluations, tuple(calls), tuple(best), seconds, failure)


@cache
def code(method: str | None = None) -> str:
    """Fingerprint of the optimizers' code: a run of other code says nothing about this one.

    Args:
        method: The method whose code alone matters, with all that it imports; None for all methods.

    Returns:
        The first digits of a SHA-256 in hexadecimal.
    """
    folder = Path(optimizers.__file__).parent
    found = set(folder.glob("*.py")) if method is None else set()
    waiting = [] if method is None else [METHODS[method].__module__.rpartition(".")[2]]
    while waiting:
        file = folder / f"{waiting.pop()}.py"
        if file.is_file() and file not in found:
            found.add(file)
            waiting += re.findall(
                r"^from calibray\.optimizers\.(\w+) import", file.read_text("utf-8"), re.MULTILINE
            )
            waiting += re.findall(
                r"^from calibray\.optimizers import (\w+)$", file.read_text("utf-8"), re.MULTILINE
            )
    digest = hashlib.sha256()
    for path in sorted(found):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
