"""The vector surrogate: a model of every residual instead of their root mean square, searched globally.

The objective is a sum over links, and an evaluation that answers with every link's residual tells far more
than their sum. Residuals are smoother than the objective formed from them, and tens of them share one
dependence on the parameters (see `kriging.py` for the model).

A run begins with a maximin Latin hypercube: of few points where there are many parameters, since residuals can be
modelled as soon as a plane can be laid through them. Then three steps take turns on a model refitted after every batch:

- *exploration*: the point of the largest expected improvement of the mean square of the residuals, over
  draws from the model: R. Astudillo, P. Frazier, ICML 2019. A normal distribution of the mean square
  in its place (D. R. Jones, M. Schonlau, W. J. Welch, J. Global Optim. 13 (1998) 455, eq. 15) gives weight to
  values below the least that is possible, and wastes the step on the emptiest corner of many dimensions;
- *exploitation*: the lowest minimum of the predicted objective that has not been evaluated yet, found by
  many local searches with the model's exact derivatives;
- *another basin*: the lowest minimum of the predicted objective where the model is still uncertain, so that
  polishing one basin does not keep the search from the next.

Input scales are learned anew at every step until there are `OFTEN` points, and then whenever these have grown in
number by a tenth; in between the model only takes new points, which saves most of the time. Tried and not kept,
on analytic and traced districts: a square root or a logarithm of permittivities (`logarithmic` helped with
reflections and hurt with walls that waves pass through), a Matern kernel of smoothness 7/2, local searches begun
from the best of hundreds of predictions, exploration by a model of the objective wherever that foretells points that
are left out better (on resonating panes 0.018 dB after 120 calls instead of 0.004), an initial design of d + 2 or
d + 4 points for three parameters (it starts in another basin more often), and steps from the best points shortened as
uncertainty grows (a trust region, on eight parameters: most of the excess left is other minima, not unfinished
descents). A learned bend of every parameter, (exp(b x) - 1) / (exp(b) - 1), and a prior of the slopes of the trend
divide the errors of prediction near the optimum by 2.9 after 2 (d + 1) points and by 1.4 after 4 (d + 1), on ten
planted problems. With an initial design of d + 1 points, or d + 4 of up to four parameters, and descents in a trust
region before the steps take turns, this gave 0.041 instead of 0.075 dB after 15 calls and 0.0064 instead of 0.0133
after 30, medians of fifteen planted problems. It is not kept, because such a model is surer of itself and the search
stays in its basin: 0.028 instead of 0.000 dB after 225 calls in a district with six parameters.

In a batch every further candidate is chosen as if the earlier ones had come out as predicted. A failed
evaluation enters the model with the residuals of the worst successful one.
"""

from __future__ import annotations

from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist, pdist
from scipy.stats import spearmanr

from calibray.errors import InputError
from calibray.optimizers.arguments import real, whole
from calibray.optimizers.box import Box
from calibray.optimizers.descent import descend
from calibray.optimizers.evaluations import Archive, Objective, merged, root_mean_square
from calibray.optimizers.multifidelity.kriging import Kriging, Predictor, fit, solve
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.sampling import maximin_design
from calibray.optimizers.schedule import AS_GIVEN, Schedule
from calibray.optimizers.session import Search, Session

FIRST = 5
"""Points of the initial design beyond the number of parameters, at most."""

CANDIDATES = 600
"""Drawn over the box, and as many around the best points."""

DRAWS = 256
"""Of the residuals, for the expected improvement."""

OFTEN = 80
"""Points up to which input scales are learned anew at every step."""

REFIT = 1.1
"""Growth of the number of points after which they are beyond."""

SEARCHES = 16
"""Local searches on the model."""

SEPARATION = 1e-4
"""Of the unit cube, below which a point is taken for one already evaluated."""

UNCERTAIN = 1e-3
"""Of the prior variance: where a predicted minimum counts as another basin."""

PATIENCE = 4
"""Batches in a row that promise too little before the search stops."""


@final
class VectorSurrogate(Optimizer):
    """Surrogate of the residual vector. Uses residuals; 20 d evaluations unless told otherwise.

    Args:
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        seed: Seed of the one random generator.
        budget: Number of evaluations, 20 d if None.
        initial: Points of the initial design, the lesser of 2 (d + 1) and d + 5 if None; points told before the first
            `ask` count, those less than half of the design's spacing apart as one.
        batch: Candidates asked for at once after the initial design, for engines that run in parallel.
        logarithmic: Parameters that the model sees on a logarithmic scale, [d] or one for all.
        noisy: Whether the engine's answers scatter; the model then smooths instead of interpolating.
        tolerance: Stop before the budget is used when the predicted gain stays below this, in the unit of the
            residuals' root mean square; never if None.
        objective: The value that belongs to residuals [n, m], [n]; their root mean square unless told otherwise. It
            must rise with their mean square, which is what is minimised; both are checked.

    Raises:
        InputError: An argument is out of range.

    Example:
        >>> import numpy as np
        >>> opt = VectorSurrogate([0.0, 0.0], [9.0, 9.0], budget=20)
        >>> while not opt.done:
        ...     x = opt.ask()
        ...     r = np.sin(x) - 0.5 * x[:, ::-1]
        ...     opt.tell(x, np.sqrt(np.mean(r**2, axis=1)), residuals=r)
        >>> opt.evaluations, bool(opt.best.y < 1e-2)
        (20, True)
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
        budget: int | None = None,
        initial: int | None = None,
        batch: int = 1,
        logarithmic: ArrayLike = False,
        noisy: bool = False,
        tolerance: float | None = None,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        d = self.box.dimension
        self._budget = 20 * d if budget is None else whole("budget", budget, at_least=1)
        self.initial = (
            min(2 * (d + 1), d + FIRST) if initial is None else whole("initial", initial, at_least=d + 2)
        )
        self.batch = whole("batch", batch, at_least=1)
        self.noisy = noisy
        self.tolerance = None if tolerance is None else real("tolerance", tolerance, at_least=0.0)
        self._logarithmic = _flags(logarithmic, self.box)
        self._seen = Box.between(*(self._seen_by_model(x) for x in (self.box.lower, self.box.upper)))
        self._model: Kriging | None = None
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search, objective)

    @property
    def budget(self) -> int:
        """Largest number of evaluations it will ask for."""
        return self._budget

    @property
    def trust(self) -> float | None:
        """How well the model ranks points that are left out by their objective; None without a model.

        Spearman's rank correlation: 1 is perfect, 0 useless, and then more initial points are in order.
        """
        if self._model is None:
            return None
        y, predicted = (root_mean_square(r) for r in (self._model.residuals, self._model.left_out()))
        correlation: Any = spearmanr(y, predicted)
        return float(correlation.statistic)

    def _search(self, archive: Archive) -> Search:
        d, left, quiet, turn = self.box.dimension, self._budget, 0, 0
        missing = self._design(self._to_unit(archive.all().x) if len(archive) else np.empty((0, d)))[:left]
        if len(missing):
            yield self._from_unit(missing)
            left -= len(missing)
        while left > 0 and quiet < PATIENCE:
            count = min(self.batch, left)
            told = archive.all()
            unit, good = self._to_unit(told.x), np.isfinite(told.y)
            points, residuals = merged(unit, archive.imputed(told).errors)
            spanned = np.linalg.matrix_rank(points - points.mean(axis=0))
            if spanned < d or len(points) < d + 2 or good.sum() < 2:  # nothing to model yet
                chosen = self._rng.random((count, d))
            else:
                self._model = self._fitted(points, residuals)
                best_first = unit[np.argsort(told.y, kind="stable")]
                best = float(root_mean_square(archive.leading.errors)[0])
                chosen, gain = self._choose(self._model, best_first, best, turn, count)
                quiet = quiet + 1 if self.tolerance is not None and gain < self.tolerance else 0
            yield self._from_unit(chosen)
            left, turn = left - count, turn + count

    def _design(self, told: NDArray[np.float64]) -> NDArray[np.float64]:
        """The initial design [k, d], in which points told [n, d] that are not clumped stand for those next to them."""
        points = maximin_design(self.initial, self.box.dimension, self._rng)
        apart, counted = 0.5 * float(pdist(points).min()), told[:0]
        for point in told:
            clumped = len(counted) and _separation(point[None], counted)[0] < apart
            if len(points) and not clumped:
                counted = np.vstack([counted, point])
                points = np.delete(points, np.argmin(cdist(point[None], points)), axis=0)
        return points

    def _fitted(self, points: NDArray[np.float64], residuals: NDArray[np.float64]) -> Kriging:
        """A model of all points, on new scales if they have grown enough in number to tell better."""
        if self._model is None:
            self._learned = len(points)
            return fit(points, residuals, noisy=self.noisy)
        if len(points) <= OFTEN or len(points) >= REFIT * self._learned:
            self._learned = len(points)
            return fit(points, residuals, noisy=self.noisy, guess=self._model.hyper)
        return solve(points, residuals, self._model.hyper)

    def _choose(
        self, model: Kriging, taken: NDArray[np.float64], best: float, turn: int, count: int
    ) -> tuple[NDArray[np.float64], float]:
        """The next batch [count, d] and the gain it promises; `taken` are the points told, best first."""
        d = self.box.dimension
        starts = np.vstack([taken[: SEARCHES // 2], self._rng.random((SEARCHES, d))])[:SEARCHES]
        minima = predicted_minima(model, starts)
        chosen, gain = [], 0.0
        for place in range(turn, turn + count):
            fresh = minima[_separation(minima, taken) > SEPARATION]
            if place % 3 and len(fresh):
                mean, share = model.predict(fresh)
                # argmax of flags is the first uncertain minimum, or the lowest one if all are known well
                index = 0 if place % 3 == 1 else np.argmax(share > UNCERTAIN)
                x, promised = fresh[index], best - float(np.sqrt(np.mean(mean[index] ** 2)))
            else:
                x, promised = self._explored(model, taken, fresh, best)
            chosen.append(x)
            gain = max(gain, promised)
            if len(chosen) < count:
                model, taken = model.with_point(x), np.vstack([taken, x])
        return np.array(chosen), gain

    def _explored(
        self, model: Kriging, taken: NDArray[np.float64], fresh: NDArray[np.float64], best: float
    ) -> tuple[NDArray[np.float64], float]:
        """The point of the largest expected improvement [d], and the gain it promises."""
        d = self.box.dimension
        near = taken[self._rng.integers(0, min(5, len(taken)), CANDIDATES)]
        reach = 10.0 ** self._rng.uniform(-3.0, -0.5, (CANDIDATES, 1))
        around = np.clip(near + reach * self._rng.standard_normal((CANDIDATES, d)), 0.0, 1.0)
        candidates = np.vstack([self._rng.random((CANDIDATES, d)), around, fresh])
        candidates = candidates[_separation(candidates, taken) > SEPARATION]
        normal = self._rng.standard_normal((DRAWS, len(model.root)))
        gain = expected_improvement(model, candidates, best, normal)
        if not gain.any():  # less likely than one draw in all; so the point nearest to improving
            centre, spread = mean_square(model, candidates)
            return candidates[np.argmax((best**2 - centre) / np.maximum(spread, 1e-300))], 0.0
        return candidates[np.argmax(gain)], best - np.sqrt(max(best**2 - gain.max(), 0.0))

    def _seen_by_model(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(self._logarithmic, np.log(np.where(self._logarithmic, x, 1.0)), x)

    def _to_unit(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._seen.to_unit(self._seen_by_model(x))

    def _from_unit(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = self._seen.from_unit(unit)
        return self.box.clip(
            np.where(self._logarithmic, np.exp(np.where(self._logarithmic, seen, 0.0)), seen)
        )


def mean_square(model: Kriging, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The mean square Q of the residuals as the model sees it.

    With prediction r, prior covariance V of the residuals and the model's share s^2 of it, which grows with the
    distance from evaluated points, Q has mean (r^T r + s^2 tr V) / m and variance
    (4 s^2 r^T V r + 2 s^4 tr V^2) / m^2. Errors of different links are correlated: taking them for independent
    stops exploration too soon.

    Args:
        model: The model of the residuals.
        x: Points of the unit cube [k, d].

    Returns:
        Its expectation and its standard deviation [k].
    """
    mean, share = model.predict(x)
    root, links = model.root, model.root.shape[1]
    centre = np.mean(mean**2, axis=1) + share * np.sum(root**2) / links
    along = np.sum((mean @ root.T) ** 2, axis=1)  # r^T V r
    return centre, np.sqrt(4.0 * share * along + 2.0 * share**2 * np.sum((root @ root.T) ** 2)) / links


def expected_improvement(
    model: Predictor, x: NDArray[np.float64], best: float, normal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Expected decrease of the mean square of the residuals below the best one, by Monte Carlo.

    Args:
        model: The model of the residuals.
        x: Points of the unit cube [k, d].
        best: The root mean square of the best residuals so far.
        normal: Standard normal draws [draws, n - 1 - d], one column a row of the model's `root`.

    Returns:
        Expected improvement [k]; 0 where no draw improves.
    """
    return improvement(*model.predict(x), normal @ model.root, best)


def improvement(
    mean: NDArray[np.float64], share: NDArray[np.float64], scatter: NDArray[np.float64], best: float
) -> NDArray[np.float64]:
    """The same from what is predicted.

    Args:
        mean: Residuals at points [k, m].
        share: Their variance there, by the prior one [k].
        scatter: Draws of residuals with the prior covariance [draws, m].
        best: The root mean square of the best residuals so far.

    Returns:
        Expected improvement [k].
    """
    along, across = 2.0 * np.sqrt(share)[:, None] * (mean @ scatter.T), np.sum(scatter**2, axis=1)
    square = np.sum(mean**2, axis=1)[:, None] + along + share[:, None] * across
    return np.maximum(best**2 - square / mean.shape[1], 0.0).mean(axis=1)


def predicted_minima(model: Kriging, starts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Local minima of the predicted objective.

    Args:
        model: The model of the residuals.
        starts: Where to search from, in the unit cube [s, d].

    Returns:
        The minima found, lowest first [k, d].
    """
    descent = descend(starts, iterations=30, tolerance=1e-8)
    x = next(descent)
    while True:
        try:
            x = descent.send(model.mean_and_slope(x))
        except StopIteration as end:
            return end.value.unit[np.argsort(end.value.cost, kind="stable")]


def _separation(x: NDArray[np.float64], taken: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each point to the nearest one taken."""
    return cdist(x, taken).min(axis=1)


def _flags(value: ArrayLike, box: Box) -> NDArray[np.bool_]:
    flags = np.array(value)
    if flags.dtype != bool or flags.shape not in ((), (box.dimension,)):
        raise InputError(
            f"logarithmic = {value!r}; it must be True, False, or one of them for each parameter"
        )
    flags = np.broadcast_to(flags, box.dimension)
    for index in np.flatnonzero(flags & (box.lower <= 0.0)):
        raise InputError(
            f"lower[{index}] = {box.lower[index]:g} of a logarithmic parameter; raise it above 0 or scale linearly"
        )
    return flags
