"""The rows of a table and their line numbers, so that messages can name the file, row and column."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.filters import evaluate
from calibray.support.messages import did_you_mean, shortened
from calibray.tables import rows_text

Coordinates = Sequence[float | str]
"""x, y and z [m], or longitude, latitude [deg] and height [m]. Each coordinate is a number or the name of a column."""

_DEGREES: Final = frozenset({"lat", "latitude", "lon", "lng", "long", "longitude"})


@dataclass(frozen=True, eq=False)
class SourceTable:
    """Rows of a table.

    Attributes:
        frame: The rows.
        row: Line number [rows] of each row in the CSV file or sheet, in which the first line has the number 1. In other
            tables, the first row has the number 1.
        source: Name of the file, or another name of the table in messages.
        changes: Changes made by earlier steps, such as the exclusion or averaging of rows, each with the number of
            affected rows.
        joined: For each column from another table: the name of that table, the name of the column in that table, and
            the column of labels by which the tables were joined.
    """

    frame: pd.DataFrame
    row: NDArray[np.int64] = field(default=None)  # type: ignore[assignment]
    source: str = "table"
    changes: Mapping[str, int] = field(default_factory=dict)
    joined: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.row is None:
            object.__setattr__(self, "row", np.arange(1, len(self.frame) + 1))

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def tables(self) -> str:
        """Names of this table and of the tables from which columns were joined, for messages."""
        return " with ".join(dict.fromkeys([self.source, *(file for file, _, _ in self.joined.values())]))

    def assign(self, **columns: Any) -> SourceTable:
        """Return the same rows with columns [rows] added or replaced."""
        return replace(self, frame=self.frame.assign(**columns))

    def note(self, change: str, number: int) -> SourceTable:
        """Return the same rows with an additional entry in `changes`."""
        return replace(self, changes={**self.changes, change: int(number)})

    def select(self, mask: NDArray[np.bool_]) -> SourceTable:
        """The rows for which a mask [rows] is true."""
        return replace(self, frame=self.frame.loc[mask].reset_index(drop=True), row=self.row[mask])

    def keep(self, mask: NDArray[np.bool_], reason: str) -> SourceTable:
        """The rows for which a mask [rows] is true. `changes` records the reason and the number of removed rows.

        Raises:
            InputError: No row remains.
        """
        if not mask.any():
            raise InputError(f"{self.source}: no row remains ({reason}); change [links] in the study")
        lost = int((~mask).sum())
        return (self.note(reason, lost) if lost else self).select(mask)

    def where(self, expression: str) -> NDArray[np.bool_]:
        """Mask [rows] of the rows that pass a filter (see `filters`). Missing values pass only `!=` and `not in`.

        Raises:
            InputError: The expression is malformed, names an unknown column, or does not give one truth value per row.
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
                f"{self.tables}: no column {shortened(name)!r}; {did_you_mean(name, map(str, self.frame))}"
            )
        return self.frame[name]

    def numbers(
        self, source: str | float, gaps: bool = False, remedy: str = "remove these rows"
    ) -> NDArray[np.float64]:
        """A column as finite numbers [rows], or a number repeated for all rows. With `gaps`, missing values are NaN.

        Messages about missing values end with `remedy`.

        Raises:
            InputError: There is no such column, or a value is missing, infinite or not a number.
        """
        if not isinstance(source, str):
            if isinstance(source, bool) or not np.isfinite(source):
                raise InputError(f"{self.source}: {source!r} must be a finite number or a column")
            return np.full(len(self), float(source))
        column = self.column(source)
        missing = column.isna().to_numpy()
        if gaps and missing.all():
            return np.full(len(self), np.nan)
        if not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_string_dtype(column)):
            raise InputError(
                f"{self.source}: column {source!r} contains {column.dtype}; it must contain numbers"
            )
        if pd.api.types.is_bool_dtype(column) or pd.api.types.is_complex_dtype(column):
            fault = "true and false" if pd.api.types.is_bool_dtype(column) else "complex numbers"
            raise InputError(f"{self.source}: column {source!r} contains {fault}; it must contain numbers")
        parsed = pd.to_numeric(column, errors="coerce")
        if (text := parsed.isna().to_numpy() & ~missing).any():
            first = int(np.flatnonzero(text)[0])
            value = column.iloc[first]
            correction = "correct it"
            if str(value).strip().startswith(("<", "≤")):
                correction = "write the limit without this sign, and state links.noise_floor_dbm"
            elif re.fullmatch(r"[+-]?\d{1,3}([.,' ]\d{3})+([.,]\d+)?", str(value).strip()):
                correction = "remove the thousands separators"
            raise InputError(f"{self.cell(first, source)}: {value!r} is not a number; {correction}")
        numbers = parsed.to_numpy(dtype=np.float64, na_value=np.nan)
        unusable = np.isinf(numbers) if gaps else ~np.isfinite(numbers)
        if unusable.any():
            if source in self.joined:
                file, name, key = self.joined[source]
                labels = self.frame[key][unusable].unique()
                listed = ", ".join(map(str, labels[:5])) + (", ..." if len(labels) > 5 else "")
                raise InputError(
                    f"{file}: column {name!r} has missing or non-finite values for {key} {listed} ({unusable.sum()} of "
                    f"{len(self)} rows of {self.source}); correct the values, or {remedy}"
                )
            raise InputError(
                f"{self.source}: column {source!r} has missing or non-finite values in {unusable.sum()} of {len(self)} "
                f"rows ({rows_text(self.row[unusable].tolist())}); correct the values, or {remedy}"
            )
        return numbers

    def labels(self, names: str | Sequence[str]) -> NDArray[np.str_]:
        """A column as labels [rows], or the labels of several columns joined by spaces.

        Raises:
            InputError: There is no such column, a label is missing, or different labels become equal when joined.
        """
        if not isinstance(names, str):
            rows = list(zip(*(self.labels(name).tolist() for name in names), strict=True))
            joined: dict[str, tuple[str, ...]] = {}
            for labels in rows:
                other = joined.setdefault(" ".join(labels), labels)
                if other != labels:
                    raise InputError(
                        f"{self.source}: columns {', '.join(names)}: {shortened(str(other))} and "
                        f"{shortened(str(labels))} are both written {shortened(' '.join(labels))!r} when joined; "
                        "rename one of these labels"
                    )
            return np.array([" ".join(labels) for labels in rows], dtype=np.str_)
        column = self.column(names)
        if (missing := column.isna().to_numpy()).any():
            first = int(np.flatnonzero(missing)[0])
            raise InputError(
                f"{self.cell(first, names)}: the label is missing (in {missing.sum()} of {len(self)} rows); add the "
                "label, or rename labels that count as missing, such as NA, None and null"
            )
        if pd.api.types.is_float_dtype(column):
            # A label must not depend on other rows, but pandas stores 26 as 26.0 if another row is empty or contains
            # 0.9.
            return column.astype(str).str.removesuffix(".0").to_numpy(dtype=np.str_)
        return column.astype(str).to_numpy(dtype=np.str_)

    def positions(self, end: str, coordinates: Coordinates) -> NDArray[np.float64]:
        """Positions [rows, 3], [m], in the scene frame, from three numbers or columns; `end` is "tx" or "rx".

        Raises:
            InputError: The number of coordinates is not three, or a column is missing, not numeric, or named as
                longitude or latitude.
        """
        if isinstance(coordinates, str) or len(coordinates) != 3:
            raise InputError(f"{end} = {coordinates!r}: must be x, y and z, each a number [m] or a column")
        for coordinate in coordinates:
            if isinstance(coordinate, str):
                if _DEGREES & set(re.split(r"[^a-z]+", coordinate.lower())):
                    raise InputError(
                        f"{self.source}: column {coordinate!r} of {end} appears to be in degrees; give metres in the "
                        "scene frame, or set position = 'geographic' in a study"
                    )
            elif isinstance(coordinate, bool) or not np.isfinite(coordinate):
                raise InputError(
                    f"{end} = {coordinates!r}: {coordinate!r} must be a finite number [m] or a column"
                )
        return np.stack([self.numbers(coordinate) for coordinate in coordinates], axis=1)

    def cell(self, index: int, column: str) -> str:
        """The file, row and column of a cell, formatted for messages."""
        if column in self.joined:
            file, name, key = self.joined[column]
            return f"{file}, {key} {self.frame[key].iloc[index]}, column {name!r}"
        return f"{self.source}, row {self.row[index]}, column {column!r}"
