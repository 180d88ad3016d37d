"""Read tables from CSV, Parquet and Excel files.

The first sheet of a workbook is converted to CSV text, so that one parser reads both formats. Sheets are read row by
row, so that a single value in the last row and column of a sheet does not increase the memory needed.
"""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.measurements.delimited_text import SUFFIXES, parse_text, read_text
from calibray.measurements.source_table import SourceTable
from calibray.support.lazy_imports import library
from calibray.support.memory import available_memory, run_limited
from calibray.support.messages import first_line, shortened
from calibray.support.output_files import as_path, exists

MAX_UNPACKED: Final = 2**28
"""Maximum unpacked size of a workbook [bytes]."""

MAX_CELLS: Final = 10_000_000
"""Maximum number of cells in a sheet."""

_Cells = tuple[Any, ...]
_ROW: Final = re.compile(rb"""<(?:\w+:)?row\s(?:[^>]*?\s)?r=["']([^"']*)["']""")


def sheet_text(path: Path) -> tuple[list[int], str]:
    """Read the first sheet of a workbook as CSV text, and the number of each row that is not blank.

    A formula is replaced by its last computed value. If there is no computed value, the formula remains text, which is
    rejected in a column of numbers. Of several merged cells, the first contains the value, and the others are empty.
    The header, which is the first row, determines the columns.

    Raises:
        InputError: The file is not a workbook, contains no worksheet, is too large, or has a value in a column without
            a name. openpyxl is not installed.
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
        raise InputError(
            f"{path}: the file is not an Excel file ({first_line(error)}); save it again"
        ) from None
    table = _below_header(path, sorted(rows.items()))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(
        ["" if cell is None else repr(cell) if isinstance(cell, float) else str(cell) for cell in cells]
        for _, cells in table
    )
    return [number for number, _ in table], text.getvalue()


def _check_archive(path: Path) -> bool:
    """Check that a workbook is not too large and has its rows in order; return whether it contains formulas."""
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_UNPACKED:
            raise InputError(
                f"{path}: {size / 2**20:,.0f} MiB unpacked, more than the limit of {MAX_UNPACKED // 2**20} MiB; save "
                "the sheet as CSV"
            )
        sheets = [archive.read(name) for name in archive.namelist() if name.startswith("xl/worksheets/")]
    for sheet in sheets:
        _check_row_order(path, sheet)
    return any(b"<f>" in sheet or b"<f " in sheet for sheet in sheets)


def _check_row_order(path: Path, sheet: bytes) -> None:
    """Reject rows that are out of order, because openpyxl drops repeated rows and takes hours to fill gaps."""
    previous = 0
    for text in _ROW.findall(sheet):
        number = int(text) if text.isdigit() and len(text) < 10 else 0
        # An Excel sheet has at most 2^20 rows.
        if not previous < number <= 1_048_576:
            raise InputError(
                f"{path}: the file is not an Excel file (row {shortened(text.decode(errors='replace'))!r} follows "
                f"row {previous}); save it again"
            )
        previous = number


def _rows(path: Path, computed: bool) -> Iterator[tuple[int, _Cells]]:
    """Yield the number and the cells (computed values or formulas) of each non-blank row, up to its last value."""
    import openpyxl

    # The file is opened here because openpyxl does not close files that it cannot read.
    with (
        path.open("rb") as file,
        closing(openpyxl.load_workbook(file, read_only=True, data_only=computed)) as book,
    ):
        if not book.worksheets:
            raise InputError(f"{path}: contains no worksheet; store the table in the first sheet")
        sheet = book.worksheets[0]
        sheet.reset_dimensions()  # The dimensions stated in a sheet may be wrong.
        count = 0
        for number, cells in enumerate(sheet.iter_rows(values_only=True), start=1):
            length = next((index for index in range(len(cells), 0, -1) if _has_value(cells[index - 1])), 0)
            count += length
            if count > MAX_CELLS:
                raise InputError(
                    f"{path}: the sheet has more than {MAX_CELLS:,} cells; save the sheet as CSV or Parquet"
                )
            if length:
                yield number, cells[:length]


def _with_formulas(values: _Cells, formulas: _Cells) -> _Cells:
    """A row of computed values. Cells without a computed value contain the formula as text."""
    padded = (*values, *[None] * (len(formulas) - len(values)))
    return tuple(
        formula if value is None and str(formula).startswith("=") else value
        for value, formula in zip_longest(padded, formulas)
    )


def _below_header(path: Path, rows: list[tuple[int, _Cells]]) -> list[tuple[int, _Cells]]:
    """Rows, truncated or padded to the columns that the header (the first row) names."""
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
                f"in row {header_row}; the first sheet must contain only the table, with the column names in the first "
                "row"
            )
        table.append((number, tuple(cells[index] if index < len(cells) else None for index in named)))
    return table


def _has_value(cell: Any) -> bool:
    return cell is not None and bool(str(cell).strip())


LARGEST_ROW_GROUP: Final = 2**30
"""Maximum decompressed size of a row group or piece of a Parquet file that is read in pieces [bytes]."""

LARGEST_TABLE: Final = 2 * LARGEST_ROW_GROUP
"""Maximum decompressed size of a Parquet file that is read as a whole [bytes]; pandas requires up to twice this
memory."""

DECODING_MEMORY: Final = 2 * LARGEST_TABLE
"""Limit on the address space of the separate process that first decodes a Parquet file [bytes]."""

PIECE_ROWS: Final = 100_000
"""Maximum number of rows of a Parquet file that are read together."""

# Both programs import pyarrow without NumPy, which they do not need. A process then takes 0.21 s instead of 0.39 s.
_DECODE: Final = """
sys.modules["numpy"] = None
from pyarrow import parquet
try:
    size = 0
    with parquet.ParquetFile({path!r}, pre_buffer=False) as file:
        for batch in file.iter_batches({rows}, use_threads=False):
            batch.validate(full=True)
            size = batch.nbytes + (size if {whole} else 0)
            if size > {limit}:
                raise MemoryError
except MemoryError:
    refuse("the content takes more memory than the file declares; export the file again")
except Exception as error:
    refuse("the file is not a Parquet file (" + " ".join(str(error).split())[:300] + "); export it again")
"""

_METADATA: Final = """
sys.modules["numpy"] = None
from pyarrow import parquet
try:
    with parquet.ParquetFile({path!r}, pre_buffer=False) as file:
        for number in range(file.metadata.num_row_groups):
            group = file.metadata.row_group(number)
            for index in range(group.num_columns):
                group.column(index).statistics
except Exception as error:
    refuse("the file is not a Parquet file (" + " ".join(str(error).split())[:300] + "); export it again")
"""

_decoded: Final[set[tuple[str | int, ...]]] = set()
"""Programs that have run without errors, each with the state of its file at that time."""


def read_table(path: str | Path) -> SourceTable:
    """Read a .csv, .txt, .tsv, .dat or .parquet file, or the first sheet of an .xlsx file. Blank lines are skipped.

    The columns of a text file are separated by commas, semicolons, tabs or spaces. If the separator is not a comma,
    numbers can have decimal commas. See `parse_text` for other lines that are skipped.

    Raises:
        InputError: The file does not exist, has a different extension, or is empty or malformed. The library that reads
            the file (pyarrow or openpyxl) is not installed.
    """
    path = as_path(path, "table")
    if not exists(path):
        raise InputError(f"{shortened(str(path), 300)}: no such file")
    match path.suffix.lower():
        case suffix if suffix in SUFFIXES:
            table = parse_text(path, read_text(path))
        case ".parquet":
            table = _read_parquet(path)
        case ".xlsx":
            numbers, text = sheet_text(path)
            table = parse_text(path, text, ",")
            # Line numbers in the text include line breaks within cells, whereas row numbers in the sheet include blank
            # rows. The header, the units and any lines above the header come first, so the table ends with the sheet.
            table = replace(table, row=np.array(numbers[len(numbers) - len(table) :], dtype=np.int64))
        case suffix:
            raise InputError(
                f"{path}: cannot read a {suffix or 'extensionless'} table; use .csv, .txt, .parquet or .xlsx"
            )
    if len(table) == 0:
        raise InputError(f"{path}: contains no rows; a table needs a header and at least one row")
    return table


@final
@dataclass(frozen=True, eq=False)
class PiecedTable:
    """A table that is read in pieces, so that a large Parquet file is never loaded entirely.

    Attributes:
        source: Name of the file.
        rows: Number of rows.
        whole: All rows, if the file format does not support reading in pieces; None for Parquet.
    """

    source: str
    rows: int
    whole: SourceTable | None

    @classmethod
    def open(cls, path: str | Path) -> PiecedTable:
        """Open a CSV, Parquet or Excel file. CSV and Excel files are read immediately.

        Raises:
            InputError: The file has a fault described in `read_table`.
        """
        path = Path(path)
        if path.suffix.lower() != ".parquet" or not exists(path):
            table = read_table(path)
            return cls(str(path), len(table), table)
        library("pyarrow", "parquet")
        with _open_parquet(path) as file:
            rows = file.metadata.num_rows
            groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        size = sum(_check_size(path, [group], LARGEST_ROW_GROUP, "a row group") for group in groups)
        _decode_elsewhere(path, size, LARGEST_ROW_GROUP, whole=False)
        if not rows:
            raise InputError(f"{path}: contains no rows; a table needs a header and at least one row")
        return cls(str(path), rows, None)

    def pieces(self, size: int) -> Iterator[SourceTable]:
        """Yield the rows in file order, in pieces of at most `size` rows. A column has the same type in all pieces.

        Raises:
            InputError: The file is damaged.
        """
        if self.whole is not None:
            for start in range(0, self.rows, size):
                piece = slice(start, start + size)
                frame = self.whole.frame.iloc[piece].reset_index(drop=True)
                yield SourceTable(frame, self.whole.row[piece], self.source)
            return
        path = Path(self.source)
        with _open_parquet(path) as file:
            integers_with_gaps, start = _integer_columns_with_gaps(file), 0
            batches = file.iter_batches(batch_size=min(size, PIECE_ROWS))
            while (frame := _next_frame(path, batches)) is not None:
                # NumPy integers cannot be missing, so pandas reads an integer column as float in pieces with gaps.
                # The same columns are therefore converted to float in the other pieces.
                numpy_columns = [
                    name
                    for name in integers_with_gaps
                    if name in frame and isinstance(frame.dtypes[name], np.dtype)
                ]
                frame = frame.astype(dict.fromkeys(numpy_columns, np.float64))
                yield SourceTable(frame, np.arange(start + 1, start + len(frame) + 1), self.source)
                start += len(frame)


def _read_parquet(path: Path) -> SourceTable:
    if find_spec("pyarrow") is None:
        raise InputError(f"{path}: Parquet needs pyarrow; install it with: pip install 'calibray[parquet]'")
    with _open_parquet(path) as file:
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
    size = _check_size(path, groups, LARGEST_TABLE, "the table")
    _decode_elsewhere(path, size, LARGEST_TABLE, whole=True)
    try:
        frame = _without_decimals(pd.read_parquet(path, engine="pyarrow"))
    except Exception as error:
        raise _damaged(path, error) from None
    return SourceTable(with_index_columns(frame), source=str(path))


def _check_size(path: Path, groups: Sequence[Any], limit: int, what: str) -> int:
    """Check the declared size of row groups, because kilobytes can decompress to gigabytes; return this size [bytes].

    Raises:
        InputError: The size exceeds the limit or the available memory.
    """
    # A column of one repeated value takes almost no space in the file, but eight bytes for each row in memory.
    size = sum(
        max(group.column(index).total_uncompressed_size, 8 * group.num_rows)
        for group in groups
        for index in range(group.num_columns)
    )
    if size > min(limit, available_memory()):
        raise InputError(
            f"{path}: {what} takes {size / 2**30:,.1f} GiB decompressed, which exceeds the limit of "
            f"{limit / 2**30:g} GiB or the free memory; keep only the required columns and rows, or "
            "write smaller row groups"
        )
    return size


def _decode_elsewhere(path: Path, size: int, limit: int, whole: bool) -> None:
    """Decode a Parquet file in a separate process with limits, because the content can be larger than declared.

    Pages can be larger than declared, and many rows can repeat one text. `size` is the declared size, and `limit` is
    the maximum size of the rows in memory, both in bytes. If `whole` is true, the limit applies to the table;
    otherwise, the limit applies to each piece.

    Raises:
        InputError: The file requires too much memory or time, or is damaged.
    """
    code = _DECODE.format(path=str(path.resolve()), limit=limit, whole=whole, rows=PIECE_ROWS)
    _run_elsewhere(path, code, size)


def _run_elsewhere(path: Path, code: str, size: int) -> None:
    """Run a program on a file in a separate process with limits, but only once per program and state of the file.

    Raises:
        InputError: The file requires too much memory or time, or is damaged.
    """
    status = path.stat()
    key = (code, status.st_mtime_ns, status.st_size, status.st_ino)
    if key in _decoded:
        return
    try:
        is_read = run_limited(code, DECODING_MEMORY, size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except TimeoutError as error:
        raise InputError(f"{path}: cannot be decompressed {error}; export it again") from None
    if not is_read:
        raise InputError(
            f"{path}: the library that reads Parquet files crashes while reading this file; export it again"
        )
    _decoded.add(key)


def _open_parquet(path: Path) -> Any:
    from pyarrow import parquet

    # If the metadata is damaged and contradicts itself, the library terminates the process.
    _run_elsewhere(path, _METADATA.format(path=str(path.resolve())), path.stat().st_size)
    try:
        # With pre_buffer, pyarrow would read ahead and keep every row group in memory.
        return parquet.ParquetFile(path, pre_buffer=False)
    except Exception as error:
        raise _damaged(path, error) from None


def _next_frame(path: Path, batches: Iterator[Any]) -> Any:
    try:
        batch = next(batches, None)
        return None if batch is None else _without_decimals(with_index_columns(batch.to_pandas()))
    except Exception as error:
        raise _damaged(path, error) from None


def with_index_columns(frame: pd.DataFrame) -> pd.DataFrame:
    """Convert named index levels to columns, drop unnamed levels, and number the rows.

    Example:
        >>> with_index_columns(pd.DataFrame({"time": [7, 9], "x": [1.0, 2.0]}).set_index("time"))
           time    x
        0     7  1.0
        1     9  2.0
    """
    named = [name for name in frame.index.names if name is not None and name not in frame]
    rows = frame.reset_index(drop=True)
    return pd.concat([frame.index.to_frame(index=False)[named], rows], axis=1) if named else rows


def _without_decimals(frame: pd.DataFrame) -> pd.DataFrame:
    """Convert decimal numbers from database exports, which pandas stores as objects, to floats."""
    names = [name for name in frame if pd.api.types.infer_dtype(frame[name], skipna=True) == "decimal"]
    return frame.astype(dict.fromkeys(names, np.float64))


def _integer_columns_with_gaps(file: Any) -> list[str]:
    """Integer columns with missing values, according to the statistics of the row groups."""
    from pyarrow import types

    integers = {column.name for column in file.schema_arrow if types.is_integer(column.type)}
    with_gaps = set()
    for number in range(file.metadata.num_row_groups):
        group = file.metadata.row_group(number)
        for index in range(group.num_columns):
            name, statistics = group.column(index).path_in_schema, group.column(index).statistics
            if name in integers and statistics is not None and statistics.null_count:
                with_gaps.add(name)
    return sorted(with_gaps)


def _damaged(path: Path, error: Exception) -> InputError:
    """The error for a Parquet file that pyarrow cannot read."""
    if isinstance(error, MemoryError):
        return InputError(f"{path}: does not fit into memory; keep only the required columns and rows")
    return InputError(f"{path}: the file is not a Parquet file ({first_line(error)}); export it again")
