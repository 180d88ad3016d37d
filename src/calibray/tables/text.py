"""Tables as plain text, for terminals, files and pipes."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from typing import Final

from rich import box
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from calibray.tables.table import Table

LISTED: Final = 12
"""Rows of a file that are named one by one before the rest is only counted."""

WIDEST: Final = 100_000
"""Characters in a line: output is for files and pipes as much as for a screen, so no cell is ever cut short."""


def render(*parts: Table | str) -> str:
    """Tables and sentences as plain text, an empty line between them.

    Args:
        parts: What to show, from top to bottom; an empty string is left out.

    Returns:
        Lines of text, without a line break at the end.

    Example:
        >>> from calibray.tables import Column, numbers
        >>> print(render("study.toml", Table("Cost", (Column(), numbers()), (("tracing", "0.3 s"),))))
        study.toml
        <BLANKLINE>
        Cost
        ───────────────
        tracing   0.3 s
    """
    return "\n\n".join(part if isinstance(part, str) else _lines(part) for part in parts if part)


def rows_text(rows: Sequence[int]) -> str:
    """Rows of a file, named one by one while they are few.

    Args:
        rows: Lines of the file.

    Returns:
        Them as words, empty if there is none.

    Example:
        >>> rows_text([3, 4, 9])
        'rows 3, 4, 9'
        >>> rows_text(range(2, 40))
        'rows 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13 and 26 more'
    """
    if not rows:
        return ""
    named = ", ".join(map(str, rows[:LISTED]))
    more = f" and {len(rows) - LISTED} more" if len(rows) > LISTED else ""
    return f"row{'s' if len(rows) > 1 else ''} {named}{more}"


def decibels(value: float | None) -> str:
    """A value in decibels as tables show it.

    Args:
        value: The value [dB], or None if there is none.

    Returns:
        Two decimals, or a dash.
    """
    return "-" if value is None else f"{value:.2f}"


def _lines(table: Table) -> str:
    grid = Grid(
        box=box.SIMPLE_HEAD if table.headed else None,
        show_header=table.headed, pad_edge=False, show_edge=False,
    )  # fmt: skip
    for column, heading in zip(table.columns, table.headings, strict=True):
        grid.add_column(Text(heading), justify=column.align, no_wrap=True)
    for row in table.rows:
        grid.add_row(*map(Text, row))
    console = Console(file=StringIO(), width=WIDEST, color_system=None)
    with console.capture() as shown:
        console.print(grid)
    lines = [line.rstrip() for line in shown.get().splitlines()]
    return "\n".join([table.title, *lines] if table.titled else lines)
