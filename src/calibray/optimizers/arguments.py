"""Checks of constructor arguments."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf, isfinite
from operator import index

from calibray.errors import InputError


def whole(name: str, value: int, at_least: int, at_most: float = inf) -> int:
    """The whole number `value` of the argument `name`, if it lies within its bounds.

    Raises:
        InputError: It is no whole number, or outside its range.
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
    """The finite number `value` of the argument `name`, if it lies within its bounds.

    Raises:
        InputError: It is no finite number, or outside its range.
    """
    number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
    if number is None or not isfinite(number) or not at_least <= number <= at_most:
        bound = f">= {at_least:g}" if at_most == inf else f"from {at_least:g} to {at_most:g}"
        raise InputError(f"{name} = {value!r}; it must be a finite number {bound}: correct it")
    return number


def choice(name: str, value: str, allowed: Iterable[str]) -> str:
    """The string `value` of the argument `name`, if it is one of those allowed.

    Raises:
        InputError: The value is not allowed.
    """
    names = sorted(allowed)
    if value not in names:
        raise InputError(f"{name} = {value!r}; choose one of {', '.join(names)}")
    return value
