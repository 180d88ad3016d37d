"""Profiles: how well the data can be explained with one parameter held at each value of its range.

For every value the sum of squares is minimised over the other parameters, from every minimum that is known, all values
in one batch of projected Levenberg-Marquardt. Where two minima fit about equally well (slab resonances), curvature at
one knows nothing of the other; the profile does. Values come close together around each minimum, by its curvature, so
that a well-determined parameter has a profile too, and once more where the profile crosses the threshold.

D. M. Bates and D. G. Watts, Nonlinear Regression Analysis and Its Applications, Wiley 1988, section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri
from threadpoolctl import threadpool_limits

from calibray.errors import InputError
from calibray.optimizers.descent import Starts, descend
from calibray.progress import Progress

Evaluate = Callable[
    [NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
]
"""Points [n, d] to what is minimized [n], residuals [n, m] and their Jacobian [n, m, d]; infinite where it failed."""

NEAR: Final = (1.0, 2.0, 3.0, 5.0)
"""Distances from a minimum, in its standard errors, that have a value of the profile."""

LIKELY: Final = 3.0
"""Excess of the mean square, in that of the interval, up to which a minimum gets values of its own."""

REFINEMENTS: Final = 2
"""How often new values are set where a profile crosses the threshold."""

ITERATIONS: Final = 60
TOLERANCE: Final = 1e-8
"""Relative decrease of the sum of squares below which a minimum is found."""

TURNS: Final = 3
"""Turns at most; another one where a profile has reached below every minimum known, which joins them."""

LOWER: Final = 1e-6
"""Relative decrease of the mean square that counts as a lower minimum."""

SAME: Final = 1e-9
"""Difference of values, in the unit cube, that is rounding."""

BATCH: Final = 400
"""Values minimised at once; their searches are kept apart by a further coordinate, of which each takes a step."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The lowest mean square for each value of one parameter.

    Attributes:
        index: The parameter.
        value: Its values, ascending [g].
        square: Lowest mean square of the residuals there [g], [dB^2]; +inf where no evaluation succeeded.
        point: Where it is taken [g, d].
    """

    index: int
    value: NDArray[np.float64]
    square: NDArray[np.float64]
    point: NDArray[np.float64]

    def pieces(self, threshold: float) -> tuple[tuple[float, float], ...]:
        """Where the profile lies below a threshold.

        Args:
            threshold: Mean square [dB^2].

        Returns:
            Lower and upper end of every piece, ascending; ends are interpolated as on a parabola.
        """
        inside = self.square <= threshold
        first = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
        last = np.flatnonzero(inside & ~np.concatenate([inside[1:], [False]]))
        return tuple(
            (self._end(low, low - 1, threshold), self._end(high, high + 1, threshold))
            for low, high in zip(first.tolist(), last.tolist(), strict=True)
        )

    def _end(self, inside: int, outside: int, threshold: float) -> float:
        """Where the profile crosses the threshold between two neighbours."""
        if not 0 <= outside < len(self.value):
            return float(self.value[inside])
        least = self.square.min()
        near, far, level = (
            np.sqrt(max(square - least, 0.0))
            for square in (self.square[inside], self.square[outside], threshold)
        )
        if not np.isfinite(far):
            return float(self.value[inside])
        share = (level - near) / (far - near)
        return float(self.value[inside] + share * (self.value[outside] - self.value[inside]))


def threshold_square(least: float, freedom: int, level: float = 0.95) -> float:
    """Mean square up to which values of one parameter are in its confidence interval.

    Args:
        least: Lowest mean square [dB^2].
        freedom: Number of links less those of parameters and nuisances; at least 1.
        level: Confidence.

    Returns:
        least (1 + F / freedom), F being the quantile with 1 and `freedom` degrees of freedom [dB^2].
    """
    return least * (1.0 + float(fdtri(1, freedom, level)) / freedom)


def profiles(
    evaluate: Evaluate,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    minima: NDArray[np.float64],
    freedom: int,
    *,
    level: float = 0.95,
    values: int = 31,
    progress: Progress | None = None,
) -> list[Profile]:
    """Profile of every parameter.

    Args:
        evaluate: What is minimised, and its derivatives.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        minima: Every local minimum known, the lowest among them [k, d].
        freedom: Number of links less those of parameters and nuisances.
        level: Confidence of the intervals that values are set close together for.
        values: Values evenly over the range, those close together not counted.
        progress: Called after every parameter.

    Returns:
        The profiles, in the order of the parameters; all hold the lowest point that any of them found. That may lie
        below every minimum that was given: then the calibration has missed it.

    Raises:
        InputError: No minimum is given, or no evaluation of one succeeded.
    """
    task = _Task(evaluate, lower, upper - lower)
    unit = (np.atleast_2d(minima) - lower) / task.width
    turn = 0
    # Matrices are small here: threads of the linear algebra cost more than they give.
    with threadpool_limits(1, user_api="blas"):
        while True:
            basins, curves, turn = _basins(task, unit, freedom, level), [], turn + 1
            for index in range(len(lower)):
                curves.append(_curve(task, index, basins, freedom, level, values))
                if progress is not None:
                    progress("profiling", len(lower) * (turn - 1) + index + 1, len(lower) * turn)
            lowest = min(curves, key=lambda curve: curve.square.min())
            best = int(np.argmin(lowest.square))
            if turn == TURNS or lowest.square[best] > (1 - LOWER) * basins.square[0]:
                break
            unit = np.concatenate([unit, lowest.point[best][None]])
    return [task.unscaled(_holding(curve, lowest.square[best], lowest.point[best])) for curve in curves]


@dataclass(frozen=True)
class _Basins:
    """Minima in the unit cube, the lowest first: where they lie, their mean square, standard errors of the likely."""

    unit: NDArray[np.float64]
    square: NDArray[np.float64]
    spread: NDArray[np.float64]


def _basins(task: _Task, unit: NDArray[np.float64], freedom: int, level: float) -> _Basins:
    residuals, jacobian = task.residuals(unit)
    square = np.mean(residuals**2, axis=1)
    known = np.argsort(square)[: np.count_nonzero(np.isfinite(square))]
    if not len(known):
        raise InputError("profile: none of the minima could be evaluated; calibrate first")
    least = square[known[0]]
    likely = known[square[known] <= least + LIKELY * (threshold_square(least, freedom, level) - least)]
    return _Basins(unit[known], square[known], _standard_errors(jacobian[likely], square[likely], freedom))


def _curve(task: _Task, index: int, basins: _Basins, freedom: int, level: float, values: int) -> Profile:
    """The profile of one parameter in the unit cube."""
    centre = basins.unit[: len(basins.spread), index]
    near = centre[:, None] + basins.spread[:, index, None] * _signed(NEAR)
    wanted = _distinct(np.concatenate([np.linspace(0.0, 1.0, values), near.ravel(), centre]))
    starts = np.tile(basins.unit, (len(wanted), 1))
    label = np.repeat(np.arange(len(wanted)), len(basins.unit))
    starts[:, index] = wanted[label]
    curve = task.minimised(index, starts, label, wanted)
    curve = _refined(task, index, curve, wanted)
    for _ in range(REFINEMENTS):
        threshold = threshold_square(curve.square.min(), freedom, level)
        ends = np.array([end for piece in curve.pieces(threshold) for end in piece])
        curve = _refined(task, index, curve, _distinct(ends))
    return curve


def _holding(curve: Profile, square: float, point: NDArray[np.float64]) -> Profile:
    """A profile that holds the lowest point of all, which the others found more or less exactly."""
    value = point[curve.index]
    place = int(np.searchsorted(curve.value, value - SAME))
    here = place < len(curve.value) and curve.value[place] <= value + SAME
    parts = (curve.value, curve.square, curve.point)
    kept = [np.delete(part, place, axis=0) for part in parts] if here else parts
    return Profile(
        curve.index,
        np.insert(kept[0], place, value),
        np.insert(kept[1], place, square),
        np.insert(kept[2], place, point, axis=0),
    )


def _refined(task: _Task, index: int, curve: Profile, wanted: NDArray[np.float64]) -> Profile:
    """A profile with further values, or with the same ones again, from their neighbours' answers."""
    right = np.clip(np.searchsorted(curve.value, wanted), 1, len(curve.value) - 1)
    neighbours = np.stack([right - 1, right, np.minimum(right + 1, len(curve.value) - 1)])
    turn, label = np.nonzero(np.isfinite(curve.square[neighbours]))
    starts = curve.point[neighbours[turn, label]]
    starts[:, index] = wanted[label]
    more = task.minimised(index, starts, label, wanted)
    value = np.concatenate([curve.value, more.value])
    square = np.concatenate([curve.square, more.square])
    order = np.lexsort((square, value))
    kept = order[np.concatenate([[True], np.diff(value[order]) > SAME])]
    return Profile(index, value[kept], square[kept], np.concatenate([curve.point, more.point])[kept])


@dataclass(frozen=True)
class _Task:
    """What is minimised, in the unit cube."""

    evaluate: Evaluate
    lower: NDArray[np.float64]
    width: NDArray[np.float64]

    def residuals(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        _, residuals, jacobian = self.evaluate(self.lower + unit * self.width)
        return residuals, jacobian * self.width

    def unscaled(self, curve: Profile) -> Profile:
        """A profile in the parameters' own units."""
        value = self.lower[curve.index] + curve.value * self.width[curve.index]
        return Profile(curve.index, value, curve.square, self.lower + curve.point * self.width)

    def minimised(
        self, index: int, starts: NDArray[np.float64], label: NDArray[np.intp], wanted: NDArray[np.float64]
    ) -> Profile:
        """The lowest minimum for each wanted value of one parameter, from the starts that are labelled with it."""
        count = len(wanted)
        square, point = np.full(count, np.inf), np.zeros((count, starts.shape[1]))
        for first in range(0, count, BATCH):
            mine = (label >= first) & (label < first + BATCH)
            if not mine.any():
                continue
            apart = (label[mine] - first) / BATCH
            ended = self._descend(index, np.column_stack([starts[mine], apart]))
            place = first + np.rint(ended.unit[:, -1] * BATCH).astype(np.intp)
            for at, cost, unit in zip(place, 2.0 * ended.cost, ended.unit[:, :-1], strict=True):
                if cost < square[at]:
                    square[at], point[at] = cost, unit
        return Profile(index, wanted, square, point)

    def _descend(self, index: int, unit: NDArray[np.float64]) -> Starts:
        search = descend(unit, ITERATIONS, TOLERANCE)
        wanted = next(search)
        try:
            while True:
                residuals, jacobian = self.residuals(wanted[:, :-1])
                jacobian = np.concatenate([jacobian, np.zeros((*residuals.shape, 1))], axis=2)
                jacobian[:, :, index] = 0.0
                wanted = search.send((residuals, jacobian))
        except StopIteration as end:
            return end.value


def _standard_errors(
    jacobian: NDArray[np.float64], square: NDArray[np.float64], freedom: int
) -> NDArray[np.float64]:
    """Standard errors by linear theory in the unit cube [k, d], at most one sixth of it."""
    links, dimension = jacobian.shape[1:]
    curvature = np.einsum("kmi,kmj->kij", jacobian, jacobian)
    floor = 1e-9 * np.trace(curvature, axis1=1, axis2=2)[:, None, None] + 1e-12
    covariance = np.linalg.inv(curvature + floor * np.eye(dimension))
    variance = np.diagonal(covariance, axis1=1, axis2=2) * (square * links / freedom)[:, None]
    return np.clip(np.sqrt(variance), 1e-6, 1.0 / NEAR[-1])


def _signed(distances: tuple[float, ...]) -> NDArray[np.float64]:
    return np.concatenate([-np.array(distances[::-1]), distances])


def _distinct(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values within the unit interval, ascending; of those that agree but for rounding, one."""
    inside = np.sort(values[(values >= 0.0) & (values <= 1.0)])
    return inside[np.concatenate([[True], np.diff(inside) > SAME])]
