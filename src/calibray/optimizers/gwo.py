"""The canonical Grey Wolf Optimizer, the paper's baseline.

S. Mirjalili, S. M. Mirjalili, A. Lewis, "Grey Wolf Optimizer", Advances in Engineering Software 69, 2014.

The following choices apply where descriptions and common implementations differ:

- Iteration t = 1..T evaluates the whole population, then moves it with a(t) = 2 (1 - t/T). The move after the last
  evaluation is omitted, so a run takes exactly N T evaluations.
- alpha, beta and delta are the three best *distinct* points over the whole run (not of the last generation), ties in
  the order of evaluation. Wolves at the same point count as one leader.
- Wolves always move, even to a worse position.
- Positions outside the bounds are clipped to them before evaluation.
- A failed evaluation (+inf) ranks last and has no other effect.
- C multiplies a position, so steps are short near the origin of the coordinates and long far from it: the pack is
  biased towards the origin. This is the published algorithm and the default; with `centred=True`, positions are
  measured from the middle of the box instead, and the origin has no effect.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.optimizers.arguments import Box, whole
from calibray.optimizers.evaluations import Archive
from calibray.optimizers.protocol import Optimizer, Schedule, Search, Session

LEADERS = 3
"""Alpha, beta and delta."""

WOLVES = 30
"""N of the paper (table II)."""

LEAST_BUDGET = 24
"""Smallest budget with which SGWO-IM has three leaders."""


def linear_decay(iteration: int, iterations: int) -> float:
    """The standard convergence factor a(t) = 2 (1 - t / T) of iteration t, from 1, of T."""
    return 2.0 * (1.0 - iteration / iterations)


def encircle(
    positions: NDArray[np.float64],
    leaders: NDArray[np.float64],
    a: float,
    r1: NDArray[np.float64],
    r2: NDArray[np.float64],
    origin: NDArray[np.float64] | float = 0.0,
) -> NDArray[np.float64]:
    """Move a pack by the guidance of its leaders (Mirjalili et al. 2014, eqs. 3.1 to 3.7).

    `r1` and `r2` [n, 3, d] are independent uniform random numbers, `leaders` are alpha, beta and delta [3, d], and
    positions [n, d] are measured from `origin` [d]. Returns X_GWO, the mean of the three guided positions [n, d], not
    yet clipped.
    """
    guide = leaders - origin
    a_coefficient = 2.0 * a * r1 - a  # A, eq. 3.3
    c_coefficient = 2.0 * r2  # C, eq. 3.4
    distance = np.abs(c_coefficient * guide - (positions - origin)[:, None, :])  # D, eq. 3.5
    return (guide - a_coefficient * distance).mean(axis=1) + origin  # eqs. 3.6, 3.7


def whole_iterations(budget: int) -> dict[str, int]:
    """The settings of GWO for a budget: 30 wolves, and as many whole iterations as fit.

    There are fewer wolves if two iterations of 30 do not fit.

    Example:
        >>> whole_iterations(600), whole_iterations(45)
        ({'population': 30, 'iterations': 20}, {'population': 22, 'iterations': 2})
    """
    wolves = min(WOLVES, budget // 2)
    return {"population": wolves, "iterations": budget // wolves}


@final
class GWO(Optimizer):
    """Grey Wolf Optimizer. Uses only the value; 600 evaluations at the paper's settings.

    Args:
        population: N, number of wolves.
        iterations: T.
        centred: Measure positions from the middle of the box instead of the origin.

    Raises:
        InputError: An argument is out of range.

    Example:
        >>> import numpy as np
        >>> opt = GWO([-5.0, -5.0], [5.0, 5.0], seed=1)
        >>> while not opt.done:
        ...     x = opt.ask()
        ...     opt.tell(x, np.sum((x - 2.0) ** 2, axis=1))
        >>> opt.evaluations, bool(opt.best.y < 0.01)
        (600, True)
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value"})
    schedule: ClassVar[Schedule | None] = Schedule(whole_iterations, LEAST_BUDGET)
    takes_starts: ClassVar[bool] = False

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        population: int = WOLVES,
        iterations: int = 20,
        centred: bool = False,
    ) -> None:
        self.box = Box.between(lower, upper)
        self.population = whole("population", population, at_least=LEADERS)
        self.iterations = whole("iterations", iterations, at_least=1)
        self._budget = self.population * self.iterations
        self.origin = self.box.centre if centred else np.zeros(self.box.dimension)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    @property
    def leaders(self) -> NDArray[np.float64]:
        """Positions of alpha, beta and delta [3, d]."""
        return self._session.archive.leaders(LEADERS)

    def _search(self, archive: Archive) -> Search:
        positions = self.box.from_unit(self._rng.random((self.population, self.box.dimension)))
        for iteration in range(1, self.iterations + 1):
            yield positions
            r1, r2 = self._rng.random((2, self.population, LEADERS, self.box.dimension))
            a = linear_decay(iteration, self.iterations)
            positions = self.box.clip(encircle(positions, archive.leaders(LEADERS), a, r1, r2, self.origin))
