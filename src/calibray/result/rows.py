"""The tables of a result's folder, read and checked: one row per link, one row per RT call."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.support.output_files import exists
from calibray.support.output_tables import without_formula_mark

LINKS: Final = {
    "row": "i", "measured_db": "f", "before_db": "f", "after_db": "f", "log_distance_db": "f", "has_path": "b",
    "held_out": "b", "retrace_gap_db": "f", "predicted_db": "f", "scene_db": "f",
}  # fmt: skip
HISTORY: Final = {"call": "i", "iteration": "i", "rmse_db": "f", "best_db": "f", "seconds": "f"}
COLUMNS: Final = {"result-links.csv": LINKS, "result-history.csv": HISTORY}
"""Columns of each file and the NumPy kind of their values: integer, float or Boolean."""

OPTIONAL: Final = ("leverage", "depth", "out_of_sight", "obstruction_m", "region_m")
"""Columns of numbers that are optional."""

FINITE: Final = ("measured_db", "log_distance_db", "best_db", "seconds")
"""Columns without infinite or missing values; in other columns, a link without a path is infinite or empty."""


def read_rows(folder: Path, name: str, columns: dict[str, str]) -> pd.DataFrame:
    """Read one of a result's tables.

    Args:
        folder: The result's folder.
        name: The file's name.
        columns: The required columns and the kinds of their values: "i", "f" or "b".

    Returns:
        The rows, with any further columns unchanged.

    Raises:
        InputError: The file does not exist, lacks a column, or has invalid values in one.
    """
    file = folder / name
    if not exists(file):
        raise InputError(f"{file}: does not exist; give the --out folder of `calibray run`")
    try:
        # Group labels such as 7 or NA must stay text.
        table = pd.read_csv(file, converters={"group": without_formula_mark})
    except (OSError, ValueError) as error:
        raise InputError(
            f"{file}: is not a table of `calibray run` ({str(error).splitlines()[0]}); give its --out folder"
        ) from None
    for column, kind in columns.items():
        if column not in table:
            raise InputError(f"{file}: has no column {column!r}; run the study again")
        actual = table[column].dtype.kind
        # Whole numbers are valid floats. A table without rows has no kinds.
        if len(table) and actual != kind and not (kind == "f" and actual == "i"):
            raise InputError(f"{file}: column {column!r} has values of the wrong type; run the study again")
        if kind == "f":
            table[column] = table[column].astype(float)
        if column in FINITE and not np.isfinite(table[column]).all():
            raise InputError(f"{file}: column {column!r} has a value that is not finite; run the study again")
    if not len(table):
        raise InputError(f"{file}: has no rows; run the study again")
    numeric = [column for column in table if str(column)[:3] in ("tx_", "rx_") or column in OPTIONAL]
    if invalid := [column for column in numeric if table[column].dtype.kind not in "if"]:
        raise InputError(f"{file}: column {invalid[0]!r} has values of the wrong type; run the study again")
    return table.astype(dict.fromkeys(numeric, float))
