"""What a cheap model of the dear one offers, and one made of a function without derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol, final

import numpy as np
from numpy.typing import NDArray

STEP: Final = 1e-5
"""Of a coordinate's range, for central differences."""


class CheapAnswer(NamedTuple):
    """What a cheap model answers to n points, each with constants of its own.

    Attributes:
        residuals: Residuals, in the rows that the dear model is told in [n, m].
        by_point: Their derivatives by the search coordinates [n, m, d].
        by_constant: Their derivatives by the model's constants [n, m, q].
    """

    residuals: NDArray[np.float64]
    by_point: NDArray[np.float64]
    by_constant: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Constants:
    """What a cheap model takes for granted, and may be told wrongly; the search does not move it.

    Attributes:
        centre: Their believed values [q]; there may be none.
        spread: Standard deviations of how far off they may be [q].
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


class CheapModel(Protocol):
    """A model that costs next to nothing beside the one that is minimised."""

    @property
    def constants(self) -> Constants:
        """Its constants, to be adjusted until it answers as the dear model does."""
        ...

    @property
    def known(self) -> NDArray[np.bool_]:
        """Rows of the residuals that it says something about [m]; of others it gives any number that is constant."""
        ...

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals [n, m] at points of the box [n, d], each with constants of its own [n, q]."""
        ...

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """The same with derivatives."""
        ...


def value_of(model: CheapModel, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The objective of a cheap model with the constants that it was told, over the rows that it knows.

    Args:
        model: The model.
        points: Points of the box [n, d].

    Returns:
        Root mean square of its residuals [n].
    """
    constants = np.repeat(model.constants.centre[None], len(points), axis=0)
    return np.sqrt(np.mean(model.residuals(points, constants)[:, model.known] ** 2, axis=1))


@final
@dataclass(frozen=True, eq=False)
class Differenced:
    """A cheap model of a function, its derivatives by central differences.

    Attributes:
        function: Points [n, d] and constants [n, q] to residuals [n, m].
        width: Range of each search coordinate [d].
        known: Rows that it says something about [m].
        constants: Its constants.

    Example:
        >>> import numpy as np
        >>> model = Differenced(lambda x, c: x**2, np.ones(1), np.ones(1, dtype=bool))
        >>> model.answer(np.array([[3.0]]), np.zeros((1, 0))).by_point.round(6).tolist()
        [[[6.0]]]
    """

    function: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
    width: NDArray[np.float64]
    known: NDArray[np.bool_]
    constants: Constants = field(default_factory=Constants.none)

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `CheapModel.residuals`."""
        return self.function(points, constants)

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """See `CheapModel.answer`."""
        d, joined = points.shape[1], np.hstack([points, constants])
        step = STEP * np.concatenate([self.width, self.constants.upper - self.constants.lower])
        moves = np.concatenate([np.diag(step), -np.diag(step)])
        moved = (joined + moves[:, None]).reshape(-1, joined.shape[1])
        values = self.function(moved[:, :d], moved[:, d:]).reshape(2, len(step), len(points), -1)
        slopes = np.moveaxis((values[0] - values[1]) / (2.0 * step[:, None, None]), 0, -1)
        return CheapAnswer(self.function(points, constants), slopes[:, :, :d], slopes[:, :, d:])
