"""Short forms of records for the Python prompt and notebooks, and of names and frequencies in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final

from calibray.support.messages import printable
from calibray.tables.table import Table
from calibray.tables.text import render, render_html

ROWS: Final = 10
"""Largest number of rows of a table; the others are only counted."""

CHARACTERS: Final = 60
"""Largest number of characters of a cell or a name; longer ones are cut."""

SENTENCE: Final = 200
"""Largest number of characters of a sentence; longer ones are cut."""


def text(*parts: Table | str) -> str:
    """Plain text for `__repr__`, with long tables and cells cut, and control characters escaped."""
    return render(*_fitted(parts))


def html(*parts: Table | str) -> str:
    """HTML for `_repr_html_`, with long tables and cells cut, and all text escaped."""
    return render_html(*_fitted(parts))


def named(names: Iterable[str], count: int = 4) -> str:
    """List names with commas between them; if there are many, only the first ones.

    Example:
        >>> named(["east", "west"])
        'east, west'
        >>> named(f"mast {k}" for k in range(500))
        'mast 0, mast 1, mast 2, mast 3 and 496 more'
    """
    short = [_short(name, CHARACTERS) for name in names]
    more = f" and {len(short) - count:,} more" if len(short) > count else ""
    return ", ".join(short[:count]) + more


def hertz(frequency: float) -> str:
    """Format a frequency [Hz] in GHz or MHz.

    Example:
        >>> hertz(28.5e9)
        '28.5 GHz'
    """
    return f"{frequency / 1e9:.6g} GHz" if frequency >= 1e9 else f"{frequency / 1e6:.6g} MHz"


def _fitted(parts: Iterable[Table | str]) -> Iterator[Table | str]:
    for part in parts:
        if isinstance(part, str):
            yield _short(part, SENTENCE)
        else:
            table = part.head(ROWS)
            yield replace(
                table,
                columns=tuple(
                    replace(column, name=_short(column.name, CHARACTERS)) for column in table.columns
                ),
                rows=tuple(tuple(_short(cell, CHARACTERS) for cell in row) for row in table.rows),
            )


def _short(text: str, length: int) -> str:
    """Text on one line of limited length, with line breaks and control characters escaped."""
    return printable(text if len(text) <= length else f"{text[: length - 3]}...")
