"""The files of a comparison: its tables, and a figure of the excess over RT calls."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from calibray.comparison.comparison import Comparison
from calibray.optimizers import label
from calibray.support.figure_style import COLORS, PALETTE, logarithmic, plain_figure, styled
from calibray.support.figure_style import write as write_figure
from calibray.support.output_files import write_table

FILES: Final = ("compare.csv", "runs.csv", "compare.png")
FLOOR_DB: Final = 1e-4
"""Smallest excess that is drawn [dB]; lower ones are drawn at this value."""


def write(comparison: Comparison, folder: Path) -> None:
    """Write a comparison's tables and figure into an existing folder."""
    write_table(folder / FILES[0], comparison.table())
    write_table(folder / FILES[1], comparison.history())
    write_figure(figure(comparison), folder / FILES[2])


@styled()
def figure(comparison: Comparison) -> Figure:
    """Excess over RT calls: the median of each method and the band between its quartiles."""
    drawing, axes = plain_figure("RT calls", "Excess RMSE [dB]", width=8.0)
    last = max(method.budget for method in comparison.methods)
    colors = iter(PALETTE * (1 + len(comparison.methods) // len(PALETTE)))
    calls = np.arange(1, last + 1)
    for method in comparison.methods:
        shown = calls if method.stops_by_itself else calls[: method.budget]
        quartiles = [comparison.quartiles(method.name, int(call)) for call in shown]
        low, middle, high = np.maximum(quartiles, FLOOR_DB).T
        color = COLORS.get(method.method) or next(colors)
        dashed = "--" if method.stops_by_itself or method.name != method.method else "-"
        axes.step(shown, middle, where="post", color=color, ls=dashed, lw=1.4, label=label(method.name))
        axes.fill_between(shown, low, high, step="post", color=color, alpha=0.13, lw=0)
    logarithmic(axes, "y")
    axes.set_xlim(0, last)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawing
