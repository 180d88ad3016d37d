"""Residuals around transmit antennas, with the pattern that each is stated to have."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.reporting.link_survey import residual
from calibray.result.record import Record
from calibray.study.mounting import link_mountings
from calibray.support.figure_style import BLUE, FAINT, INK, ORANGE, styled
from calibray.support.messages import shortened
from calibray.tracing.antennas import AntennaPattern
from calibray.tracing.mounting import Mounting, Pose, jones_vectors

MOST: Final = 6
"""Transmitters that are drawn, those with the most links."""

DEEPEST_DB: Final = -30.0
"""Level of the pattern at the centre of a figure [dB]; sectors radiate backwards with about this."""


def residuals_by_direction(result: Record) -> Figure | None:
    """Draw the residuals of links over the direction from their transmitter, and its pattern on the horizon.

    Returns:
        The figure; None if the study does not state how transmitters are mounted, or its links cannot be read.
    """
    study = result.study
    if "tx" not in study.links.mountings:
        return None
    try:
        links = study.measurements()
        mounting = link_mountings(study, links)["tx"]
    except InputError:
        return None
    if links.row.tolist() != result.links["row"].tolist():
        return None
    # Predicted minus measured path loss, so that an outer point received more than was predicted.
    residuals = residual(result.links, sign=1)
    shown = np.isfinite(residuals) & result.links["has_path"].to_numpy(bool)
    has_names = study.links.transmitter in links.table.frame
    labels = links.table.labels(study.links.transmitter) if has_names else np.full(len(links), "all")
    away = links.rx - links.tx
    bearing = np.arctan2(away[:, 0], away[:, 1])
    names = sorted(name for name, _ in Counter(labels[shown].tolist()).most_common(MOST))
    return _draw(names, {name: shown & (labels == name) for name in names}, bearing, residuals, mounting)


@styled()
def _draw(
    names: list[str],
    links: dict[str, NDArray[np.bool_]],
    bearing: NDArray[np.float64],
    residuals: NDArray[np.float64],
    mounting: Mounting,
) -> Figure | None:
    """One polar plot for each transmitter; `bearing` is clockwise from y [L], [rad]."""
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
        axes.set_yticks([-limit, 0, limit], [f"{-limit:g}", "0", f"{limit:g} dB"], color=INK, fontsize=7)
        axes.tick_params(axis="x", labelsize=7, colors=FAINT)
        axes.plot(np.linspace(0, 2 * np.pi, 181), np.zeros(181), color=INK, lw=0.8)
        axes.scatter(bearing[mask], residuals[mask], s=10, c=BLUE, alpha=0.7, lw=0)
        turn = np.linspace(0, 2 * np.pi, 361)
        level = np.maximum(_pattern_db(mounting, int(np.flatnonzero(mask)[0]), turn), DEEPEST_DB)
        axes.plot(turn, limit * (1 - 2 * level / DEEPEST_DB), color=ORANGE, lw=1.2)
        axes.set_title(f"{shortened(name, 28)} ({mask.sum():,})", fontsize=9)
    return figure


def _pattern_db(mounting: Mounting, link: int, bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gain on the horizon of the antenna of one link, relative to its largest there [n], [dB]."""
    on_link = mounting.of_paths(np.full(len(bearing), link))
    pose = Pose(*on_link.pose)
    angles = np.stack([np.full(len(bearing), np.pi / 2), np.pi / 2 - bearing], axis=1)
    jones = jones_vectors(AntennaPattern.of(mounting.antennas[on_link.index[0]]), angles, pose)
    power = (np.abs(jones) ** 2).sum(axis=(1, 2))
    return 10 * np.log10(np.maximum(power / max(float(power.max()), 1e-300), 1e-30))
