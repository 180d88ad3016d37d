"""Multi-start least squares with exact derivatives: projected Levenberg-Marquardt from many points in parallel.

Local searches are cheap if the engine returns derivatives, and a batch of candidates takes little longer than one
candidate. Many searches therefore run in parallel, and each `ask` returns the next trial point of every search still in
progress. Because of slab resonances, RMSE is a multimodal function of the permittivities, so one starting point is not
enough. A search that comes close to a better search is merged into the better search. A search that cannot catch up
with the best search is abandoned, and its last point is kept among the minima (`minima`). Other minima that fit nearly
as well as the best one show how ambiguous the solution is. `descent.py` computes the steps.

Starting points are used in rounds, until `RETURNS` searches have ended in the best minimum. If there is a better
minimum with an equally wide basin, the probability that all searches have missed this minimum is e^-k after k returns
to the best minimum. If fewer searches end in the best minimum, all starting points are used. (The Bayesian rule of
Boender and Rinnooy Kan, Mathematical Programming 37, 1987, counts the different minima, and therefore requires every
search to run to its end.)

If too few searches have ended in the best minimum, minima are combined into new starting points (`recombine`). Searches
start from the combinations that fit best, until no better minimum is found. If there is at least one full round of
starting points, basin hopping follows (Wales and Doye, Journal of Physical Chemistry A 101, 1997): searches start from
copies of the best minimum in which one or two coordinates are redrawn. A resonating slab causes repeated minima along
the coordinate of its material, and the effects of different materials are nearly independent. A lower minimum therefore
often differs in only a few coordinates.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from calibray.errors import InputError
from calibray.optimizers.arguments import Box, real, whole
from calibray.optimizers.descent import Starts, descend, distinct
from calibray.optimizers.evaluations import Archive, Evaluations, Objective, root_mean_square
from calibray.optimizers.protocol import Optimizer, Schedule, Search, Session
from calibray.optimizers.sampling import design
from calibray.support.messages import shortened

CATCH_UP = 100.0
"""A search is abandoned if its cost exceeds the lowest cost by more than this multiple of its predicted decrease."""

NEARER = 10.0
"""Value that replaces `CATCH_UP` for searches from combined minima, which start close to the minima that they reach."""

COMBINATIONS = 32
"""Maximum number of combinations of minima per round, which is also limited by the number of starting points.
"""

FOLLOWED = 0.2
"""Fraction of the combinations from which searches start; the combinations that fit best are chosen."""

PARENTS = 12
"""Number of minima that are combined, starting from the lowest."""

SPACE = 0.05
"""Smallest distance in the unit cube between a combination and a known minimum or another combination."""

ROUND = 64
"""Number of starting points per round."""

HOPS = 8
"""Ratio of the number of starting points to the number of searches in a round of basin hopping."""

PATIENCE = 6
"""Number of successive rounds without a lower minimum after which basin hopping ends. In 24 development problems that
use all starting points, 14 runs ended above the lowest known minimum with a patience of 0, nine with a patience of 3,
and two with a patience of 6.
"""

RETURNS = 10
"""Number of searches ending in the best minimum after which the method starts no more searches."""

LEVEL = 1e-4
"""Relative difference in mean square below which two minima, for example along a valley, fit equally well."""

NOISELESS = 1e-9
"""Fraction of the largest mean square that is added to the tolerance `LEVEL`, to allow for rounding errors in noiseless
problems."""

APART = 0.01
"""Distance in the unit cube below which two searches are considered to have ended in the same minimum."""


@final
class LeastSquares(Optimizer):
    """Multi-start Levenberg-Marquardt. The method uses residuals and Jacobians, and stops on its own, without a budget.

    Args:
        seed: Seed of basin hopping and of the scrambled Sobol points from which searches start.
        starts: Maximum number of Sobol points; powers of two cover the box most evenly. Each point costs about ten
            evaluations. If all points are used, combinations of the minima and basin hopping need about as many
            evaluations again. The best point passed to `tell` before the first `ask`, if any, is a further starting
            point.
        x0: Further starting points, [d] or [k, d].
        iterations: Maximum number of steps of each search.
        tolerance: A search has converged if its step in the unit cube, or the relative decrease in mean square that its
            model predicts, is at most this tolerance.
        catch_up: A search is abandoned if its cost exceeds the lowest cost by more than this multiple of its predicted
            decrease. Use a smaller multiple if some starting points are already minima and the other points serve only
            to check for a better minimum.

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
        self._budget = None
        self.starts = whole("starts", starts, at_least=1)
        self.iterations = whole("iterations", iterations, at_least=1)
        self.tolerance = real("tolerance", tolerance, at_least=0.0, at_most=1.0)
        self.catch_up = real("catch_up", catch_up, at_least=0.0)
        self.x0 = _user_starts(x0, self.box)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search, objective)

    def _search(self, archive: Archive) -> Search:
        box = self.box
        unit = box.to_unit(self.x0)
        if len(archive):
            unit = np.vstack([unit, box.to_unit(archive.best.x)])
        sobol = design("sobol", self.starts, box.dimension, self._rng)
        ended = None
        for first in range(0, self.starts, ROUND):
            unit = np.concatenate([unit, sobol[first : first + ROUND]])
            ended = yield from self._descended(unit, ended, self.catch_up)
            if returns(ended) >= RETURNS:
                break
            # The user's starting points and the best earlier point are used only in the first round.
            unit = unit[:0]
        if ended is not None and len(ended.cost):
            if returns(ended) < RETURNS:
                ended = yield from self._recombined(ended)
                ended = yield from self._hopped(ended)
            self._session.minima = box.from_unit(distinct(ended, APART).unit)

    def _recombined(self, ended: Starts) -> Generator[NDArray[np.float64], Evaluations, Starts]:
        number, before = min(COMBINATIONS, self.starts), np.inf
        followed = round(FOLLOWED * number)
        while followed and ended.cost.min() < before:
            # Only a minimum with a cost below this value counts as lower.
            before = ended.cost.min() - _slack(ended)
            unit = recombine(distinct(ended, SPACE).unit, number)
            if not len(unit):
                break
            ended = yield from self._descended(unit, ended, min(NEARER, self.catch_up), followed)
        return ended

    def _hopped(self, ended: Starts) -> Generator[NDArray[np.float64], Evaluations, Starts]:
        failures = 0
        while self.starts >= ROUND and failures < PATIENCE:
            best, before = ended.unit[ended.cost.argmin()], ended.cost.min() - _slack(ended)
            unit = hops(best, self.starts // HOPS, self._rng)
            ended = yield from self._descended(unit, ended, self.catch_up)
            failures = 0 if ended.cost.min() < before else failures + 1
        return ended

    def _descended(
        self, unit: NDArray[np.float64], earlier: Starts | None, catch_up: float, followed: int | None = None
    ) -> Generator[NDArray[np.float64], Evaluations, Starts]:
        descent = descend(unit, self.iterations, self.tolerance, catch_up, earlier, followed)
        try:
            unit = next(descent)
            while True:
                answers = yield self.box.from_unit(unit)
                failed = ~np.isfinite(answers.y)[:, None]
                # `descend` treats infinite residuals as a failed evaluation.
                residuals = np.where(failed, np.inf, answers.errors)
                unit = descent.send((residuals, answers.slopes * self.box.width))
        except StopIteration as end:
            return end.value


def returns(ended: Starts) -> int:
    """Number of searches that ended in the best minimum or an equally good minimum, including merged searches."""
    if not len(ended.cost):
        return 0
    return int(ended.searches[ended.cost <= ended.cost.min() + _slack(ended)].sum())


def recombine(minima: NDArray[np.float64], number: int) -> NDArray[np.float64]:
    """Combine minima [k, d], best first, into at most `number` points from which searches can reach other minima.

    The best minimum is shifted by the difference between two minima, or one of its coordinates is replaced by that of
    another minimum. Shifts help because a single cause, such as a resonating slab, repeats minima at equal distances,
    regardless of the other parameters. Shifts correspond to mutation in differential evolution (Storn and Price,
    Journal of Global Optimization 11, 1997), and exchanges correspond to crossover. Exchanges help if the effects of
    parameters are nearly independent, as for materials that rarely occur on the same path. Points within `SPACE` of a
    minimum are excluded. Shifts and exchanges alternate, starting with those of the lowest minima.
    """
    best, low, dimension = minima[0], minima[:PARENTS], minima.shape[1]
    target, source = np.nonzero(~np.eye(len(low), dtype=bool))
    # Pairs of the lowest minima come first.
    order = np.lexsort((target + source, np.maximum(target, source)))
    shifted = best + (low[target] - low[source])[order]
    # One coordinate of the best minimum is replaced by that of another minimum, for each coordinate and minimum in
    # turn.
    exchanged = np.where(np.eye(dimension, dtype=bool), low[1:, None], best).reshape(-1, dimension)
    new = [_new(points, minima) for points in (shifted, exchanged)]
    turn = np.argsort(np.concatenate([np.arange(len(points)) for points in new]), kind="stable")
    kept = np.empty((0, dimension))
    for point in np.concatenate(new)[turn]:
        if len(kept) >= number:
            break
        if (np.linalg.norm(kept - point, axis=1) > SPACE).all():
            kept = np.vstack([kept, point])
    return kept


def hops(best: NDArray[np.float64], number: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Copy a point [d] of the unit cube; in each copy [number, d], one or two coordinates are redrawn at random."""
    points = np.repeat(best[None], number, axis=0)
    for point in points:
        count = min(len(best), random.integers(1, 3))
        point[random.choice(len(best), count, replace=False)] = random.random(count)
    return points


def _new(points: NDArray[np.float64], minima: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points inside the unit cube that are farther than `SPACE` from every minimum."""
    inside = ((points >= 0.0) & (points <= 1.0)).all(axis=1)
    return points[inside & (cdist(points, minima) > SPACE).all(axis=1)]


def _slack(ended: Starts) -> float:
    """Difference in cost below which two minima fit equally well."""
    return float(LEVEL * ended.cost.min() + NOISELESS * ended.cost.max())


def _user_starts(x0: ArrayLike | None, box: Box) -> NDArray[np.float64]:
    if x0 is None:
        return np.empty((0, box.dimension))
    try:
        points = np.atleast_2d(np.array(x0, dtype=float))
    except (ValueError, TypeError):
        raise InputError(
            f"x0 = {shortened(repr(x0))}; it must contain one number for each parameter"
        ) from None
    if points.ndim != 2 or points.shape[1] != box.dimension:
        d = box.dimension
        raise InputError(f"x0 has shape {np.shape(x0)}; it must be [{d}] or [k, {d}]: reshape it")
    for row, column in np.argwhere(~((points >= box.lower) & (points <= box.upper))):
        raise InputError(
            f"x0[{row}, {column}] = {points[row, column]:g} lies outside its bounds "
            f"[{box.lower[column]:g}, {box.upper[column]:g}]; move the starting point or widen the bounds"
        )
    return points
