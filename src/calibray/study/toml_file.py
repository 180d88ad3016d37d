"""Reads and writes study files: TOML, environment variables in file names, and keys of several engines."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import tomlkit
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from tomlkit.items import Item, Table

from calibray.engines.kinds import DEFAULT, KINDS
from calibray.errors import InputError
from calibray.study.calibration_sections import ParameterSection
from calibray.support.messages import printable, shortened
from calibray.support.output_files import exists
from calibray.support.strict_models import CLOSED, describe_fault

SCHEMA_FILE: Final = "study.schema.json"
HEADING: Final = (
    f"#:schema {SCHEMA_FILE}\n"
    "# Drafted by `calibray init`. Comments state the reason for each assumption. Check antennas and heights first.\n"
)


def read_content(path: Path) -> dict[str, Any]:
    """Read the sections of a study file.

    Raises:
        InputError: The file does not exist, cannot be read, or is not TOML.
    """
    if not exists(path):
        raise InputError(f"{shortened(str(path), 300)}: no such study file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; save the file as UTF-8") from None
    except (ValueError, RecursionError) as error:
        # The parser also fails on numbers with thousands of digits and on lists nested thousands of levels deep.
        raise InputError(f"{path}: not valid TOML: {shortened(str(error), 300)}") from None


def study_text(content: Mapping[str, Any], reasons: Mapping[str, str]) -> str:
    """The text of a study file. Comments state the `reasons` for assumptions, by dotted name of the section or key.

    Raises:
        InputError: A name contains characters that TOML cannot represent.
    """
    document, text, agrees = tomlkit.document(), "", False
    try:
        for name, section in content.items():
            document[name] = _section(name, section, reasons)
        text = (HEADING if reasons else "") + tomlkit.dumps(document)
        agrees = tomllib.loads(text) == _with_lists(content)
    except ValueError:  # a lone surrogate, which no TOML file can contain
        pass
    # Whatever names a table contains, the file must state exactly the content of the draft.
    if not agrees:
        raise InputError(
            "draft: the name of a column or group cannot be written in TOML; rename the column or group in the table"
        )
    return text


def reasons_in(text: str) -> dict[str, str]:
    """The comments after sections and keys in a study file, by dotted name; empty if the text is not TOML."""
    try:
        document = tomlkit.parse(text)
    except ValueError:
        return {}
    sections = {name: item for name, item in document.items() if isinstance(item, Table)}
    items: dict[str, object] = dict(sections)
    for name, section in sections.items():
        items |= {f"{name}.{key}": section.value.item(key) for key in section}
    comments = {name: item.trivia.comment for name, item in items.items() if isinstance(item, Item)}
    return {name: comment.removeprefix("#").strip() for name, comment in comments.items() if comment}


def _section(name: str, section: Any, reasons: Mapping[str, str]) -> Any:
    """A section, or a value that precedes the first section."""
    if not isinstance(section, Mapping):
        return _item(section)
    table = tomlkit.table()
    for key, value in section.items():
        table[key] = _commented(_item(value), reasons.get(f"{name}.{key}"))
    return _commented(table, reasons.get(name))


def _commented(item: Any, reason: str | None) -> Any:
    """An item followed by a comment on the same line, because text after a line break would be read as TOML."""
    return item.comment(printable(reason)) if reason else item


def _item(value: Any) -> Any:
    """A value in TOML, with inline tables. Large numbers are written in the form 3.5e9 instead of 3500000000."""
    if isinstance(value, Mapping):
        table = tomlkit.inline_table()
        table.update({key: _item(part) for key, part in value.items()})
        return table
    if isinstance(value, list | tuple):
        array = tomlkit.array()
        array.extend(_item(part) for part in value)
        return array
    if (
        isinstance(value, float)
        and 1e6 <= abs(value) < 1e16
        and float(giga := f"{value / 1e9:.10g}e9") == value
    ):
        return tomlkit.value(giga)
    return tomlkit.item(value)


def _with_lists(value: Any) -> Any:
    """A value in which tuples are replaced by lists, as in parsed TOML."""
    if isinstance(value, Mapping):
        return {key: _with_lists(part) for key, part in value.items()}
    return [_with_lists(part) for part in value] if isinstance(value, list | tuple) else value


def refuse_unquoted_names(parameters: Any, path: str | Path) -> None:
    """Raise an error for ``walls.thickness = ...``, which TOML reads as a table "walls" with a key "thickness"."""
    for name, entry in parameters.items() if isinstance(parameters, Mapping) else ():
        for key, value in entry.items() if isinstance(entry, Mapping) else ():
            if isinstance(value, Mapping) and key not in ParameterSection.model_fields:
                raise InputError(
                    f'{path}: parameters.{name}.{key}: quote the name, "{name}.{key}" = {{ ... }}'
                )


def expand(text: str, environment: Mapping[str, str]) -> str:
    """Replace environment variables: ``${NAME}``, or ``${NAME:-default}`` for unset or empty variables.

    Raises:
        InputError: A variable without a default is not set, or a ``${`` is malformed.

    Example:
        >>> expand("${HERE:-there}/links.csv", {})
        'there/links.csv'
    """

    def value(match: re.Match[str]) -> str:
        name, default = match.groups()
        if environment.get(name):
            return environment[name]
        if default is None:
            raise InputError(
                f"environment variable {name} is not set; set the variable or write ${{{name}:-DEFAULT}}"
            )
        return default

    expanded, count = re.subn(r"\$\{([A-Za-z_]\w*)(?::-([^{}]*))?\}", value, text)
    if text.count("${") != count:
        raise InputError("malformed environment variable ${...}; write ${NAME} or ${NAME:-DEFAULT}")
    return expanded


def split_engine_keys(content: Any, source: str) -> tuple[Any, dict[str, Any]]:
    """Split the table ``[engine]`` into the keys of the named engine and the keys of other engines.

    A study can use replay and also state the command of a program, which `calibray run --engine command` then calls.

    Raises:
        InputError: A key of another engine has an invalid value, or a key shared by several engines has a value that is
            valid only for engines that the table does not describe.
    """
    # The validation of the study rejects a value that is not a table or does not name an engine.
    name = content.get("name", DEFAULT) if isinstance(content, dict) else None
    if not isinstance(name, str) or name not in KINDS:
        return content, {}
    own, others = KINDS[name].model_fields, {}
    for key, value in content.items():
        faults = {
            kind: _fault(section.model_fields[key], value)
            for kind, section in KINDS.items()
            if key in section.model_fields
        }
        fitting = [kind for kind, fault in faults.items() if fault is None]
        # Several engines may use the same key, such as `rays`, for values of different types.
        if faults and (key not in own or (faults[name] is not None and fitting)):
            if not fitting:
                raise InputError(
                    f"{source}: engine.{key} = {shortened(repr(value))}: {next(iter(faults.values()))}"
                )
            if is_shared(key) and not any(_described(kind, content) for kind in fitting):
                given, fault = json.dumps(value, default=str), faults.get(name, "unknown key")
                raise InputError(
                    f"{source}: engine.{key} = {shortened(given)}: {fault} with "
                    f"engine.name = {name!r}; correct or remove it, or set engine.name = {fitting[0]!r}"
                )
            others[key] = value
    rest = {key: value for key, value in content.items() if key not in others}
    return {"name": DEFAULT, **rest}, others


def is_shared(key: str) -> bool:
    """Whether several engines have a key."""
    return sum(key in section.model_fields for section in KINDS.values()) > 1


def _described(kind: str, content: Mapping[str, Any]) -> bool:
    """Whether the table states a key that only this engine has; always True for the default engine."""
    own = KINDS[kind].model_fields
    return kind == DEFAULT or any(key in own and not is_shared(key) for key in content)


def _fault(field: FieldInfo, value: Any) -> str | None:
    """The error in the value of a key; None if the value is valid."""
    # The type is composed at run time, which type checkers do not support.
    annotated: Any = Annotated
    checker = TypeAdapter[Any](annotated[field.annotation, Field(), *field.metadata], config=CLOSED)
    try:
        checker.validate_json(json.dumps(value, default=str))
    except ValidationError as error:
        return describe_fault(error.errors()[0])
    return None
