"""Excel workbooks: the first sheet is converted to CSV text, so that one parser reads both formats.

Sheets are read row by row, so a sheet whose only value is in its last row and column needs no more memory than others.
"""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Iterator
from contextlib import closing
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final

from calibray.errors import InputError
from calibray.support.lazy_imports import library
from calibray.support.messages import first_line, shortened

MAX_UNPACKED: Final = 2**28
"""Largest unpacked size of a workbook [bytes]."""

MAX_CELLS: Final = 10_000_000
"""Largest number of cells of a sheet."""

MAX_ROWS: Final = 1_048_576
"""Number of rows of an Excel sheet, fixed by the format."""

_Cells = tuple[Any, ...]
_ROW: Final = re.compile(rb"""<(?:\w+:)?row\s(?:[^>]*?\s)?r=["']([^"']*)["']""")


def sheet_text(path: Path) -> tuple[list[int], str]:
    """Read the first sheet of a workbook as CSV, with the sheet's row number of each row that is not blank.

    A formula counts as its last computed value. A formula without a value stays text, which no column of numbers
    accepts. Of merged cells, the first contains the value and the others are empty. The columns are those of the
    header, which is the first row.

    Raises:
        InputError: The file is not a workbook, has no sheet of cells, is too large, or has a value in a column
            without a name; or openpyxl is not installed.
    """
    library("openpyxl", "excel")
    try:
        has_formulas = _check_archive(path)
        rows = dict(_rows(path, computed=True))
        if has_formulas:
            for number, formulas in _rows(path, computed=False):
                rows[number] = _with_formulas(rows.get(number, ()), formulas)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: not an Excel file ({first_line(error)}); save it again") from None
    table = _below_header(path, sorted(rows.items()))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_csv_cell(cell) for cell in cells] for _, cells in table)
    return [number for number, _ in table], text.getvalue()


def _check_archive(path: Path) -> bool:
    """Refuse a workbook that is too large or has rows out of order; return whether it has formulas."""
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_UNPACKED:
            raise InputError(
                f"{path}: {size / 2**20:,.0f} MiB unpacked, must be at most {MAX_UNPACKED // 2**20}; save the sheet "
                "as CSV"
            )
        sheets = [archive.read(name) for name in archive.namelist() if name.startswith("xl/worksheets/")]
    for sheet in sheets:
        _check_row_order(path, sheet)
    return any(b"<f>" in sheet or b"<f " in sheet for sheet in sheets)


def _check_row_order(path: Path, sheet: bytes) -> None:
    """Refuse rows that are not in ascending order: openpyxl drops repeated ones and spends hours on filling gaps."""
    previous = 0
    for text in _ROW.findall(sheet):
        number = int(text) if text.isdigit() and len(text) < 10 else 0
        if not previous < number <= MAX_ROWS:
            raise InputError(
                f"{path}: not an Excel file (row {shortened(text.decode(errors='replace'))!r} follows row {previous}); "
                "save it again"
            )
        previous = number


def _rows(path: Path, computed: bool) -> Iterator[tuple[int, _Cells]]:
    """Number and cells of every row that is not blank, up to its last value; computed values or formulas."""
    import openpyxl

    # The file is opened here because openpyxl does not close files that it cannot read.
    with (
        path.open("rb") as file,
        closing(openpyxl.load_workbook(file, read_only=True, data_only=computed)) as book,
    ):
        if not book.worksheets:
            raise InputError(f"{path}: has no sheet of cells; put the table into the first sheet")
        sheet = book.worksheets[0]
        sheet.reset_dimensions()  # The size that a sheet states may be wrong.
        count = 0
        for number, cells in enumerate(sheet.iter_rows(values_only=True), start=1):
            length = next((index for index in range(len(cells), 0, -1) if _has_value(cells[index - 1])), 0)
            count += length
            if count > MAX_CELLS:
                raise InputError(f"{path}: more than {MAX_CELLS:,} cells; save the sheet as CSV or Parquet")
            if length:
                yield number, cells[:length]


def _with_formulas(values: _Cells, formulas: _Cells) -> _Cells:
    """A row of computed values, with the formula as text where no value was computed."""
    padded = (*values, *[None] * (len(formulas) - len(values)))
    return tuple(
        formula if value is None and str(formula).startswith("=") else value
        for value, formula in zip_longest(padded, formulas)
    )


def _below_header(path: Path, rows: list[tuple[int, _Cells]]) -> list[tuple[int, _Cells]]:
    """Rows cut and padded to the named columns of the first row, the header."""
    if not rows:
        return rows
    header_row, header = rows[0]
    named = [index for index, cell in enumerate(header) if _has_value(cell)]
    allowed, table = set(named), []
    for number, cells in rows:
        stray = [index for index, cell in enumerate(cells) if _has_value(cell) and index not in allowed]
        if stray:
            raise InputError(
                f"{path}, row {number}: {str(cells[stray[0]])[:60]!r} is in column {stray[0] + 1}, which has no name "
                f"in row {header_row}; the first sheet must contain only the table, with the column names in its "
                "first row"
            )
        table.append((number, tuple(cells[index] if index < len(cells) else None for index in named)))
    return table


def _csv_cell(cell: Any) -> str:
    return "" if cell is None else repr(cell) if isinstance(cell, float) else str(cell)


def _has_value(cell: Any) -> bool:
    return cell is not None and bool(str(cell).strip())
