"""Tables as output files: CSV and Parquet, complete or in parts, without cells that a spreadsheet would compute."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from calibray.errors import InputError
from calibray.support.output_files import check_file, replacing

if TYPE_CHECKING:
    import pandas as pd

TABLES: Final = (".csv", ".parquet")

# Computed by spreadsheets, or marked already.
_FORMULA: Final = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20].", re.DOTALL)


def check_table(file: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> Path:
    """Refuse a table that cannot be written: see `check_file`; the name must end in .csv or .parquet.

    Raises:
        InputError: The extension is another one, or an error of `check_file`.
    """
    target = check_file(file, inputs, overwrite)
    if target.suffix.lower() not in TABLES:
        raise InputError(f"output file {target}: tables end in {' or '.join(TABLES)}; name it so")
    return target


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a CSV or Parquet file, without the index, and move it into place; errors as for `growing_table`."""
    with growing_table(path) as append:
        append(table)


def csv_text(table: pd.DataFrame, float_format: str | None = None, header: bool = True) -> str:
    """A table as CSV without its index; texts that a spreadsheet would compute are marked by an apostrophe."""
    names = [formula_free(name) for name in table.columns]
    safe, returns = table.set_axis(names, axis=1), any("\r" in str(name) for name in names)
    for number, kind in enumerate(table.dtypes):  # by position, since names may repeat
        if kind.kind not in "biufcmM":
            cells = table.iloc[:, number].astype(object).map(formula_free, na_action="ignore")
            returns = returns or any(isinstance(cell, str) and "\r" in cell for cell in cells)
            safe.isetitem(number, cells.to_numpy())
    return safe.to_csv(
        index=False,
        header=header,
        float_format=float_format,
        lineterminator="\n",
        # Python's writer does not quote a carriage return, which readers take for the end of a line.
        quoting=csv.QUOTE_NONNUMERIC if returns else csv.QUOTE_MINIMAL,
    )


def formula_free(cell: Any) -> Any:
    """Mark a text that a spreadsheet would read as a formula; numbers and other texts are unchanged.

    Example:
        >>> formula_free("=HYPERLINK(1)"), formula_free("-80.5"), formula_free("- east")
        ("'=HYPERLINK(1)", '-80.5', "'- east")
    """
    if not (isinstance(cell, str) and _FORMULA.match(cell)):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def without_formula_mark(cell: str) -> str:
    """Remove the mark that `formula_free` adds."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


@contextmanager
def growing_table(path: str | Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    """Write a CSV or Parquet file in parts and move it into place once it is complete.

    Yields a function that appends rows without their index; all calls must have the columns and types of the first one.

    Raises:
        InputError: An error of `check_table`, or Parquet without pyarrow, or a column changes its type.
    """
    # Whether the file may be replaced was checked before the work.
    target = check_table(path, overwrite=True)
    write = _csv if target.suffix.lower() == ".csv" else _parquet
    with replacing(target) as partial, write(partial, target) as append:
        yield append


@contextmanager
def _csv(partial: Path, _: Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    with partial.open("w", encoding="utf-8") as stream:

        def append(table: pd.DataFrame) -> None:
            stream.write(csv_text(table, header=stream.tell() == 0))

        yield append


@contextmanager
def _parquet(partial: Path, target: Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            f"{target}: Parquet needs pyarrow; install it with: pip install 'calibray[parquet]'"
        ) from None
    with ExitStack() as stack:
        writers: list[parquet.ParquetWriter] = []

        def append(table: pd.DataFrame) -> None:
            schema = writers[0].schema if writers else None
            try:
                rows = pyarrow.Table.from_pandas(table, schema, preserve_index=False)
            except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError) as error:
                raise InputError(f"{target}: cannot be Parquet ({error}); write CSV") from None
            if not writers:
                writers.append(stack.enter_context(parquet.ParquetWriter(partial, rows.schema)))
            writers[0].write_table(rows)

        yield append
