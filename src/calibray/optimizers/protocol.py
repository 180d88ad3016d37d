"""What every optimizer offers: ask for candidates, tell their evaluations, until it is done."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.optimizers.archive import Best
from calibray.optimizers.session import Session


class Optimizer(ABC):
    """Minimises an objective over a box; the caller owns the loop.

    `while not opt.done: x = opt.ask(); opt.tell(x, *evaluate(x))` is the whole of it. A final class states
    its settings in its constructor, hands its algorithm to a `Session`, and overrides nothing that stands
    here.

    Attributes:
        uses: What it uses of an evaluation, of "value", "residuals" and "jacobian".
    """

    uses: ClassVar[frozenset[str]]
    _session: Session

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
            y: Objective [n]; +inf tells that an evaluation failed.
            residuals: Residuals [n, m], weighted so that y = sqrt(mean(residuals**2)).
            jacobian: Derivatives of the residuals by the parameters [n, m, d].

        Raises:
            InputError: A shape is wrong, a number is not finite, a point lies outside the bounds, or
                something in `uses` is missing. Nothing of that call is kept.
        """
        self._session.tell(x, y, residuals, jacobian)
