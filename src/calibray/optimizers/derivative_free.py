"""Derivative-free least squares: POUNDERS, and Gauss-Newton with finite differences.

Both are local methods. The first search starts in the middle of the box, or at the best point already passed to `tell`.
If a search converges before the budget is used up, the next search starts at a random point.

POUNDERS: S. M. Wild, "Solving Derivative-Free Nonlinear Least Squares Problems with POUNDERS", in Advances and Trends
in Optimization with Engineering Applications, SIAM (2017), ch. 40. POUNDERS is implemented here because the authors'
package IBCDFO depends on a solver (MINQ) that no package index offers. Each residual is modelled by the quadratic of
least curvature that interpolates the residual at evaluated points near the best point. The sum of the squared models is
expanded to second order and minimized in a box-shaped trust region. Points near the best point that span all directions
are chosen first, because they make the models fully linear. If a step fails while a direction is missing, a point along
this direction is evaluated before the region shrinks.

Gauss-Newton is the usual choice if a least-squares solver is available but derivatives are not. At every accepted
point, one further evaluation per parameter is required; these evaluations form one batch. `descent.py` computes the
steps.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import ClassVar, Final, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from calibray.optimizers.arguments import Box, real, whole
from calibray.optimizers.descent import descend
from calibray.optimizers.evaluations import Archive, Evaluations, Objective, root_mean_square
from calibray.optimizers.protocol import Optimizer, Search, Session, first_start, limited

SPANNING: Final = (1.75, 10.0)
"""Maximum distances of spanning points, for a fully linear model and for any model, in units of radius x sqrt(d)."""

NEW_DIRECTION: Final = 1e-3
"""Smallest component of a spanning point along a new direction, divided by max(distance, radius) (theta_1)."""

INDEPENDENT: Final = 1e-3
"""Smallest pivot (see `_pivot`) for which a further point is included in the model (theta_2)."""

ACCEPTED: Final = 0.05
"""Minimum fraction of the predicted decrease that a successful step achieves; after a successful step, the region does
not shrink."""

LARGEST: Final = 0.5
"""Maximum trust-region radius, as a fraction of the box width."""


@final
class POUNDERS(Optimizer):
    """Derivative-free least squares with quadratic models. The method uses residuals and spends the whole budget.

    Args:
        seed: Seed of the random points at which searches restart.
        budget: Number of evaluations.
        radius: Initial trust-region radius, as a fraction of the box width.
        tolerance: Trust-region radius at which a search has converged, as a fraction of the box width.

    Raises:
        InputError: An argument is out of range.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value", "residuals"})

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
        self.radius = real("radius", radius, at_least=1e-6, at_most=LARGEST)
        self.tolerance = real("tolerance", tolerance, at_least=1e-12, at_most=self.radius)
        search = _searches(_descend, seed, self._budget, self.radius, self.tolerance)
        self._session = Session(self.box, self.uses, search, objective)


def _searches(
    local: Callable[..., Search], seed: int, budget: int, *settings: float
) -> Callable[[Archive], Search]:
    """Return a function that runs local searches from successive starting points until the budget is used up."""
    rng = np.random.default_rng(whole("seed", seed, at_least=0))

    def search(archive: Archive) -> Search:
        start = first_start(archive)
        while True:
            yield from local(archive, start, *settings)
            start = rng.random(len(start))

    return lambda archive: limited(search(archive), budget)


class _Points(NamedTuple):
    """Evaluated points of the unit cube [n, d], and their residuals [n, m]."""

    unit: NDArray[np.float64]
    residuals: NDArray[np.float64]

    @property
    def value(self) -> NDArray[np.float64]:
        """Half the sum of squared residuals at each point [n]."""
        return 0.5 * np.sum(self.residuals**2, axis=1)


def _descend(archive: Archive, start: NDArray[np.float64], radius: float, last: float) -> Search:
    """Run one local search with trust-region radii from `radius` down to `last`, and yield candidates [n, d]."""
    box, d = archive.box, len(start)

    def evaluated(
        points: _Points | None, unit: NDArray[np.float64]
    ) -> Generator[NDArray[np.float64], Evaluations, _Points]:
        answer = archive.imputed((yield box.from_unit(unit)))
        new = _Points(box.to_unit(answer.x), answer.errors)
        both = [new] if points is None else [points, new]
        return _Points(*(np.concatenate(part) for part in zip(*both, strict=True)))

    # The first points are displaced towards the farther face along each axis.
    side = np.where(start <= 0.5, radius, -radius)
    points = yield from evaluated(None, np.vstack([start, start + np.diag(side)]))
    while radius > last:
        best = int(np.argmin(points.value))
        centre = points.unit[best]
        chosen, missing = _spanning(points, best, radius)
        # A model needs d points in addition to the best point. If too few nearby points span new directions, distant
        # points are used.
        if missing is None or len(chosen) == d:
            step, predicted = _step(points, best, _enriched(points, best, chosen, radius), radius)
            if predicted > 0 and np.abs(step).max() > 1e-3 * last:
                before = points.value[best]
                points = yield from evaluated(points, np.clip(centre + step, 0.0, 1.0)[None])
                ratio = (before - points.value[-1]) / predicted
                # A successful step that ends near the edge of the trust region suggests a larger region.
                if ratio >= ACCEPTED:
                    radius = min(2 * radius, LARGEST) if np.abs(step).max() > 0.75 * radius else radius
                    continue
        if missing is None:
            radius *= 0.5
        else:
            points = yield from evaluated(points, improving_point(centre, missing, radius)[None])


def _spanning(points: _Points, best: int, radius: float) -> tuple[list[int], NDArray[np.float64] | None]:
    """Find points that span the directions around the best point, and the directions that no nearby point spans.

    Returns the indices of the points, and the missing directions [k, d]. If a direction is missing, the model is not
    fully linear. The second return value is None if no direction is missing.
    """
    offset = (points.unit - points.unit[best]) / radius
    distance = np.linalg.norm(offset, axis=1)
    chosen: list[int] = []
    basis = np.zeros((0, offset.shape[1]))
    missing: NDArray[np.float64] | None = None
    for reach in SPANNING:
        for index in range(len(offset) - 1, -1, -1):
            if index == best or index in chosen or distance[index] > reach * np.sqrt(offset.shape[1]):
                continue
            # Gram-Schmidt gives the component along directions that the chosen points do not span.
            rest = offset[index] - basis.T @ (basis @ offset[index])
            if np.linalg.norm(rest) >= NEW_DIRECTION * max(distance[index], 1.0):
                chosen.append(index)
                basis = np.vstack([basis, rest / np.linalg.norm(rest)])
            if len(chosen) == offset.shape[1]:
                return chosen, missing
        if missing is None:
            # The orthogonal complement of the directions that nearby points span.
            missing = np.linalg.svd(basis)[2][len(basis) :] if len(basis) else np.eye(offset.shape[1])
    return chosen, missing


def _enriched(points: _Points, best: int, chosen: list[int], radius: float) -> NDArray[np.int64]:
    """Indices of the best point, the spanning points, and further points that help to determine the curvature.

    There are at most 2 d + 1 points, as in Wild's experiments.
    """
    offset = (points.unit - points.unit[best]) / radius
    near = np.flatnonzero(np.linalg.norm(offset, axis=1) <= SPANNING[1] * np.sqrt(offset.shape[1]))
    kept = [best, *chosen]
    for index in reversed(near.tolist()):
        if len(kept) == 2 * offset.shape[1] + 1:
            break
        if index not in kept and _pivot(offset[[*kept, index]]) >= INDEPENDENT:
            kept.append(index)
    return np.array(kept)


def _pivot(offset: NDArray[np.float64]) -> float:
    """Smallest singular value of the quadratic kernel projected onto the complement of the linear functions."""
    plane = np.hstack([np.ones((len(offset), 1)), offset])
    # Each column of q weights the points so that the weighted sum of every linear function is zero.
    q = np.linalg.qr(plane, mode="complete")[0][:, plane.shape[1] :]
    return float(np.linalg.svd(q.T @ _quadratic(offset) @ q, compute_uv=False)[-1])


def _quadratic(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """The kernel (x . y)^2 / 2, for which the Hessian of the interpolant has the smallest Frobenius norm."""
    return 0.5 * (offset @ offset.T) ** 2


def _step(
    points: _Points, best: int, kept: NDArray[np.int64], radius: float
) -> tuple[NDArray[np.float64], float]:
    """The step [d] that minimizes the model in the trust region, and the predicted decrease in the value."""
    offset = (points.unit[kept] - points.unit[best]) / radius
    count, d = offset.shape
    plane = np.hstack([np.ones((count, 1)), offset])
    # Least-curvature interpolation. The unknowns are one multiplier per point, the constant and the slopes.
    system = np.block([[_quadratic(offset), plane], [plane.T, np.zeros((d + 1, d + 1))]])
    side = np.vstack([points.residuals[kept], np.zeros((d + 1, points.residuals.shape[1]))])
    solved = np.linalg.lstsq(system, side, rcond=1e-12)[0]
    residuals, slopes = points.residuals[best], solved[count + 1 :]  # [m], [d, m]
    # Curvatures weighted by residuals, sum_i r_i sum_j lambda_ij s_j s_j^T, plus the Gauss-Newton term.
    curvature = (offset.T * (solved[:count] @ residuals)) @ offset + slopes @ slopes.T
    gradient = slopes @ residuals
    low = np.maximum(-points.unit[best] / radius, -1.0)
    high = np.minimum((1.0 - points.unit[best]) / radius, 1.0)

    def model(step: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        product = curvature @ step
        return float(gradient @ step + 0.5 * step @ product), gradient + product

    newton = np.linalg.lstsq(curvature, -gradient, rcond=None)[0]
    # The curvature may be indefinite, so there may be several minima in the region.
    starts = (np.zeros(d), np.clip(newton, low, high), np.where(gradient > 0, low, high))
    bounds = np.stack([low, high], axis=1)
    ended = [minimize(model, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    lowest = min(ended, key=lambda end: end.fun)
    return radius * lowest.x, -float(lowest.fun)


def improving_point(
    centre: NDArray[np.float64], missing: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """Choose a point in the unit cube [d] that improves the model around `centre` [d].

    The candidates lie within the radius along a missing direction [k, d], opposite to a missing direction, or along an
    axis towards the farther face. The candidate with the largest component along missing directions is chosen. Axes are
    included because, in a corner, all missing directions can lead out of the cube.
    """
    directions = np.vstack([missing, -missing, np.diag(np.where(centre <= 0.5, 1.0, -1.0))])
    edge = np.where(directions > 0, 1.0 - centre, centre)
    room = np.divide(edge, np.abs(directions), out=np.full_like(edge, np.inf), where=directions != 0)
    length = np.minimum(room.min(axis=1), radius)
    part = length * np.concatenate([np.ones(2 * len(missing)), np.linalg.norm(missing, axis=0)])
    best = np.argmax(part)
    return np.clip(centre + length[best] * directions[best], 0.0, 1.0)


@final
class GaussNewton(Optimizer):
    """Gauss-Newton least squares with finite differences. The method uses residuals and spends the whole budget.

    Args:
        seed: Seed of the random points at which searches restart.
        budget: Number of evaluations.
        step: Finite-difference step, as a fraction of the box width.
        tolerance: A search has converged if the relative decrease in cost, or the step as a fraction of the box width,
            is below this tolerance.

    Raises:
        InputError: An argument is out of range.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value", "residuals"})

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
        search = _searches(_newton, seed, self._budget, self.step, self.tolerance)
        self._session = Session(self.box, self.uses, search, objective)


def _newton(archive: Archive, start: NDArray[np.float64], step: float, tolerance: float) -> Search:
    """Run one local search, and yield candidates [n, d] in the box."""
    box, lowest = archive.box, np.inf
    descent = descend(start[None], 10**6, tolerance)
    unit = next(descent)
    while True:
        residuals = archive.imputed((yield box.from_unit(unit))).errors
        value, slope = float(np.sum(residuals**2)), np.zeros((*residuals.shape, unit.shape[1]))
        if value < lowest:  # derivatives are not needed at a rejected step
            lowest = value
            moves = np.where(unit[0] <= 0.5, step, -step)
            moved = archive.imputed((yield box.from_unit(unit + np.diag(moves)))).errors
            slope = ((moved - residuals) / moves[:, None]).T[None]
        try:
            unit = descent.send((residuals, slope))
        except StopIteration:
            return
