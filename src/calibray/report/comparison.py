"""What a comparison of methods writes and shows: tables and a figure."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from calibray.comparison.comparison import Comparison, quantile
from calibray.files import write_table
from calibray.optimizers import METHODS
from calibray.report.figures import COLORS, label, plain_figure
from calibray.report.figures import write as write_figure

FILES: Final = ("compare.csv", "runs.csv", "compare.png")
FLOOR_DB: Final = 1e-4  # drawn in place of less
PALETTE: Final = (
    "#8e6bb0",
    "#d99a2b",
    "#3aa6a6",
    "#8c5a3c",
    "#d46a9f",
    "#6f7f2e",
    "#5c6bc0",
    "#777777",
)
HEADINGS: Final = (
    "method", "uses", ">RT calls", ">excess at 30 [dB]", ">at 60 [dB]", ">at 225 [dB]", ">at the end [dB]",
    ">quartiles [dB]", ">worst [dB]", ">calls to 0.05 dB", ">to 0.02 dB", ">to 0.01 dB", ">failed", ">time [s]",
)  # fmt: skip


def write(comparison: Comparison, folder: Path) -> None:
    """Write a comparison's tables and figure.

    Args:
        comparison: The comparison.
        folder: Folder to write into, which exists.
    """
    write_table(folder / FILES[0], comparison.table())
    write_table(folder / FILES[1], comparison.history())
    write_figure(figure(comparison), folder / FILES[2])


def rows(comparison: Comparison) -> list[list[str]]:
    """A comparison's table as cells, under `HEADINGS`.

    Args:
        comparison: The comparison.

    Returns:
        One row per method; median excesses, and with the RT calls to an excess how many runs of all came there.
    """
    return [_cells(row) for row in comparison.table().to_dict("records")]


def markdown(comparison: Comparison) -> str:
    """A comparison as a table in Markdown.

    Args:
        comparison: The comparison.

    Returns:
        The lines of the table.
    """
    lines = [
        [heading.removeprefix(">") for heading in HEADINGS],
        ["---:" if heading.startswith(">") else "---" for heading in HEADINGS],
        *rows(comparison),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def figure(comparison: Comparison) -> Figure:
    """Excess over RT calls: the median of each method and the band between its quartiles.

    Args:
        comparison: The comparison.

    Returns:
        The figure.
    """
    drawing, axes = plain_figure("RT calls", "Excess RMSE [dB]", width=8.0)
    last = max(contender.budget for contender in comparison.contenders)
    colors = iter(PALETTE * (1 + len(comparison.contenders) // len(PALETTE)))
    calls = np.arange(1, last + 1)
    for contender in comparison.contenders:
        endless = METHODS[contender.method].schedule is None
        shown = calls if endless else calls[: contender.budget]
        excess = np.array([comparison.excess(contender.name, call) for call in shown])
        low, middle, high = (
            np.maximum([quantile(each, share) for each in excess], FLOOR_DB) for share in (0.25, 0.5, 0.75)
        )
        color = COLORS.get(contender.method) or next(colors)
        dashed = "--" if endless or contender.name != contender.method else "-"
        axes.step(shown, middle, where="post", color=color, ls=dashed, lw=1.4, label=label(contender.name))
        axes.fill_between(shown, low, high, step="post", color=color, alpha=0.13, lw=0)
    axes.set(yscale="log", xlim=(0, last))
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawing


def _cells(row: dict[str, object]) -> list[str]:
    def number(key: str) -> str:
        value = row[key]
        return "-" if pd.isna(value) else f"{value:.4f}" if np.isfinite(value) else "none"

    def calls(level: str) -> str:
        value, count = row[f"calls_to_{level}_db"], row[f"reached_{level}_db"]
        return f"{'-' if pd.isna(value) else f'{value:.0f}'} ({count}/{row['runs']})"

    return [
        label(str(row["method"])),
        str(row["uses"]),
        f"{row['rt_calls']:.0f}",
        *(number(f"median_excess_db_{place}") for place in ("30", "60", "225", "end")),
        f"{number('q25_excess_db_end')} to {number('q75_excess_db_end')}",
        number("worst_excess_db_end"),
        *(calls(level) for level in ("0.05", "0.02", "0.01")),
        str(row["failed"]),
        f"{row['seconds']:.2f}",
    ]
