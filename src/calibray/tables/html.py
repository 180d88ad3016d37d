"""Tables as HTML; all text is escaped, since names come from files."""

from __future__ import annotations

from html import escape

from calibray.tables.table import Table


def render(*parts: Table | str) -> str:
    """Render tables and sentences as HTML: elements `p` and `table`, without scripts and links.

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
