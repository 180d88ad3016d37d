"""A coverage map, and the files to which it is written: GeoTIFF, picture and table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from calibray.coordinates import Frame, parse_crs
from calibray.errors import InputError
from calibray.result.held_out import NO_PATH
from calibray.scenes.buildings import footprints
from calibray.scenes.triangles import Triangles
from calibray.support.figure_style import FAINT, INK, LINE, ORANGE, PAPER, dress, styled, write
from calibray.support.lazy_imports import library
from calibray.support.output_files import check_outputs, csv_text, write_bytes, write_text

FILES: Final = ("map.tif", "map.png", "map.csv")
GEOTIFF, PICTURE, TABLE = FILES

LOSS_COLORS: Final = "viridis_r"
POWER_COLORS: Final = "viridis"
WIDTH_COLORS: Final = "cividis"
"""Matplotlib colour scales whose order is clear to colour-blind readers and in greyscale; strong signals are bright."""

QUANTILES: Final = (0.02, 0.98)
"""Quantiles of the cells' values at which the colour scale ends, so that a few extreme values do not compress the
scale."""


@final
@dataclass(frozen=True, eq=False, repr=False)
class CoverageMap:
    """Path loss, or received power, over a grid of square cells.

    Attributes:
        tx: Position of the transmitter [3], [m].
        height: Height of the receivers above the ground [m].
        cell: Width of the cells [m].
        x: Eastings of the cells' centres, ascending [nx], [m].
        y: Northings of the cells' centres, ascending [ny], [m].
        z: Heights of the receivers [ny, nx], [m].
        path_loss_db: Path loss with nuisances [ny, nx], [dB]; in cells without a path, the prediction of the
            log-distance model. Path loss is NaN at the transmitter and, in an outdoor study, in cells that lie inside
            buildings and have no path.
        lower_db: Lower end of the interval [ny, nx], [dB]; NaN if there is no prediction or no level.
        upper_db: Upper end of the interval [ny, nx], [dB].
        no_path: Mask of the cells without a path, for which the log-distance model predicts path loss [ny, nx].
        level: Probability that the interval contains a measurement; None for a map without intervals.
        power_dbm: Transmitted power for a map of received power [dBm]; None for a map of path loss.
        frame: Geographic frame of the scene; None if unknown.
        triangles: The scene, used for drawing.
        observables: Further observables of the study [ny, nx], keyed by name and unit, such as spread_ns.
    """

    tx: NDArray[np.float64]
    height: float
    cell: float
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    path_loss_db: NDArray[np.float64]
    lower_db: NDArray[np.float64]
    upper_db: NDArray[np.float64]
    no_path: NDArray[np.bool_]
    level: float | None
    power_dbm: float | None
    frame: Frame | None
    triangles: Triangles
    observables: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def __repr__(self) -> str:
        (name, best), *_ = self.layers.items()
        known = best[np.isfinite(best)]
        values = f"{name} {known.min():.1f} to {known.max():.1f}" if known.size else f"{name} unknown"
        tx = ", ".join(f"{coordinate:g}" for coordinate in self.tx)
        return f"<map of {best.size:,} cells of {self.cell:g} m, transmitter at ({tx}) m, {values}>"

    @property
    def layers(self) -> dict[str, NDArray[np.float64]]:
        """The mapped quantity (path loss [dB] or received power [dBm]) and its interval, as arrays [ny, nx] by name."""
        if self.power_dbm is None:
            best = {"path_loss_db": self.path_loss_db}
            interval = {"lower_db": self.lower_db, "upper_db": self.upper_db}
        else:
            # The upper end of the path-loss interval is the lower end of the power interval.
            best = {"received_power_dbm": self.power_dbm - self.path_loss_db}
            interval = {
                "lower_dbm": self.power_dbm - self.upper_db,
                "upper_dbm": self.power_dbm - self.lower_db,
            }
        return best if self.level is None else best | interval

    def table(self) -> pd.DataFrame:
        """Tabulate the cells from south to north and west to east: x_m, y_m, z_m, layers, observables, basis."""
        x, y = np.meshgrid(self.x, self.y)
        predicted = np.where(self.no_path, NO_PATH, np.where(np.isfinite(self.path_loss_db), "model", ""))
        columns = {"x_m": x, "y_m": y, "z_m": self.z, **self.layers, **self.observables, "basis": predicted}
        return pd.DataFrame({name: values.reshape(-1) for name, values in columns.items()})

    def save(
        self, folder: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False
    ) -> tuple[str, ...]:
        """Write the map as a GeoTIFF, a picture and a table.

        Args:
            folder: Folder for `map.tif`, `map.png` and `map.csv`; a missing folder is created.
            inputs: Files that the calculation reads; these files are never replaced.
            overwrite: If True, also replace files that Calibray did not write.

        Returns:
            Names of the files that were written; without rasterio, there is no GeoTIFF.

        Raises:
            InputError: The folder cannot be written to, or a file in it must not be replaced.
        """
        target = check_outputs(folder, FILES, inputs, overwrite)
        names = FILES if find_spec("rasterio") else FILES[1:]
        try:
            target.mkdir(parents=True, exist_ok=True)
            write_text(target / TABLE, csv_text(self.table(), "%.8g"))
            write(figure(self), target / PICTURE)
            if GEOTIFF in names:
                geotiff(self, target / GEOTIFF)
        except OSError as error:
            raise InputError(
                f"output folder {target}: cannot be written ({error.strerror}); choose another folder"
            ) from None
        return names


def geotiff(coverage: CoverageMap, path: Path) -> None:
    """Write a map as a north-up GeoTIFF: a band for each layer and observable, and a band that is 1 without a path.

    Args:
        coverage: The map. If the map has no frame, the GeoTIFF uses the scene's coordinates and declares no coordinate
            reference system.
        path: The file.

    Raises:
        InputError: rasterio is not installed, or the frame's projection is unknown.
    """
    rasterio = library("rasterio", "scenes")
    frame, bands = coverage.frame, {**coverage.layers, **coverage.observables}
    bands["no_path"] = coverage.no_path.astype(float)
    west, north = coverage.x[0] - coverage.cell / 2, coverage.y[-1] + coverage.cell / 2
    georeference: dict[str, Any] = {}
    if frame is not None:
        west, north = west + frame.easting, north + frame.northing
        georeference["crs"] = rasterio.crs.CRS.from_wkt(parse_crs(frame.crs).to_wkt())
    georeference["transform"] = rasterio.Affine(coverage.cell, 0, west, 0, -coverage.cell, north)
    rows, columns = coverage.z.shape
    layout = {"width": columns, "height": rows, "count": len(bands), "dtype": "float32", "nodata": np.nan}
    compressed = {"driver": "GTiff", "compress": "deflate", "predictor": 3}
    # GDAL accepts only UTF-8 file names, so the file is first created in memory.
    with rasterio.MemoryFile() as memory:
        with memory.open(**compressed, **layout, **georeference) as file:
            for number, (name, values) in enumerate(bands.items(), start=1):
                finite = np.where(np.isfinite(values), values, np.nan)
                file.write(finite[::-1].astype("float32"), number)
                file.set_band_description(number, name)
                if name != "no_path":
                    unit = name.rpartition("_")[2]
                    file.set_band_unit(number, {"dbm": "dBm", "db": "dB"}.get(unit, unit))
            file.update_tags(
                tx_m=" ".join(f"{coordinate:g}" for coordinate in coverage.tx),
                receiver_height_m=f"{coverage.height:g}",
                **({} if coverage.level is None else {"interval_level": f"{coverage.level:g}"}),
            )
        write_bytes(path, memory.read())


@styled()
def figure(coverage: CoverageMap) -> Figure:
    """Draw a map with the outlines of buildings, and a second panel that shows half the width of the interval."""
    best, *ends = coverage.layers.values()
    panels: list[tuple[str, NDArray[np.float64], str]] = [
        ("Path loss [dB]", best, LOSS_COLORS)
        if coverage.power_dbm is None
        else ("Received power [dBm]", best, POWER_COLORS)
    ]
    if ends:
        lower, upper = ends
        half = (upper - lower) / 2
        panels.append((f"Half of the {100 * (coverage.level or 0.0):g} % interval [dB]", half, WIDTH_COLORS))
    rows, columns = coverage.z.shape
    side_by_side = len(panels) == 1 or columns < 2 * rows
    size = np.array([7.0, float(np.clip(5.6 * rows / columns, 2.5, 9.0)) + 0.9])
    picture = Figure(
        figsize=tuple(size * ([len(panels), 1] if side_by_side else [1, len(panels)])),
        dpi=150,
        layout="constrained",
    )
    shape = (1, len(panels)) if side_by_side else (len(panels), 1)
    all_axes = picture.subplots(*shape, squeeze=False).flat
    for axes, (label, values, colors) in zip(all_axes, panels, strict=True):
        _panel(axes, coverage, values, label, colors)
    return picture


def _panel(axes: Axes, coverage: CoverageMap, values: NDArray[np.float64], label: str, colors: str) -> None:
    dress(axes, "x, east [m]", "y, north [m]")
    axes.grid(visible=False)
    half = coverage.cell / 2
    west, east = coverage.x[0] - half, coverage.x[-1] + half
    south, north = coverage.y[0] - half, coverage.y[-1] + half
    finite = np.where(np.isfinite(values), values, np.nan)
    low, high = _range(finite)
    label += f"\ncolours: {low:.3g} to {high:.3g} (2 % to 98 % quantile);"
    label += "\nvalues outside this range have the end colours"
    axes.set_facecolor(LINE)
    image = axes.imshow(
        finite, extent=(west, east, south, north), origin="lower", cmap=colors, vmin=low, vmax=high,
        interpolation="nearest", zorder=1,
    )  # fmt: skip
    if coverage.no_path.any():
        # With two points per cell, the hatched area ends near the edges of the cells.
        cells = np.kron(coverage.no_path, np.ones((2, 2)))
        ends = [
            (middle[:, None] + np.array([-half, half]) / 2).ravel() for middle in (coverage.x, coverage.y)
        ]
        axes.contourf(*ends, cells, levels=[0.5, 1.5], colors="none", hatches=["////"], zorder=2)
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
        bar = figure.colorbar(image, ax=axes, label=label, shrink=0.8, extend="both")
        bar.outline.set_edgecolor(FAINT)  # pyright: ignore[reportCallIssue]
    hatched = "hatched: no path, log-distance model" if coverage.no_path.any() else ""
    blank = "grey: no prediction, inside a building or at the transmitter" if np.isnan(finite).any() else ""
    if key := "\n".join(filter(None, (hatched, blank))):
        axes.annotate(key, (1, 1.01), xycoords="axes fraction", ha="right", color=FAINT, fontsize=8)


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    """Ends of the colour scale: the 2 % and 98 % quantiles, at least 1 dB apart."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = np.quantile(finite, QUANTILES)
    middle, half = (low + high) / 2, max((high - low) / 2, 0.5)
    return float(middle - half), float(middle + half)
