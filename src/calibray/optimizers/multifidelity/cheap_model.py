"""The interface of a cheap model of an expensive engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


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
