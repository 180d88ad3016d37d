"""Faults that Pydantic finds, in the words of the file they stand in."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Final, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from calibray.errors import InputError
from calibray.spelling import did_you_mean

_UNKNOWN: Final = ("extra_forbidden", "unexpected_keyword_argument")

_WORDS: Final[Mapping[str, str]] = {
    "missing": "is required",
    "greater_than_equal": "must be at least {ge:g}",
    "greater_than": "must be greater than {gt:g}",
    "less_than_equal": "must be at most {le:g}",
    "literal_error": "must be one of {expected}",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "bool_type": "must be true or false",
    "string_type": "must be text in quotes",
    "string_too_short": "must not be empty",
    "tuple_type": "must be a list",
    "too_long": "must have {max_length} entries, has {actual_length}",
    "model_type": "must be a table",
    "dict_type": "must be a table",
    "dataclass_type": "must be a table",
}


def explain(
    error: ValidationError, model: type[BaseModel], content: Mapping[str, Any], source: str
) -> InputError:
    """One message for all faults, a line each: file, dotted key, value, bound.

    Args:
        error: What Pydantic found.
        model: The model that the content was validated against; its keys are offered for misspelled ones.
        content: The content.
        source: Name of the file, for the message.

    Returns:
        The error to raise.
    """
    lines: dict[str, str] = {}
    for fault in error.errors():
        path = _path(fault["loc"], content)
        key = dotted(path)
        context = fault.get("ctx", {})
        if fault["type"] in _UNKNOWN:
            line = f"{key}: unknown key; {did_you_mean(str(path[-1]), _keys(model, path[:-1]))}"
        elif fault["type"] == "missing":
            line = f"{key}: {_WORDS['missing']}"
        elif isinstance(cause := context.get("error"), InputError):
            # A message about a whole table names the key itself.
            text = str(cause)
            line = text if text.startswith(key) else f"{key}{_shown(path, content)}: {text}"
        else:
            words = _WORDS.get(fault["type"], fault["msg"]).format(**context)
            line = f"{key}{_shown(path, content)}: {words}"
        # A value that fits none of several types has one fault per type; the first says enough.
        lines.setdefault(key, line)
    return InputError("\n".join(f"{source}: {line}" for line in lines.values()))


def dotted(path: Sequence[str | int]) -> str:
    """A key as it is written in TOML, for instance ``parameters."walls.thickness".bounds[1]``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            name = f'"{part}"' if "." in part else part
            text += f".{name}" if text else name
    return text


def _path(location: Sequence[str | int], content: Any) -> tuple[str | int, ...]:
    """Pydantic's location without the parts that name a type instead of a key."""
    path: list[str | int] = []
    for index, part in enumerate(location):
        last = index == len(location) - 1
        if isinstance(content, Mapping):
            if part not in content and not last:
                break
            content = content.get(part)
        elif isinstance(content, list) and isinstance(part, int):
            content = content[part] if part < len(content) else None
        else:
            break
        path.append(part)
    return tuple(path)


def _shown(path: Sequence[str | int], content: Any) -> str:
    """The value at a path, if it is short enough to help."""
    for part in path:
        content = content[part]
    return "" if isinstance(content, Mapping) else f" = {content!r}"


def _keys(model: Any, path: Sequence[str | int]) -> list[str]:
    """The keys that a model knows at a path."""
    for part in path:
        model = (
            _table(_annotations(model).get(str(part))) if _annotations(model) else _table(get_args(model)[1])
        )
    return list(_annotations(model))


def _annotations(model: Any) -> dict[str, Any]:
    if isinstance(model, type) and issubclass(model, BaseModel):
        return {name: field.annotation for name, field in model.model_fields.items()}
    return {field.name: field.type for field in fields(model)} if is_dataclass(model) else {}


def _table(annotation: Any) -> Any:
    """The table among the types that a key may have."""
    options = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    return next((option for option in options if option is not type(None)), None)
