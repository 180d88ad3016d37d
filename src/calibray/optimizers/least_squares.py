"""Multi-start least squares with exact derivatives: projected Levenberg-Marquardt on all starts at once.

Local searches are cheap where derivatives come with the residuals, and a batch of candidates costs little
more than one; so many starts run side by side, and each `ask` holds the next trial point of every start that
is still moving. RMSE over permittivities is multimodal (slab resonances), which is why one start is not
enough. A search is given up when it nears a better one, or lies so far behind the best that it can hardly
catch up; where it stood is kept as a minimum of its own (`minima`), for what fits nearly as well tells how
far the best can be trusted. The steps are those of `descent.py`.

Starts come in rounds, and end once the best minimum has come back often enough: another one that fits better,
with as wide a basin, would have been missed by all searches with a probability of e^-k after k returns. Narrower
ones are what a problem gets all its starts for. (The Bayesian rule of Boender and Rinnooy Kan, Mathematical
Programming 37, 1987, counts the different minima, for which every search would have to be followed to its end.
With all that were given up as one minimum it stopped short of the optimum in two of four seeds of `hall`, one of
`landscapes.py`; with each as a minimum of its own it never stopped.)

Where the starts are used up and the best has not come back that often, combinations of the minima are tried, and
searches start from those that fit best, until they give no better minimum (`recombination.py`). Following what was
given up to its end instead took twice the evaluations, and found the optimum of an office floor less often.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.arguments import real, whole
from calibray.optimizers.box import Box
from calibray.optimizers.descent import Starts, descend, distinct
from calibray.optimizers.evaluations import Archive, Evaluations, Objective, root_mean_square
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.recombination import SPACE, recombined
from calibray.optimizers.sampling import design
from calibray.optimizers.schedule import Schedule
from calibray.optimizers.session import Search, Session

CATCH_UP = 100.0
"""Predicted decreases that a search may lie behind the best one before it is given up, unless told otherwise."""
NEARER = 10.0
"""The same of searches that begin near their end, or beside others that stand there."""
RECOMBINED = 32
"""Combinations of minima that are tried at a time, no more than there were starts."""
FOLLOWED = 0.2
"""Share of them that searches start from, those that fit best."""
ROUND = 64
"""Starts of a round."""
RETURNS = 10
"""Searches that end in the best minimum before no more are started."""
LEVEL = 1e-4
"""Relative difference of the mean square below which two minima fit equally well, as along a valley."""
NOISELESS = 1e-9
"""The same, relative to the largest mean square: where data hold no noise, the lowest ones are rounding."""
APART = 0.01
"""Distance in the unit cube below which two searches are taken to have ended in the same minimum."""


@final
class LeastSquares(Optimizer):
    """Multi-start Levenberg-Marquardt. Uses residuals and Jacobian; no budget, for it stops by itself.

    Args:
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        seed: Seed of the scrambled Sobol points that the searches start from.
        starts: Number of those points at most; powers of two are spread best. Each costs about ten evaluations, and
            where all are used, combinations of what they found some hundred more.
            The best point told before the first `ask`, if any, is a further start.
        x0: Further starting points of the user's, [d] or [k, d].
        iterations: Largest number of steps of each search.
        tolerance: A search has converged when its model predicts less than this relative decrease of the mean
            square, or a step shorter than this in the unit cube.
        catch_up: Predicted decreases that a search may lie behind the best one before it is given up; fewer where
            starts are minima already, and the others need but show whether they lead to a better one.
        objective: The value that belongs to residuals [n, m], [n]; their root mean square unless told otherwise. It
            must rise with their mean square, which is what is minimised; both are checked.

    Raises:
        InputError: An argument is out of range.

    Example:
        >>> import numpy as np
        >>> opt = LeastSquares([0.0], [9.0], starts=4)
        >>> while not opt.done:
        ...     x = opt.ask()
        ...     r, j = np.sin(x) - 0.5, np.cos(x)[:, :, None]
        ...     opt.tell(x, np.abs(r[:, 0]), residuals=r, jacobian=j)
        >>> bool(abs(np.sin(opt.best.x[0]) - 0.5) < 1e-9)
        True
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value", "residuals", "jacobian"})
    schedule: ClassVar[Schedule | None] = None
    takes_starts: ClassVar[bool] = True

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        starts: int = 512,
        x0: ArrayLike | None = None,
        iterations: int = 100,
        tolerance: float = 1e-10,
        catch_up: float = CATCH_UP,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        self.starts = whole("starts", starts, at_least=1)
        self.iterations = whole("iterations", iterations, at_least=1)
        self.tolerance = real("tolerance", tolerance, at_least=0.0, at_most=1.0)
        self.catch_up = real("catch_up", catch_up, at_least=0.0)
        self.x0 = _user_starts(x0, self.box)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search, objective)

    @property
    def budget(self) -> None:
        """None: it stops when every search has converged."""
        return

    def _search(self, archive: Archive) -> Search:
        box = self.box
        told_best = [box.to_unit(archive.best.x[None])] if len(archive) else []
        sobol = design("sobol", self.starts, box.dimension, self._rng)
        unit, ended = np.concatenate([box.to_unit(self.x0), *told_best]), None
        for first in range(0, self.starts, ROUND):
            unit = np.concatenate([unit, sobol[first : first + ROUND]])
            ended = yield from self._descended(unit, ended, self.catch_up)
            if returns(ended) >= RETURNS:
                break
            unit = unit[:0]
        if ended is not None and len(ended.cost):
            if returns(ended) < RETURNS:
                ended = yield from self._recombined(ended)
            self._session.minima = box.from_unit(distinct(ended, APART).unit)

    def _recombined(self, ended: Starts) -> Generator[NDArray[np.float64], Evaluations, Starts]:
        number, before = min(RECOMBINED, self.starts), np.inf
        followed = round(FOLLOWED * number)
        while followed and ended.cost.min() < before:
            before = ended.cost.min() - _alike(ended)
            unit = recombined(distinct(ended, SPACE).unit, number)
            if not len(unit):
                break
            ended = yield from self._descended(unit, ended, min(NEARER, self.catch_up), followed)
        return ended

    def _descended(
        self,
        unit: NDArray[np.float64],
        known: Starts | None,
        catch_up: float,
        followed: int | None = None,
    ) -> Generator[NDArray[np.float64], Evaluations, Starts]:
        descent = descend(unit, self.iterations, self.tolerance, catch_up, known, followed)
        try:
            unit = next(descent)
            while True:
                told = yield self.box.from_unit(unit)
                failed = ~np.isfinite(told.y)[:, None]
                residuals = np.where(failed, np.inf, told.errors)
                unit = descent.send((residuals, told.slopes * self.box.width))
        except StopIteration as end:
            return end.value


def returns(ended: Starts) -> int:
    """How many searches ended in the best minimum, or in one that fits as well.

    Args:
        ended: The searches.

    Returns:
        Their number, with those that were merged with them.
    """
    if not len(ended.cost):
        return 0
    return int(ended.searches[ended.cost <= ended.cost.min() + _alike(ended)].sum())


def _alike(ended: Starts) -> float:
    """Difference of cost below which two minima fit equally well."""
    return float(LEVEL * ended.cost.min() + NOISELESS * ended.cost.max())


def _user_starts(x0: ArrayLike | None, box: Box) -> NDArray[np.float64]:
    if x0 is None:
        return np.empty((0, box.dimension))
    points = np.atleast_2d(np.array(x0, dtype=float))
    if points.ndim != 2 or points.shape[1] != box.dimension:
        d = box.dimension
        raise InputError(f"x0 has shape {np.shape(x0)}; it must be [{d}] or [k, {d}]: reshape it")
    for row, column in np.argwhere(~((points >= box.lower) & (points <= box.upper))):
        raise InputError(
            f"x0[{row}, {column}] = {points[row, column]:g} lies outside its bounds "
            f"[{box.lower[column]:g}, {box.upper[column]:g}]; move the start or widen the bounds"
        )
    return points
