"""A coverage map for people and for other tools: GeoTIFF, picture and table."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from calibray.coordinates import parse_crs
from calibray.errors import InputError
from calibray.prediction.predicted_grid import PredictedGrid
from calibray.scenes.building_outlines import footprints
from calibray.support.extras import library
from calibray.support.figure_style import FAINT, INK, LINE, ORANGE, PAPER, dress, styled, write
from calibray.support.output_files import check_outputs, replacing

FILES: Final = ("map.tif", "map.png", "map.csv")
GEOTIFF, PICTURE, TABLE = FILES

LOSS: Final = "viridis_r"
POWER: Final = "viridis"
WIDTH_COLORS: Final = "cividis"
"""Matplotlib's scales that stay ordered for colour-blind people and in grey; what is strong is bright."""


def save_map(
    coverage: PredictedGrid, folder: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False
) -> tuple[str, ...]:
    """Write a coverage map as GeoTIFF, picture and table.

    Args:
        coverage: The map.
        folder: Folder to write `map.tif`, `map.png` and `map.csv` into; made if absent.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace files that Calibray did not write.

    Returns:
        Names of the files; without rasterio the GeoTIFF is not among them.

    Raises:
        InputError: The folder cannot be written, or a file there must not be replaced.
    """
    target = check_outputs(folder, FILES, inputs, overwrite)
    names = FILES if find_spec("rasterio") else FILES[1:]
    try:
        target.mkdir(parents=True, exist_ok=True)
        with replacing(target / TABLE) as partial:
            coverage.table().to_csv(partial, index=False, float_format="%.8g")
        write(figure(coverage), target / PICTURE)
        if GEOTIFF in names:
            geotiff(coverage, target / GEOTIFF)
    except OSError as error:
        raise InputError(
            f"output folder {target}: cannot be written ({error.strerror}); name another"
        ) from None
    return names


def geotiff(coverage: PredictedGrid, path: Path) -> None:
    """Write a map as a GeoTIFF: a band for each layer, north up, missing where there is no path.

    Args:
        coverage: The map. Where its frame is not known, coordinates are the scene's own metres, and no reference system
            is stated.
        path: The file.

    Raises:
        InputError: rasterio is not installed, or the frame's projection is not known.
    """
    rasterio = library("rasterio", "scenes")
    frame, bands = coverage.frame, coverage.layers
    west, north = coverage.x[0] - coverage.cell / 2, coverage.y[-1] + coverage.cell / 2
    place: dict[str, Any] = {}
    if frame is not None:
        west, north = west + frame.easting, north + frame.northing
        place["crs"] = rasterio.crs.CRS.from_wkt(parse_crs(frame.crs).to_wkt())
    place["transform"] = rasterio.Affine(coverage.cell, 0, west, 0, -coverage.cell, north)
    rows, columns = coverage.z.shape
    layout = {"width": columns, "height": rows, "count": len(bands), "dtype": "float32", "nodata": np.nan}
    compressed = {"driver": "GTiff", "compress": "deflate", "predictor": 3}
    # By way of memory: GDAL takes no names but those in UTF-8.
    with rasterio.MemoryFile() as memory:
        with memory.open(**compressed, **layout, **place) as file:
            for number, (name, values) in enumerate(bands.items(), start=1):
                known = np.where(np.isfinite(values), values, np.nan)
                file.write(known[::-1].astype("float32"), number)
                file.set_band_description(number, name)
                file.set_band_unit(number, "dBm" if name.endswith("dbm") else "dB")
            file.update_tags(
                tx_m=" ".join(f"{each:g}" for each in coverage.tx),
                receiver_height_m=f"{coverage.height:g}",
                **({} if coverage.level is None else {"interval_level": f"{coverage.level:g}"}),
            )
        with replacing(path) as partial:
            partial.write_bytes(memory.read())


@styled()
def figure(coverage: PredictedGrid) -> Figure:
    """A map as a picture, over the outlines of buildings; beside it half the width of the interval, if there is one.

    Args:
        coverage: The map.

    Returns:
        The figure.
    """
    (name, best), *ends = coverage.layers.items()
    power = name.endswith("dbm")
    panels: list[tuple[str, NDArray[np.float64], str]] = [
        ("Received power [dBm]" if power else "Path loss [dB]", best, POWER if power else LOSS)
    ]
    if ends:
        half = (ends[1][1] - ends[0][1]) / 2
        panels.append((f"Half of the {coverage.level:.0%} interval [dB]", half, WIDTH_COLORS))
    rows, columns = coverage.z.shape
    across = len(panels) == 1 or columns < 2 * rows
    size = np.array([7.0, float(np.clip(5.6 * rows / columns, 2.5, 9.0)) + 0.9])
    drawn = Figure(
        figsize=tuple(size * ([len(panels), 1] if across else [1, len(panels)])),
        dpi=150,
        layout="constrained",
    )
    shape = (1, len(panels)) if across else (len(panels), 1)
    for axes, (label, values, colors) in zip(drawn.subplots(*shape, squeeze=False).flat, panels, strict=True):
        _panel(axes, coverage, values, label, colors)
    return drawn


def _panel(axes: Axes, coverage: PredictedGrid, values: NDArray[np.float64], label: str, colors: str) -> None:
    dress(axes, "x, east [m]", "y, north [m]")
    axes.grid(visible=False)
    half = coverage.cell / 2
    west, east = coverage.x[0] - half, coverage.x[-1] + half
    south, north = coverage.y[0] - half, coverage.y[-1] + half
    known = np.where(np.isfinite(values), values, np.nan)
    low, high = _range(known)
    axes.set_facecolor(LINE)
    shown = axes.imshow(
        known, extent=(west, east, south, north), origin="lower", cmap=colors, vmin=low, vmax=high,
        interpolation="nearest", zorder=1,
    )  # fmt: skip
    for loop in footprints(coverage.triangles, west, south, east, north):
        axes.add_patch(PathPatch(Outline(np.vstack([loop, loop[:1]])), fill=False, ec=INK, lw=0.5, zorder=2))
    axes.plot(*coverage.tx[:2], "^", ms=10, mfc=ORANGE, mec=PAPER, mew=1.2, zorder=4, clip_on=False)
    axes.annotate(
        "TX", (coverage.tx[0], coverage.tx[1]), (8, 4), textcoords="offset points", color=INK, zorder=4,
        bbox={"fc": PAPER, "ec": "none", "alpha": 0.8, "pad": 1},
    )  # fmt: skip
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    figure = axes.get_figure()
    if isinstance(figure, Figure):
        bar = figure.colorbar(shown, ax=axes, label=label, shrink=0.8, extend="both")
        bar.outline.set_edgecolor(FAINT)  # pyright: ignore[reportCallIssue]
    if np.isnan(known).any():
        axes.annotate(
            "grey: no path", (1, 1.01), xycoords="axes fraction", ha="right", color=FAINT, fontsize=8
        )


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    """Where colours begin and end: all but the outermost 1 % on either side, at least 1 dB apart."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = np.quantile(known, [0.01, 0.99])
    middle, half = (low + high) / 2, max((high - low) / 2, 0.5)
    return float(middle - half), float(middle + half)
