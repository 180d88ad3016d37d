"""Figures of calibrations: cost and convergence (as in the paper), path loss, and residuals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from calibray.reporting.link_survey import Survey, in_measured_quantity, measured_quantity
from calibray.reporting.trust_figures import PANELS, residuals_by_direction, trust_figures
from calibray.reporting.wording import method_text
from calibray.result.record import Record
from calibray.support import figure_style as style
from calibray.support.messages import shortened

SYMBOLS: Final = 60
"""Maximum number of links that are drawn as symbols joined by a line."""

FILE_ORDER: Final = 500
"""Maximum number of links that are drawn in the order of the study's file, with held-out links shaded.
If there are more links, they are sorted by measured path loss."""

RASTERIZED: Final = 2000
"""Maximum number of points that are drawn as vector graphics; if there are more, the points are rasterized."""

LONG: Final = 1000
"""Number of RT calls above which the axis is logarithmic, because the first calls reduce the RMSE most."""

GROUPS: Final = 24
"""Maximum number of groups shown; the groups with the most links are shown."""


@style.styled()
def cumulative_cost(results: Mapping[str, Record]) -> Figure:
    """Draw RT calls and time versus iterations (the cumulative-cost figure of the paper)."""
    figure = Figure(figsize=(6.4, 4.2), dpi=150, layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for axes, column, y in zip(
        panels, ("call", "seconds"), ("RT calls so far", "Time so far [s]"), strict=True
    ):
        style.dress(axes, "Iteration" if column == "seconds" else "", y)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        for method, result in results.items():
            value = result.history.groupby("iteration")[column].max()
            label = f"{method_text(result, method)}: {value.iloc[-1]:.4g}"
            axes.plot(value.index, value, "o-", ms=4, color=style.COLORS.get(method), label=label)
            if method == "sgwo-im":
                # The first iterations evaluate all wolves; later iterations evaluate only the wolves that the surrogate
                # selects.
                calls = result.history.groupby("iteration").size()
                for first in calls[calls < calls.iloc[0]].index[:1]:
                    axes.axvline(
                        first - 1, color=style.COLORS[method], ls="--", lw=1, label="start of the surrogate"
                    )
        axes.legend(frameon=False)
    if _unequal(results):
        style.logarithmic(panels[0], "y")
    return figure


@style.styled()
def convergence(results: Mapping[str, Record], optimum_db: float | None = None) -> Figure:
    """Draw the lowest RMSE so far [dB] versus RT calls, and the RMSE of the global optimum [dB] if it is known."""
    figure, axes = style.plain_figure("RT calls", "Best RMSE so far [dB]")
    for method, result in results.items():
        history = result.history
        axes.step(
            history["call"], history["best_db"], where="post", color=style.COLORS.get(method),
            label=f"{method_text(result, method)}: {result.rmse_db:.3f} dB",
        )  # fmt: skip
    if _unequal(results) or max(result.history["call"].max() for result in results.values()) > LONG:
        style.logarithmic(axes, "x")
        axes.set_xlim(left=1)
    if optimum_db is not None:
        axes.axhline(optimum_db, color=style.INK, ls="--", lw=1, label=f"global optimum: {optimum_db:.3f} dB")
    axes.legend(frameon=False)
    return figure


@style.styled()
def path_loss_by_receiver(results: Mapping[str, Record]) -> Figure:
    """Draw the measured path loss of every link, and the path loss modelled before and after calibration."""
    first = next(iter(results.values()))
    links = first.links
    few, many = len(links) <= SYMBOLS, len(links) > FILE_ORDER
    number = np.arange(1, len(links) + 1)
    # With many links, curves are readable only if the links are sorted by measured path loss.
    order = np.argsort(links["measured_db"].to_numpy(float), kind="stable") if many else number - 1
    x_label = "Receiver" if few else "Link, by measured path loss" if many else "Link"
    quantity = measured_quantity(first)
    y_label = f"{quantity.name[:1].upper()}{quantity.name[1:]} [{quantity.unit}]"
    figure, axes = style.plain_figure(x_label, y_label, width=10.0)
    held_out = links["held_out"].to_numpy(bool)
    if not many and 0 < held_out.sum() < len(links):
        for run, (start, end) in enumerate(_runs(held_out)):
            name = None if run else "held out"
            axes.axvspan(start + 0.5, end + 0.5, color=style.FAINT, alpha=0.12, lw=0, label=name)

    def draw(result: Record, name: str, line: str, dots: str, layer: int = 2, **look: Any) -> None:
        values = in_measured_quantity(result, name)[order]
        shown = np.where(np.isfinite(values), values, np.nan)
        axes.plot(
            number, shown, line if few else dots, rasterized=len(links) > RASTERIZED, zorder=layer, **look
        )

    draw(first, "measured", "o-", "-" if many else ".", 3, color=style.INK, ms=5, lw=1.5, label="measured")
    draw(first, "before", "s--", ".", color=style.FAINT, ms=4 if few else 2, lw=1, label="before calibration")
    for index, (method, result) in enumerate(results.items()):
        color, size = style.COLORS.get(method, style.BLUE), 2 if many else 4
        # Upper lines are thinner, so that the lines below them remain visible.
        width = 1.3 + 1.4 * (len(results) - 1 - index)
        draw(result, "after", "-", ".", color=color, label=method_text(result, method), ms=size, lw=width)
    axes.set_xlim(0, len(links) + 1)
    axes.legend(frameon=False, ncols=6, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


@style.styled()
def residual_over_distance(survey: Survey) -> Figure:
    """Draw the residual of each link versus the distance between its antennas."""
    figure, axes = style.residual_figure("Distance [m]")
    residuals, held_out = survey.residual_db, survey.table["held_out"].to_numpy(bool)
    for mask, color, marker, name in (
        (~held_out & survey.has_path, style.BLUE, "o", "calibration links"),
        (held_out & survey.has_path, style.ORANGE, "^", "held out"),
        (~survey.has_path, style.FAINT, "s", "no path"),
    ):
        shown = mask & np.isfinite(residuals)
        if shown.any():
            size = 40 if shown.sum() <= 100 else 16 if shown.sum() <= 1000 else 5
            axes.scatter(survey.distance[shown], residuals[shown], s=size, c=color, marker=marker, alpha=0.7, lw=0,
                         label=f"{name} ({shown.sum():,})", rasterized=len(residuals) > RASTERIZED)  # fmt: skip
    distance = survey.distance[np.isfinite(residuals)]
    if len(distance) and distance.max() > 8 * distance.min():
        style.logarithmic(axes, "x")
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    return figure


@style.styled()
def residual_by_group(survey: Survey) -> Figure:
    """Draw the residuals of each group: median, quartiles, and whiskers that contain 90 % of the links."""
    frame = pd.DataFrame({"group": survey.group, "residual": survey.residual_db})[survey.has_path].dropna()
    sizes = frame.groupby("group").size().sort_values(ascending=False, kind="stable")
    names = sorted(sizes.index[:GROUPS])
    figure, axes = style.plain_figure(
        "Predicted − measured [dB]", "", height=max(2.2, 1.2 + 0.32 * len(names))
    )
    axes.grid(axis="y", visible=False)
    axes.grid(axis="x", color=style.LINE)
    axes.axvline(0, color=style.INK, lw=0.8)
    values = [frame.loc[frame["group"] == name, "residual"].to_numpy() for name in names]
    if values:
        lines, median = {"color": style.BLUE, "linewidth": 1.2}, {"color": style.ORANGE, "linewidth": 2}
        axes.boxplot(values, orientation="horizontal", whis=(5, 95), showfliers=False, widths=0.5, boxprops=lines,
                     whiskerprops=lines, capprops=lines, medianprops=median)  # fmt: skip
    labels = [f"{shortened(name, 28)} ({len(value):,})" for name, value in zip(names, values, strict=True)]
    axes.set_yticks(range(1, len(names) + 1), labels)
    axes.invert_yaxis()
    return figure


def result_figures(result: Record, links: Survey | None) -> dict[str, Figure]:
    """All figures of a calibration, by name; without `links`, figures that require positions are omitted."""
    method = {result.study.method.name: result}
    figures = {
        "convergence": convergence(method),
        "cumulative-cost": cumulative_cost(method),
        "path-loss": path_loss_by_receiver(method),
    }
    if links is not None:
        figures["residual-over-distance"] = residual_over_distance(links)
        if links.group is not None:
            figures["residual-by-group"] = residual_by_group(links)
    further = {
        "observables": measured_over_modelled(result),
        "residual-by-direction": residuals_by_direction(result),
    }
    return figures | {name: drawn for name, drawn in further.items() if drawn} | trust_figures(result)


def _unequal(results: Mapping[str, Record]) -> bool:
    """Whether the numbers of RT calls differ so much that only a logarithmic axis shows all methods."""
    calls = [result.history["call"].max() for result in results.values()]
    return bool(max(calls) > 4 * min(calls))


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Start and end of every run of True values in a mask."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]


@style.styled()
def measured_over_modelled(result: Record) -> Figure | None:
    """Draw measured versus modelled values of the first observables, without device biases; None if there are none."""
    fits = dict(list(result.fit.observables.items())[:PANELS])
    if not fits:
        return None
    columns = min(len(fits), 3)
    rows = -(-len(fits) // columns)
    figure = Figure(figsize=(3.2 * columns + 0.4, 3.0 * rows + 0.3), dpi=150, layout="constrained")
    held_out = result.links["held_out"].to_numpy(bool)
    for number, (name, fit) in enumerate(fits.items(), start=1):
        axes = figure.add_subplot(rows, columns, number)
        style.dress(axes, f"modelled [{fit.unit}]", f"measured [{fit.unit}]")
        measured, modelled = (
            result.links[f"{name}_{when}_{fit.unit}"].to_numpy(float) for when in ("measured", "after")
        )
        if (bias := f"{name}_bias_{fit.unit}") in result.links:
            measured = measured - result.links[bias].to_numpy(float)
        shown = np.isfinite(measured) & np.isfinite(modelled)
        for part, color, role in (
            (~held_out, style.BLUE, "calibration"),
            (held_out, style.ORANGE, "held out"),
        ):
            if (part & shown).any():
                axes.scatter(modelled[part & shown], measured[part & shown], s=10, c=color, lw=0, label=role)
        if shown.any():
            both = np.concatenate([measured[shown], modelled[shown]])
            ends = [both.min(), both.max()]
            axes.plot(ends, ends, color=style.INK, lw=0.8)
        axes.set_title(shortened(name, 28), fontsize=9)
        axes.legend(fontsize=7, labelcolor=style.FAINT, frameon=False)
    return figure
