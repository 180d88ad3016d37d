"""A drafted study as TOML, with the reasons of its assumptions as comments."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

SCHEMA_FILE: Final = "study.schema.json"


def toml(content: Mapping[str, Any], reasons: Mapping[str, str]) -> str:
    """Write a study.

    Args:
        content: Sections by name.
        reasons: Reasons of assumptions by the dotted name of the section or key.

    Returns:
        The file's text.
    """
    lines = [
        f"#:schema {SCHEMA_FILE}",
        "# Drafted by `calibray init`. Comments give the reason of each assumption: check antennas and heights first.",
    ]
    tables = {key: value for key, value in content.items() if isinstance(value, Mapping)}
    lines += [f"{key} = {_value(value)}" for key, value in content.items() if key not in tables]
    for name, table in tables.items():
        lines += ["", *_table(name, table, reasons)]
    return "\n".join(lines) + "\n"


def _table(name: str, table: Mapping[str, Any], reasons: Mapping[str, str]) -> Iterator[str]:
    if name in reasons:
        yield f"# {reasons[name]}"
    yield f"[{name}]"
    for key, value in table.items():
        reason = reasons.get(f"{name}.{key}")
        yield f"{_key(key)} = {_value(value)}" + (f"  # {reason}" if reason else "")


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _text(key)


def _text(text: str) -> str:
    # JSON escapes all characters that TOML must, except DEL.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")


def _value(value: Any) -> str:
    """A value in TOML; texts and numbers are written as in JSON."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {_value(part)}" for key, part in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, float):
        # Frequencies are easier to read as 3.5e9.
        giga = f"{value / 1e9:.10g}e9"
        return giga if abs(value) >= 1e6 and float(giga) == value else repr(value)
    return _text(value) if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
