"""Gauss-Newton with finite differences: the approach of a user with a least squares solver and no derivatives.

Every accepted point takes one evaluation for each parameter, all in one batch. Steps are those of `descent.py`. It is a
local method: it starts in the middle of the box (or at the best point passed to `tell` before), and restarts at random
points if it has converged before its budget is used.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.optimizers.arguments import Box, real, whole
from calibray.optimizers.descent import descend
from calibray.optimizers.evaluations import Archive, Objective, root_mean_square
from calibray.optimizers.library_adapter import limited
from calibray.optimizers.protocol import AS_GIVEN, Optimizer, Schedule, Search, Session


@final
class GaussNewton(Optimizer):
    """Least squares with forward differences. Uses residuals; budget as set.

    Args:
        seed: Seed of the random points of restarts.
        budget: Number of evaluations.
        step: Step of the differences, as a share of the box.
        tolerance: Relative decrease, or step as a share of the box, at which a search has converged.

    Raises:
        InputError: An argument is out of range.
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
        step: float = 1e-3,
        tolerance: float = 1e-4,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        self.step = real("step", step, at_least=1e-12, at_most=0.1)
        self.tolerance = real("tolerance", tolerance, at_least=1e-15, at_most=1.0)
        rng, settings = np.random.default_rng(whole("seed", seed, at_least=0)), (self.step, self.tolerance)
        self._session = Session(
            self.box,
            self.uses,
            lambda archive: limited(_search(archive, settings, rng), self._budget),
            objective,
        )


def _search(archive: Archive, settings: tuple[float, float], rng: np.random.Generator) -> Search:
    """Search from one starting point after the other, without end."""
    d = archive.box.dimension
    start = archive.box.to_unit(archive.best.x) if len(archive) else np.full(d, 0.5)
    while True:
        yield from _descend(archive, start, *settings)
        start = rng.random(d)


def _descend(archive: Archive, start: NDArray[np.float64], step: float, tolerance: float) -> Search:
    """One local search; yields candidates [n, d] of the box."""
    box, lowest = archive.box, np.inf
    descent = descend(start[None], 10**6, tolerance)
    unit = next(descent)
    while True:
        residuals = archive.imputed((yield box.from_unit(unit))).errors
        value, slope = float(np.sum(residuals**2)), np.zeros((*residuals.shape, unit.shape[1]))
        if value < lowest:  # a rejected step needs no derivatives
            lowest = value
            moves = np.where(unit[0] <= 0.5, step, -step)
            moved = archive.imputed((yield box.from_unit(unit + np.diag(moves)))).errors
            slope = ((moved - residuals) / moves[:, None]).T[None]
        try:
            unit = descent.send((residuals, slope))
        except StopIteration:
            return
