"""CMA-ES, the covariance matrix adaptation evolution strategy, in its author's library.

N. Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv:1604.00772, in the package `cma`. It searches the unit cube,
starts in the middle (or at the best point passed to `tell` before) with a step of 0.3, and restarts from a random point
if it converges before its budget is used.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike

from calibray.optimizers.arguments import Box, whole
from calibray.optimizers.evaluations import Archive
from calibray.optimizers.library_adapter import limited
from calibray.optimizers.protocol import AS_GIVEN, Optimizer, Schedule, Search, Session
from calibray.support.lazy_imports import library

STEP = 0.3
"""Initial standard deviation in the unit cube."""


@final
class CMAES(Optimizer):
    """Covariance matrix adaptation. Uses only the value, with the given budget. Needs `calibray[optimizers]`.

    Args:
        budget: Number of evaluations.
        population: Candidates per generation; 4 + 3 ln d if None.

    Raises:
        InputError: An argument is out of range, or `cma` is not installed.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value"})
    schedule: ClassVar[Schedule | None] = AS_GIVEN
    takes_starts: ClassVar[bool] = False

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int = 225,
        population: int | None = None,
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        default = 4 + int(3 * np.log(self.box.dimension))
        self.population = default if population is None else whole("population", population, at_least=4)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._cma = library("cma", "optimizers")
        self._session = Session(self.box, self.uses, self._search)

    def _search(self, archive: Archive) -> Search:
        return limited(self._generations(archive), self._budget)

    def _generations(self, archive: Archive) -> Search:
        d = self.box.dimension
        start = self.box.to_unit(archive.best.x) if len(archive) else np.full(d, 0.5)
        options = {
            "bounds": [0.0, 1.0],
            "popsize": self.population,
            "randn": lambda *shape: self._rng.standard_normal(shape),
            "seed": np.nan,  # leaves NumPy's global generator alone
            "verbose": -9,
        }
        if d == 1:
            options["maxstd_boundrange"] = np.inf  # its limit fails in one dimension, as of cma 4.5
        while True:
            strategy = self._cma.CMAEvolutionStrategy(start, STEP, options)
            while not strategy.stop():
                unit = np.array(strategy.ask())
                answers = yield self.box.from_unit(unit)
                strategy.tell(list(unit), list(archive.imputed(answers).y))
            start = self._rng.random(d)
