"""Tables and sentences as plain text for terminals, files and pipes, as HTML and as Markdown.

Control characters and markup are escaped, because names come from files.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from io import StringIO
from typing import Final

from rich import box
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from calibray.support.messages import printable
from calibray.tables.table import Table

LISTED: Final = 12
"""Largest number of rows of a file that are listed; the others are only counted."""

WIDEST: Final = 100_000
"""Characters per line: many, so that no cell is cut; output also goes to files and pipes."""


def render(*parts: Table | str) -> str:
    """Render tables and sentences as plain text, with an empty line between them; empty strings are omitted.

    Example:
        >>> from calibray.tables import Column, numbers
        >>> print(render("study.toml", Table("Cost", (Column(), numbers()), (("tracing", "0.3 s"),))))
        study.toml
        <BLANKLINE>
        Cost
        ───────────────
        tracing   0.3 s
    """
    return "\n\n".join(
        printable(part, "\n") if isinstance(part, str) else _lines(part) for part in parts if part
    )


def render_html(*parts: Table | str) -> str:
    """Render tables and sentences as HTML: elements `p` and `table`, without scripts and links.

    Example:
        >>> render_html("a < b")
        '<p>a &lt; b</p>'
    """
    return "\n".join(
        f"<p>{escape(part)}</p>" if isinstance(part, str) else _html_table(part) for part in parts if part
    )


def render_markdown(table: Table) -> str:
    """Render a table in Markdown, without a title above it and without a final line break."""
    rules = ["---" if column.align == "left" else "---:" for column in table.columns]
    return "\n".join(_markdown_line(line) for line in [table.headings, rules, *table.rows])


def rows_text(rows: Sequence[int]) -> str:
    """List rows of a file; if there are many, only the first ones; empty without rows.

    Example:
        >>> rows_text([3, 4, 9])
        'rows 3, 4, 9'
        >>> rows_text(range(2, 40))
        'rows 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13 and 26 more'
    """
    if not rows:
        return ""
    first = ", ".join(map(str, rows[:LISTED]))
    more = f" and {len(rows) - LISTED} more" if len(rows) > LISTED else ""
    return f"row{'s' if len(rows) > 1 else ''} {first}{more}"


def decibels(value: float | None) -> str:
    """Format a value [dB] for tables with two decimals; a dash if unknown."""
    return "-" if value is None else f"{value:.2f}"


def _lines(table: Table) -> str:
    grid = Grid(
        box=box.SIMPLE_HEAD if table.headed else None,
        show_header=table.headed, pad_edge=False, show_edge=False,
    )  # fmt: skip
    for column, heading in zip(table.columns, table.headings, strict=True):
        grid.add_column(Text(printable(heading)), justify=column.align, no_wrap=True)
    for row in table.rows:
        grid.add_row(*(Text(printable(cell)) for cell in row))
    console = Console(file=StringIO(), width=WIDEST, color_system=None)
    with console.capture() as shown:
        console.print(grid)
    lines = [line.rstrip() for line in shown.get().splitlines()]
    return "\n".join([printable(table.title), *lines] if table.titled else lines)


def _html_table(table: Table) -> str:
    caption = f"<caption>{escape(table.title)}</caption>" if table.title else ""
    headings = [column.heading for column in table.columns]
    head = f"<thead>{_html_row(table, 'th', headings)}</thead>" if any(headings) else ""
    body = "".join(_html_row(table, "td", row) for row in table.rows)
    return f"<table>{caption}{head}<tbody>{body}</tbody></table>"


def _html_row(table: Table, tag: str, cells: list[str] | tuple[str, ...]) -> str:
    return "<tr>{}</tr>".format(
        "".join(
            f'<{tag} style="text-align: {column.align}">{escape(cell)}</{tag}>'
            for column, cell in zip(table.columns, cells, strict=True)
        )
    )


def _markdown_line(cells: Iterable[str]) -> str:
    escaped = (printable(cell).replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"
