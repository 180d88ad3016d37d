"""Drawing: antennas over a scene seen from above."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.scenes.diagnosis import read_meshes
from calibray.scenes.meshes import Mesh
from calibray.scenes.source import find_scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    path, root = find_scene(source)
    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    meshes = [mesh for _, _, mesh in read_meshes(path, root)]
    whole = np.ptp(np.concatenate([mesh.vertices[:, :2] for mesh in meshes]), axis=0)
    for mesh in meshes:
        if not is_ground(mesh, whole):
            seen = mesh.vertices[mesh.faces][:, :, :2]
            # Walls are lines when seen from above.
            axes.add_collection(PolyCollection(list(seen), facecolor="0.85", edgecolor="0.45", linewidth=0.4))
    marks = {"receivers": (rx, "o", "tab:blue", 12), "transmitters": (tx, "^", "tab:red", 50)}
    for what, places in (inside or {}).items():
        marks[what] = (places, "x", "tab:orange", 30)
    for what, (places, marker, color, size) in marks.items():
        points = np.asarray(places, dtype=float).reshape(-1, 3)
        if len(points):
            axes.scatter(
                points[:, 0],
                points[:, 1],
                s=size,
                c=color,
                marker=marker,
                label=f"{len(points)} {what}",
                zorder=3,
            )
    axes.autoscale_view()
    axes.legend(loc="upper right")
    axes.set_title(path.name)
    return figure


def is_ground(mesh: Mesh, whole: NDArray[np.float64]) -> bool:
    """Whether a mesh is a sheet under the whole scene.

    Args:
        mesh: The mesh.
        whole: Extent of the scene to the east and to the north [2], [m].

    Returns:
        True if no face of it is steep, and it covers most of the scene.
    """
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    normal = np.cross(sides[:, 0], sides[:, 1])
    level = np.abs(normal[:, 2]) > 0.5 * np.linalg.norm(normal, axis=1)
    wide = (np.ptp(mesh.vertices[:, :2], axis=0) > 0.8 * whole).all()
    seen, extent = np.abs(normal[:, 2]).sum() / 2, float(np.prod(whole))
    return bool(level.all() and wide and seen > 0.5 * extent)
