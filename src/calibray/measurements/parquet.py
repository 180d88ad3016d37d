"""Tables read in pieces: Parquet row group by row group, so that no more of a file is in memory than is worked on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from calibray.errors import InputError
from calibray.measurements.table_files import SourceTable, damaged, read_table
from calibray.support.extras import library
from calibray.support.output_files import exists


@final
@dataclass(frozen=True, eq=False)
class PiecedTable:
    """A table whose rows are read when they are asked for.

    Attributes:
        source: Name of the file.
        rows: Number of rows.
        whole: All of them, of a file that can only be read at once; None of a Parquet file.
    """

    source: str
    rows: int
    whole: SourceTable | None

    @classmethod
    def open(cls, path: str | Path) -> PiecedTable:
        """Open a CSV, Parquet or Excel file.

        Args:
            path: The file. Parquet is read in pieces; the others are read now.

        Returns:
            The table.

        Raises:
            InputError: What `read_table` refuses.
        """
        path = Path(path)
        if path.suffix.lower() != ".parquet" or not exists(path):
            table = read_table(path)
            return cls(str(path), len(table), table)
        library("pyarrow", "parquet")
        with _opened(path) as file:
            rows = file.metadata.num_rows
        if not rows:
            raise InputError(f"{path}: holds no rows; a table needs a header and at least one row")
        return cls(str(path), rows, None)

    def pieces(self, size: int) -> Iterator[SourceTable]:
        """The rows, some at a time.

        Args:
            size: Number of rows of a piece, at most.

        Yields:
            The pieces, in the order of the file; a column has the same type in each.

        Raises:
            InputError: The file is damaged.
        """
        if self.whole is not None:
            for start in range(0, self.rows, size):
                some = slice(start, start + size)
                frame = self.whole.frame.iloc[some].reset_index(drop=True)
                yield SourceTable(frame, self.whole.row[some], self.source)
            return
        with _opened(Path(self.source)) as file:
            gaps, start = _with_gaps(file), 0
            batches = file.iter_batches(batch_size=size)
            while (frame := self._next(batches)) is not None:
                # Of NumPy's types whole numbers of which one is missing are floats, in whatever piece it is.
                plain = [name for name in gaps if name in frame and isinstance(frame.dtypes[name], np.dtype)]
                frame = frame.astype(dict.fromkeys(plain, np.float64))
                yield SourceTable(frame, np.arange(start + 1, start + len(frame) + 1), self.source)
                start += len(frame)

    def _next(self, batches: Iterator[Any]) -> Any:
        try:
            batch = next(batches, None)
            return None if batch is None else batch.to_pandas().reset_index(drop=True)
        except Exception as error:
            raise damaged(Path(self.source), error) from None


def _opened(path: Path) -> Any:
    from pyarrow import parquet

    try:
        # Read ahead, all row groups would be in memory by and by.
        return parquet.ParquetFile(path, pre_buffer=False)
    except Exception as error:
        raise damaged(path, error) from None


def _with_gaps(file: Any) -> list[str]:
    """Columns of whole numbers of which some are missing, as the row groups tell."""
    from pyarrow import types

    found = set()
    groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
    whole = {each.name for each in file.schema_arrow if types.is_integer(each.type)}
    for group in groups:
        for number in range(group.num_columns):
            column = group.column(number)
            statistics = column.statistics
            if column.path_in_schema in whole and statistics is not None and statistics.null_count:
                found.add(column.path_in_schema)
    return sorted(found)
