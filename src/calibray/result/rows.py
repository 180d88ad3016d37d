"""The tables of a result's folder, read and checked: one row per link, one row per RT call."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.support.output_files import exists

LINKS: Final = {
    "row": "i", "measured_db": "f", "before_db": "f", "after_db": "f", "log_distance_db": "f", "has_path": "b",
    "held_out": "b", "retrace_gap_db": "f",
}  # fmt: skip
HISTORY: Final = {"call": "i", "iteration": "i", "rmse_db": "f", "best_db": "f", "seconds": "f"}
COLUMNS: Final = {"result-links.csv": LINKS, "result-history.csv": HISTORY}
"""The columns of each file, and the kinds of their numbers."""

OPTIONAL: Final = ("leverage", "depth", "chosen_db")
"""Columns of numbers that are optional."""

FINITE: Final = ("measured_db", "log_distance_db", "best_db", "seconds")
"""Columns without infinite or missing values; in the others a link without a path is infinite or empty."""


def read_rows(folder: Path, name: str, columns: dict[str, str]) -> pd.DataFrame:
    """Read one of a result's tables.

    Args:
        folder: The result's folder.
        name: The file's name.
        columns: The columns that it must have, and the kinds of their values: "i", "f" or "b".

    Returns:
        Its rows; further columns as they are.

    Raises:
        InputError: The file does not exist, or lacks a column, or holds something else in it.
    """
    file = folder / name
    if not exists(file):
        raise InputError(f"{file}: is no file; name the --out folder of `calibray run`")
    try:
        # A group may be called 7, or NA.
        table = pd.read_csv(file, converters={"group": str})
    except (OSError, ValueError) as error:
        raise InputError(
            f"{file}: is no table of `calibray run` ({str(error).splitlines()[0]}); name its --out folder"
        ) from None
    for column, kind in columns.items():
        if column not in table:
            raise InputError(f"{file}: has no column {column!r}; run the study again")
        found = table[column].dtype.kind
        # Whole numbers pass for numbers; a table without rows tells no kinds.
        if len(table) and found != kind and not (kind == "f" and found == "i"):
            raise InputError(
                f"{file}: column {column!r} holds something else than it should; run the study again"
            )
        if kind == "f":
            table[column] = table[column].astype(float)
        if column in FINITE and not np.isfinite(table[column]).all():
            raise InputError(
                f"{file}: column {column!r} holds a value that is not finite; run the study again"
            )
    if not len(table):
        raise InputError(f"{file}: has no rows; run the study again")
    places = [column for column in table if str(column)[:3] in ("tx_", "rx_") or column in OPTIONAL]
    if strange := [column for column in places if table[column].dtype.kind not in "if"]:
        raise InputError(
            f"{file}: column {strange[0]!r} holds something else than it should; run the study again"
        )
    return table.astype(dict.fromkeys(places, float))
