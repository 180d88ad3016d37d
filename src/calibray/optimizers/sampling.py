"""Designs of points in the unit cube, and searches that evaluate one design and stop.

These searches are baselines: any optimizer that learns from evaluations should perform better with the same budget.
"""

from __future__ import annotations

from typing import ClassVar, Final, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist, pdist

from calibray.optimizers.arguments import Box, whole
from calibray.optimizers.evaluations import Archive
from calibray.optimizers.protocol import Optimizer, Search, Session
from calibray.support.interruption import defer_interruption


def design(kind: str, count: int, dimension: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw points in the unit cube [count, dimension].

    The kinds are "random" (independent and uniform), "latin-hypercube" (one point in each of `count` slices of every
    dimension) and "sobol" (the first `count` points of a scrambled sequence whose length is the next power of two).
    """
    if kind == "random":
        return rng.random((count, dimension))
    from scipy.stats import qmc  # the import takes 0.4 s

    if kind == "latin-hypercube":
        return qmc.LatinHypercube(dimension, rng=rng).random(count)
    # If SciPy is interrupted while reading the direction numbers, it ignores the interruption and continues without
    # these numbers.
    with defer_interruption():
        sequence = qmc.Sobol(dimension, rng=rng)
    # Sobol points are balanced only in blocks of a power of two, and SciPy warns about other block sizes.
    return sequence.random_base2((count - 1).bit_length())[:count]


def maximin_design(
    count: int, dimension: int, rng: np.random.Generator, tries: int = 50
) -> NDArray[np.float64]:
    """Draw `tries` Latin hypercubes [count, dimension], and return the one whose points are the farthest apart."""
    drawn = [design("latin-hypercube", count, dimension, rng) for _ in range(tries)]
    spacing = [pdist(points).min(initial=np.inf) for points in drawn]
    return drawn[int(np.argmax(spacing))]


def draw_around(
    points: NDArray[np.float64], count: int, log_reach: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw points [count, d] around given points [n, d] of the unit cube, at distances of various orders of magnitude.

    The standard deviation of each point's offset is log-uniform from 10^`log_reach` to 10^-0.5.
    """
    near = points[rng.integers(0, len(points), count)]
    reach = 10.0 ** rng.uniform(log_reach, -0.5, (count, 1))
    return np.clip(near + reach * rng.standard_normal(near.shape), 0.0, 1.0)


SEPARATION: Final = 1e-4
"""Distance in the unit cube below which a point is considered already evaluated."""


def distance_to_nearest(x: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance [k] from each point of x [k, d] to the nearest of `points` [n, d], n >= 1."""
    return cdist(x, points).min(axis=1)


def not_evaluated(
    candidates: NDArray[np.float64], points: NDArray[np.float64], separation: float
) -> NDArray[np.float64]:
    """The candidates [k, d] farther than `separation` from all `points` [n, d]; if there are none, the farthest one."""
    distance = distance_to_nearest(candidates, points)
    return candidates[distance > min(separation, np.nextafter(distance.max(), -np.inf))]


class Sampling(Optimizer):
    """A search that evaluates one design and then ends; subclasses define the kind of design.

    Args:
        seed: Seed of the design.
        budget: Number of points, all in one batch.

    Raises:
        InputError: An argument is out of range.

    Attributes:
        kind: Name of the design.
    """

    kind: ClassVar[str]

    def __init__(self, lower: ArrayLike, upper: ArrayLike, *, seed: int = 0, budget: int = 225) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    def _search(self, archive: Archive) -> Search:
        yield self.box.from_unit(design(self.kind, self._budget, self.box.dimension, self._rng))


@final
class RandomSearch(Sampling):
    """Independent uniform points. The method uses only objective values and spends the whole budget.

    Example:
        >>> RandomSearch([0.0, 0.0], [1.0, 2.0], budget=10).ask().shape
        (10, 2)
    """

    kind: ClassVar[str] = "random"


@final
class LatinHypercube(Sampling):
    """One point in each slice of every dimension. The method uses only objective values and spends the whole budget.

    Example:
        >>> sorted((LatinHypercube([0.0], [1.0], budget=4).ask()[:, 0] * 4).astype(int).tolist())
        [0, 1, 2, 3]
    """

    kind: ClassVar[str] = "latin-hypercube"


@final
class Sobol(Sampling):
    """A scrambled Sobol sequence. The method uses only objective values and spends the whole budget.

    Example:
        >>> Sobol([0.0, 0.0], [1.0, 2.0], budget=10).ask().shape
        (10, 2)
    """

    kind: ClassVar[str] = "sobol"
