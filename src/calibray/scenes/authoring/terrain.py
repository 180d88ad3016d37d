"""Terrain: the ground as a sheet of triangles, either level or derived from a height model."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import binary_dilation, distance_transform_edt

from calibray.coordinates import WGS84, Frame, transformer
from calibray.errors import InputError
from calibray.scenes.authoring.geodata import HeightModel, open_height_model
from calibray.scenes.meshes import Mesh

MAX_POINTS: Final = 4_000_000
"""Maximum number of points in a ground sheet, to limit memory use."""

STEP: Final = 200.0
"""A cell is suspicious if its height differs from the heights of all neighbouring cells by at least this amount [m].
For example, some models mark gaps with -999 in feet, which is a height of -304 m. Buildings and masts in surface models
are rarely taller than this amount."""

_LOG: Final = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights of the ground on a grid; a diagonal from south-west to north-east divides each cell into two triangles.

    Attributes:
        x: Eastings of the grid [nx], [m], in ascending order.
        y: Northings of the grid [ny], [m], in ascending order.
        z: Heights [ny, nx], [m].
        repairs: Number of missing heights that were filled in, by reason.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    repairs: dict[str, int] = field(default_factory=dict)

    def heights(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Interpolate heights [n], [m], on the triangles; outside the grid, use the nearest height on its border."""
        x = np.clip(np.asarray(x, dtype=float), self.x[0], self.x[-1])
        y = np.clip(np.asarray(y, dtype=float), self.y[0], self.y[-1])
        column = np.clip(np.searchsorted(self.x, x, side="right") - 1, 0, len(self.x) - 2)
        row = np.clip(np.searchsorted(self.y, y, side="right") - 1, 0, len(self.y) - 2)
        u = (x - self.x[column]) / (self.x[column + 1] - self.x[column])
        v = (y - self.y[row]) / (self.y[row + 1] - self.y[row])
        southwest, southeast = self.z[row, column], self.z[row, column + 1]
        northwest, northeast = self.z[row + 1, column], self.z[row + 1, column + 1]
        lower = southwest + u * (southeast - southwest) + v * (northeast - southeast)
        upper = southwest + v * (northwest - southwest) + u * (northeast - northwest)
        # South-east of the diagonal, where u exceeds v, a point is in the lower triangle of `mesh`.
        return np.where(u >= v, lower, upper)

    def mesh(self) -> Mesh:
        """The ground as triangles, counter-clockwise when seen from above."""
        east, north = np.meshgrid(self.x, self.y)
        columns, rows = len(self.x), len(self.y)
        southwest = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        northeast = southwest + columns + 1
        lower = np.column_stack([southwest, southwest + 1, northeast])
        upper = np.column_stack([southwest, northeast, southwest + columns])
        faces = np.stack([lower, upper], axis=1).reshape(-1, 3)
        return Mesh(np.column_stack([east.ravel(), north.ravel(), self.z.ravel()]), faces)


def make_level_ground(bounds: ArrayLike) -> Terrain:
    """Make a level rectangle of two triangles at z = 0; the bounds are west, south, east and north [4], [m]."""
    west, south, east, north = np.asarray(bounds, dtype=float)
    return Terrain(np.array([west, east]), np.array([south, north]), np.zeros((2, 2)))


def lower_origin(terrain: Terrain, frame: Frame) -> tuple[Terrain, Frame]:
    """Move the frame's origin vertically so that the lowest ground is less than a metre above z = 0."""
    lowest = float(np.floor(terrain.z.min()))
    return replace(terrain, z=terrain.z - lowest), replace(frame, height=frame.height + lowest)


def read_terrain(path: str | Path, frame: Frame, bounds: ArrayLike, spacing: float | None = None) -> Terrain:
    """Read the ground from a height model.

    Args:
        path: A GeoTIFF that states its reference system; its scale, offset, unit and missing heights are taken into
            account.
        frame: The scene's frame.
        bounds: West, south, east and north bounds of the area to cover, in the frame [4], [m].
        spacing: Width of the grid's cells [m]; by default, the cell width of the model, but at least 1 m.

    Returns:
        The terrain, interpolated linearly between the centres of the model's cells. Where the model has no height, for
        example on water, the height of the nearest cell with a height is used. Cells without a height are counted.

    Raises:
        InputError: The file does not exist, cannot be read or used (see `open_height_model`), does not cover the
            bounds, or has no heights within the bounds. The grid would be too fine.
    """
    path = Path(path)
    west, south, east, north = np.asarray(bounds, dtype=float)
    share = np.linspace(0, 1, 21)
    sample_x, sample_y = np.meshgrid(west + (east - west) * share, south + (north - south) * share)
    with open_height_model(path) as model:
        dataset, affine = model.dataset, model.dataset.transform
        column, row = pixels(sample_x, sample_y, frame, model.crs, affine)
        inside = (column >= 0) & (row >= 0) & (column <= dataset.width - 1) & (row <= dataset.height - 1)
        if not inside.all():
            centre = frame.to_geographic([(west + east) / 2, (south + north) / 2, 0])[:2]
            raise InputError(
                f"height model {path}: does not cover the scene, {east - west:.0f} m x {north - south:.0f} m "
                f"around {centre.round(5).tolist()}; give a larger model, or reduce the margin"
            )
        # Interpolation needs one additional cell on each side.
        first = np.maximum(np.floor([row.min() - 1, column.min() - 1]).astype(int), 0)
        last = np.ceil([row.max() + 1, column.max() + 1]).astype(int)
        last = np.minimum(last, [dataset.height - 1, dataset.width - 1])
        crs, heights = model.crs, model.read(first, last)
        _warn_of_steps(model, heights, first)
    filled, repairs = _fill(path, heights)
    if spacing is None:
        spacing = max(float(np.ptp(sample_x) / np.ptp(column)), 1.0)
    if not (np.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing = {spacing!r}: must be a finite number of metres greater than 0")
    columns, rows = (max(2, int(np.ceil(length / spacing)) + 1) for length in (east - west, north - south))
    if columns * rows > MAX_POINTS:
        raise InputError(
            f"spacing = {spacing:g} m: gives {columns * rows} points of ground, more than {MAX_POINTS}; "
            "give a larger spacing"
        )
    x, y = np.linspace(west, east, columns), np.linspace(south, north, rows)
    grid_x, grid_y = np.meshgrid(x, y)
    column, row = pixels(grid_x, grid_y, frame, crs, affine)
    axes = tuple(np.arange(low, high + 1, dtype=float) for low, high in zip(first, last, strict=True))
    points = np.stack(
        [np.clip(value, axis[0], axis[-1]) for value, axis in zip((row, column), axes, strict=True)], axis=-1
    )
    return Terrain(x, y, RegularGridInterpolator(axes, filled)(points) - frame.height, repairs)


def pixels(
    x: NDArray[np.float64], y: NDArray[np.float64], frame: Frame, crs: str, affine: object
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns and rows in a raster of positions in the frame; the centres of cells have integer values."""
    east, north = transformer(frame.crs, crs).transform(x + frame.easting, y + frame.northing)
    inverse = ~affine  # type: ignore[operator]
    column = inverse.a * east + inverse.b * north + inverse.c
    row = inverse.d * east + inverse.e * north + inverse.f
    # The affine transform counts columns and rows from the corner of the first cell, not from its centre.
    return column - 0.5, row - 0.5


def _warn_of_steps(model: HeightModel, heights: np.ma.MaskedArray, first: NDArray[np.integer]) -> None:
    """Warn if the lowest or highest heights [rows, columns], [m], differ from all their neighbours by `STEP` or more.

    Such heights are often gaps that the file does not declare. `first` is the row and column of the first cell.
    """
    known = ~np.ma.getmaskarray(heights)
    if not known.any():
        return
    for extreme in (heights.min(), heights.max()):
        cells = known & (heights.data == extreme)
        ring = np.asarray(binary_dilation(cells, np.ones((3, 3))), dtype=bool)
        around = heights.data[ring & known & ~cells]
        step = float(np.abs(around - extreme).min()) if len(around) else 0.0
        if step >= STEP:
            row, column = (first + np.argwhere(cells)[0]).tolist()
            place = transformer(model.crs, WGS84).transform(*model.dataset.xy(row, column))
            stored = model.stored(float(extreme))
            _LOG.warning(
                "height model %s: the height in %d of %d cells is %.4g m, which differs by at least %.4g m from all "
                "surrounding cells, first at longitude %.5f, latitude %.5f; if this value marks gaps, declare it as "
                "nodata (gdal_edit.py -a_nodata %g)",
                model.path, cells.sum(), cells.size, extreme, step, *place, stored,
            )  # fmt: skip


def _fill(path: Path, heights: np.ma.MaskedArray) -> tuple[NDArray[np.float64], dict[str, int]]:
    """Fill each gap with the height of the nearest cell that has a height, and count the filled cells."""
    values = heights.filled(np.nan)
    missing = np.ma.getmaskarray(heights) | ~np.isfinite(values)
    if missing.all():
        raise InputError(f"height model {path}: has no height within the scene; give a model that covers it")
    if not missing.any():
        return values, {}
    nearest = np.asarray(distance_transform_edt(missing, return_distances=False, return_indices=True))
    return values[tuple(nearest)], {"missing heights, filled from the nearest cell": int(missing.sum())}
