"""DFO-LS, derivative-free least squares in its authors' library.

C. Cartis, J. Fiala, B. Marteau, L. Roberts, "Improving the Flexibility and Robustness of Model-Based
Derivative-Free Optimization Solvers", ACM Trans. Math. Softw. 45 (2019) 32, in the package `DFO-LS`. It
fits a linear model to every residual in a trust region, one evaluation at a time. DFO-LS is a local method: it starts
in the middle of the unit cube (or at the best point passed to `tell` before), and restarts from random points if it
converges before its budget is used.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.optimizers.arguments import Box, real, whole
from calibray.optimizers.evaluations import Archive, Objective, root_mean_square
from calibray.optimizers.library_adapter import Evaluate, inverted, limited
from calibray.optimizers.protocol import AS_GIVEN, Optimizer, Schedule, Search, Session
from calibray.support.lazy_imports import library


@final
class DFOLS(Optimizer):
    """Derivative-free least squares. Uses residuals; budget as set. Needs `calibray[optimizers]`.

    Args:
        seed: Seed of the random points of restarts.
        budget: Number of evaluations.
        radius: First trust region, as a share of the box.
        tolerance: Trust region at which a search has converged, as a share of the box.

    Raises:
        InputError: An argument is out of range, or `DFO-LS` is not installed.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value", "residuals"})
    schedule: ClassVar[Schedule | None] = AS_GIVEN
    takes_starts: ClassVar[bool] = False

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int = 225,
        radius: float = 0.2,
        tolerance: float = 1e-4,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        self.radius = real("radius", radius, at_least=1e-6, at_most=0.5)
        self.tolerance = real("tolerance", tolerance, at_least=1e-12, at_most=self.radius)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._dfols = library("dfols", "optimizers")
        self._session = Session(self.box, self.uses, self._search, objective)

    def _search(self, archive: Archive) -> Search:
        # The thread holds no reference to this object, so it ends when this object is dropped.
        solve, radii = self._dfols.solve, (self.radius, self.tolerance)
        minimise = partial(_minimise, solve, radii, self._budget, archive, self._rng)
        return limited(inverted(minimise), self._budget)


def _minimise(
    solve: Callable[..., Any],
    radii: tuple[float, float],
    budget: int,
    archive: Archive,
    rng: np.random.Generator,
    evaluate: Evaluate,
) -> None:
    """Minimise from one starting point after the other, without end."""
    box = archive.box
    d = box.dimension

    def residuals(unit: NDArray[np.float64]) -> NDArray[np.float64]:
        return archive.imputed(evaluate(box.from_unit(unit[None]))).errors[0]

    start = box.to_unit(archive.best.x) if len(archive) else np.full(d, 0.5)
    while True:
        before = len(archive)
        outcome = solve(
            residuals,
            start,
            bounds=(np.zeros(d), np.ones(d)),
            rhobeg=radii[0],
            rhoend=radii[1],
            maxfun=budget + d + 2,  # `limited` keeps the budget, and DFO-LS warns of a small one
            do_logging=False,
            # Coordinate directions: the random ones come from NumPy's global generator.
            user_params={"init.random_initial_directions": False},
        )
        if len(archive) == before:
            raise RuntimeError(f"DFO-LS ended without an evaluation: {outcome.msg}")
        start = rng.random(d)
