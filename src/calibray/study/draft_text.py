"""A drafted study as TOML, with the reasons of its assumptions as comments.

Names of columns, groups and files come from foreign tables: all of them are quoted here, so that none becomes TOML.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any, Final

from calibray.errors import InputError
from calibray.support.messages import printable

SCHEMA_FILE: Final = "study.schema.json"


def toml(content: Mapping[str, Any], reasons: Mapping[str, str]) -> str:
    """Write the sections of a study, with reasons of assumptions by the dotted name of the section or key.

    Raises:
        InputError: A name holds characters that TOML has not.
    """
    lines = [
        f"#:schema {SCHEMA_FILE}",
        "# Drafted by `calibray init`. Comments give the reason of each assumption: check antennas and heights first.",
    ]
    tables = {key: value for key, value in content.items() if isinstance(value, Mapping)}
    lines += [f"{key} = {_value(value)}" for key, value in content.items() if key not in tables]
    for name, table in tables.items():
        lines += ["", *_table(name, table, reasons)]
    text = "\n".join(lines) + "\n"
    # Whatever names a table has, the file must say what was drafted and nothing else.
    try:
        agrees = tomllib.loads(text) == _with_lists(content)
    except (tomllib.TOMLDecodeError, UnicodeError):
        agrees = False
    if not agrees:
        raise InputError("draft: a column or group has a name that no study can hold; rename it in the table")
    return text


def _with_lists(value: Any) -> Any:
    """A value with lists in place of tuples, as TOML reads them."""
    if isinstance(value, Mapping):
        return {key: _with_lists(part) for key, part in value.items()}
    return [_with_lists(part) for part in value] if isinstance(value, list | tuple) else value


def _table(name: str, table: Mapping[str, Any], reasons: Mapping[str, str]) -> Iterator[str]:
    if name in reasons:
        yield _comment(reasons[name])
    yield f"[{_key(name)}]"
    for key, value in table.items():
        reason = reasons.get(f"{name}.{key}")
        yield f"{_key(key)} = {_value(value)}" + (f"  {_comment(reason)}" if reason else "")


def _comment(text: str) -> str:
    """A comment on one line: a line break in a column's name would end it, and the rest of the name would be TOML."""
    return f"# {printable(text)}"


def _quoted(text: str) -> str:
    """A basic string of TOML."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    # TOML has no escape of two digits.
    return (
        '"' + "".join(letter if letter.isprintable() else f"\\U{ord(letter):08x}" for letter in escaped) + '"'
    )


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _quoted(key)


def _value(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {_value(part)}" for key, part in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        # Frequencies are easier to read as 3.5e9.
        giga = f"{value / 1e9:.10g}e9"
        return giga if 1e6 <= abs(value) < 1e16 and float(giga) == value else repr(float(value))
    raise TypeError(f"{value!r} has no form in a study")
