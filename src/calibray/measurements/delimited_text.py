"""Read text tables that loggers and spreadsheets have written; detect the encoding, separator, header and units."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.measurements.source_table import SourceTable
from calibray.support.messages import counted, shortened

SUFFIXES: Final = (".csv", ".txt", ".tsv", ".dat")
"""File extensions of text tables."""

PLACEHOLDERS: Final = frozenset({"-", "--", "---", "\u2013", "\u2014", "?", "*"})
"""Strings that represent a missing number in a column of numbers."""

UNITS: Final = frozenset({
    "m", "cm", "mm", "km", "ft", "feet", "foot", "in", "inch", "inches", "db", "dbm", "dbi", "hz", "khz",
    "mhz", "ghz", "deg", "degree", "degrees", "\u00b0", "rad", "radian", "radians", "s", "ms", "us", "\u00b5s",
    "\u03bcs", "ns", "min", "h", "%", "v", "w", "mw", "m/s", "km/h", "mph", "bit", "kbps", "mbps", "bool", "string",
    "text", "int", "float",
})  # fmt: skip
"""Units, in lower case, that are recognized in a row of units below the header."""

_HEAD: Final = 64  # number of records from which the layout of a file is detected


@dataclass(frozen=True)
class _Layout:
    """Layout of a text table.

    Attributes:
        separator: Column separator; a space stands for any sequence of spaces and tabs.
        skipped: Number of lines above the header.
        units: Unit of each column, from the row of units below the header; empty if there is no such row.
        unit_lines: Indices, counted from the header, of the first line of the row of units and of the line after this
            row.
    """

    separator: str
    skipped: int = 0
    units: tuple[str, ...] = ()
    unit_lines: tuple[int, int] = (0, 0)


def read_text(path: Path) -> str:
    """Read a text file encoded in UTF-8, UTF-16 or, failing these, Windows-1252.

    Raises:
        InputError: The file cannot be read, is an archive or contains bytes that are not text.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    if raw.startswith(b"PK\x03\x04"):
        raise InputError(
            f"{path}: the file is a ZIP archive or an Excel file; unpack it, or name the Excel file .xlsx"
        )
    encoding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    # Without a byte order mark, the zero bytes of the first letters indicate UTF-16 and its byte order.
    if raw[:2].count(0) == raw[2:4].count(0) == 1:
        encoding = "utf-16-be" if raw.startswith(b"\0") else "utf-16-le"
    try:
        return raw.decode(encoding)
    except UnicodeDecodeError as error:
        try:
            text = raw.decode("cp1252")
        except UnicodeDecodeError:
            text = "\0"
        if re.search(r"[\x00-\x08\x0e-\x1f\x7f]", text):
            raise InputError(
                f"{path}: not UTF-8 text ({error.reason} at byte {error.start}); save it as UTF-8"
            ) from None
        return text


def parse_text(path: Path, text: str, separator: str | None = None) -> SourceTable:
    r"""Read the rows of a text table; blank lines are ignored.

    A line above the header is skipped if most of its cells are empty, or if its number of cells differs from that of
    the header. Units in the row below the header are appended to the column names. Cells in a column of numbers can
    contain placeholders (`PLACEHOLDERS`). Every number in a column can be followed by a decibel unit, which must be the
    same throughout the column.

    Args:
        path: Path of the file, for messages.
        text: Content of the file.
        separator: Column separator; detected if None.

    Raises:
        InputError: The text is malformed, or its header or decimal mark is ambiguous.
        KeyboardInterrupt: The user pressed Ctrl-C while pandas was reading.

    Example:
        >>> text = "Logger 2.1\nx;y;Pegel\nm;m;dBm\n1,5;2;-70,5\n2,5;2;-\n"
        >>> parse_text(Path("log.csv"), text).frame
           x [m]  y [m]  Pegel [dBm]
        0    1.5      2        -70.5
        1    2.5      2          NaN
    """
    layout = _layout(text, separator)
    lines = list(io.StringIO(text, newline=""))[layout.skipped :]
    if layout.separator == " ":
        lines = [re.sub(r"[ \t]+", " ", line.strip(" \t")) for line in lines]
    first, end = layout.unit_lines
    # Blank lines replace the row of units, so that line numbers stay correct.
    lines[first:end] = ["\n"] * (end - first)
    text = "".join(lines)
    header, rows, has_empty_end = _checked_layout(path, text, layout)
    if not header:
        return SourceTable(pd.DataFrame())
    decimal = "." if layout.separator == "," else _decimal_mark(path, text, layout)
    try:
        frame = pd.read_csv(
            io.StringIO(text),
            sep=layout.separator,
            decimal=decimal,
            skipinitialspace=True,
            low_memory=False,
            index_col=False if has_empty_end else None,
        )
    except ValueError as error:
        # pandas reports Ctrl-C during reading as "source failed"; when pandas reads from memory, this has no other
        # cause.
        if "source failed" in str(error):
            raise KeyboardInterrupt from None
        raise InputError(f"{path}: malformed CSV ({shortened(str(error), 300)}); check the quotes") from None
    if len(frame) != len(rows):
        raise InputError(
            f"{path}: the file has {len(rows)} rows, but only {len(frame)} can be read; check the quotes"
        )
    units = layout.units or [""] * len(frame.columns)
    frame = frame.set_axis(list(map(_with_unit, frame, units)), axis=1)
    for name in frame:
        frame[name] = _plain_numbers(frame[name], decimal)
    table = SourceTable(frame, np.array(rows, dtype=np.int64), str(path))
    return table.note("lines above the header, skipped", layout.skipped) if layout.skipped else table


def _layout(text: str, separator: str | None) -> _Layout:
    """Find the first line that can be the header of the rows below, and the separator that gives the most columns."""
    first_lines = list(islice(io.StringIO(text, newline=""), 30 + 4 * _HEAD))
    for above in range(31):  # number of lines above the header
        layouts: list[tuple[int, _Layout]] = []
        head = first_lines[above : above + 4 * _HEAD]
        if above and (len(head) < 2 or not head[0].strip()):
            continue
        for mark in ",;\t " if separator is None else separator:
            records = _records(head, mark)
            widths = {len(cells) for cells, _, _ in records[1:]}
            width = len(records[0][0]) if records else 0
            # Rows may end with a separator even if the header does not.
            if width < 2 or not widths <= {width, width + 1} or len(widths) > 1:
                continue
            # Spreadsheets pad lines above the header with empty cells.
            if 2 * sum(map(bool, map(str.strip, records[0][0]))) < width:
                continue
            # A row of values is not a header, and lines above a header are not rows of the table.
            if above and (len(records) < 2 or any(map(_is_number, records[0][0]))):
                continue
            layouts.append((width, _Layout(mark, above, *_unit_row(records))))
        marks = {layout.separator for _, layout in layouts}
        if layouts and marks != {" "}:
            return max(
                (layout for layout in layouts if layout[1].separator != " "), key=lambda layout: layout[0]
            )[1]
        if layouts and not any(mark in head[0] for mark in ",;\t"):
            return layouts[0][1]
    header = next((line for line in io.StringIO(text) if line.strip()), "")
    return _Layout(separator or next((mark for mark in ";\t" if mark in header and "," not in header), ","))


def _records(lines: Sequence[str], mark: str) -> list[tuple[list[str], int, int]]:
    """Split the first non-blank records into cells, each with the line indices of its start and its end."""
    if mark == " ":
        lines = [re.sub(r"[ \t]+", " ", line.strip(" \t")) for line in lines]
    reader, records, start = csv.reader(lines, delimiter=mark, skipinitialspace=True), [], 0
    try:
        for cells in islice(reader, _HEAD):
            if len(cells) > 1 or "".join(cells).strip():
                records.append((cells, start, reader.line_num))
            start = reader.line_num
    except csv.Error:
        return []
    return records


def _unit_row(records: Sequence[tuple[list[str], int, int]]) -> tuple[tuple[str, ...], tuple[int, int]]:
    """Units of the columns, and the first line and end of the row of units; () and (0, 0) if there is no such row."""
    if len(records) < 3:
        return (), (0, 0)
    (header, *_), (cells, start, end), (below, *_) = records[:3]
    units = [cell.strip().strip("[]()") for cell in cells]
    over_numbers = [unit.lower() for unit, number in zip(units, below, strict=False) if _is_number(number)]
    allowed = UNITS | PLACEHOLDERS | {""}
    if not (UNITS & set(over_numbers) and set(over_numbers) <= allowed) or any(map(_is_number, cells)):
        return (), (0, 0)
    return tuple(unit if unit.lower() in UNITS else "" for unit in units[: len(header)]), (start, end)


def _is_number(cell: str) -> bool:
    return bool(re.fullmatch(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?", cell.strip(), re.IGNORECASE))


def _with_unit(name: object, unit: str) -> str:
    """Append a unit to the name of a column, unless the name already contains the unit."""
    plain = str(name).strip()
    return (
        plain
        if not unit or unit.lower() in re.split(r"[^a-z\u00b0%/]+", plain.lower())
        else f"{plain} [{unit}]"
    )


def _plain_numbers(column: pd.Series, decimal: str) -> pd.Series:
    """Convert a column of strings to numbers.

    The strings can be numbers, numbers with a common decibel unit, or placeholders. If any other string occurs, the
    column remains text, without leading and trailing white space.
    """
    if not pd.api.types.is_string_dtype(column):
        return column
    texts = column.str.strip()
    empty = column.isna() | texts.isin(PLACEHOLDERS)
    units = texts.str.extract(r"(?i)^[^a-z]*?\d\s*(dbm?)$", expand=False).str.lower()[~empty]
    if len(units) and units.notna().all() and units.nunique() == 1:
        texts = texts.str.replace(r"(?i)\s*dbm?$", "", regex=True)
    elif empty.sum() == column.isna().sum():
        return texts
    numbers = pd.to_numeric(texts.str.replace(decimal, ".") if decimal != "." else texts, errors="coerce")
    is_text = numbers.isna() & ~empty
    return texts if is_text.any() or empty.all() else numbers


def _decimal_mark(path: Path, text: str, layout: _Layout) -> str:
    """Find the decimal mark of the numbers in a CSV text.

    Raises:
        InputError: Numbers have different decimal marks, or a decimal mark could be a thousands separator.
    """
    lines: dict[str, int] = {}
    # The first number with a comma or point in each column, and the columns that contain whole numbers of at most four
    # characters.
    unclear: dict[int, tuple[int, str]] = {}
    whole: set[int] = set()
    is_clear = False
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=layout.separator, skipinitialspace=True)
    for cells in reader:
        for column, cell in enumerate(map(str.strip, cells)):
            if "," in cell or "." in cell:
                number = re.fullmatch(r"[+-]?\d*([.,])\d+(e[+-]?\d+)?(\s*dbm?)?", cell, re.IGNORECASE)
                if number is not None:
                    line = layout.skipped + reader.line_num
                    lines.setdefault(number[1], line)
                    is_clear |= re.fullmatch(r"[+-]?[1-9]\d{0,2}[.,]\d{3}", cell) is None
                    unclear.setdefault(column, (line, cell))
            elif len(cell) <= 4 and cell.lstrip("+-").isdecimal():
                whole.add(column)
    if len(lines) > 1:
        raise InputError(
            f"{path}: numbers have a decimal comma in row {lines[',']} and a decimal point in row {lines['.']}; use "
            "the same mark throughout"
        )
    if "," in lines and not is_clear and (both := sorted(whole & set(unclear))):
        line, cell = unclear[both[0]]
        raise InputError(
            f"{path}, row {line}: {cell!r} can mean {cell.replace(',', '.')} or {cell.replace(',', '')}, because its "
            "column also contains numbers without a comma; remove thousands separators, or write decimal points"
        )
    return "," if "," in lines else "."


def _checked_layout(path: Path, text: str, layout: _Layout) -> tuple[list[str], list[int], bool]:
    """Read the header and the line number of each row of a CSV text; reject faults that pandas would correct silently.

    The third return value is true if every row ends with an additional empty cell.

    Raises:
        InputError: The header contains only numbers or names a column twice, or a row has more or fewer cells than the
            header.
    """
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=layout.separator, skipinitialspace=True)
    header: list[str] = []
    lines: list[int] = []
    ends: set[int] = set()
    next_line = layout.skipped + 1
    try:
        for cells in reader:
            line, next_line = next_line, layout.skipped + reader.line_num + 1
            if len(cells) <= 1 and not "".join(cells).strip():
                continue
            if not header:
                header = cells
                if all(map(_is_number, filter(str.strip, header))):
                    raise InputError(
                        f"{path}, row {line}: contains numbers; insert a line with the column names above this row"
                    )
                names = Counter(name.strip() for name in header if name.strip())
                if repeated := [name for name, count in names.items() if count > 1]:
                    raise InputError(
                        f"{path}, row {line}: column {repeated[0]!r} appears twice; rename one of the columns"
                    )
                continue
            ends.add(len(cells) - len(header))
            if len(ends) > 1 or ends - {0, 1} or (1 in ends and cells[-1].strip()):
                raise InputError(
                    f"{path}, row {line}: {counted(len(cells), 'cell')}, but the header has "
                    f"{len(header)}; correct the row"
                )
            lines.append(line)
    except csv.Error as error:
        raise InputError(f"{path}, row {next_line}: malformed CSV ({error})") from None
    return header, lines, 1 in ends
