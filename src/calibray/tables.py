"""Tables as data, and functions that render tables and sentences as plain text and HTML.

Control characters and markup are escaped, because some names come from files. At the Python prompt and in notebooks,
tables and sentences are shortened.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from io import StringIO
from shutil import get_terminal_size
from typing import Final, Literal

from calibray.support.messages import printable

LISTED: Final = 12
"""Maximum number of rows, names or findings in a list; further items are only counted."""

WIDEST: Final = 100_000
"""Number of characters per line if the output is not a terminal or the terminal is too narrow; every cell fits in a
line of this length."""

ROWS: Final = 10
"""Maximum number of table rows shown at the prompt; further rows are only counted."""

CHARACTERS: Final = 60
"""Maximum number of characters shown of a cell or a name; longer text is cut."""

SENTENCE: Final = 200
"""Maximum number of characters shown of a sentence; longer sentences are cut."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: The quantity in the cells; empty for the column that contains the row names.
        unit: The unit that all cells share; empty if the cells have no unit or have different units.
        align: "left" for text, "right" for numbers.

    Example:
        >>> Column("time", "s").heading
        'time [s]'
    """

    name: str = ""
    unit: str = ""
    align: Literal["left", "right"] = "left"

    @property
    def heading(self) -> str:
        """The name, followed by the unit in brackets."""
        return " ".join(part for part in (self.name, self.unit and f"[{self.unit}]") if part)


def numbers(name: str = "", unit: str = "") -> Column:
    """Make a right-aligned column of numbers."""
    return Column(name, unit, "right")


@dataclass(frozen=True)
class Table:
    """A table with cells of text.

    Attributes:
        title: The title; may be empty.
        columns: The columns.
        rows: The cells of each row, one for every column.

    Raises:
        ValueError: A row has more or fewer cells than there are columns.

    Example:
        >>> table = Table("Cost", (Column(), numbers("time", "s")), (("tracing", "0.3"),))
        >>> table.titled, table.headed
        (False, True)
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table {self.title!r}: a row has {len(row)} cells, must be {len(self.columns)}: {row}"
                )

    @property
    def titled(self) -> bool:
        """Whether the title is shown above the table; if not, the title is the heading of the first column."""
        return bool(self.title) and bool(self.columns[0].heading)

    @property
    def headed(self) -> bool:
        """Whether the table has a row of headings."""
        return bool(self.title) or any(column.heading for column in self.columns)

    @property
    def headings(self) -> tuple[str, ...]:
        """The heading of each column."""
        first = self.columns[0].heading or self.title
        return (first, *(column.heading for column in self.columns[1:]))

    def head(self, count: int) -> Table:
        """Shorten the table to its first `count` rows; if rows are omitted, an additional last row states how many.

        Example:
            >>> Table("", (Column("link"),), (("a",), ("b",), ("c",))).head(1).rows
            (('a',), ('... and 2 more',))
        """
        if len(self.rows) <= count:
            return self
        left_out = (f"... and {len(self.rows) - count:,} more", *("" for _ in self.columns[1:]))
        return replace(self, rows=(*self.rows[:count], left_out))


def render(*parts: Table | str) -> str:
    """Render tables and sentences as plain text, separated by blank lines; empty strings are omitted.

    Example:
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
    """Render tables and sentences as HTML elements `p` and `table`, without scripts or links.

    Example:
        >>> render_html("a < b")
        '<p>a &lt; b</p>'
    """
    return "\n".join(
        f"<p>{escape(part)}</p>" if isinstance(part, str) else _html_table(part) for part in parts if part
    )


def rows_text(rows: Sequence[int]) -> str:
    """List at most `LISTED` row numbers of a file, and count the others; if there are no rows, the text is empty.

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
    """Format a value [dB] with two decimal places for a table; an unknown value becomes a dash."""
    return "-" if value is None else f"{value:.2f}"


def short_text(*parts: Table | str) -> str:
    """Render plain text for `__repr__`; long tables and cells are cut, and control characters are escaped."""
    return render(*_fitted(parts))


def short_html(*parts: Table | str) -> str:
    """Render HTML for `_repr_html_`; long tables and cells are cut, and all text is escaped."""
    return render_html(*_fitted(parts))


def named(names: Iterable[str], count: int = 4) -> str:
    """List at most `count` names, separated by commas, and count the others.

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


def _lines(table: Table) -> str:
    from rich import box
    from rich.cells import cell_len
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table as Grid
    from rich.text import Text

    grid = Grid(
        box=box.SIMPLE_HEAD if table.headed else None,
        show_header=table.headed, pad_edge=False, show_edge=False,
    )  # fmt: skip
    for index, (column, heading) in enumerate(zip(table.columns, table.headings, strict=True)):
        # The first column contains the names of the rows; if a table has only one column, it contains sentences.
        is_text = column.align == "left" and (index > 0 or len(table.columns) == 1)
        # Rich uses the longest word as the minimum width, even for a cell that must not wrap.
        cells = (heading, *(row[index] for row in table.rows))
        least = None if is_text else max(cell_len(printable(cell)) for cell in cells)
        grid.add_column(
            Text(printable(heading)),
            justify=column.align,
            no_wrap=not is_text,
            min_width=least,
            overflow="fold",
        )
    width = get_terminal_size((WIDEST, 1)).columns
    for number, row in enumerate(table.rows):
        if number and len(row) == 1 and width < WIDEST:
            grid.add_row()  # separates sentences that may span several lines
        grid.add_row(*(Text(printable(cell)) for cell in row))
    console = Console(file=StringIO(), width=WIDEST, color_system=None)
    if Measurement.get(console, console.options, grid).minimum <= width < WIDEST:
        console = Console(file=StringIO(), width=width, color_system=None)
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
    """Cut text to a maximum length and escape line breaks and control characters."""
    return printable(text if len(text) <= length else f"{text[: length - 3]}...")
