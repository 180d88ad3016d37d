"""Figures that show the reliability of a calibration: posterior, validation and diagnostics."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.reporting.diagnostics import diagnostics
from calibray.reporting.link_survey import residual
from calibray.result.files import has_links
from calibray.result.record import Record
from calibray.study.mounting import link_mountings
from calibray.support import figure_style as style
from calibray.support.messages import shortened
from calibray.tracing.antennas import AntennaPattern, Mounting, Pose, jones_vectors, wave_basis
from calibray.validation.validation import Validation

PARAMETERS: Final = 12
"""Maximum number of parameters shown; the least certain parameters come first."""

BARS: Final = 36
"""Number of bars in the histogram over the range between a parameter's bounds."""

ROWS: Final = 14
"""Maximum number of rows in the power figure."""

PANELS: Final = 6
"""Maximum number of panels in a figure; each panel shows one observable or one transmitter, in descending order of the
number of links."""

DEEPEST_DB: Final = -30.0
"""Level of the antenna pattern at the centre of a figure, relative to its maximum [dB]. The back lobe of a sector
antenna is at about this level."""


def trust_figures(result: Record) -> dict[str, Figure]:
    """Draw those figures for which the calibration contains data."""
    tables, figures = diagnostics(result), {}
    if all(len(result.uncertainty.draws.get(name, ())) > 1 for name in result.parameters):
        figures["possible-values"] = possible_values(result)
    if result.held_out is not None:
        validation = Validation.of(result.held_out)
        figures["held-out-errors"] = held_out_errors(validation)
        figures["held-out-blocks"] = held_out_blocks(validation)
    for name, draw in (("power", power), ("neighbours", neighbours), ("leverage", leverage)):
        if name in tables:
            figures[name] = draw(tables[name])
    if "depth" in tables and len(tables["depth"]) > 1:
        figures["residual-by-depth"] = by_depth(tables["depth"])
    return figures


@style.styled()
def possible_values(result: Record) -> Figure:
    """Draw the posterior of every parameter between its bounds, with its 95 % interval."""
    names = sorted(result.parameters, key=lambda name: -_spread(result, name))[:PARAMETERS]
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(10.0 if columns > 1 else 6.4, 0.5 + 1.9 * rows), dpi=150, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        _draw_posterior(axes, result, name)
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    return figure


def _draw_posterior(axes: Axes, result: Record, name: str) -> None:
    section, interval = result.study.parameters[name], result.intervals.get(name)
    lower, upper = map(float, section.bounds)
    log = section.scale == "log"
    ends = np.geomspace(lower, upper, BARS + 1) if log else np.linspace(lower, upper, BARS + 1)
    style.dress(axes, shortened(name, 34), "")
    count, _ = np.histogram(result.uncertainty.draws[name], ends)
    axes.stairs(
        count / len(result.uncertainty.draws[name]), ends, fill=True, color=style.BLUE, alpha=0.45, lw=0
    )
    for low, high in () if interval is None else (interval.pieces or ((interval.lower, interval.upper),)):
        axes.plot([low, high], [0, 0], color=style.BLUE, lw=4, solid_capstyle="butt", clip_on=False, zorder=3)
    axes.axvline(result.fit.initial_parameters[name], color=style.FAINT, lw=1.2, ls="--")
    axes.axvline(result.parameters[name], color=style.ORANGE, lw=1.6)
    axes.set(xlim=(lower, upper), ylim=(0, None), yticks=[])
    if log:
        style.logarithmic(axes, "x")
    axes.spines["left"].set_visible(False)
    if interval is not None:
        axes.set_title(interval.verdict, fontsize=9, color=style.FAINT, loc="right")


def _spread(result: Record, name: str) -> float:
    """Standard deviation of a parameter's draws, as a share of its range."""
    section = result.study.parameters[name]
    scale = np.log if section.scale == "log" else np.asarray
    bounds = np.array(section.bounds, dtype=float)
    return float(np.std(scale(result.uncertainty.draws[name])) / np.ptp(scale(bounds)))


@style.styled()
def held_out_errors(validation: Validation) -> Figure:
    """Draw the distribution of absolute errors on held-out links, by model."""
    figure, axes = style.plain_figure(
        "Absolute error of held-out links [dB]", "Share of links up to this error"
    )
    judged, reach = validation.block >= 0, 0.0
    for name, color in _colors(validation):
        error = np.sort(np.abs(validation.errors[name][judged]))
        share = np.arange(1, len(error) + 1) / len(error)
        # Without this limit, a few very large errors would compress the rest of the curves.
        reach = max(reach, float(np.quantile(error, 0.97)))
        wide = 2.2 if name == validation.best else 1.2
        axes.step(error, share, where="post", color=color, lw=wide, label=f"{name}: {_rmse(error):.2f} dB")
    axes.set(xlim=(0, reach or 1.0), ylim=(0, 1.02))
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


@style.styled()
def held_out_blocks(validation: Validation) -> Figure:
    """Draw the RMSE of every model on every block."""
    count = len(validation.labels)
    figure, axes = style.plain_figure("Block", "Held-out RMSE [dB]")
    for name, color in _colors(validation):
        values = [_rmse(validation.errors[name][validation.block == number]) for number in range(count)]
        best = name == validation.best
        axes.plot(range(count), values, "o-" if best else "o--", color=color, ms=5 if best else 3.5,
                  lw=1.8 if best else 0.8, label=name)  # fmt: skip
    step = -(-count // 12)
    axes.set_xticks(range(0, count, step), [shortened(label, 12) for label in validation.labels[::step]])
    axes.set_ylim(0, None)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def _colors(validation: Validation) -> list[tuple[str, str]]:
    """Assign colours to models; calibrated models have the main colours of the page."""
    calibrated = iter((style.BLUE, style.ORANGE, style.GREEN))
    others = iter((style.FAINT, *style.PALETTE, *style.PALETTE))
    return [
        (name, next(calibrated, style.INK) if name.startswith("calibrated") else next(others))
        for name in validation.table.index
    ]


def _rmse(error: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")


@style.styled()
def power(table: pd.DataFrame) -> Figure:
    """Draw the share of power by material and type of interaction."""
    shown = table.head(ROWS)
    names = [f"{row.material} {row.interaction}".strip() for row in shown.itertuples()]
    figure, axes = style.plain_figure("Mean share of a link's power [%]", "", height=1.2 + 0.3 * len(shown))
    axes.grid(axis="y", visible=False)
    axes.grid(axis="x", color=style.LINE)
    axes.barh(range(len(shown)), 100 * shown["share"], color=style.BLUE, height=0.6)
    axes.set_yticks(range(len(shown)), [shortened(name, 30) for name in names])
    axes.invert_yaxis()
    return figure


@style.styled()
def neighbours(table: pd.DataFrame) -> Figure:
    """Draw the semivariance of residuals versus distance between links."""
    figure, axes = style.plain_figure("Distance between links [m]", "Semivariance of residuals [dB²]")
    axes.plot(table["distance_m"], table["semivariance_db2"], "o-", color=style.BLUE)
    axes.set(xlim=(0, None), ylim=(0, None))
    return figure


@style.styled()
def leverage(table: pd.DataFrame) -> Figure:
    """Draw the residual of every link versus its leverage."""
    figure, axes = style.residual_figure("Leverage")
    size = 40 if len(table) <= 100 else 16 if len(table) <= 1000 else 5
    axes.scatter(table["leverage"], table["residual_db"], s=size, c=style.BLUE, alpha=0.7, lw=0,
                 rasterized=len(table) > 2000)  # fmt: skip
    axes.set_xlim(0, None)
    return figure


@style.styled()
def by_depth(table: pd.DataFrame) -> Figure:
    """Draw the mean residual by the number of interactions of the strongest path, with two standard errors."""
    figure, axes = style.residual_figure("Interactions of the strongest path")
    # A single link has no standard error, so no error bar is drawn.
    error = table["standard_deviation_db"] / np.sqrt((table["links"] - 1).replace(0, np.nan))
    axes.errorbar(table["depth"], table["mean_db"], 2 * error, fmt="o", color=style.BLUE, capsize=3)
    labels = [f"{row.depth:.0f}\n({row.links:,})" for row in table.itertuples()]
    axes.set_xticks(table["depth"].to_numpy(float), labels)
    axes.set_xlim(table["depth"].min() - 0.5, table["depth"].max() + 0.5)
    return figure


def residuals_by_direction(result: Record) -> Figure | None:
    """Draw residuals versus the bearing of the receiver from the transmitter, with the horizontal antenna pattern.

    No figure is drawn if the study does not state how the transmit antennas are mounted, or if the links cannot be read
    or have changed.
    """
    study = result.study
    if "tx" not in study.links.mountings:
        return None
    try:
        links = study.measurements()
        mounting = link_mountings(study, links)["tx"]
    except InputError:
        return None
    if not has_links(result, links):
        return None
    # Values are predicted minus measured path loss, so points farther out received more power than predicted.
    residuals = residual(result.links, sign=1)
    shown = np.isfinite(residuals) & result.links["has_path"].to_numpy(bool)
    has_names = study.links.transmitter in links.table.frame
    labels = links.table.labels(study.links.transmitter) if has_names else np.full(len(links), "all")
    away = links.rx - links.tx
    bearing = np.arctan2(away[:, 0], away[:, 1])
    names = sorted(name for name, _ in Counter(labels[shown].tolist()).most_common(PANELS))
    return _polar_figures(
        names, {name: shown & (labels == name) for name in names}, bearing, residuals, mounting
    )


@style.styled()
def _polar_figures(
    names: list[str],
    links: dict[str, NDArray[np.bool_]],
    bearing: NDArray[np.float64],
    residuals: NDArray[np.float64],
    mounting: Mounting,
) -> Figure | None:
    """Draw one polar plot for each transmitter; `bearing` [L], [rad], is measured clockwise from the y axis."""
    if not names:
        return None
    columns = min(len(names), 3)
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.9 * columns + 0.4, 3.3 * rows), dpi=150, layout="constrained")
    limit = max(float(np.ceil(np.abs(residuals[np.any(list(links.values()), axis=0)]).max())), 1.0)
    for number, name in enumerate(names):
        mask = links[name]
        axes = figure.add_subplot(rows, columns, number + 1, projection="polar")
        axes.set_theta_zero_location("N")  # type: ignore[attr-defined]
        axes.set_theta_direction(-1)  # type: ignore[attr-defined]
        axes.set_ylim(-limit, limit)
        axes.set_yticks(
            [-limit, 0, limit], [f"{-limit:g}", "0", f"{limit:g} dB"], color=style.INK, fontsize=7
        )
        axes.tick_params(axis="x", labelsize=7, colors=style.FAINT)
        axes.plot(np.linspace(0, 2 * np.pi, 181), np.zeros(181), color=style.INK, lw=0.8)
        axes.scatter(bearing[mask], residuals[mask], s=10, c=style.BLUE, alpha=0.7, lw=0)
        turn = np.linspace(0, 2 * np.pi, 361)
        level = np.maximum(_pattern_db(mounting, int(np.flatnonzero(mask)[0]), turn), DEEPEST_DB)
        # 0 dB is drawn at the rim, `limit`, and DEEPEST_DB at the centre, minus `limit`.
        axes.plot(turn, limit * (1 - 2 * level / DEEPEST_DB), color=style.ORANGE, lw=1.2)
        axes.set_title(f"{shortened(name, 28)} ({mask.sum():,})", fontsize=9)
    return figure


def _pattern_db(mounting: Mounting, link: int, bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gain of a link's antenna in the horizontal plane at the given bearings, relative to the maximum [n], [dB]."""
    on_link = mounting.of_paths(np.full(len(bearing), link))
    pose = Pose(*on_link.pose)
    # Azimuths are measured counter-clockwise from east, and bearings clockwise from north.
    angles = np.stack([np.full(len(bearing), np.pi / 2), np.pi / 2 - bearing], axis=1)
    jones = jones_vectors(AntennaPattern.of(mounting.antennas[on_link.index[0]]), wave_basis(angles), pose)
    power = (np.abs(jones) ** 2).sum(axis=(1, 2))
    return 10 * np.log10(np.maximum(power / max(float(power.max()), 1e-300), 1e-30))
