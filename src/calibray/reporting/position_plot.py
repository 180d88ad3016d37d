"""Antennas over a scene seen from above."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from calibray.scenes import read_meshes
from calibray.scenes.triangles import LEVEL, is_ground
from calibray.support.figure_style import BLUE, FAINT, INK, LINE, ORANGE, dress, styled


@styled()
def draw_positions(
    source: str | Path, tx: ArrayLike, rx: ArrayLike, inside: Mapping[str, ArrayLike] | None = None
) -> Figure:
    """Draw antennas over the scene seen from above.

    Args:
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        tx: Transmitters [n, 3], [m].
        rx: Receivers [m, 3], [m].
        inside: Further positions to mark, by what they are: [k, 3], [m].

    Returns:
        The figure; its `savefig` writes PNG, SVG or PDF.

    Raises:
        InputError: The scene cannot be read.
    """
    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    dress(axes, "x, east [m]", "y, north [m]")
    axes.grid(visible=False)
    meshes = [item.mesh for item in read_meshes(source)]
    whole = np.ptp(np.concatenate([mesh.vertices[:, :2] for mesh in meshes]), axis=0)
    for mesh in meshes:
        if not is_ground(mesh, whole):
            corners = mesh.vertices[mesh.faces]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            # Walls are lines when seen from above; within a roof there are none to be seen.
            steep = np.abs(normal[:, 2]) <= LEVEL * np.linalg.norm(normal, axis=1)
            edges = np.where(steep, FAINT, LINE).tolist()
            axes.add_collection(
                PolyCollection(list(corners[:, :, :2]), facecolor=LINE, edgecolor=edges, linewidth=0.6)
            )
    marks = {"receivers": (rx, "o", BLUE, 12), "transmitters": (tx, "^", ORANGE, 60)}
    for what, places in (inside or {}).items():
        marks[what] = (places, "x", INK, 30)
    for what, (places, marker, color, size) in marks.items():
        points = np.asarray(places, dtype=float).reshape(-1, 3)
        if len(points):
            axes.scatter(
                *points[:, :2].T, s=size, c=color, marker=marker, label=f"{len(points)} {what}", zorder=3
            )
    axes.autoscale_view()
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=len(marks))
    return figure
