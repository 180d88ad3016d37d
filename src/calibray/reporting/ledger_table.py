"""The calls of a ledger as a table."""

from __future__ import annotations

import pandas as pd
from pandas.api.types import is_numeric_dtype

from calibray.tables import Column, Table, numbers


def calls(frame: pd.DataFrame) -> Table:
    """The RT calls that were paid for.

    Args:
        frame: A ledger's table, without the columns of links.

    Returns:
        One row per call; of a message, which stands last, only the first line.
    """
    names = [name for name in frame.columns if name != "message"]
    numeric = [is_numeric_dtype(frame[name]) for name in names]
    columns = [numbers(name) if number else Column(name) for name, number in zip(names, numeric, strict=True)]
    rows = tuple(
        (
            *(f"{value:.6g}" if number else str(value) for value, number in zip(row, numeric, strict=True)),
            message.partition("\n")[0],
        )
        for row, message in zip(frame[names].itertuples(index=False), frame["message"], strict=True)
    )
    return Table("", (*columns, Column("message")), rows)
