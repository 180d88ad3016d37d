"""A comparison of methods as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd

from calibray.optimizers.methods import label
from calibray.tables import Column, Table, numbers

if TYPE_CHECKING:
    from calibray.comparison.comparison import Comparison

COLUMNS: Final = (
    Column("method"), Column("uses"), numbers("RT calls"),
    numbers("excess at 30", "dB"), numbers("at 60", "dB"), numbers("at 225", "dB"), numbers("at the end", "dB"),
    numbers("quartiles", "dB"), numbers("worst", "dB"),
    numbers("calls to 0.05 dB"), numbers("to 0.02 dB"), numbers("to 0.01 dB"), numbers("failed"), numbers("time", "s"),
)  # fmt: skip


_TOLD: Final = ("method", "RT calls", "at the end", "quartiles", "worst", "failed")


def table(comparison: Comparison) -> Table:
    """A comparison's table.

    Args:
        comparison: The comparison.

    Returns:
        One row per method; median excesses, and with the RT calls to an excess how many runs of all came there.
    """
    records = comparison.table().to_dict("records")
    rows = tuple(_cells({str(key): value for key, value in record.items()}) for record in records)
    return Table("", COLUMNS, rows)


def optimum(comparison: Comparison) -> str:
    """The optimum that excesses are counted from.

    Args:
        comparison: The comparison.

    Returns:
        A line.
    """
    return f"Optimum {comparison.optimum:.6g} dB, found by {comparison.found_by}"


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    def number(key: str) -> str:
        value = row[key]
        return "-" if pd.isna(value) else f"{value:.4f}" if np.isfinite(value) else "none"

    def calls(level: str) -> str:
        value, count = row[f"calls_to_{level}_db"], row[f"reached_{level}_db"]
        return f"{'-' if pd.isna(value) else f'{value:.0f}'} ({count}/{row['runs']})"

    return (
        label(str(row["method"])),
        str(row["uses"]),
        f"{row['rt_calls']:.0f}",
        *(number(f"median_excess_db_{place}") for place in ("30", "60", "225", "end")),
        f"{number('q25_excess_db_end')} to {number('q75_excess_db_end')}",
        number("worst_excess_db_end"),
        *(calls(level) for level in ("0.05", "0.02", "0.01")),
        str(row["failed"]),
        f"{row['seconds']:.2f}",
    )


def summary(finished: Comparison) -> tuple[Table | str, ...]:
    """Methods side by side.

    Args:
        finished: The comparison.

    Returns:
        Its name, what matters of its table, and the optimum.
    """
    whole = table(finished)
    chosen = [k for k, column in enumerate(whole.columns) if column.name in _TOLD]
    short = Table(
        "",
        tuple(whole.columns[k] for k in chosen),
        tuple(tuple(row[k] for k in chosen) for row in whole.rows),
    )
    heading = f"Methods on {finished.name}, excess over the optimum with all RT calls spent"
    return heading, short, optimum(finished)
