"""A study's content as TOML, with the reasons of what was assumed as comments."""

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
        reasons: Why a section or a key is as it is, by its dotted name.

    Returns:
        The file's text.
    """
    lines = [
        f"#:schema {SCHEMA_FILE}",
        "# Drafted by `calibray init`: what was assumed stands beside. Check it, above all antennas and heights.",
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
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def _value(value: Any) -> str:
    """A value as TOML has it; JSON's texts and numbers are TOML's."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {_value(part)}" for key, part in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, float):
        giga = f"{value / 1e9:.10g}e9"
        return giga if abs(value) >= 1e6 and float(giga) == value else repr(value)
    return json.dumps(value, ensure_ascii=False)
