"""Strict models of file contents, which refuse unknown keys and wrong types, and the models' error messages."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Final, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibray.errors import InputError
from calibray.support.messages import MAX_LISTED, did_you_mean, shortened

CLOSED: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""Configuration of models that refuse unknown keys, type conversions, and numbers that are not finite."""

Text = Annotated[str, Field(min_length=1)]


class Section(BaseModel):
    """A strict, immutable model of a table in a file."""

    model_config = CLOSED | ConfigDict(frozen=True)


_UNKNOWN: Final = ("extra_forbidden", "unexpected_keyword_argument")

_WORDS: Final[Mapping[str, str]] = {
    "missing": "is required",
    "greater_than_equal": "must be at least {ge:g}",
    "greater_than": "must be greater than {gt:g}",
    "less_than_equal": "must be at most {le:g}",
    "less_than": "must be less than {lt:g}",
    "literal_error": "must be one of {expected}",
    "union_tag_invalid": "must be one of {expected_tags}",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "bool_type": "must be true or false",
    "string_type": "must be text in quotes",
    "string_too_short": "must not be empty",
    "tuple_type": "must be a list",
    "too_short": "must not be empty",
    "too_long": "must have {max_length} entries, but has {actual_length}",
    "model_type": "must be a table",
    "dict_type": "must be a table",
    "dataclass_type": "must be a table",
}


def explain(
    error: ValidationError,
    model: type[BaseModel],
    content: Mapping[str, Any],
    source: str,
    tagged: Sequence[str] = (),
) -> InputError:
    """Combine all errors in one message; the line of each states the file, the dotted key, the value and the bound.

    The message suggests valid keys for misspelt keys. `tagged` lists the tables of which there are several kinds; in
    such a table, the key `name` states the kind.
    """
    lines: dict[str, str] = {}
    for fault in error.errors():
        location = fault["loc"]
        if location[:1] and location[0] in tagged:
            # In its locations, Pydantic puts the kind after the table's name, but the kind is not a key in the file.
            location = (location[0], "name") if "tag" in fault["type"] else (location[0], *location[2:])
        path = _path(location, content, fault["type"] == "missing")
        key = dotted(path)
        if fault["type"] in _UNKNOWN:
            line = f"{key}: unknown key; {did_you_mean(str(path[-1]), _keys(model, path[:-1]))}"
        elif fault["type"] == "missing":
            line = f"{key}: {_WORDS['missing']}"
        else:
            text = describe_fault(fault)
            # A message about a whole table already contains the key.
            line = text if text.startswith(key) else f"{key}{_shown(path, content)}: {text}"
        # A value that matches none of the permitted types causes one error per type.
        if key not in lines:
            lines[key] = line
        elif fault["type"] in _WORDS and not lines[key].endswith(text := describe_fault(fault)):
            lines[key] += f", or {text}"
    listed = list(lines.values())[:MAX_LISTED]
    if len(lines) > len(listed):
        listed.append(f"and {len(lines) - len(listed)} more errors; correct those above first")
    return InputError("\n".join(f"{source}: {line}" for line in listed))


def describe_fault(fault: Mapping[str, Any]) -> str:
    """The message for an error reported by Pydantic, without the value."""
    context = fault.get("ctx") or {}
    if isinstance(cause := context.get("error"), InputError):
        return str(cause)
    template = _WORDS.get(fault["type"])
    return fault["msg"] if template is None else template.format(**context)


def dotted(path: Sequence[str | int]) -> str:
    """Format a key in TOML notation, for example ``parameters."walls.thickness".bounds[1]``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            name = shortened(f'"{part}"' if "." in part else part)
            text += f".{name}" if text else name
    return text


def _path(location: Sequence[str | int], content: Any, missing: bool) -> tuple[str | int, ...]:
    """Remove type names from the location of a Pydantic error; only the last key may be missing from the content."""
    path: list[str | int] = []
    for index, part in enumerate(location):
        last = index == len(location) - 1
        if isinstance(content, Mapping):
            if part not in content and not (missing and last):
                break
            content = content.get(part)
        elif isinstance(content, list) and isinstance(part, int):
            content = content[part] if part < len(content) else None
        else:
            break
        path.append(part)
    return tuple(path)


def _shown(path: Sequence[str | int], content: Any) -> str:
    """The shortened value at a path, formatted as ` = VALUE`; empty for a table."""
    for part in path:
        content = content[part]
    return "" if isinstance(content, Mapping) else f" = {shortened(repr(content))}"


def _keys(model: Any, path: Sequence[str | int]) -> list[str]:
    """The keys of a model at a path, for all kinds of table that are permitted there."""
    models = [model]
    for part in path:
        models = [table for known in models for table in _tables(_annotation(known, str(part)))]
    return list(dict.fromkeys(key for known in models for key in _annotations(known)))


def _annotation(model: Any, key: str) -> Any:
    """The type of a key in a model, or of the values in a mapping; None if `model` is neither."""
    if annotations := _annotations(model):
        return annotations.get(key)
    arguments = get_args(model)
    return arguments[1] if len(arguments) > 1 else None


def _annotations(model: Any) -> dict[str, Any]:
    if isinstance(model, type) and issubclass(model, BaseModel):
        return {name: field.annotation for name, field in model.model_fields.items()}
    return {field.name: field.type for field in fields(model)} if is_dataclass(model) else {}


def _tables(annotation: Any) -> list[Any]:
    """The types that the value of a key can have, except None."""
    options = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    return [option for option in options if option is not type(None)]
