"""What every optimizer offers: ask for candidates, tell their evaluations, until it is done."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.evaluations import Best
from calibray.optimizers.schedule import Schedule
from calibray.optimizers.session import Session


class Optimizer(ABC):
    """What minimises a value over a box; the caller owns the loop.

    `while not opt.done: x = opt.ask(); opt.tell(x, *evaluate(x))` is the whole of it. A final class states
    its settings in its constructor, hands its algorithm to a `Session`, declares the attributes below, and overrides
    nothing that stands here.

    The value may be any number: an error, a negative logarithm of a likelihood. A method that uses residuals
    minimises their mean square, so its value must rise and fall with that. For a likelihood tell deviance residuals:
    sign(r) sqrt(2 (l(r) - l(0))) of a residual r whose negative log-likelihood is l; its constructor's `objective`
    says what value belongs to them.

    Attributes:
        uses: What it uses of an evaluation, of "value", "residuals" and "jacobian".
        schedule: How it keeps to a budget; None where it stops by itself.
        takes_starts: Whether its constructor takes `x0`, points to start from, and `starts`, how many of its own it
            adds. The best point told to any other before the first `ask` leads its search.
    """

    uses: ClassVar[frozenset[str]]
    schedule: ClassVar[Schedule | None]
    takes_starts: ClassVar[bool]
    _session: Session

    @classmethod
    def needs_derivatives(cls) -> bool:
        """Tell whether every evaluation must come with derivatives.

        Returns:
            True if so.
        """
        return "jacobian" in cls.uses

    @classmethod
    def within(cls, budget: int) -> dict[str, int]:
        """Work out the settings that keep to a budget.

        Args:
            budget: Number of evaluations.

        Returns:
            Arguments of the constructor; none where it stops by itself.

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
    @abstractmethod
    def budget(self) -> int | None:
        """Number of evaluations it will ask for, or None when it stops by itself."""

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
        return self._session.best

    @property
    def minima(self) -> NDArray[np.float64]:
        """Where the search ended [k, d]: the best point, then every other minimum that the method keeps.

        Raises:
            InputError: Nothing has been told yet.
        """
        return np.concatenate([self.best.x[None], self._session.minima])

    @property
    def evaluations(self) -> int:
        """Number of evaluations told, asked for or not."""
        return len(self._session.archive)

    def ask(self) -> NDArray[np.float64]:
        """The candidates to evaluate next.

        Returns:
            Points [n, d] inside the bounds, each still without an evaluation; the same again until told.

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

        Candidates that were asked for may come in any order and in portions; the search goes on when the
        batch is complete. Points that were not asked for, for instance those of an earlier run, join the
        archive: they can become the best point, a leader or data of a surrogate, but stand for no
        candidate and no iteration.

        Args:
            x: Points [n, d] inside the bounds.
            y: Value [n]; +inf tells that an evaluation failed.
            residuals: Residuals [n, m], weighted so that y = sqrt(mean(residuals**2)), or whatever value the
                constructor was told to belong to them. Not looked at where only the value is used.
            jacobian: Derivatives of the residuals by the parameters [n, m, d].

        Raises:
            InputError: A shape is wrong, a number is not finite, a point lies outside the bounds, something in `uses`
                is missing, or a value does not belong to its residuals. Nothing of that call is kept.
        """
        self._session.tell(x, y, residuals, jacobian)
