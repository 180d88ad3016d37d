"""Projected Levenberg-Marquardt from many starting points in parallel, for least-squares problems in the unit cube.

A step p minimizes the damped quadratic model g.p + p.(H + mu I) p / 2 within the cube, where g is J^T r and H is J^T J,
both divided by the number of residuals. Components that would leave the cube are fixed at its faces. The system is
solved again for the other components until no component leaves the cube. The damping mu is updated from the gain ratio
as in H. B. Nielsen (Damping Parameter in Marquardt's Method, IMM-REP-1999-05, Technical University of Denmark).

`descend` is a generator, so the caller decides how points are evaluated. `least_squares.py` calls the engine, and
`descend_all` calls a model.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

INITIAL_DAMPING = 1e-3
"""Initial mu, as a fraction of the largest diagonal element of H."""

MERGE_DISTANCE = 1e-3
"""Distance in the unit cube below which two searches are assumed to converge to the same minimum."""

Residuals = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Residuals [s, m] and their Jacobian with respect to unit-cube coordinates [s, m, d]. A row with a non-finite residual
indicates a failed evaluation.
"""


@dataclass(frozen=True)
class Starts:
    """Local searches in progress, with the quadratic model of each search.

    Attributes:
        unit: Current points in the unit cube [s, d].
        cost: Half the mean square of the residuals at these points [s].
        gradient: Gradient g of the cost [s, d].
        curvature: Gauss-Newton matrix H of the cost [s, d, d].
        damping: Damping mu [s].
        growth: Factor by which the next rejection increases the damping [s].
        searches: Number of searches [s] that each search represents: itself and those merged into it.
    """

    unit: NDArray[np.float64]
    cost: NDArray[np.float64]
    gradient: NDArray[np.float64]
    curvature: NDArray[np.float64]
    damping: NDArray[np.float64]
    growth: NDArray[np.float64]
    searches: NDArray[np.int64]

    def rows(self, keep: NDArray[np.bool_]) -> Starts:
        """The searches for which `keep` [s] is True."""
        return Starts(*(getattr(self, field.name)[keep] for field in fields(self)))


def begin(unit: NDArray[np.float64], evaluated: Residuals) -> Starts:
    """Form the quadratic models at evaluated points [s, d] in the unit cube. A failed evaluation has infinite cost."""
    r, j = evaluated
    failed = np.asarray(~np.isfinite(r).all(axis=1))
    r, j = np.where(failed[:, None], 0.0, r), np.where(failed[:, None, None], 0.0, j)
    links = r.shape[1]
    # The cost is half the mean square, so its derivatives are also means over the residuals.
    curvature = np.einsum("smi,smj->sij", j, j) / links
    largest = np.diagonal(curvature, axis1=1, axis2=2).max(axis=1)
    return Starts(
        unit=unit,
        cost=np.where(failed, np.inf, 0.5 * np.mean(r**2, axis=1)),
        gradient=np.einsum("smi,sm->si", j, r) / links,
        curvature=curvature,
        damping=INITIAL_DAMPING * np.where(largest > 0.0, largest, 1.0),
        growth=np.full(len(unit), 2.0),
        searches=np.ones(len(unit), dtype=np.int64),
    )


def damped_steps(starts: Starts) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute steps [s, d] that stay inside the unit cube, and the decreases in cost that the models predict [s]."""
    count, dimension = starts.unit.shape
    # The lower limit keeps the matrix non-singular if two parameters have the same effect and the damping is
    # negligible.
    floor = 1e-13 * np.trace(starts.curvature, axis1=1, axis2=2)
    damping = np.maximum(starts.damping, floor)
    damped = starts.curvature + damping[:, None, None] * np.eye(dimension)
    low, high = -starts.unit, 1.0 - starts.unit
    step = np.zeros((count, dimension))
    free = np.ones((count, dimension), dtype=bool)
    for _ in range(dimension + 1):
        # Fixed components keep their displacement, so their rows become rows of the identity.
        matrix = np.where(free[:, :, None] & free[:, None, :], damped, np.eye(dimension))
        fixed = np.where(free, 0.0, step)
        side = np.where(free, -starts.gradient - np.einsum("sij,sj->si", damped, fixed), fixed)
        step = np.linalg.solve(matrix, side[:, :, None])[:, :, 0]
        outside = free & ((step < low) | (step > high))
        step = np.clip(step, low, high)
        if not outside.any():
            break
        free &= ~outside
    # Fixing groups of components is a heuristic, so a projected gradient step is the fallback. This step always
    # decreases the cost of the model, because the trace is at least the largest curvature in any direction.
    bound = np.trace(damped, axis1=1, axis2=2)[:, None]
    gradient_step = np.clip(-starts.gradient / bound, low, high)
    better = _decrease(starts, gradient_step) > _decrease(starts, step)
    step = np.where(better[:, None], gradient_step, step)
    return step, _decrease(starts, step)


def _decrease(starts: Starts, step: NDArray[np.float64]) -> NDArray[np.float64]:
    slope = np.einsum("si,si->s", starts.gradient, step)
    return -slope - 0.5 * np.einsum("si,sij,sj->s", step, starts.curvature, step)


def advance(starts: Starts, trial: Starts, predicted: NDArray[np.float64]) -> Starts:
    """Accept or reject trial points by comparing actual and predicted decreases in cost [s]; update the damping."""
    # A failed trial has an infinite cost, so its ratio is minus infinity.
    ratio = (starts.cost - trial.cost) / predicted
    better = ratio > 1e-4
    gain = np.where(better, ratio, 0.0)
    shrink = np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)  # Nielsen 1999, eq. 2.3
    damping = starts.damping * np.where(better, shrink, starts.growth)
    growth = np.where(better, 2.0, 2.0 * starts.growth)

    def chosen(name: str) -> NDArray[np.float64]:
        new, old = getattr(trial, name), getattr(starts, name)
        return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    unit, cost, gradient, curvature = (chosen(name) for name in ("unit", "cost", "gradient", "curvature"))
    return Starts(unit, cost, gradient, curvature, damping, growth, starts.searches)


def merge(starts: Starts, settled: Starts) -> tuple[Starts, Starts, NDArray[np.bool_]]:
    """Merge each search that is close to a better search into that search, because both would reach the same minimum.

    Returns the moving searches, the settled searches, and a mask of the moving searches that can be dropped [s]. The
    counts in `searches` include the merged searches.
    """
    number, cost = len(settled.cost), np.concatenate([settled.cost, starts.cost])
    # Ties are broken by index, so of any two searches exactly one is better.
    rank = np.lexsort((np.arange(len(cost)), cost)).argsort()
    distance = cdist(starts.unit, np.concatenate([settled.unit, starts.unit]))
    near = (distance < MERGE_DISTANCE) & (rank[None] < rank[number:, None])
    merged = np.asarray(near.any(axis=1))
    searches = np.concatenate([settled.searches, starts.searches])
    target = np.where(near, distance, np.inf).argmin(axis=1) if merged.any() else rank[:0]
    for row in sorted(np.flatnonzero(merged), key=lambda row: -rank[number + row]):  # the worst first
        searches[target[row]] += searches[number + row]
    return replace(starts, searches=searches[number:]), replace(settled, searches=searches[:number]), merged


def descend(
    unit: NDArray[np.float64],
    iterations: int,
    tolerance: float,
    catch_up: float = 1e30,
    earlier: Starts | None = None,
    followed: int | None = None,
) -> Generator[NDArray[np.float64], Residuals, Starts]:
    """Search from all points [s, d] until each search has converged, been merged into a better one, or been abandoned.

    Each search takes at most `iterations` steps. A search has converged if its step, or the relative decrease in cost
    that its model predicts, is at most `tolerance`. A search is abandoned if its cost exceeds the lowest cost by more
    than `catch_up` times its predicted decrease. A search that comes close to the final point of a better search in
    `earlier` is merged into the better search. Only the `followed` starting points with the lowest costs are used, or
    all points if `followed` is None. The generator yields points to evaluate [s, d]. It returns the earlier searches,
    then the searches that converged or were still moving at the end, and then the abandoned searches.
    """
    starts = begin(unit, (yield unit))
    # Searches do not start at failed evaluations.
    starts = starts.rows(np.isfinite(starts.cost))
    if followed is not None:
        starts = starts.rows(starts.cost.argsort(kind="stable").argsort() < followed)
    behind = starts.rows(np.zeros(len(starts.cost), dtype=bool))
    settled = behind if earlier is None else earlier
    for _ in range(iterations):
        step, predicted = damped_steps(starts)
        converged = (predicted <= tolerance * starts.cost) | (np.abs(step).max(axis=1) <= tolerance)
        settled = joined(settled, starts.rows(converged))
        starts, step, predicted = starts.rows(~converged), step[~converged], predicted[~converged]
        lowest = min(starts.cost.min(initial=np.inf), settled.cost.min(initial=np.inf))
        hopeless = starts.cost - catch_up * predicted > lowest
        starts, settled, merged = merge(starts, settled)
        behind = joined(behind, starts.rows(hopeless & ~merged))
        moving = ~hopeless & ~merged
        starts, step, predicted = starts.rows(moving), step[moving], predicted[moving]
        if not moving.any():
            break
        unit = np.clip(starts.unit + step, 0.0, 1.0)
        starts = advance(starts, begin(unit, (yield unit)), predicted)
    return joined(joined(settled, starts), behind)


def descend_all(
    unit: NDArray[np.float64],
    evaluate: Callable[[NDArray[np.float64]], Residuals],
    iterations: int,
    tolerance: float,
) -> Starts:
    """Search from `unit` [s, d] on a model that returns residuals and their Jacobian; return the final searches."""
    descent = descend(unit, iterations, tolerance)
    points = next(descent)
    while True:
        try:
            points = descent.send(evaluate(points))
        except StopIteration as end:
            return end.value


def distinct(starts: Starts, separation: float) -> Starts:
    """Keep only the best of any searches that ended within `separation` of each other; the result is sorted by cost."""
    order = np.argsort(starts.cost, kind="stable")
    near = cdist(starts.unit[order], starts.unit[order]) < separation
    kept = np.zeros(len(order), dtype=bool)
    for row in range(len(order)):
        kept[row] = not (near[row] & kept).any()
    return Starts(*(getattr(starts, field.name)[order[kept]] for field in fields(Starts)))


def joined(first: Starts, second: Starts) -> Starts:
    """Concatenate searches."""
    names = [field.name for field in fields(Starts)]
    return Starts(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))
