"""Differential evolution in SciPy, with one generation per batch (R. Storn, K. Price, J. Global Optim. 11 (1997) 341).

SciPy's final polish, which would need derivatives, is not used. It restarts with another population if it converges
before its budget is used.
"""

from __future__ import annotations

from functools import partial
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import differential_evolution

from calibray.optimizers.arguments import Box, whole
from calibray.optimizers.evaluations import Archive
from calibray.optimizers.library_adapter import Evaluate, inverted, limited
from calibray.optimizers.protocol import AS_GIVEN, Optimizer, Schedule, Search, Session


@final
class DifferentialEvolution(Optimizer):
    """Differential evolution. Uses only the value, with the given budget.

    Args:
        budget: Number of evaluations.
        population: Candidates per generation as a multiple of d; SciPy uses at least 5 in total.

    Raises:
        InputError: An argument is out of range.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value"})
    schedule: ClassVar[Schedule | None] = AS_GIVEN
    takes_starts: ClassVar[bool] = False

    def __init__(
        self, lower: ArrayLike, upper: ArrayLike, *, seed: int = 0, budget: int = 225, population: int = 5
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        self.population = whole("population", population, at_least=1)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    def _search(self, archive: Archive) -> Search:
        # The thread holds no reference to this object, so it ends when this object is dropped.
        minimise = partial(_minimise, self.population, archive, self._rng)
        return limited(inverted(minimise), self._budget)


def _minimise(population: int, archive: Archive, rng: np.random.Generator, evaluate: Evaluate) -> None:
    """Minimise with one population after the other, without end."""
    box = archive.box

    def objective(x: NDArray[np.float64]) -> NDArray[np.float64]:  # [d, n], SciPy's vectorized form
        return archive.imputed(evaluate(box.clip(x.T))).y

    start = archive.best.x if len(archive) else None
    while True:
        differential_evolution(
            objective,
            list(zip(box.lower, box.upper, strict=True)),
            popsize=population,
            x0=start,
            tol=0.0,
            polish=False,
            vectorized=True,
            updating="deferred",
            rng=rng,
        )
        start = None
