"""Tables as data, independent of their layout."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Meaning of its cells; empty for the column that names the rows.
        unit: Unit of all its cells; empty if they have no unit or different ones.
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
        """The name with the unit in brackets."""
        return " ".join(part for part in (self.name, self.unit and f"[{self.unit}]") if part)


def numbers(name: str = "", unit: str = "") -> Column:
    """A column of numbers, aligned to the right."""
    return Column(name, unit, "right")


@dataclass(frozen=True)
class Table:
    """A table with cells of text.

    Attributes:
        title: Its title; may be empty.
        columns: Its columns.
        rows: The cells of every row, one per column.

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
        """Whether the title is above the table; otherwise it is the heading of the first column."""
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
        """The first rows, and a last row with the number of rows that are left out, if any.

        Example:
            >>> Table("", (Column("link"),), (("a",), ("b",), ("c",))).head(1).rows
            (('a',), ('... and 2 more',))
        """
        if len(self.rows) <= count:
            return self
        left_out = (f"... and {len(self.rows) - count:,} more", *("" for _ in self.columns[1:]))
        return replace(self, rows=(*self.rows[:count], left_out))
