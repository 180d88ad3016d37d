"""Multi-start least squares with exact derivatives: projected Levenberg-Marquardt on all starts at once.

Local searches are cheap where derivatives come with the residuals, and a batch of candidates costs little
more than one; so many starts run side by side, and each `ask` holds the next trial point of every start
that is still moving. RMSE over permittivities is multimodal (slab resonances), which is why one start is
not enough. A search is given up when it nears a better one, or lies so far behind the best that it can
hardly catch up.

The step of a start minimises the damped quadratic model g.p + p.(H + mu I) p / 2 with H = J^T J and g =
J^T r, in coordinates scaled to the unit cube, subject to the box: components that would leave it are set
on the face one group after the other and the rest is solved again. The damping mu follows the gain ratio
after H. B. Nielsen (Damping Parameter in Marquardt's Method, IMM-REP-1999-05, Technical University of
Denmark).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.archive import Archive, Evaluations
from calibray.optimizers.arguments import real, whole
from calibray.optimizers.box import Box
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.sampling import design
from calibray.optimizers.session import Search, Session

INITIAL_DAMPING = 1e-3  # of the largest diagonal element of H
CATCH_UP = 100.0  # predicted decreases that a search may lie behind the best one before it is given up
MERGE_DISTANCE = 1e-3  # of the unit cube, below which two starts are taken to approach the same minimum


@dataclass(frozen=True)
class Starts:
    """Local searches in progress, with the quadratic model of each.

    Attributes:
        unit: Where they stand, in the unit cube [s, d].
        cost: Half the mean square of the residuals there [s].
        gradient: Its gradient g [s, d].
        curvature: Its Gauss-Newton matrix H [s, d, d].
        damping: mu [s].
        growth: Factor on the damping at the next rejection [s].
    """

    unit: NDArray[np.float64]
    cost: NDArray[np.float64]
    gradient: NDArray[np.float64]
    curvature: NDArray[np.float64]
    damping: NDArray[np.float64]
    growth: NDArray[np.float64]

    def rows(self, keep: NDArray[np.bool_]) -> Starts:
        """The searches that go on.

        Args:
            keep: Which of them [s].

        Returns:
            Those searches.
        """
        return Starts(*(getattr(self, field.name)[keep] for field in fields(self)))


def begin(unit: NDArray[np.float64], told: Evaluations, width: NDArray[np.float64]) -> Starts:
    """Form the models at evaluated points.

    Args:
        unit: The points in the unit cube [s, d].
        told: Their evaluations, with residuals and Jacobians.
        width: Width of the box [d].

    Returns:
        The searches; one whose evaluation failed has infinite cost.
    """
    failed = ~np.isfinite(told.y)
    r = np.where(failed[:, None], 0.0, told.residuals)
    j = np.where(failed[:, None, None], 0.0, told.jacobian) * width
    links = r.shape[1]
    curvature = np.einsum("smi,smj->sij", j, j) / links
    largest = np.diagonal(curvature, axis1=1, axis2=2).max(axis=1)
    return Starts(
        unit=unit,
        cost=np.where(failed, np.inf, 0.5 * np.mean(r**2, axis=1)),
        gradient=np.einsum("smi,sm->si", j, r) / links,
        curvature=curvature,
        damping=INITIAL_DAMPING * np.where(largest > 0.0, largest, 1.0),
        growth=np.full(len(unit), 2.0),
    )


def damped_steps(starts: Starts) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The step of every search inside the box, and the decrease of cost that its model predicts.

    Args:
        starts: The searches.

    Returns:
        Steps in the unit cube [s, d] and predicted decreases [s].
    """
    count, dimension = starts.unit.shape
    damped = starts.curvature + starts.damping[:, None, None] * np.eye(dimension)
    low, high = -starts.unit, 1.0 - starts.unit
    step = np.zeros((count, dimension))
    free = np.ones((count, dimension), dtype=bool)
    for _ in range(dimension + 1):
        # Fixed components keep their displacement: their rows become the identity.
        matrix = np.where(free[:, :, None] & free[:, None, :], damped, np.eye(dimension))
        fixed = np.where(free, 0.0, step)
        side = np.where(free, -starts.gradient - np.einsum("sij,sj->si", damped, fixed), fixed)
        step = np.linalg.solve(matrix, side[:, :, None])[:, :, 0]
        outside = free & ((step < low) | (step > high))
        step = np.clip(step, low, high)
        if not outside.any():
            break
        free &= ~outside
    # Fixing groups of components is a heuristic; the projected gradient step is a floor that always descends.
    bound = np.trace(damped, axis1=1, axis2=2)[:, None]
    gradient_step = np.clip(-starts.gradient / bound, low, high)
    better = _decrease(starts, gradient_step) > _decrease(starts, step)
    step = np.where(better[:, None], gradient_step, step)
    return step, _decrease(starts, step)


def _decrease(starts: Starts, step: NDArray[np.float64]) -> NDArray[np.float64]:
    slope = np.einsum("si,si->s", starts.gradient, step)
    return -slope - 0.5 * np.einsum("si,sij,sj->s", step, starts.curvature, step)


def advance(starts: Starts, trial: Starts, predicted: NDArray[np.float64]) -> Starts:
    """Accept or reject the trial points.

    Args:
        starts: The searches before the step.
        trial: The models at their trial points.
        predicted: Decrease of cost that was predicted [s].

    Returns:
        The searches after it, with their new damping.
    """
    ratio = (starts.cost - trial.cost) / predicted
    better = ratio > 1e-4
    gain = np.where(better, ratio, 0.0)
    shrink = np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)  # Nielsen 1999, eq. 2.3
    damping = starts.damping * np.where(better, shrink, starts.growth)
    growth = np.where(better, 2.0, 2.0 * starts.growth)

    def chosen(name: str) -> NDArray[np.float64]:
        new, old = getattr(trial, name), getattr(starts, name)
        return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return Starts(*(chosen(name) for name in ("unit", "cost", "gradient", "curvature")), damping, growth)


def redundant(starts: Starts, settled: Starts) -> NDArray[np.bool_]:
    """Which searches come close to a better one, and would only find the same minimum.

    Args:
        starts: The searches that move.
        settled: Those that have converged.

    Returns:
        True for each moving search that can be dropped [s].
    """
    unit = np.concatenate([settled.unit, starts.unit])
    rank = np.lexsort((np.arange(len(unit)), np.concatenate([settled.cost, starts.cost]))).argsort()
    distance = np.linalg.norm(starts.unit[:, None] - unit[None], axis=-1)
    return ((distance < MERGE_DISTANCE) & (rank[None] < rank[len(settled.unit) :, None])).any(axis=1)


@final
class LeastSquares(Optimizer):
    """Multi-start Levenberg-Marquardt. Uses residuals and Jacobian; no budget, for it stops by itself.

    Args:
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        seed: Seed of the scrambled Sobol points that the searches start from.
        starts: Number of those points; powers of two are spread best. Each costs about ten evaluations.
            The best point told before the first `ask`, if any, is a further start.
        x0: Further starting points of the user's, [d] or [k, d].
        iterations: Largest number of steps of each search.
        tolerance: A search has converged when its model predicts less than this relative decrease of the mean
            square, or a step shorter than this in the unit cube.

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
    ) -> None:
        self.box = Box.between(lower, upper)
        self.starts = whole("starts", starts, at_least=1)
        self.iterations = whole("iterations", iterations, at_least=1)
        self.tolerance = real("tolerance", tolerance, at_least=0.0, at_most=1.0)
        self.x0 = _user_starts(x0, self.box)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    @property
    def budget(self) -> None:
        """None: it stops when every search has converged."""
        return

    def _search(self, archive: Archive) -> Search:
        box = self.box
        told_best = [box.to_unit(archive.best.x[None])] if len(archive) else []
        sobol = design("sobol", self.starts, box.dimension, self._rng)
        unit = np.concatenate([box.to_unit(self.x0), *told_best, sobol])
        starts = begin(unit, (yield box.from_unit(unit)), box.width)
        starts = starts.rows(np.isfinite(starts.cost))
        settled = starts.rows(np.zeros(len(starts.cost), dtype=bool))
        for _ in range(self.iterations):
            step, predicted = damped_steps(starts)
            still = (predicted <= self.tolerance * starts.cost) | (np.abs(step).max(axis=1) <= self.tolerance)
            settled = _joined(settled, starts.rows(still))
            lowest = min(starts.cost.min(initial=np.inf), settled.cost.min(initial=np.inf))
            hopeless = starts.cost - CATCH_UP * predicted > lowest
            moving = ~still & ~hopeless & ~redundant(starts, settled)
            starts, step, predicted = starts.rows(moving), step[moving], predicted[moving]
            if not moving.any():
                return
            unit = np.clip(starts.unit + step, 0.0, 1.0)
            starts = advance(starts, begin(unit, (yield box.from_unit(unit)), box.width), predicted)


def _user_starts(x0: ArrayLike | None, box: Box) -> NDArray[np.float64]:
    points = np.atleast_2d(np.array(x0 if x0 is not None else np.empty((0, box.dimension)), dtype=float))
    if points.ndim != 2 or points.shape[1] != box.dimension:
        d = box.dimension
        raise InputError(f"x0 has shape {np.shape(x0)}; it must be [{d}] or [k, {d}]: reshape it")
    for row, column in np.argwhere(~((points >= box.lower) & (points <= box.upper))):
        raise InputError(
            f"x0[{row}, {column}] = {points[row, column]:g} lies outside its bounds "
            f"[{box.lower[column]:g}, {box.upper[column]:g}]; move the start or widen the bounds"
        )
    return points


def _joined(first: Starts, second: Starts) -> Starts:
    return replace(
        first,
        **{f.name: np.concatenate([getattr(first, f.name), getattr(second, f.name)]) for f in fields(first)},
    )
