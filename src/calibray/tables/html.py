"""Tables as HTML, every text escaped: names come from files."""

from __future__ import annotations

from html import escape

from calibray.tables.table import Table


def render(*parts: Table | str) -> str:
    """Tables and sentences as a fragment of HTML.

    Args:
        parts: What to show, from top to bottom; an empty string is left out.

    Returns:
        Elements `p` and `table`, without scripts or anything to be loaded.

    Example:
        >>> render("a < b")
        '<p>a &lt; b</p>'
    """
    return "\n".join(
        f"<p>{escape(part)}</p>" if isinstance(part, str) else _table(part) for part in parts if part
    )


def _table(table: Table) -> str:
    caption = f"<caption>{escape(table.title)}</caption>" if table.title else ""
    headings = [column.heading for column in table.columns]
    head = f"<thead>{_row(table, 'th', headings)}</thead>" if any(headings) else ""
    body = "".join(_row(table, "td", row) for row in table.rows)
    return f"<table>{caption}{head}<tbody>{body}</tbody></table>"


def _row(table: Table, tag: str, cells: list[str] | tuple[str, ...]) -> str:
    return "<tr>{}</tr>".format(
        "".join(
            f'<{tag} style="text-align: {column.align}">{escape(cell)}</{tag}>'
            for column, cell in zip(table.columns, cells, strict=True)
        )
    )
