"""The figures of the paper's experiment, from results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calibray.comparison.labels import label

if TYPE_CHECKING:
    from calibray.result import Result

COLORS = {"gwo": "#4c9f70", "sgwo-im": "#2f6db5", "auto": "#c8553d"}
MEASURED, BEFORE = "#222222", "#9a9a9a"


def cumulative_cost(results: Mapping[str, Result]) -> Figure:
    """RT calls and time over iterations (the paper's figure of cumulative cost).

    Args:
        results: Results by method.

    Returns:
        The figure.
    """
    figure = Figure(figsize=(10.0, 4.2), dpi=150, layout="constrained")
    for axes, column, y in zip(
        figure.subplots(1, 2), ("call", "seconds"), ("RT calls so far", "Time so far [s]"), strict=True
    ):
        _style(axes, "Iteration", y)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        for method, result in results.items():
            value = result.history.groupby("iteration")[column].max()
            end = f"{value.iloc[-1]:.4g}"
            axes.plot(
                value.index, value, "o-", ms=4, color=COLORS.get(method), label=f"{label(method)}: {end}"
            )
            if method == "sgwo-im":
                calls = result.history.groupby("iteration")["call"].max().diff()
                lean = calls[calls < calls.iloc[1]]
                if len(lean):
                    axes.axvline(
                        lean.index[0] - 1, color=COLORS[method], ls="--", lw=1, label="surrogate takes over"
                    )
        axes.legend(frameon=False)
    return figure


def convergence(results: Mapping[str, Result], optimum_db: float) -> Figure:
    """Best RMSE so far over RT calls.

    Args:
        results: Results by method.
        optimum_db: RMSE of the global optimum, drawn as a line, [dB].

    Returns:
        The figure.
    """
    figure, axes = plain_figure("RT calls", "Best RMSE so far [dB]")
    for method, result in results.items():
        history = result.history
        axes.step(
            history["call"], history["best_db"], where="post", color=COLORS.get(method),
            label=f"{label(method)}: {result.rmse_db:.3f} dB",
        )  # fmt: skip
    axes.axhline(
        optimum_db, color=COLORS["auto"], ls="--", lw=1, label=f"global optimum: {optimum_db:.3f} dB"
    )
    axes.legend(frameon=False)
    return figure


def path_loss_by_receiver(results: Mapping[str, Result]) -> Figure:
    """Path loss by receiver: measured, before calibration and after.

    Args:
        results: Results by method, all of the same links.

    Returns:
        The figure.
    """
    figure, axes = plain_figure("Receiver", "Path loss [dB]", width=10.0)
    links = next(iter(results.values())).links
    index = np.arange(1, len(links) + 1)
    axes.plot(index, links["measured_db"], "o-", color=MEASURED, ms=5, lw=1.5, label="measured")
    axes.plot(index, links["before_db"], "s--", color=BEFORE, ms=4, lw=1, label="before calibration")
    for method, result in results.items():
        axes.plot(index, result.links["after_db"], "-", color=COLORS.get(method), lw=1.3, label=label(method))
    axes.set_xlim(0, len(links) + 1)
    axes.legend(frameon=False, ncols=2)
    return figure


def write(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG.

    Args:
        figure: The figure.
        path: File to write.

    Returns:
        The file.
    """
    FigureCanvasAgg(figure).print_png(path)
    return path


def plain_figure(x: str, y: str, width: float = 6.4) -> tuple[Figure, Axes]:
    """An empty figure of one panel in the style of all.

    Args:
        x: What the horizontal axis shows, with its unit.
        y: What the vertical axis shows, with its unit.
        width: Width [in].

    Returns:
        The figure and its axes.
    """
    figure = Figure(figsize=(width, 4.2), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    _style(axes, x, y)
    return figure, axes


def _style(axes: Axes, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e6e6e6")
    axes.set_axisbelow(True)
