"""The engine evaluations of a run, from which alone leaders, memories, surrogates and results are derived."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.optimizers.arguments import Box

Objective = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Function that maps residuals [n, m] to values [n]. The value must increase with the mean square of the residuals."""

OBJECTIVE_TOLERANCE = 1e-4
"""Maximum relative difference between a value and the objective computed from its residuals, which may be in single
precision."""

DECIMALS = 9
"""Number of decimals to which unit-cube coordinates are rounded before repeated points are merged."""


@dataclass(frozen=True)
class Best:
    """The best evaluation so far: the point [d] and its value, which is +inf if every evaluation failed."""

    x: NDArray[np.float64]
    y: float


@dataclass(frozen=True)
class Evaluations:
    """Evaluations by the engine. Build them with `checked_evaluations`, which validates and copies the arrays.

    Attributes:
        x: Points [n, d].
        y: Values [n], +inf for a failed evaluation.
        residuals: Residuals [n, m], or None. Their mean square increases with y.
        jacobian: Derivatives of the residuals with respect to the parameters [n, m, d], or None.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    residuals: NDArray[np.float64] | None = None
    jacobian: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return self.y.size

    @property
    def errors(self) -> NDArray[np.float64]:
        """The residuals [n, m], for algorithms that use residuals."""
        if self.residuals is None:
            raise InputError(
                "residuals = None; this optimizer needs them: call tell(x, y, residuals=..., ...)"
            )
        return self.residuals

    @property
    def slopes(self) -> NDArray[np.float64]:
        """The derivatives [n, m, d] of the residuals, for algorithms that use these derivatives."""
        if self.jacobian is None:
            raise InputError("jacobian = None; this optimizer needs it: call tell(x, y, jacobian=..., ...)")
        return self.jacobian

    def rows(self, rows: NDArray[np.intp]) -> Evaluations:
        """The evaluations with the given indices [k], in the given order."""
        residuals = None if self.residuals is None else self.residuals[rows]
        jacobian = None if self.jacobian is None else self.jacobian[rows]
        return Evaluations(self.x[rows], self.y[rows], residuals, jacobian)

    @staticmethod
    def joined(parts: list[Evaluations]) -> Evaluations:
        """Concatenate one or more sets of evaluations, all with the same optional parts."""

        def stack(arrays: Iterable[NDArray[np.float64] | None]) -> NDArray[np.float64] | None:
            present = [array for array in arrays if array is not None]
            return np.concatenate(present) if present else None

        return Evaluations(
            np.concatenate([part.x for part in parts]),
            np.concatenate([part.y for part in parts]),
            stack(part.residuals for part in parts),
            stack(part.jacobian for part in parts),
        )


class Archive:
    """All evaluations of a run, whether requested or not, in the order in which `tell` received them."""

    def __init__(self, box: Box) -> None:
        self.box = box
        self._parts: list[Evaluations] = []
        self._leading: Evaluations | None = None

    def __len__(self) -> int:
        return sum(len(part) for part in self._parts)

    def add(self, evaluations: Evaluations) -> None:
        """Append checked evaluations, without their Jacobians."""
        self._parts.append(Evaluations(evaluations.x, evaluations.y, evaluations.residuals))
        lowest = self._parts[-1].rows(np.argmin(evaluations.y, keepdims=True))
        if self._leading is None or lowest.y[0] < self._leading.y[0]:
            self._leading = lowest

    @property
    def best(self) -> Best:
        """The point and value of `leading`.

        Raises:
            InputError: No evaluation has been passed to `tell` yet.
        """
        return Best(read_only(self.leading.x[0]), float(self.leading.y[0]))

    @property
    def leading(self) -> Evaluations:
        """The first evaluation with the lowest value.

        Raises:
            InputError: No evaluation has been passed to `tell` yet.
        """
        if self._leading is None:
            raise InputError(
                "there is no best point, because there are no evaluations yet; call tell() first"
            )
        return self._leading

    @property
    def lowest(self) -> float:
        """Root mean square of the residuals of `leading`, which can differ from `y`; +inf if all evaluations failed."""
        succeeded = self._leading is not None and np.isfinite(self._leading.y[0])
        return float(root_mean_square(self.leading.errors)[0]) if succeeded else np.inf

    def all(self) -> Evaluations:
        """All evaluations so far, without Jacobians, in the order in which `tell` received them.

        Raises:
            InputError: No evaluation has been passed to `tell` yet.
        """
        if not self._parts:
            raise InputError("the archive contains no evaluations; call tell() first")
        self._parts = [Evaluations.joined(self._parts)]
        return self._parts[0]

    def leaders(self, count: int) -> NDArray[np.float64]:
        """The best distinct points [count, d] of the whole run, best first; ties are in the order of `tell`.

        If there are fewer than `count` points, the last point is repeated.
        """
        evaluations = self.all()
        chosen: list[NDArray[np.float64]] = []
        for row in np.argsort(evaluations.y, kind="stable"):
            if not any(np.array_equal(evaluations.x[row], point) for point in chosen):
                chosen.append(evaluations.x[row])
                if len(chosen) == count:
                    break
        return np.array(chosen + [chosen[-1]] * (count - len(chosen)))

    def imputed(self, evaluations: Evaluations) -> Evaluations:
        """Assign failed evaluations the value and residuals of the worst successful one, so that models avoid them.

        The value and the residuals are zero if every evaluation so far has failed.
        """
        run = self.all()
        failed, good = ~np.isfinite(evaluations.y), np.flatnonzero(np.isfinite(run.y))
        worst = good[np.argmax(run.y[good])] if good.size else None
        y = np.where(failed, 0.0 if worst is None else run.y[worst], evaluations.y)
        residuals = evaluations.residuals
        if residuals is not None:
            fill = np.zeros(residuals.shape[1]) if worst is None else run.errors[worst]
            residuals = np.where(failed[:, None], fill, residuals)
        return Evaluations(evaluations.x, y, residuals)


def checked_evaluations(
    box: Box,
    x: ArrayLike,
    y: ArrayLike,
    parts: Mapping[str, ArrayLike | None],
    uses: frozenset[str],
    objective: Objective | None = None,
) -> Evaluations:
    """Validate and copy evaluations: points x [n, d], values y [n], and the residuals and the Jacobian in `parts`.

    A value of +inf indicates a failed evaluation, whose residuals and derivatives are ignored. Parts that the optimizer
    does not use are checked and dropped. Values are compared with the objective of the residuals unless `objective` is
    None.

    Raises:
        InputError: A shape is wrong, a number is not finite, a point is outside the box, a part that the optimizer uses
            is missing, or a value does not match its residuals.
    """
    points, values = _array("x", x, (None, box.dimension)), _array("y", y, (None,))
    if len(points) != len(values) or len(values) == 0:
        raise InputError(
            f"x has shape {points.shape} and y has shape {values.shape}; pass one value per "
            "point, and at least one point"
        )
    _finite("x", points)
    for row, column in np.argwhere((points < box.lower) | (points > box.upper)):
        raise InputError(
            f"x[{row}, {column}] = {points[row, column]:g} lies outside its bounds "
            f"[{box.lower[column]:g}, {box.upper[column]:g}]; remove the point or widen the bounds"
        )
    # The comparison is negated so that NaN is also rejected.
    for (row,) in np.argwhere(~((values > -np.inf) & (values <= np.inf))):
        raise InputError(f"y[{row}] = {values[row]}; it must be a number, or +inf for a failed evaluation")
    residuals, jacobian = parts["residuals"], parts["jacobian"]
    for name in sorted(uses & parts.keys()):
        if parts[name] is None:
            raise InputError(f"{name} = None; this optimizer needs it: call tell(x, y, residuals=..., ...)")
    good = np.isfinite(values)
    errors = None if residuals is None else _array("residuals", residuals, (len(values), None))
    slopes = None
    if errors is not None:
        _finite("residuals", errors, good)
        if errors.shape[1] == 0:
            raise InputError("residuals has 0 columns; at least one link is required")
        if objective is not None:
            _check_value(values, errors, good, objective)
    if jacobian is not None:
        links = None if errors is None else errors.shape[1]
        slopes = _array("jacobian", jacobian, (len(values), links, box.dimension))
        _finite("jacobian", slopes, good)
    return Evaluations(
        points, values, errors if "residuals" in uses else None, slopes if "jacobian" in uses else None
    )


def check_order(evaluations: Evaluations, archive: Archive) -> None:
    """Check that values increase with the mean square of residuals among the new evaluations and the best one so far.

    Raises:
        InputError: An evaluation has a lower value but a higher mean square than another evaluation.
    """
    if len(archive):
        without_jacobian = Evaluations(evaluations.x, evaluations.y, evaluations.residuals)
        evaluations = Evaluations.joined([archive.leading, without_jacobian])
    evaluations = evaluations.rows(np.flatnonzero(np.isfinite(evaluations.y)))
    size = root_mean_square(evaluations.errors)
    order = np.argsort(size, kind="stable")
    value, size = evaluations.y[order], size[order]
    # In order of mean square, no value may be below an earlier value.
    highest = np.maximum.accumulate(value)
    slack = OBJECTIVE_TOLERANCE * np.abs(value) + 1e-9
    for row in np.flatnonzero(highest > value + slack):
        before = int(np.argmax(value[:row]))
        if size[row] > (1.0 + OBJECTIVE_TOLERANCE) * size[before] + 1e-9:
            raise InputError(
                f"y = {value[row]:g} with sqrt(mean(residuals**2)) = {size[row]:g}, but y = {value[before]:g} "
                f"with {size[before]:g}; the mean square must increase with the value: pass deviance residuals"
            )


def root_mean_square(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """The default objective: the root mean square [n] of residuals [n, m]."""
    return np.sqrt(np.mean(residuals**2, axis=1))


def merge_repeated(
    unit: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Merge repeated points [n, d] in the unit cube into distinct points [k, d] with mean values [k, ...]."""
    points, group = np.unique(np.round(unit, DECIMALS), axis=0, return_inverse=True)
    # Each row contains the weights that average the repeats of one point.
    share = (np.arange(len(points))[:, None] == group) / np.bincount(group)[:, None]
    return points, share @ values


def read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make an array read-only in place, and return it."""
    array.setflags(write=False)
    return array


def _array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    array = np.array(value, dtype=float)
    fits = len(shape) == array.ndim and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
    if not fits:
        letters = "nmd"[: len(shape)]
        sizes = (letter if size is None else str(size) for letter, size in zip(letters, shape, strict=True))
        raise InputError(f"{name} has shape {array.shape}; it must be [{', '.join(sizes)}]: reshape it")
    return array


def _finite(name: str, array: NDArray[np.float64], rows: NDArray[np.bool_] | None = None) -> None:
    bad = ~np.isfinite(array)
    if rows is not None:
        bad &= rows.reshape(-1, *[1] * (array.ndim - 1))
    for index in np.argwhere(bad):
        raise InputError(
            f"{name}[{', '.join(map(str, index))}] = {array[tuple(index)]}; it must be finite: "
            "pass y = +inf for a failed evaluation"
        )


def _check_value(
    values: NDArray[np.float64], residuals: NDArray[np.float64], good: NDArray[np.bool_], objective: Objective
) -> None:
    computed = np.where(good, objective(np.where(good[:, None], residuals, 0.0)), 0.0)
    slack = OBJECTIVE_TOLERANCE * np.abs(computed) + 1e-9
    for row in np.flatnonzero(good & ~(np.abs(np.where(good, values, 0.0) - computed) <= slack)):
        if objective is root_mean_square:
            name, remedy = f"sqrt(mean(residuals[{row}]**2))", "put the weights into the residuals"
        else:
            name, remedy = f"objective(residuals[{row}])", "pass the value that belongs to the residuals"
        raise InputError(
            f"y[{row}] = {values[row]:g}, but {name} = {computed[row]:g}; they must agree within "
            f"{OBJECTIVE_TOLERANCE:g}: {remedy}"
        )
