"""Check of a method's settings in a study file: the names, the types and the sizes of values."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import Parameter, signature
from math import isfinite
from typing import Any, Final

from calibray.errors import InputError
from calibray.support.messages import did_you_mean, shortened

LARGEST: Final = 10**6
"""Largest whole number of a setting: no method can keep more candidates in memory."""

LONGEST: Final = 10**4
"""Largest number of entries of a list, and of characters of a text."""

_NOT_SETTINGS: Final = ("lower", "upper", "seed", "objective", "model")
_TYPES: Final[Mapping[str, tuple[tuple[type, ...], str]]] = {
    "bool": ((bool,), "true or false"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a number"),
    "str": ((str,), "text in quotes"),
}


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Refuse settings that a method does not have; the method itself checks whether their values suit it.

    If the method is unknown or chosen later, only the size of values is checked.

    Raises:
        InputError: A setting is unknown, of another type, not finite or too large; the message begins with its key.
    """
    if not options:
        return
    # Optimizers import SciPy; a study without options is read without them.
    from calibray.optimizers import METHODS

    settings = None
    if name in METHODS:
        arguments = signature(METHODS[name]).parameters
        settings = {key: argument for key, argument in arguments.items() if key not in _NOT_SETTINGS}
    for key, value in options.items():
        prefix = f"method.options.{shortened(key)}"
        if settings is not None and key not in settings:
            raise InputError(
                f"{prefix}: the method {name!r} has no such setting; {did_you_mean(key, settings)}"
            )
        prefix += f" = {shortened(repr(value))}"
        _check_size(prefix, value)
        if settings is not None:
            _check_type(prefix, settings[key], value)


def _check_type(prefix: str, argument: Parameter, value: Any) -> None:
    """Check the annotation of the constructor's argument; other types, such as arrays, are not checked."""
    types = [part.strip() for part in str(argument.annotation).split("|")]
    if not set(types) - {"None"} <= set(_TYPES):
        return
    for name in types:
        allowed, _ = _TYPES.get(name, ((), ""))
        # In Python, True and False are integers as well.
        if isinstance(value, allowed) and (isinstance(value, bool) == (name == "bool")):
            return
    wanted = " or ".join(_TYPES[name][1] for name in types if name in _TYPES)
    raise InputError(f"{prefix}: must be {wanted}")


def _check_size(prefix: str, value: Any, depth: int = 2) -> None:
    match value:
        case bool():
            pass
        case int() if abs(value) > LARGEST:
            raise InputError(f"{prefix}: must be at most {LARGEST:,}")
        case float() if not isfinite(value):
            raise InputError(f"{prefix}: must be a finite number")
        case str() if len(value) > LONGEST:
            raise InputError(f"{prefix}: must have at most {LONGEST:,} characters")
        case list() | tuple() if depth and len(value) <= LONGEST:
            for entry in value:
                _check_size(prefix, entry, depth - 1)
        case list() | tuple():
            raise InputError(f"{prefix}: must be a list of at most {LONGEST:,} entries, or of such lists")
        case int() | float() | str():
            pass
        case _:
            raise InputError(f"{prefix}: must be a number, a text, true, false, or a list of them")
