"""Checks of constructor arguments, and the search box with its mappings to and from the unit cube."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf, isfinite
from operator import index

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError


def whole(name: str, value: int, at_least: int, at_most: float = inf) -> int:
    """Check that the argument `name` is a whole number within the bounds, and return this number.

    Raises:
        InputError: The value is not a whole number, or is out of range.
    """
    try:
        number = index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or not at_least <= number <= at_most:
        bound = f">= {at_least}" if at_most == inf else f"from {at_least} to {at_most:g}"
        raise InputError(f"{name} = {value!r}; it must be a whole number {bound}: correct it")
    return number


def real(name: str, value: float, at_least: float, at_most: float = inf) -> float:
    """Check that the argument `name` is a finite number within the bounds, and return this number.

    Raises:
        InputError: The value is not a finite number, or is out of range.
    """
    number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
    if number is None or not isfinite(number) or not at_least <= number <= at_most:
        bound = f">= {at_least:g}" if at_most == inf else f"from {at_least:g} to {at_most:g}"
        raise InputError(f"{name} = {value!r}; it must be a finite number {bound}: correct it")
    return number


def choice(name: str, value: str, allowed: Iterable[str]) -> str:
    """Check that the argument `name` is one of the allowed strings, and return this string.

    Raises:
        InputError: The value is not allowed.
    """
    names = sorted(allowed)
    if value not in names:
        raise InputError(f"{name} = {value!r}; choose one of {', '.join(names)}")
    return value


@dataclass(frozen=True)
class Box:
    """A box lower <= x <= upper [d]; build it with `Box.between`, which checks the bounds."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    @staticmethod
    def between(lower: ArrayLike, upper: ArrayLike) -> Box:
        """Build a box from lower and upper bounds [d], which are copied.

        Raises:
            InputError: The bounds are not finite vectors of equal length >= 1, or a lower bound is not below its upper
                bound.

        Example:
            >>> Box.between([1.0, 0.0], [9.0, 1.0]).to_unit([[5.0, 0.25]])
            array([[0.5 , 0.25]])
        """
        low, high = np.array(lower, dtype=float), np.array(upper, dtype=float)
        if low.ndim != 1 or low.shape != high.shape or low.size == 0:
            raise InputError(
                f"lower has shape {low.shape} and upper {high.shape}; "
                "both must be vectors of the same length, with at least one entry"
            )
        for number, (a, b) in enumerate(zip(low, high, strict=True)):
            if not (np.isfinite(a) and np.isfinite(b) and a < b):
                raise InputError(
                    f"lower[{number}] = {a:g} and upper[{number}] = {b:g}; the bounds must be finite with "
                    "lower below upper: swap them, or remove a fixed parameter from the search"
                )
        low.setflags(write=False)
        high.setflags(write=False)
        return Box(low, high)

    @property
    def dimension(self) -> int:
        """Number of parameters d."""
        return self.lower.size

    @property
    def width(self) -> NDArray[np.float64]:
        """Upper bounds minus lower bounds [d]."""
        return self.upper - self.lower

    def clip(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Clip points [..., d] to the box."""
        return np.clip(x, self.lower, self.upper)

    def to_unit(self, x: ArrayLike) -> NDArray[np.float64]:
        """Map points [..., d] of the box to the unit cube: `lower` to 0 and `upper` to 1."""
        return (np.asarray(x, dtype=float) - self.lower) / self.width

    def from_unit(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points [..., d] of the unit cube to the box; rounding never moves a point outside the box."""
        return self.clip(self.lower + unit * self.width)
