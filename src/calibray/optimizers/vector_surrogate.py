"""The vector surrogate models every residual instead of the root mean square, and searches this model globally.

The objective is a sum over links. An evaluation that returns the residual of every link therefore contains far more
information than the objective alone. Residuals are smoother than the objective, and tens of residuals share a single
kernel over the parameters (`regression.py`).

A run begins with a maximin Latin hypercube. Even for many parameters, this design needs few points, because residuals
can be modelled as soon as the points determine a linear trend. Three kinds of steps then alternate, and the model is
updated after every batch:

- *Exploration*: the point with the largest expected improvement in the mean square of the residuals, computed from
  draws of the residuals (R. Astudillo, P. Frazier, ICML 2019). A normal distribution of the mean square (D. R. Jones,
  M. Schonlau, W. J. Welch, J. Global Optim. 13 (1998) 455, eq. 15) would give weight to impossibly low values and, in
  many dimensions, waste steps on the least explored corners of the box.
- *Exploitation*: the lowest minimum of the predicted objective that has not been evaluated yet, found by many local
  searches with exact derivatives of the model.
- *Another basin*: the lowest minimum of the predicted objective where the model is still uncertain, so that the
  refinement of one basin does not prevent the exploration of others.

Input scales are estimated at every step until there are `OFTEN` points, and afterwards whenever the number of points
has grown by a tenth. Between these estimates, the model receives new points but keeps its scales, which saves most of
the computing time.

In a batch, each candidate after the first is chosen as if the answers to the previous candidates had equalled the
predictions. In the model, a failed evaluation is assigned the residuals of the worst successful evaluation.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist, pdist

from calibray.optimizers.arguments import Box, whole
from calibray.optimizers.descent import descend_all
from calibray.optimizers.evaluations import Archive, Objective, merge_repeated, root_mean_square
from calibray.optimizers.protocol import Optimizer, Search, Session
from calibray.optimizers.regression import Kriging, fit, solve
from calibray.optimizers.sampling import (
    SEPARATION,
    distance_to_nearest,
    draw_around,
    maximin_design,
    not_evaluated,
)

FIRST = 5
"""Maximum number of points by which the initial design exceeds the number of parameters."""

CANDIDATES = 600
"""Number of candidates drawn over the whole box, and also the number drawn around the best points."""

DRAWS = 256
"""Number of draws of the residuals for the expected improvement."""

OFTEN = 80
"""Number of points up to which input scales are estimated at every step."""

REFIT = 1.1
"""Factor by which the number of points must grow before input scales are estimated again."""

SEARCHES = 16
"""Number of local searches on the model."""

UNCERTAIN = 1e-3
"""A predicted minimum counts as another basin if the predictive variance there exceeds this fraction of the prior
variance."""


@final
class VectorSurrogate(Optimizer):
    """Surrogate of the residual vector. The method uses residuals and takes 20 d evaluations by default.

    Args:
        budget: Number of evaluations; 20 d if None.
        initial: Size of the initial design; if None, the smaller of 2 (d + 1) and d + 5. Points already passed to
            `tell` count towards this size, but points closer together than half the spacing of the design count as one
            point.
        batch: Number of candidates per batch after the initial design, for engines that run in parallel.
        noisy: Whether the engine's answers are noisy. If so, the model smooths the answers instead of interpolating
            them.

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

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int | None = None,
        initial: int | None = None,
        batch: int = 1,
        noisy: bool = False,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        d = self.box.dimension
        self._budget = 20 * d if budget is None else whole("budget", budget, at_least=1)
        default = min(2 * (d + 1), d + FIRST)
        self.initial = default if initial is None else whole("initial", initial, at_least=d + 2)
        self.batch = whole("batch", batch, at_least=1)
        self.noisy = noisy
        self._model: Kriging | None = None
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search, objective)

    def _search(self, archive: Archive) -> Search:
        box, left, turn = self.box, self._budget, 0
        d = box.dimension
        missing = self._design(box.to_unit(archive.all().x) if len(archive) else np.empty((0, d)))[:left]
        if len(missing):
            yield box.from_unit(missing)
            left -= len(missing)
        while left > 0:
            count = min(self.batch, left)
            evaluated = archive.all()
            unit, good = box.to_unit(evaluated.x), np.isfinite(evaluated.y)
            points, residuals = merge_repeated(unit, archive.imputed(evaluated).errors)
            spanned = np.linalg.matrix_rank(points - points.mean(axis=0))
            if spanned < d or len(points) < d + 2 or good.sum() < 2:  # too few points for a model
                chosen = self._rng.random((count, d))
            else:
                self._model = self._fitted(points, residuals)
                best_first = unit[np.argsort(evaluated.y, kind="stable")]
                chosen = self._choose(self._model, best_first, archive.lowest, turn, count)
            yield box.from_unit(chosen)
            left, turn = left - count, turn + count

    def _design(self, earlier: NDArray[np.float64]) -> NDArray[np.float64]:
        """The initial design [k, d] without the points that are replaced by previous evaluations [n, d]."""
        points = maximin_design(self.initial, self.box.dimension, self._rng)
        spacing, counted = 0.5 * float(pdist(points).min()), earlier[:0]
        for point in earlier:
            # An evaluated point replaces the nearest point of the design, unless it is close to a point already
            # counted.
            clumped = len(counted) and distance_to_nearest(point[None], counted)[0] < spacing
            if len(points) and not clumped:
                counted = np.vstack([counted, point])
                points = np.delete(points, np.argmin(cdist(point[None], points)), axis=0)
        return points

    def _fitted(self, points: NDArray[np.float64], residuals: NDArray[np.float64]) -> Kriging:
        """Fit a model to all points; estimate the scales again if the number of points has grown enough."""
        if self._model is None:
            self._learned = len(points)
            return fit(points, residuals, noisy=self.noisy)
        kernel = self._model.process.kernel
        if len(points) <= OFTEN or len(points) >= REFIT * self._learned:
            self._learned = len(points)
            return fit(points, residuals, noisy=self.noisy, guess=kernel)
        return solve(points, residuals, kernel)

    def _choose(
        self, model: Kriging, taken: NDArray[np.float64], best: float, turn: int, count: int
    ) -> NDArray[np.float64]:
        """The next batch [count, d]; `taken` contains the evaluated points, best first."""
        d = self.box.dimension
        starts = np.vstack([taken[: SEARCHES // 2], self._rng.random((SEARCHES, d))])[:SEARCHES]
        minima = predicted_minima(model, starts)
        chosen = []
        for step in range(turn, turn + count):
            fresh = minima[distance_to_nearest(minima, taken) > SEPARATION]
            # The steps alternate: exploration, the lowest minimum, another basin.
            if step % 3 and len(fresh):
                _, share = model.predict(fresh)
                # argmax of the mask is the first uncertain minimum, or the lowest minimum if none is uncertain
                index = 0 if step % 3 == 1 else np.argmax(share > UNCERTAIN)
                x = fresh[index]
            else:
                x = self._explore(model, taken, fresh, best)
            chosen.append(x)
            if len(chosen) < count:
                model, taken = model.with_point(x), np.vstack([taken, x])
        return np.array(chosen)

    def _explore(
        self, model: Kriging, taken: NDArray[np.float64], fresh: NDArray[np.float64], best: float
    ) -> NDArray[np.float64]:
        """The point [d] with the largest expected improvement."""
        around = draw_around(taken[:5], CANDIDATES, -3.0, self._rng)
        candidates = np.vstack([self._rng.random((CANDIDATES, self.box.dimension)), around, fresh])
        candidates = not_evaluated(candidates, taken, SEPARATION)
        # Multiplied by `root`, these draws have the covariance between residuals.
        normal = self._rng.standard_normal((DRAWS, len(model.root)))
        mean, share = model.predict(candidates)
        gain = improvement(mean, share, normal @ model.root, best)
        if not gain.any():  # if no draw is an improvement, take the point closest to an improvement
            centre, spread = mean_square(model, candidates)
            return candidates[np.argmax((best**2 - centre) / np.maximum(spread, 1e-300))]
        return candidates[np.argmax(gain)]


def mean_square(model: Kriging, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Expectation and standard deviation [k] of the mean square Q of the residuals at points [k, d].

    Let r be the prediction and s^2 V the predictive covariance. V is the prior covariance between residuals, and s^2
    increases with the distance from evaluated points. Q then has the mean (r^T r + s^2 tr V) / m and the variance (4
    s^2 r^T V r + 2 s^4 tr V^2) / m^2. Errors of different links are correlated; if they were treated as independent,
    exploration would stop too early.
    """
    mean, share = model.predict(x)
    root, links = model.root, model.root.shape[1]
    centre = np.mean(mean**2, axis=1) + share * np.sum(root**2) / links
    along = np.sum((mean @ root.T) ** 2, axis=1)  # r^T V r
    return centre, np.sqrt(4.0 * share * along + 2.0 * share**2 * np.sum((root @ root.T) ** 2)) / links


def improvement(
    mean: NDArray[np.float64], share: NDArray[np.float64], draws: NDArray[np.float64], best: float
) -> NDArray[np.float64]:
    """Expected improvement [k] in the mean square of the residuals over the best value, by Monte Carlo.

    `mean` contains the predictions [k, m], `share` contains their variances relative to the prior variances [k], and
    `draws` contains random vectors with the prior covariance [n, m]. The result is 0 if no draw is an improvement.
    `best` is the lowest root mean square so far.
    """
    # |r + s v|^2 = r.r + 2 s r.v + s^2 v.v for prediction r and draw v.
    along, across = 2.0 * np.sqrt(share)[:, None] * (mean @ draws.T), np.sum(draws**2, axis=1)
    square = np.sum(mean**2, axis=1)[:, None] + along + share[:, None] * across
    return np.maximum(best**2 - square / mean.shape[1], 0.0).mean(axis=1)


def predicted_minima(model: Kriging, starts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find local minima [k, d] of the predicted objective, lowest first, by searches from starting points [s, d]."""
    ends = descend_all(starts, model.mean_and_slope, 30, 1e-8)
    return ends.unit[np.argsort(ends.cost, kind="stable")]
