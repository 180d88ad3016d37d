"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable

from calibray.support.messages import printable
from calibray.tables.table import Table

_RULES = {"left": "---", "right": "---:"}


def render(table: Table) -> str:
    """Render a table in Markdown, without a title above it and a line break at the end."""
    lines = [table.headings, [_RULES[column.align] for column in table.columns], *table.rows]
    return "\n".join(_line(line) for line in lines)


def _line(cells: Iterable[str]) -> str:
    escaped = (printable(cell).replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"
