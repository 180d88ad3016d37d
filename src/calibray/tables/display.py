"""What a record shows of itself where Python or a notebook prints it: what matters, on one screen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final

from calibray.tables import html as markup
from calibray.tables import text as plain
from calibray.tables.table import Table

ROWS: Final = 10
"""Rows of a table before the rest is only counted."""

CHARACTERS: Final = 60
"""Characters of a cell or a name before it is cut short."""

SENTENCE: Final = 200
"""Characters of a sentence before it is cut short."""


def text(*parts: Table | str) -> str:
    """What `__repr__` answers.

    Args:
        parts: Tables and sentences, from top to bottom.

    Returns:
        Plain text: long tables and cells cut short, characters that steer a terminal written out.
    """
    return plain.render(*_fitted(parts))


def html(*parts: Table | str) -> str:
    """What `_repr_html_` answers.

    Args:
        parts: Tables and sentences, from top to bottom.

    Returns:
        A fragment of HTML, cut short likewise, every text escaped.
    """
    return markup.render(*_fitted(parts))


def named(names: Iterable[str], count: int = 4) -> str:
    """Names, one by one while they are few.

    Args:
        names: The names.
        count: How many are named.

    Returns:
        Them with commas between.

    Example:
        >>> named(["east", "west"])
        'east, west'
        >>> named(f"mast {k}" for k in range(500))
        'mast 0, mast 1, mast 2, mast 3 and 496 more'
    """
    known = [_short(name, CHARACTERS) for name in names]
    more = f" and {len(known) - count:,} more" if len(known) > count else ""
    return ", ".join(known[:count]) + more


def hertz(frequency: float) -> str:
    """A frequency in GHz or MHz.

    Args:
        frequency: The frequency [Hz].

    Returns:
        Its value and unit.

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
            shown = part.head(ROWS)
            yield replace(
                shown,
                columns=tuple(
                    replace(column, name=_short(column.name, CHARACTERS)) for column in shown.columns
                ),
                rows=tuple(tuple(_short(cell, CHARACTERS) for cell in row) for row in shown.rows),
            )


def _short(words: str, length: int) -> str:
    """Words on one line of limited length, line breaks and escape characters written out."""
    cut = words if len(words) <= length else f"{words[: length - 3]}..."
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in cut)
