"""Tables from CSV and Parquet files, with the line of every row kept for messages."""

from __future__ import annotations

import csv
import io
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.excel import sheet_text
from calibray.measurements.filters import evaluate
from calibray.support.messages import did_you_mean, first_line, shortened
from calibray.support.output_files import exists


@dataclass(frozen=True, eq=False)
class SourceTable:
    """Rows of a table and where they stand in their file.

    Attributes:
        frame: The rows as a DataFrame.
        row: Place [rows] of each row: its line in a CSV file (the header is line 1), else its number from 1.
        source: Name of the file, or what stands for it in messages.
    """

    frame: pd.DataFrame
    row: NDArray[np.int64] = field(default=None)  # type: ignore[assignment]
    source: str = "table"

    def __post_init__(self) -> None:
        if self.row is None:
            object.__setattr__(self, "row", np.arange(1, len(self.frame) + 1))

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, mask: NDArray[np.bool_]) -> SourceTable:
        """The rows where a mask [rows] is true."""
        return SourceTable(self.frame.loc[mask].reset_index(drop=True), self.row[mask], self.source)

    def where(self, expression: str) -> NDArray[np.bool_]:
        """Evaluate a row filter.

        Args:
            expression: A filter over the columns (see `filters`), for instance ``"gpsmode == 4 and rx_x_m < -55"``.

        Returns:
            The mask [rows] of the rows that pass; a row for which the answer is unknown does not.

        Raises:
            InputError: The expression is malformed, names an unknown column, or gives no truth value per row.
        """
        try:
            return evaluate(expression, self.frame)
        except InputError as error:
            raise InputError(f"{self.source}: where = {shortened(expression)!r}: {error}") from None

    def column(self, name: str) -> pd.Series:
        """One column.

        Raises:
            InputError: There is no such column.
        """
        if name not in self.frame:
            raise InputError(
                f"{self.source}: no column {shortened(name)!r}; {did_you_mean(name, map(str, self.frame))}"
            )
        return self.frame[name]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """One column as finite numbers.

        Args:
            name: The column.

        Returns:
            Its values [rows].

        Raises:
            InputError: There is no such column, or a value is missing, infinite or no number.
        """
        column = self.column(name)
        if not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_string_dtype(column)):
            raise InputError(f"{self.source}: column {name!r} holds {column.dtype}, must hold numbers")
        if pd.api.types.is_bool_dtype(column):
            raise InputError(f"{self.source}: column {name!r} holds true and false, must hold numbers")
        values = pd.to_numeric(column, errors="coerce")
        if (text := (values.isna() & column.notna()).to_numpy()).any():
            first = int(np.flatnonzero(text)[0])
            raise InputError(f"{self.place(first, name)}: {column.iloc[first]!r} is not a number; correct it")
        numbers = values.to_numpy(dtype=np.float64, na_value=np.nan)
        if (gaps := ~np.isfinite(numbers)).any():
            rows = ", ".join(map(str, self.row[gaps][:5])) + (", ..." if gaps.sum() > 5 else "")
            raise InputError(
                f"{self.source}: column {name!r} is missing or not finite in {gaps.sum()} of {len(self)} "
                f"rows (row {rows}); correct them, or leave them out with a where filter"
            )
        return numbers

    def labels(self, name: str) -> NDArray[np.str_]:
        """One column as labels [rows].

        Raises:
            InputError: There is no such column, or a label is missing.
        """
        column = self.column(name)
        if (gaps := column.isna().to_numpy()).any():
            first = int(np.flatnonzero(gaps)[0])
            raise InputError(
                f"{self.place(first, name)}: the label is missing ({gaps.sum()} in all); give one"
            )
        if pd.api.types.is_float_dtype(column) and (column % 1 == 0).all():
            # A gap in a row that was left out makes whole numbers floats: label 5 must not become "5.0".
            column = column.astype(np.int64)
        return column.astype(str).to_numpy(dtype=np.str_)

    def place(self, index: int, column: str) -> str:
        """The words that say where a cell stands: file, row and column."""
        return f"{self.source}, row {self.row[index]}, column {column!r}"


def read_table(path: str | Path) -> SourceTable:
    """Read a CSV, Parquet or Excel file.

    Args:
        path: The file; its ending, .csv, .parquet or .xlsx, says how it is read. CSV means UTF-8 and commas; of an
            Excel file the first sheet is read.

    Returns:
        Its rows, blank lines left out.

    Raises:
        InputError: The file does not exist, is of another kind, is empty, or is malformed; or what reads
            it, pyarrow or openpyxl, is not installed.
    """
    path = Path(path)
    if not exists(path):
        raise InputError(f"{shortened(str(path), 300)}: no such file")
    match path.suffix.lower():
        case ".csv":
            table = _read_csv(path)
        case ".parquet":
            table = _read_parquet(path)
        case ".xlsx":
            table = _read_excel(path)
        case suffix:
            raise InputError(
                f"{path}: cannot read a {suffix or 'nameless'} table; use .csv, .parquet or .xlsx"
            )
    if len(table) == 0:
        raise InputError(f"{path}: holds no rows; a table needs a header and at least one row")
    return table


def _read_csv(path: Path) -> SourceTable:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            text = file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not UTF-8 text ({error.reason} at byte {error.start}); save it as UTF-8"
        ) from None
    return _parsed(path, text)


def _parsed(path: Path, text: str) -> SourceTable:
    header, lines = _checked_layout(path, text)
    if not header:
        return SourceTable(pd.DataFrame())
    try:
        frame = pd.read_csv(io.StringIO(text), skipinitialspace=True, low_memory=False)
    except ValueError as error:
        # Reading from memory fails so for one reason only: pandas takes Ctrl-C in the midst of it for a failure.
        if "source failed" in str(error):
            raise KeyboardInterrupt from None
        raise InputError(f"{path}: malformed CSV ({shortened(str(error), 300)}); check its quotes") from None
    if len(frame) != len(lines):
        raise InputError(f"{path}: {len(lines)} rows stand in it but {len(frame)} are read; check its quotes")
    return SourceTable(frame, np.array(lines, dtype=np.int64), str(path))


def _checked_layout(path: Path, text: str) -> tuple[list[str], list[int]]:
    """The header of a CSV text and the first line of each of its rows; pandas would mend faults silently."""
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    header: list[str] = []
    lines: list[int] = []
    line = 1
    try:
        for cells in reader:
            line, start = reader.line_num + 1, line
            if len(cells) <= 1 and not "".join(cells).strip():
                continue
            if not header:
                header = cells
                if len(header) == 1 and (other := next((mark for mark in ";\t" if mark in header[0]), "")):
                    raise InputError(f"{path}, row {start}: columns are parted by {other!r}, must be by ','")
                if repeated := [name for name, count in Counter(header).items() if count > 1]:
                    raise InputError(f"{path}, row {start}: column {repeated[0]!r} stands twice; rename one")
            elif len(cells) != len(header):
                raise InputError(
                    f"{path}, row {start}: {len(cells)} cells, the header has {len(header)}; correct the row"
                )
            else:
                lines.append(start)
    except csv.Error as error:
        raise InputError(f"{path}, row {line}: malformed CSV ({error})") from None
    return header, lines


def damaged(path: Path, error: Exception) -> InputError:
    """What is to be raised where a Parquet file cannot be read.

    Args:
        path: The file.
        error: What the library says of it.

    Returns:
        The error.
    """
    return InputError(f"{path}: not a Parquet file ({first_line(error)}); export it again")


def _read_parquet(path: Path) -> SourceTable:
    try:
        frame = pd.read_parquet(path, engine="pyarrow")
    except ImportError:
        raise InputError(
            f"{path}: Parquet needs pyarrow; install it with: pip install calibray[parquet]"
        ) from None
    except Exception as error:
        raise damaged(path, error) from None
    return SourceTable(frame.reset_index(drop=True), source=str(path))


def _read_excel(path: Path) -> SourceTable:
    numbers, text = sheet_text(path)
    table = _parsed(path, text)
    return SourceTable(table.frame, np.array(numbers[1:], dtype=np.int64), table.source)
