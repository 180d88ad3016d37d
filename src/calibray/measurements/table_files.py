"""Read tables from CSV, Parquet and Excel files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.measurements.delimited_text import SUFFIXES, parse_text, read_text
from calibray.measurements.excel import sheet_text
from calibray.measurements.source_table import SourceTable
from calibray.support.lazy_imports import library
from calibray.support.memory import available_memory, run_limited
from calibray.support.messages import first_line, shortened
from calibray.support.output_files import exists

LARGEST_TABLE: Final = 2 * 2**30
"""Largest decompressed size of a Parquet file that is read at once [bytes]; pandas needs up to twice as much."""

LARGEST_ROW_GROUP: Final = 2**30
"""Largest decompressed size of a row group, or of a piece, of a Parquet file that is read in pieces [bytes]."""

DECODING_MEMORY: Final = 4 * 2**30
"""Limit of the address space in which a Parquet file is first decoded [bytes]."""

PIECE_ROWS: Final = 100_000
"""Largest number of rows of a Parquet file that are read together."""

_DECODE: Final = """
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
    refuse("takes more memory than it declares; export it again")
except Exception as error:
    refuse("not a Parquet file (" + " ".join(str(error).split())[:300] + "); export it again")
"""

_METADATA: Final = """
from pyarrow import parquet
try:
    with parquet.ParquetFile({path!r}, pre_buffer=False) as file:
        for number in range(file.metadata.num_row_groups):
            group = file.metadata.row_group(number)
            for index in range(group.num_columns):
                group.column(index).statistics
except Exception as error:
    refuse("not a Parquet file (" + " ".join(str(error).split())[:300] + "); export it again")
"""

_decoded: Final[set[tuple[str | int, ...]]] = set()
"""Files that were decoded before and have not changed since."""


def read_table(path: str | Path) -> SourceTable:
    """Read a .csv, .txt, .tsv, .dat, .parquet or .xlsx file without blank lines; of a workbook, the first sheet.

    Commas, semicolons, tabs or spaces separate the columns of a text. If the separator is not a comma, numbers may have
    decimal commas. `parse_text` describes what is skipped.

    Raises:
        InputError: The file does not exist, has another extension, is empty or malformed, or the library that reads it
            (pyarrow, openpyxl) is not installed.
    """
    path = Path(path)
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
            # Lines of the text count line breaks within cells, and rows of the sheet blank rows.
            table = replace(table, row=np.array(numbers[len(numbers) - len(table) :], dtype=np.int64))
        case suffix:
            raise InputError(
                f"{path}: cannot read a {suffix or 'nameless'} table; use .csv, .txt, .parquet or .xlsx"
            )
    if len(table) == 0:
        raise InputError(f"{path}: contains no rows; a table needs a header and at least one row")
    return table


@final
@dataclass(frozen=True, eq=False)
class PiecedTable:
    """A table that is read in pieces, so that a large Parquet file is never in memory as a whole.

    Attributes:
        source: Name of the file.
        rows: Number of rows.
        whole: All rows, if the file's format can only be read at once; None for Parquet.
    """

    source: str
    rows: int
    whole: SourceTable | None

    @classmethod
    def open(cls, path: str | Path) -> PiecedTable:
        """Open a CSV, Parquet or Excel file; CSV and Excel files are read immediately.

        Raises:
            InputError: As `read_table`.
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
        """The rows in the order of the file, in pieces of at most `size`; a column has the same type in all pieces.

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
                # NumPy has no missing integer, so pandas makes such a column float. A piece without a gap must agree.
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
        raise InputError(f"{path}: Parquet needs pyarrow; install it with: pip install calibray[parquet]")
    with _open_parquet(path) as file:
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
    size = _check_size(path, groups, LARGEST_TABLE, "the table")
    _decode_elsewhere(path, size, LARGEST_TABLE, whole=True)
    try:
        frame = pd.read_parquet(path, engine="pyarrow")
    except Exception as error:
        raise _damaged(path, error) from None
    return SourceTable(frame.reset_index(drop=True), source=str(path))


def _check_size(path: Path, groups: Sequence[Any], limit: int, what: str) -> int:
    """The declared size of row groups [bytes], which is refused if too large: kilobytes may decompress to gigabytes.

    Raises:
        InputError: The size exceeds the limit or the memory.
    """
    # A column of one repeated value takes almost no space in the file, but eight bytes for each row in memory.
    size = sum(
        max(group.column(index).total_uncompressed_size, 8 * group.num_rows)
        for group in groups
        for index in range(group.num_columns)
    )
    if size > min(limit, available_memory()):
        raise InputError(
            f"{path}: {what} takes {size / 2**30:,.1f} GiB decompressed, at most {limit / 2**30:g} GiB and the free "
            "memory are read; keep the columns and rows that you need, or write smaller row groups"
        )
    return size


def _decode_elsewhere(path: Path, size: int, limit: int, whole: bool) -> None:
    """Decode a Parquet file in a process with limits: pages may be larger than declared, and rows may share one text.

    Its declared size and the limit of its rows in memory are in bytes. The limit applies to the whole table or a row
    group.

    Raises:
        InputError: The file needs more memory or time, or is damaged.
    """
    code = _DECODE.format(path=str(path.resolve()), limit=limit, whole=whole, rows=PIECE_ROWS)
    _run_elsewhere(path, code, size)


def _run_elsewhere(path: Path, code: str, size: int) -> None:
    """Run code on a file in a process with limits, once for each code and state of the file.

    Raises:
        InputError: The file needs more memory or time, or is damaged.
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
        raise InputError(f"{path}: its library fails while reading it; export it again")
    _decoded.add(key)


def _open_parquet(path: Path) -> Any:
    from pyarrow import parquet

    # The library ends the process where damaged metadata contradict themselves.
    _run_elsewhere(path, _METADATA.format(path=str(path.resolve())), path.stat().st_size)
    try:
        # With pre_buffer, pyarrow reads ahead and keeps every row group in memory.
        return parquet.ParquetFile(path, pre_buffer=False)
    except Exception as error:
        raise _damaged(path, error) from None


def _next_frame(path: Path, batches: Iterator[Any]) -> Any:
    try:
        batch = next(batches, None)
        return None if batch is None else batch.to_pandas().reset_index(drop=True)
    except Exception as error:
        raise _damaged(path, error) from None


def _integer_columns_with_gaps(file: Any) -> list[str]:
    """Integer columns with missing values, from the statistics of the row groups."""
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
    """The error for a Parquet file that its library cannot read."""
    if isinstance(error, MemoryError):
        return InputError(f"{path}: does not fit into memory; keep the columns and rows that you need")
    return InputError(f"{path}: not a Parquet file ({first_line(error)}); export it again")
