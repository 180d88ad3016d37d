"""Trees from a raster of canopy heights: polygons of equal height."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.scenes.authoring.footprints import project
from calibray.scenes.authoring.geodata import open_height_model
from calibray.scenes.authoring.terrain import pixels
from calibray.support.lazy_imports import library

LEAST: Final = 2.0
"""Height from which vegetation counts as trees [m], as in canopy models from laser scans."""

STEP: Final = 1.0
"""Step to which heights are rounded, so that cells form polygons [m]; canopy models err by metres."""


def read_canopy(
    path: Path, frame: Frame, bounds: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Read the trees within bounds from a raster of canopy heights.

    Args:
        path: A GeoTIFF of heights above the ground, opened and bounded like a height model (`open_height_model`);
            a gap has no trees.
        frame: The scene's frame.
        bounds: West, south, east and north in it [4], [m].

    Returns:
        Shapely polygons in the frame [n], [m], and the height of the trees on each [n], [m].

    Raises:
        InputError: The file cannot be used, or has no trees within the bounds.
    """
    rasterio = library("rasterio", "scenes")
    library("rasterio.features", "scenes")
    shapely = library("shapely", "scenes")
    west, south, east, north = bounds
    x, y = np.meshgrid(np.linspace(west, east, 21), np.linspace(south, north, 21))
    with open_height_model(path) as model:
        dataset, affine = model.dataset, model.dataset.transform
        column, row = pixels(x, y, frame, model.crs, affine)
        size = np.array([dataset.height, dataset.width])
        first = np.clip(np.floor([row.min(), column.min()]).astype(int), 0, size - 1)
        last = np.clip(np.ceil([row.max(), column.max()]).astype(int), 0, size - 1)
        heights, crs = model.read(first, last).filled(0.0), model.crs
    classes = np.round(heights / STEP).astype(np.int32)
    a, b, c, d, e, f = (float(value) for value in tuple(affine)[:6])
    row, column = (int(value) for value in first)
    window = type(affine)(a, b, c + a * column + b * row, d, e, f + d * column + e * row)
    found = [
        (shapely.from_geojson(json.dumps(shape)), value * STEP)
        for shape, value in rasterio.features.shapes(classes, classes * STEP >= LEAST, transform=window)
    ]
    outline = (
        project(np.array([polygon for polygon, _ in found], dtype=object), frame, crs)
        if found
        else np.zeros(0)
    )
    inside = shapely.intersects(outline, shapely.box(*bounds)) if found else np.zeros(0, dtype=bool)
    if not inside.any():
        raise InputError(
            f"canopy {path}: has no trees of {LEAST:g} m or more within the scene; give one that covers it"
        )
    return outline[inside], np.array([top for _, top in found])[inside]
