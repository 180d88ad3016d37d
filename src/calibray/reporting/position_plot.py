"""A plan of the scene with the antennas, as a figure or a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from calibray.errors import InputError
from calibray.scenes import read_meshes
from calibray.scenes.triangles import LEVEL, is_ground
from calibray.support.figure_style import BLUE, FAINT, LINE, ORANGE, dress, styled
from calibray.support.output_files import check_file, replacing

SUFFIXES: Final = (".png", ".svg", ".pdf")


def save_positions(
    file: Path,
    source: str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    inputs: Iterable[Path] = (),
    overwrite: bool = False,
) -> None:
    """Draw a plan of the scene with the antennas into a file.

    Args:
        file: The file, .png, .svg or .pdf.
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        tx: Transmitters [n, 3], [m]; repeated positions are drawn once.
        rx: Receivers [m, 3], [m].
        inputs: Files that are never replaced.
        overwrite: Replace a file that Calibray did not write.

    Raises:
        InputError: The file has another suffix or must not be replaced, or the scene cannot be read.
    """
    if file.suffix.lower() not in SUFFIXES:
        raise InputError(f"{file}: the suffix {file.suffix!r} is unknown; use {', '.join(SUFFIXES)}")
    check_file(file, inputs, overwrite)
    figure = draw_positions(source, np.unique(tx, axis=0), rx)
    with replacing(file) as partial:
        figure.savefig(partial, format=file.suffix[1:].lower(), dpi=150)


@styled()
def draw_positions(source: str | Path, tx: ArrayLike, rx: ArrayLike) -> Figure:
    """Draw a plan of the scene with the antennas; arguments as for `save_positions`.

    Raises:
        InputError: The scene cannot be read.
    """
    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    dress(axes, "x, east [m]", "y, north [m]")
    axes.grid(visible=False)
    meshes = [item.mesh for item in read_meshes(source)]
    extent = np.ptp(np.concatenate([mesh.vertices[:, :2] for mesh in meshes]), axis=0)
    for mesh in meshes:
        if not is_ground(mesh, extent):
            corners = mesh.vertices[mesh.faces]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            # Walls are lines in plan and get an edge; edges between the triangles of a roof are not drawn.
            steep = np.abs(normal[:, 2]) <= LEVEL * np.linalg.norm(normal, axis=1)
            edges = np.where(steep, FAINT, LINE).tolist()
            axes.add_collection(
                PolyCollection(list(corners[:, :, :2]), facecolor=LINE, edgecolor=edges, linewidth=0.6)
            )
    marks = {"receivers": (rx, "o", BLUE, 12), "transmitters": (tx, "^", ORANGE, 60)}
    for name, (positions, marker, color, size) in marks.items():
        points = np.asarray(positions, dtype=float).reshape(-1, 3)
        if len(points):
            label = f"{len(points)} {name}"
            axes.scatter(*points[:, :2].T, s=size, c=color, marker=marker, label=label, zorder=3)
    axes.autoscale_view()
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=len(marks))
    return figure
