"""Excel workbooks: their first sheet as text of the CSV form, so that one reader judges both.

Read row by row: a sheet whose only value stands in its last column and row takes no more memory than others.
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
from calibray.support.extras import library
from calibray.support.messages import first_line, shortened

UNPACKED: Final = 2**28
"""Size beyond which a workbook's files are not unpacked [bytes]."""
CELLS: Final = 10_000_000
"""Number of cells beyond which a sheet is refused."""

ROWS: Final = 1_048_576
"""The rows of an Excel sheet."""

_ROW: Final = re.compile(rb"""<(?:\w+:)?row\s(?:[^>]*?\s)?r=["']([^"']*)["']""")


def sheet_text(path: Path) -> tuple[list[int], str]:
    """The first sheet of a workbook, blank rows left out, as CSV.

    A formula is what it gave when the workbook was last computed; one that never was is its own text, which is no
    number. Of merged cells the first holds the value and the others none.

    Args:
        path: The workbook, .xlsx.

    Returns:
        The number of every row, the header's first, and the text; the columns are those of the header.

    Raises:
        InputError: The file is no workbook, has no sheet of cells, holds more than can be read, or has a value beside
            the columns that have a name; or openpyxl is not installed.
    """
    library("openpyxl", "excel")
    try:
        formulas = _formulas(path)
        rows = dict(_rows(path, computed=True))
        if formulas:
            for number, cells in _rows(path, computed=False):
                rows[number] = _filled(rows.get(number, ()), cells)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: not an Excel file ({first_line(error)}); save it again") from None
    table = _named(path, sorted(rows.items()))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([_words(cell) for cell in cells] for _, cells in table)
    return [number for number, _ in table], text.getvalue()


def _formulas(path: Path) -> bool:
    """Whether there are formulas in a workbook of a size that can be read."""
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > UNPACKED:
            raise InputError(
                f"{path}: {size / 2**20:,.0f} MiB unpacked, at most {UNPACKED // 2**20} are read; save the sheet as CSV"
            )
        sheets = [archive.read(name) for name in archive.namelist() if name.startswith("xl/worksheets/")]
    for content in sheets:
        _check_order(path, content)
    return any(b"<f>" in content or b"<f " in content for content in sheets)


def _check_order(path: Path, sheet: bytes) -> None:
    """Refuse rows that do not ascend: openpyxl passes over them, and fills what lies between with empty ones."""
    before = 0
    for text in _ROW.findall(sheet):
        number = int(text) if text.isdigit() and len(text) < 10 else 0
        if not before < number <= ROWS:
            raise InputError(
                f"{path}: not an Excel file (row {shortened(text.decode(errors='replace'))!r} follows row {before}); "
                "save it again"
            )
        before = number


def _rows(path: Path, computed: bool) -> Iterator[tuple[int, tuple[Any, ...]]]:
    """Number and cells of every row that is not blank, up to its last value; formulas or what they gave."""
    import openpyxl

    # Opened here, for openpyxl leaves open what it cannot read.
    with (
        path.open("rb") as file,
        closing(openpyxl.load_workbook(file, read_only=True, data_only=computed)) as book,
    ):
        if not book.worksheets:
            raise InputError(f"{path}: has no sheet of cells; put the table into the first sheet")
        sheet = book.worksheets[0]
        # What a sheet says of its own size may be wrong.
        sheet.reset_dimensions()
        count = 0
        for number, cells in enumerate(sheet.iter_rows(values_only=True), start=1):
            last = next((place for place in range(len(cells), 0, -1) if _holds(cells[place - 1])), 0)
            count += last
            if count > CELLS:
                raise InputError(f"{path}: more than {CELLS:,} cells; save the sheet as CSV or Parquet")
            if last:
                yield number, cells[:last]


def _filled(cells: tuple[Any, ...], written: tuple[Any, ...]) -> tuple[Any, ...]:
    """A row whose formulas stand as text where nothing was computed."""
    short = len(written) - len(cells)
    return tuple(
        formula if cell is None and str(formula).startswith("=") else cell
        for cell, formula in zip_longest((*cells, *[None] * short), written)
    )


def _words(cell: Any) -> str:
    """A cell as CSV has it."""
    return "" if cell is None else repr(cell) if isinstance(cell, float) else str(cell)


def _holds(cell: Any) -> bool:
    return cell is not None and bool(str(cell).strip())


def _named(path: Path, rows: list[tuple[int, tuple[Any, ...]]]) -> list[tuple[int, tuple[Any, ...]]]:
    """Rows as long as the header, which is the first of them."""
    if not rows:
        return rows
    first, header = rows[0]
    found = []
    for number, cells in rows:
        places = [place for place, cell in enumerate(cells) if _holds(cell)]
        if stray := [place for place in places if place >= len(header) or not _holds(header[place])]:
            raise InputError(
                f"{path}, row {number}: {str(cells[stray[0]])[:60]!r} stands in column {stray[0] + 1}, which has no "
                f"name in row {first}; the table is the first sheet alone, its first row names the columns"
            )
        found.append((number, (*cells, *[None] * (len(header) - len(cells)))))
    named = [place for place, cell in enumerate(header) if _holds(cell)]
    return [(number, tuple(cells[place] for place in named)) for number, cells in found]
