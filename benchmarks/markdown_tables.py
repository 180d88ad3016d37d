"""Tables in Markdown, for the pages of measurements."""

from __future__ import annotations

from collections.abc import Iterable

from calibray.support.messages import printable
from calibray.tables import Table


def render_markdown(table: Table) -> str:
    """Render a table in Markdown, without a title above it and without a final line break."""
    rules = ["---" if column.align == "left" else "---:" for column in table.columns]
    return "\n".join(_line(cells) for cells in [table.headings, rules, *table.rows])


def _line(cells: Iterable[str]) -> str:
    escaped = (printable(cell).replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"
