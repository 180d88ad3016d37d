"""Suggested measurements as tables for the terminal."""

from __future__ import annotations

import pandas as pd

from calibray.prediction.position_checks import POSITION_COLUMNS
from calibray.tables import Column, Table, numbers


def suggestion_tables(suggestions: pd.DataFrame) -> tuple[Table, ...]:
    """Suggestions as tables for the terminal.

    Args:
        suggestions: The suggestions, from `suggest`.

    Returns:
        A table of positions, and a table of the gain expected from each suggestion and those above it.
    """
    grouped = ["group"] if "group" in suggestions else []
    columns = (
        numbers("rank"),
        numbers("row"),
        *(numbers(name, "m") for name in POSITION_COLUMNS),
        *map(Column, grouped),
        numbers("path loss", "dB"),
        numbers("draws differ by", "dB"),
    )
    rows, gains = [], []
    for rank, row in enumerate(suggestions.to_dict("records"), start=1):
        losses = (f"{row['path_loss_db']:.1f}", f"{row['spread_db']:.1f}")
        position = (f"{row[name]:.2f}" for name in POSITION_COLUMNS)
        rows.append((str(rank), str(row["row"]), *position, *(str(row[name]) for name in grouped), *losses))
        gains.append((str(rank), row["gain"]))
    expected = Table(
        "Expected 95 % intervals once it and those above are measured",
        (numbers("rank"), Column("gain")),
        tuple(gains),
    )
    tables = Table("Where to measure next", columns, tuple(rows)), expected
    if "observable" not in suggestions:
        return tables
    worth = suggestions[["observable", "observable_gain"]].itertuples(index=False)
    further = Table(
        "What to measure there besides path loss",
        (numbers("rank"), Column("observable"), Column("expected 95 % intervals, relative to those above")),
        tuple((str(rank), *map(str, row)) for rank, row in enumerate(worth, start=1)),
    )
    return *tables, further
