"""Interfaces of optimizers (`ask` returns candidates, `tell` receives their evaluations) and of optional cheap models.

An algorithm is a generator that yields the candidates [n, d] of each iteration and receives their evaluations, so that
its code can follow the publication that describes it. A `Session` suspends the algorithm between `ask` and `tell`,
checks the evaluations, keeps the archive, and collects the answers to a batch. Answers can arrive in any order and in
several calls.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from typing import Any, ClassVar, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.arguments import Box
from calibray.optimizers.evaluations import (
    Archive,
    Best,
    Evaluations,
    Objective,
    check_order,
    checked_evaluations,
    root_mean_square,
)
from calibray.support.messages import counted

Search = Generator[NDArray[np.float64], Evaluations, None]
"""An algorithm, which yields candidates [n, d] inside the box and receives their evaluations in the same order."""


class Session:
    """A search in progress.

    Args:
        box: The search box.
        uses: Parts of an evaluation that the algorithm uses: "value", "residuals", "jacobian".
        search: Function that starts the algorithm with the archive; the algorithm does not run before the first `ask`.
        objective: Function that converts residuals to the value; applies only if the algorithm uses residuals.

    Attributes:
        minima: Distinct minima that the algorithm keeps, lowest first [k, d]; empty until the algorithm sets them.
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
        self._open = np.arange(0)
        self._answers: dict[int, Evaluations] = {}
        self._links: int | None = None
        self._finished = False
        self.minima = np.empty((0, box.dimension))

    @property
    def done(self) -> bool:
        """Whether the algorithm has ended; if necessary, the next candidates are computed to find out."""
        # The algorithm does not start before the first `ask`, so that `tell` can still receive earlier evaluations.
        if self._asked is not None:
            self._advance()
        return self._finished

    def ask(self) -> NDArray[np.float64]:
        """See `Optimizer.ask`."""
        self._advance()
        if self._asked is None:
            raise InputError(
                f"done after {counted(len(self.archive), 'evaluation')}; start a new optimizer to continue"
            )
        return self._asked[self._open]

    def tell(
        self,
        x: ArrayLike,
        y: ArrayLike,
        residuals: ArrayLike | None = None,
        jacobian: ArrayLike | None = None,
    ) -> None:
        """See `Optimizer.tell`."""
        parts = {"residuals": residuals, "jacobian": jacobian}
        evaluations = checked_evaluations(self.archive.box, x, y, parts, self._uses, self._objective)
        if evaluations.residuals is not None:
            links = evaluations.residuals.shape[1]
            if self._links not in (None, links):
                raise InputError(
                    f"residuals have {counted(links, 'column')}, but earlier residuals had "
                    f"{self._links}; pass the same links"
                )
            if self._objective is not root_mean_square:
                check_order(evaluations, self.archive)
            self._links = links
        self.archive.add(evaluations)
        if self._asked is None:
            return
        # If the whole batch arrives in the requested order, its points need not be matched individually.
        if np.array_equal(evaluations.x, self._asked) and len(self._open) == len(self._asked):
            self._answers, self._open = {0: evaluations}, self._open[:0]
            return
        for row, point in enumerate(evaluations.x):
            # If candidates of a batch are equal, the answer belongs to the first candidate without an answer.
            same = np.flatnonzero((self._asked[self._open] == point).all(axis=1))
            if same.size:
                self._answers[int(self._open[same[0]])] = evaluations.rows(np.array([row]))
                self._open = np.delete(self._open, same[0])

    def _advance(self) -> None:
        """Compute the next batch if the current batch is complete."""
        if self._finished or len(self._open):
            return
        answers = [self._answers[row] for row in sorted(self._answers)]
        try:
            self._asked = self._search.send(Evaluations.joined(answers)) if answers else next(self._search)
            self._open, self._answers = np.arange(len(self._asked)), {}
        except StopIteration:
            self._asked, self._open, self._answers, self._finished = None, np.arange(0), {}, True


def limited(search: Search, budget: int) -> Search:
    """Stop a search when its budget is used up, and shorten the last batch if necessary.

    The search itself must not end earlier.
    """
    with closing(search):
        x = next(search)
        while True:
            answers = yield x[:budget]
            budget -= len(answers)
            if budget == 0:
                return
            x = search.send(answers)


def first_start(archive: Archive) -> NDArray[np.float64]:
    """Starting point [d] of a local search in the unit cube: the best point passed to `tell`, or else the centre."""
    return archive.box.to_unit(archive.best.x) if len(archive) else np.full(archive.box.dimension, 0.5)


@dataclass(frozen=True)
class Schedule:
    """Settings with which a method respects a budget.

    Attributes:
        settings: Function that maps a budget of evaluations to constructor arguments that respect the budget.
        least: Smallest budget that the method accepts.
    """

    settings: Callable[[int], dict[str, int]]
    least: int = 1


AS_GIVEN: Final = Schedule(lambda budget: {"budget": budget})
"""The schedule of a method whose setting `budget` accepts any budget."""


class Optimizer(ABC):
    """A method that minimizes a function over a box; the caller runs the loop.

    `while not opt.done: x = opt.ask(); opt.tell(x, *evaluate(x))` is a complete run. A final class receives its
    settings in the constructor and passes its algorithm to a `Session`. It sets the attributes below whose defaults do
    not apply, and overrides nothing else.

    The value can be any number, such as an error or a negative log likelihood. A method that uses residuals minimizes
    their mean square, so the value must increase with the mean square. For a likelihood, pass deviance residuals
    sign(r) sqrt(2 (l(r) - l(0))) to `tell`, where r are the residuals and l is the negative log likelihood of a
    residual.

    Every constructor takes `lower` and `upper`, the bounds [d], and `seed`, the seed of the random generator. If
    residuals are used, the constructor also takes `objective`, a function that maps residuals [n, m] to the value [n];
    the default is the root mean square. `tell` checks that values agree with this function and increase with the mean
    square.

    Attributes:
        uses: The parts of an evaluation that the method uses: "value", "residuals", "jacobian".
        schedule: Schedule with which the method respects a budget; None if the method stops on its own.
        takes_starts: Whether the constructor takes starting points (`x0`) and the number of further starting points
            (`starts`). Most methods also use the points passed to `tell` before the first `ask`.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value"})
    schedule: ClassVar[Schedule | None] = AS_GIVEN
    takes_starts: ClassVar[bool] = False
    _session: Session
    _budget: Any  # int, or None if the method stops on its own

    @classmethod
    def needs_derivatives(cls) -> bool:
        """Whether every evaluation must include derivatives."""
        return "jacobian" in cls.uses

    @classmethod
    def within(cls, budget: int) -> dict[str, int]:
        """The constructor arguments that respect a budget; empty if the method stops on its own.

        Raises:
            InputError: The budget is too small for the method.
        """
        if cls.schedule is None:
            return {}
        if budget < cls.schedule.least:
            raise InputError(
                f"budget = {budget}; {cls.__name__} needs at least "
                f"{counted(cls.schedule.least, 'evaluation')}: raise the budget"
            )
        return cls.schedule.settings(budget)

    @property
    def budget(self) -> int | None:
        """Maximum number of evaluations that the method requests; None if the method stops on its own."""
        return self._budget

    @property
    def done(self) -> bool:
        """Whether the search has ended."""
        return self._session.done

    @property
    def best(self) -> Best:
        """The best evaluation so far: the point `x` [d] and the value `y`.

        Raises:
            InputError: No evaluation has been passed to `tell` yet.
        """
        return self._session.archive.best

    @property
    def minima(self) -> NDArray[np.float64]:
        """The best point and then the distinct minima that the method keeps [k, d]; the best point can occur twice.

        Raises:
            InputError: No evaluation has been passed to `tell` yet.
        """
        return np.concatenate([self.best.x[None], self._session.minima])

    @property
    def evaluations(self) -> int:
        """Number of evaluations so far, whether requested or not."""
        return len(self._session.archive)

    def ask(self) -> NDArray[np.float64]:
        """The candidates [n, d] to evaluate next: the candidates of the current batch that have no evaluation yet.

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
        """Pass evaluations to the optimizer; all arrays are copied.

        Requested candidates can be passed in any order and in several calls; the search continues when the batch is
        complete. Points that were not requested, such as points of an earlier run, are added to the archive. Such a
        point can become the best point or a leader, and surrogates are fitted to it, but it does not count as the
        answer to a candidate.

        Args:
            x: Points [n, d] inside the bounds.
            y: Values [n]; +inf for a failed evaluation.
            residuals: Residuals [n, m], weighted so that y = sqrt(mean(residuals**2)), or so that the constructor's
                `objective` returns y. If the method uses only the value, residuals are checked but not used.
            jacobian: Derivatives of the residuals with respect to the parameters [n, m, d].

        Raises:
            InputError: A shape is wrong, a number is not finite, a point is outside the bounds, a part in `uses` is
                missing, or a value does not match its residuals. Nothing from this call is kept.
        """
        self._session.tell(x, y, residuals, jacobian)


class CheapAnswer(NamedTuple):
    """The output of a cheap model at n points, each evaluated with its own set of constants.

    Attributes:
        residuals: Residuals, in the order of the engine's residuals [n, m].
        by_point: Derivatives of the residuals with respect to the search coordinates [n, m, d].
        by_constant: Derivatives of the residuals with respect to the model's constants [n, m, q].
    """

    residuals: NDArray[np.float64]
    by_point: NDArray[np.float64]
    by_constant: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Constants:
    """Constants of a cheap model that may be wrong and that are not search parameters.

    Attributes:
        centre: Assumed values [q]; q can be 0.
        spread: Standard deviations of the errors of the assumed values [q].
        lower: Lower bounds [q].
        upper: Upper bounds [q].
    """

    centre: NDArray[np.float64]
    spread: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    @staticmethod
    def none() -> Constants:
        """No constants."""
        return Constants(*(np.zeros(0) for _ in range(4)))

    @property
    def width(self) -> NDArray[np.float64]:
        """Upper bounds minus lower bounds [q]."""
        return self.upper - self.lower

    def draw(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Constants [k, q] drawn from the prior with standard normal numbers [k, q] and clipped to the bounds."""
        return np.clip(self.centre + self.spread * normal, self.lower, self.upper)


class CheapModel(Protocol):
    """A model whose computing time is negligible compared with that of the engine."""

    @property
    def constants(self) -> Constants:
        """The model's constants, which are adjusted until the model agrees with the engine."""
        ...

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask [m] of the residuals that the model predicts; the other residuals are arbitrary constants."""
        ...

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals [n, m] at points of the box [n, d] with constants [n, q]."""
        ...

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """Residuals and their derivatives at points of the box [n, d] with constants [n, q]."""
        ...
