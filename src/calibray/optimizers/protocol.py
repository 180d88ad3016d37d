"""The interface of every optimizer: ask for candidates, tell their evaluations, until it is done."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.evaluations import Best
from calibray.optimizers.session import Session


@dataclass(frozen=True)
class Schedule:
    """How a method keeps to a budget.

    Attributes:
        settings: From a number of evaluations to the constructor arguments that keep to it.
        least: Smallest budget that the method can run on.
    """

    settings: Callable[[int], dict[str, int]]
    least: int = 1


def _as_given(budget: int) -> dict[str, int]:
    return {"budget": budget}


AS_GIVEN: Final = Schedule(_as_given)
"""The schedule of a method that takes any budget as its setting `budget`."""


class Optimizer(ABC):
    """Minimises a value over a box; the caller owns the loop.

    `while not opt.done: x = opt.ask(); opt.tell(x, *evaluate(x))` is a complete run. A final class takes its settings
    in the constructor, hands its algorithm to a `Session`, sets the attributes below, and overrides nothing.

    The value may be any number, such as an error or a negative log likelihood. A method that uses residuals minimises
    their mean square, so the value must rise and fall with it. For a likelihood tell deviance residuals
    sign(r) sqrt(2 (l(r) - l(0))) of residuals r with negative log likelihood l; the constructor's `objective` computes
    the value from them.

    Attributes:
        uses: Parts of an evaluation that the method uses, of "value", "residuals" and "jacobian".
        schedule: How it keeps to a budget; None if it stops by itself.
        takes_starts: Whether its constructor takes `x0`, points to start from, and `starts`, the number of its own
            starting points. In every other method the best point told before the first `ask` leads the search.
    """

    uses: ClassVar[frozenset[str]]
    schedule: ClassVar[Schedule | None]
    takes_starts: ClassVar[bool]
    _session: Session
    _budget: Any  # int, or None if the method stops by itself

    @classmethod
    def needs_derivatives(cls) -> bool:
        """Whether every evaluation must come with derivatives."""
        return "jacobian" in cls.uses

    @classmethod
    def within(cls, budget: int) -> dict[str, int]:
        """The constructor arguments that keep to a budget; none if the method stops by itself.

        Raises:
            InputError: The budget is too small for the method.
        """
        if cls.schedule is None:
            return {}
        if budget < cls.schedule.least:
            raise InputError(
                f"budget = {budget}; {cls.__name__} needs at least {cls.schedule.least} evaluations: raise it"
            )
        return cls.schedule.settings(budget)

    @property
    def budget(self) -> int | None:
        """Largest number of evaluations it will ask for, or None if it stops by itself."""
        return self._budget

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._session.done

    @property
    def best(self) -> Best:
        """The best real evaluation so far, with `.x` [d] and `.y`.

        Raises:
            InputError: Nothing has been told yet.
        """
        return self._session.archive.best

    @property
    def minima(self) -> NDArray[np.float64]:
        """The best point, then every other minimum that the method keeps [k, d].

        Raises:
            InputError: Nothing has been told yet.
        """
        return np.concatenate([self.best.x[None], self._session.minima])

    @property
    def evaluations(self) -> int:
        """Number of evaluations told, asked for or not."""
        return len(self._session.archive)

    def ask(self) -> NDArray[np.float64]:
        """The candidates [n, d] to evaluate next, inside the bounds; the same again until told.

        Raises:
            InputError: The optimizer is done.
        """
        return self._session.ask()

    def tell(
        self,
        x: ArrayLike,
        y: ArrayLike,
        residuals: ArrayLike | None = None,
        jacobian: ArrayLike | None = None,
    ) -> None:
        """Tell evaluations; everything is copied.

        Candidates that were asked for may come in any order and in portions; the search goes on when the batch is
        complete. Points that were not asked for, for instance those of an earlier run, join the archive. They can
        become the best point, a leader or data of a surrogate, but answer no candidate and end no iteration.

        Args:
            x: Points [n, d] inside the bounds.
            y: Value [n]; +inf for a failed evaluation.
            residuals: Residuals [n, m], weighted so that y = sqrt(mean(residuals**2)), or the value that the
                constructor's `objective` gives. Ignored if only the value is used.
            jacobian: Derivatives of the residuals by the parameters [n, m, d].

        Raises:
            InputError: A shape is wrong, a number is not finite, a point lies outside the bounds, something in `uses`
                is missing, or a value does not belong to its residuals. Nothing of that call is kept.
        """
        self._session.tell(x, y, residuals, jacobian)
