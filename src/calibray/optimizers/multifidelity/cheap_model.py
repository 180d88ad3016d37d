"""The interface of a cheap model of an expensive engine, and a cheap model made from a function without derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol, final

import numpy as np
from numpy.typing import NDArray

STEP: Final = 1e-5
"""Step of central differences, as a share of a coordinate's range."""


class CheapAnswer(NamedTuple):
    """The answer of a cheap model to n points, each with one set of constants.

    Attributes:
        residuals: Residuals in the order of the engine's residuals [n, m].
        by_point: Their derivatives with respect to the search coordinates [n, m, d].
        by_constant: Their derivatives with respect to the model's constants [n, m, q].
    """

    residuals: NDArray[np.float64]
    by_point: NDArray[np.float64]
    by_constant: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Constants:
    """Constants of a cheap model that the search does not change and that may be wrong.

    Attributes:
        centre: Their believed values [q]; q may be 0.
        spread: Standard deviations of their errors [q].
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
        """Upper minus lower bounds [q]."""
        return self.upper - self.lower

    def draw(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Constants from their prior within the bounds [k, q], from standard normal numbers [k, q]."""
        return np.clip(self.centre + self.spread * normal, self.lower, self.upper)


class CheapModel(Protocol):
    """A model whose computing time is negligible compared with the engine that is minimised."""

    @property
    def constants(self) -> Constants:
        """Its constants, which are adjusted until it agrees with the engine."""
        ...

    @property
    def known(self) -> NDArray[np.bool_]:
        """Residuals that the model predicts [m]; for the others it returns any constant number."""
        ...

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals [n, m] at points of the box [n, d] with constants [n, q]."""
        ...

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """Residuals with their derivatives."""
        ...


@final
@dataclass(frozen=True, eq=False)
class FunctionModel:
    """A cheap model given as a function; its derivatives are central differences.

    Attributes:
        function: Points [n, d] and constants [n, q] to residuals [n, m].
        width: Range of each search coordinate [d].
        known: Residuals that the function predicts [m].
        constants: Its constants.

    Example:
        >>> import numpy as np
        >>> model = FunctionModel(lambda x, c: x**2, np.ones(1), np.ones(1, dtype=bool))
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
        d, arguments = points.shape[1], np.hstack([points, constants])
        step = STEP * np.concatenate([self.width, self.constants.width])
        moves = np.concatenate([np.diag(step), -np.diag(step)])
        moved = (arguments + moves[:, None]).reshape(-1, arguments.shape[1])
        values = self.function(moved[:, :d], moved[:, d:]).reshape(2, len(step), len(points), -1)
        slopes = np.moveaxis((values[0] - values[1]) / (2.0 * step[:, None, None]), 0, -1)
        return CheapAnswer(self.function(points, constants), slopes[:, :, :d], slopes[:, :, d:])
