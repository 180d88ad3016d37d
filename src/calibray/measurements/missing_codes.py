"""Numbers that loggers write where nothing was measured, such as 100, -200 or -999."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from calibray.measurements.source_table import SourceTable

CODES: Final = (
    *(0, 1, -1, 99, 100, 101, 127, 128, 255, 500, 999, 1000, 9999, 32767, 65535, 99999, 2147483647),
    *(-200, -255, -256, -500, -999, -1000, -9999, -32768, -99999, -2147483648),
)  # fmt: skip
"""Numbers in use for missing values: by UJIIndoorLoc (100), Wi-Fi RTT logs (-200), Android (2147483647), and others."""

MIN_GAP_DB: Final = 20.0
"""A code is at least this far from every measured value [dB]."""

LARGEST_LEVEL: Final = 190.0
"""Magnitude above which a code with the sign of the other values can be no power [dBm] or gain [dB]."""


def find_codes(values: ArrayLike) -> tuple[float, ...]:
    """Find the numbers that stand for a missing value among values [n], [dB] or [dBm]; ascending.

    A number counts as a code if it is in `CODES`, is far from all other values, and has the other sign or an impossible
    magnitude: 100 is a code among powers, and a value among path losses.

    Example:
        >>> find_codes([-70.0, 100.0, -200.0]), find_codes([70.0, 100.0, 130.0])
        ((-200.0, 100.0), ())
    """
    numbers = np.asarray(values, dtype=np.float64)
    distinct = np.unique(numbers[np.isfinite(numbers)])
    is_candidate = np.isin(distinct, CODES)
    # A loss of 100 dB is a candidate, and lies among the other losses.
    measured = distinct[~is_candidate]
    if not len(measured):
        return ()
    sign = np.sign(np.median(measured))
    return tuple(
        float(code)
        for code in distinct[is_candidate]
        if (np.sign(code) != sign or abs(code) > LARGEST_LEVEL)
        and np.min(np.abs(measured - code)) >= MIN_GAP_DB
    )


def without_codes(column: pd.Series) -> pd.Series:
    """A column of numbers with NaN in place of codes."""
    return column.mask(column.isin(find_codes(_numbers(column))))


def mask_codes(
    table: SourceTable, columns: Sequence[str], stated: Sequence[float] = ()
) -> tuple[SourceTable, NDArray[np.bool_]]:
    """Set the codes in columns of measured values to missing, and note their number.

    Codes are judged over all columns, which hold one quantity; those stated are codes whatever the other values are.
    Returns the rows, and a mask [rows] of those in which a column had a code.

    Raises:
        InputError: There is no such column.
    """
    values = np.column_stack([_numbers(table.column(name)) for name in columns])
    codes = sorted({*find_codes(values), *map(float, stated)})
    coded = np.isin(values, codes)
    if not coded.any():
        return table, np.zeros(len(table), dtype=bool)
    changed = {
        name: table.frame[name].mask(coded[:, index])
        for index, name in enumerate(columns)
        if coded[:, index].any()
    }
    present = ", ".join(f"{code:g}" for code in codes if (values == code).any())
    table = table.assign(**changed).note(f"values that mean not measured ({present})", int(coded.sum()))
    return table, np.asarray(coded.any(axis=1))


def _numbers(column: pd.Series) -> NDArray[np.float64]:
    """The numbers of a column [rows]; NaN for text, which is refused with its row where values are used."""
    if not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_string_dtype(column)):
        return np.full(len(column), np.nan)
    return pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
