"""The settings of a method as a study file gives them: known, of the type that the method takes, and of a size."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import Parameter, signature
from math import isfinite
from typing import Any, Final

from calibray.errors import InputError
from calibray.support.messages import did_you_mean, shortened

LARGEST: Final = 10**6
"""The whole number beyond which a setting is refused: no method keeps more candidates than that."""

LONGEST: Final = 10**4
"""The number of entries beyond which a list is refused."""

_GIVEN: Final = ("lower", "upper", "seed", "objective", "model")
_TYPES: Final[Mapping[str, tuple[tuple[type, ...], str]]] = {
    "bool": ((bool,), "true or false"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a number"),
    "str": ((str,), "text in quotes"),
}


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Refuse settings that a method does not take; whether their values suit it, it says itself.

    Args:
        name: The method; of one that is unknown or chosen later, only the values' size is checked.
        options: The settings.

    Raises:
        InputError: A setting is unknown, of another type, not finite or too large; the message begins with its key.
    """
    if not options:
        return
    # Optimizers take SciPy along; a study without options is read without them.
    from calibray.optimizers import METHODS

    known = (
        {key: entry for key, entry in signature(METHODS[name]).parameters.items() if key not in _GIVEN}
        if name in METHODS
        else None
    )
    for key, value in options.items():
        place = f"method.options.{shortened(key)}"
        if known is not None and key not in known:
            raise InputError(f"{place}: the method {name!r} has no such setting; {did_you_mean(key, known)}")
        _check_size(f"{place} = {shortened(repr(value))}", value)
        if known is not None:
            _check_type(f"{place} = {shortened(repr(value))}", known[key], value)


def _check_type(place: str, entry: Parameter, value: Any) -> None:
    """By the annotation of the constructor's argument; an array may be a number or a list of them."""
    types = [part.strip() for part in str(entry.annotation).split("|")]
    if not set(types) - {"None"} <= set(_TYPES):
        return
    for each in types:
        allowed, _ = _TYPES.get(each, ((), ""))
        if isinstance(value, allowed) and (isinstance(value, bool) == (each == "bool")):
            return
    wanted = " or ".join(_TYPES[each][1] for each in types if each in _TYPES)
    raise InputError(f"{place}: must be {wanted}")


def _check_size(place: str, value: Any, depth: int = 2) -> None:
    match value:
        case bool():
            pass
        case int() if abs(value) > LARGEST:
            raise InputError(f"{place}: must be at most {LARGEST:,}")
        case float() if not isfinite(value):
            raise InputError(f"{place}: must be a finite number")
        case str() if len(value) > LONGEST:
            raise InputError(f"{place}: must have at most {LONGEST:,} characters")
        case list() | tuple() if depth and len(value) <= LONGEST:
            for each in value:
                _check_size(place, each, depth - 1)
        case list() | tuple():
            raise InputError(f"{place}: must be a list of at most {LONGEST:,} entries, or of such lists")
        case int() | float() | str():
            pass
        case _:
            raise InputError(f"{place}: must be a number, a text, true, false, or a list of them")
