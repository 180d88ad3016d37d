"""Maps of links and building outlines, drawn in the report (with links coloured by residual) or as a separate file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.reporting.link_survey import Survey
from calibray.scenes import Triangles, read_meshes
from calibray.scenes.buildings import footprints
from calibray.scenes.obstruction import Region
from calibray.scenes.triangles import LEVEL, STEEP, is_ground
from calibray.support.figure_style import BLUE, FAINT, LINE, ORANGE, dress, styled
from calibray.support.lazy_imports import library
from calibray.support.messages import counted
from calibray.support.output_files import check_file, replacing

WIDTH: Final = 1000
"""Width of the map, which is also its maximum height, in map units."""

LEAST_ASPECT: Final = 0.45
"""Smallest ratio of height to width; without this limit, the map of links along a street would be a thin strip."""

MARGIN: Final = 0.12
"""Margin around the links, as a share of their extent."""

LEAST_EXTENT: Final = 5.0
"""Smallest extent of the map [m]."""

MOST_WALLS: Final = 20_000
"""Maximum number of lines drawn for vertical faces; if there are more, the longest lines are drawn."""

RAMP: Final = ("#1f5fa8", "#5b94cf", "#a9b4bd", "#e0953f", "#b34a00")
"""Colours from negative to positive residuals; colour-blind readers can distinguish the two ends of the scale."""


OUTLINED: Final = 400
"""Maximum number of links for which symbols have an outline."""


@dataclass(frozen=True)
class Plan:
    """Layout of the map that the template draws.

    Attributes:
        height: Height in map units; the width is `WIDTH`.
        west: Coordinate of the left edge [m].
        north: Coordinate of the upper edge [m].
        scale: Map units per metre [1/m].
        buildings: Outlines of buildings, as SVG path data.
        walls: Vertical faces seen from above, as SVG path data.
        bar: Length of the scale bar [m].
        regions: Outlines of the study's regions, as SVG path data.
    """

    height: int
    west: float
    north: float
    scale: float
    buildings: str
    bar: float
    walls: str = ""
    regions: str = ""

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert positions [n, 2 or 3], [m], to coordinates [n, 2] in map units, from the upper left corner."""
        return np.stack(
            [(points[:, 0] - self.west) * self.scale, (self.north - points[:, 1]) * self.scale], axis=1
        )


def plan(survey: Survey, triangles: Triangles | None, regions: Iterable[Region] = ()) -> Plan:
    """Lay out the map of a calibration's links, including regions (such as trees) and, if it can be read, the scene."""
    layout = lay_out(np.concatenate([survey.tx, survey.rx]), triangles)
    return replace(layout, regions="".join(_outlines(region, layout) for region in regions))


def lay_out(ends: NDArray[np.float64], triangles: Triangles | None) -> Plan:
    """Lay out a map of positions [n, 2 or 3], [m], with the scene if it can be read."""
    ends = ends[:, :2]
    low, high = ends.min(axis=0), ends.max(axis=0)
    extent = np.maximum((high - low) * (1 + 2 * MARGIN), LEAST_EXTENT)
    # The ratio of height to width lies between LEAST_ASPECT and 1.
    extent[1] = max(extent[1], LEAST_ASPECT * extent[0])
    extent[0] = max(extent[0], extent[1])
    middle = (low + high) / 2
    west, north = middle[0] - extent[0] / 2, middle[1] + extent[1] / 2
    scale = WIDTH / extent[0]
    layout = Plan(
        round(extent[1] * scale), float(west), float(north), float(scale), "", _round(extent[0] / 5)
    )
    if triangles is None:
        return layout
    return replace(layout, buildings=_buildings(triangles, layout), walls=_walls(triangles, layout))


def marks(links: Survey, layout: Plan) -> dict[str, Any]:
    """The symbols of links on the map: discs at the end with more distinct positions, and triangles at the other."""
    residuals = links.residual_db
    limit = ramp_limit(residuals)
    by_rx = len(np.unique(links.rx, axis=0)) >= len(np.unique(links.tx, axis=0))
    moving, fixed = (links.rx, links.tx) if by_rx else (links.tx, links.rx)
    count = len(residuals)
    position = layout.project(moving).round(1).tolist()
    color, held_out, lost = ramp(residuals, limit), links.table["held_out"].to_numpy(bool), ~links.has_path
    # The largest residuals are drawn last, so that they lie on top.
    order = np.argsort(np.nan_to_num(np.abs(residuals), nan=-1.0), kind="stable")
    return {
        "width": WIDTH,
        "radius": 6.5 if count <= OUTLINED else 4.0 if count <= 10 * OUTLINED else 2.5,
        "limit": f"{limit:g}",
        "ramp": ", ".join(RAMP),
        "ends": ("receivers", "transmitters") if by_rx else ("transmitters", "receivers"),
        "links": [
            (*position[link], color[link], "lost" if lost[link] else "held" if held_out[link] else "")
            for link in order
        ],
        "kinds": [
            kind
            for kind, which in (("held", held_out), ("lost", lost), ("faint", links.faint))
            if which.any()
        ],
        "masts": np.unique(layout.project(fixed).round(1), axis=0).tolist(),
        "bar": layout.bar * layout.scale,
    }


def ramp(value: NDArray[np.float64], limit: float) -> list[str]:
    """Colours of values [n] in CSS notation, "none" for NaN; the ramp ends at plus and minus `limit`."""
    stops = np.array([[int(color[k : k + 2], 16) for k in (1, 3, 5)] for color in RAMP], dtype=float)
    position = np.clip((np.nan_to_num(value) / limit + 1) / 2, 0, 1) * (len(RAMP) - 1)
    channel = [np.interp(position, range(len(RAMP)), stops[:, k]).round().astype(int) for k in range(3)]
    colors = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in zip(*channel, strict=True)]
    return ["none" if np.isnan(number) else color for number, color in zip(value, colors, strict=True)]


def ramp_limit(value: NDArray[np.float64]) -> float:
    """The end of the colour ramp: a round number that 95 % of the absolute values [n] do not exceed; NaN is ignored.

    Example:
        >>> ramp_limit(np.linspace(-4.3, 4.3, 50))
        5.0
    """
    sizes = np.abs(value[np.isfinite(value)])
    largest = float(np.quantile(sizes, 0.95)) if len(sizes) else 0.0
    return _round(max(largest, 0.1), up=True)


def _round(value: float, up: bool = False) -> float:
    """The largest number of the series 1, 2, 5, 10, ... up to a value or, with `up`, the smallest not below it."""
    power = 10.0 ** np.floor(np.log10(value))
    steps = np.array([1.0, 2.0, 5.0, 10.0]) * power
    # A rounding error above a step must not lead to the next step.
    return float(steps[steps >= value * 0.999].min() if up else steps[steps <= value * 1.001].max())


def _buildings(triangles: Triangles, layout: Plan) -> str:
    """Outlines of all objects within the map except the ground; identical outlines are drawn once."""
    south = layout.north - layout.height / layout.scale
    loops = footprints(triangles, layout.west, south, layout.west + WIDTH / layout.scale, layout.north)
    outlines: dict[frozenset[tuple[float, ...]], list[list[float]]] = {}
    for loop in loops:
        line = layout.project(loop).round(1)
        outlines.setdefault(frozenset(map(tuple, line.tolist())), line.tolist())
    return "".join(f"M{'L'.join(f'{x:g},{y:g}' for x, y in line)}Z" for line in outlines.values())


def _outlines(region: Region, layout: Plan) -> str:
    """Outline of the union of a region's polygons, simplified with a tolerance of one map unit."""
    shapely = library("shapely", "scenes")
    parts = shapely.get_parts(shapely.simplify(shapely.union_all(region.outline), 1 / layout.scale))
    lines = [layout.project(shapely.get_coordinates(ring)).round(1) for ring in shapely.get_rings(parts)]
    return "".join(f"M{'L'.join(f'{x:g},{y:g}' for x, y in line.tolist())}Z" for line in lines)


def _walls(triangles: Triangles, layout: Plan) -> str:
    """Vertical faces within the map; seen from above, each is a line, and identical lines are drawn once."""
    normal = triangles.normal
    area = np.linalg.norm(normal, axis=1)
    steep = (np.abs(normal[:, 2]) < STEEP * area) & (area > 0)
    corners = layout.project(triangles.corners[steep].reshape(-1, 3)).round(1).reshape(-1, 3, 2)
    # Seen from above, a vertical triangle is the line between the two corners that are furthest apart.
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    longest = np.linalg.norm(sides[:, :, 0] - sides[:, :, 1], axis=2).argmax(axis=1)
    lines = sides[np.arange(len(sides)), longest]
    inside = (lines.max(axis=1) > 0).all(axis=1) & (lines.min(axis=1) < [WIDTH, layout.height]).all(axis=1)
    lines = lines[inside]
    # Every line starts at the end with the smaller x (or, if equal, y), so that both faces of a wall give identical
    # lines.
    backwards = (lines[:, 0] > lines[:, 1]) @ [2, 1] > (lines[:, 0] < lines[:, 1]) @ [2, 1]
    lines[backwards] = lines[backwards][:, ::-1]
    lines = np.unique(lines.reshape(-1, 4), axis=0)
    length = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    drawn = lines[np.argsort(-length, kind="stable")[:MOST_WALLS]]
    return "".join(f"M{x:g},{y:g}L{u:g},{v:g}" for x, y, u, v in drawn.tolist())


SUFFIXES: Final = (".png", ".svg", ".pdf")


def save_positions(
    file: Path,
    source: str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    inputs: Iterable[Path] = (),
    overwrite: bool = False,
) -> None:
    """Draw a plan of the scene and the antennas, and save it to a file.

    Args:
        file: The file, .png, .svg or .pdf.
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        tx: Positions of the transmitters [n, 3], [m]; repeated positions are drawn once.
        rx: Receivers [m, 3], [m].
        inputs: Files that are never replaced.
        overwrite: If True, also replace a file that Calibray did not write.

    Raises:
        InputError: The file has an unknown suffix or must not be replaced, or the scene cannot be read.
    """
    if file.suffix.lower() not in SUFFIXES:
        raise InputError(f"{file}: the suffix {file.suffix!r} is unknown; use {', '.join(SUFFIXES)}")
    check_file(file, inputs, overwrite)
    figure = draw_positions(source, np.unique(tx, axis=0), rx)
    with replacing(file) as partial:
        figure.savefig(partial, format=file.suffix[1:].lower(), dpi=150)


@styled()
def draw_positions(source: str | Path, tx: ArrayLike, rx: ArrayLike) -> Figure:
    """Draw a plan of the scene and the antennas; the arguments are those of `save_positions`.

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
            # Seen from above, walls are lines, so they are drawn with an edge; edges between the triangles of a roof
            # are not drawn.
            steep = np.abs(normal[:, 2]) <= LEVEL * np.linalg.norm(normal, axis=1)
            edges = np.where(steep, FAINT, LINE).tolist()
            axes.add_collection(
                PolyCollection(list(corners[:, :, :2]), facecolor=LINE, edgecolor=edges, linewidth=0.6)
            )
    marks = {"receiver": (rx, "o", BLUE, 12), "transmitter": (tx, "^", ORANGE, 60)}
    for name, (positions, marker, color, size) in marks.items():
        points = np.asarray(positions, dtype=float).reshape(-1, 3)
        if len(points):
            label = counted(len(points), name)
            axes.scatter(*points[:, :2].T, s=size, c=color, marker=marker, label=label, zorder=3)
    axes.autoscale_view()
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=len(marks))
    return figure
