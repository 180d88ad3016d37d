"""Trees in an OpenStreetMap extract: single trees, tree rows, woods and forests as polygons with heights."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import WGS84, Frame
from calibray.errors import InputError
from calibray.scenes.authoring.footprints import parse_length, project
from calibray.scenes.authoring.geodata import open_height_model
from calibray.scenes.authoring.terrain import pixels
from calibray.support.lazy_imports import library
from calibray.support.output_files import write_text

TREES_FILE: Final = "trees.geojson"
"""Name of the file with the trees of a scene."""

KINDS: Final = {
    ("natural", "tree"): "tree",
    ("natural", "tree_row"): "tree row",
    ("natural", "wood"): "wood",
    ("landuse", "forest"): "forest",
}
"""Kinds of trees by OpenStreetMap tag."""

HEIGHTS: Final = {"tree": 10.0, "tree row": 10.0, "wood": 15.0, "forest": 15.0}
"""Assumed heights [m] of trees without a stated height. In ITU-R P.833, the wood with the largest loss had a mean tree
height of 15 m."""

CROWN: Final = 6.0
"""Assumed diameter of a crown [m]."""

CLEARANCE: Final = 2.5
"""Height [m] at which the crowns of single trees and tree rows begin, high enough for people to pass underneath; woods
begin at the ground."""

TALLEST: Final = 120.0
"""Maximum height of a tree [m]; the world's tallest tree is 116 m high."""

WIDEST_CROWN: Final = 60.0
"""Maximum diameter of a crown [m]."""


@dataclass(frozen=True, eq=False)
class Trees:
    """Trees as vertical prisms.

    Attributes:
        outline: Shapely polygons in the scene's frame [n], [m].
        kind: Kind of each polygon [n], one of the values of `KINDS`.
        bottom: Height above the ground of the bottom of each prism [n], [m].
        top: Height above the ground of the top of each prism [n], [m].
        assumed: Whether each height is an assumption [n].
    """

    outline: NDArray[Any]
    kind: NDArray[np.str_]
    bottom: NDArray[np.float64]
    top: NDArray[np.float64]
    assumed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.outline)

    @property
    def counts(self) -> dict[str, int]:
        """Number of polygons by kind, and number of polygons with an assumed height."""
        assumed = (
            {"trees, tree rows and woods with an assumed height": int(self.assumed.sum())}
            if self.assumed.any()
            else {}
        )
        return dict(Counter(f"{name}s" for name in self.kind.tolist())) | assumed

    def within(self, bounds: NDArray[np.float64]) -> Trees:
        """The trees wholly or partly within the west, south, east and north bounds [4], [m]."""
        shapely = library("shapely", "scenes")
        here = shapely.intersects(self.outline, shapely.box(*bounds)) if len(self) else slice(None)
        return replace(self, **{item.name: getattr(self, item.name)[here] for item in fields(self)})

    def write(self, folder: Path, frame: Frame) -> None:
        """Write `TREES_FILE`, with the outline (longitude, latitude), kind, bottom and top of each polygon."""
        shapely = library("shapely", "scenes")

        def degrees(corner: NDArray[np.float64]) -> NDArray[np.float64]:
            return frame.to_geographic(np.column_stack([corner, np.zeros(len(corner))]))[:, :2].round(7)

        features = [
            {
                "type": "Feature",
                "properties": {"kind": str(kind), "bottom": bottom, "top": top},
                "geometry": json.loads(geometry),
            }
            for kind, bottom, top, geometry in zip(
                self.kind,
                self.bottom.tolist(),
                self.top.tolist(),
                shapely.to_geojson(shapely.transform(self.outline, degrees)).tolist(),
                strict=True,
            )
        ]
        write_text(
            folder / TREES_FILE, json.dumps({"type": "FeatureCollection", "features": features}) + "\n"
        )


def read_trees(path: str | Path, frame: Frame) -> Trees:
    """Read the trees in an extract: nodes, ways and areas with a tag in `KINDS`.

    The tags `height` and `diameter_crown` are used if present; otherwise, `HEIGHTS` and `CROWN` are used.

    Raises:
        InputError: The file cannot be read, or pyosmium is not installed.
    """
    osmium, shapely = library("osmium", "scenes"), library("shapely", "scenes")
    chosen = osmium.filter.TagFilter(*KINDS)
    geometry = osmium.geom.WKBFactory()
    shapes, tags, kinds = [], [], []
    try:
        for item in osmium.FileProcessor(path).with_areas(chosen).with_filter(chosen):
            kind = next((name for (key, value), name in KINDS.items() if item.tags.get(key) == value), "")
            if kind == "tree" and item.is_node():
                shape = geometry.create_point(item)
            elif kind == "tree row" and item.is_way():
                shape = geometry.create_linestring(item)
            elif kind in ("wood", "forest") and item.is_area():
                shape = geometry.create_multipolygon(item)
            else:
                continue
            shapes.append(shapely.from_wkb(shape))
            tags.append({tag.k: tag.v for tag in item.tags})
            kinds.append(kind)
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:
        raise InputError(f"extract {path}: cannot be read ({error}); give an .osm or .osm.pbf file") from None
    heights = [_stated(tag, "height", TALLEST) for tag in tags]
    crowns = [_stated(tag, "diameter_crown", WIDEST_CROWN) for tag in tags]
    top = np.array(
        [height or HEIGHTS[kind] for height, kind in zip(heights, kinds, strict=True)], dtype=float
    )
    kind, narrow = np.array(kinds, dtype=str), np.isin(kinds, ("tree", "tree row"))
    # Points become discs and lines become strips, as wide as a crown; areas keep their outline.
    radius = np.where(narrow, [0.5 * (crown or CROWN) for crown in crowns], 0.0)
    outline = np.array(shapes, dtype=object)
    if len(outline):
        outline = shapely.make_valid(project(outline, frame, WGS84))
        outline = np.where(narrow, shapely.buffer(outline, radius), outline)
    # The crown of a low tree begins at half the height of the tree.
    bottom = np.where(narrow, np.minimum(CLEARANCE, top / 2), 0.0)
    return Trees(outline, kind, bottom, top, np.array([height is None for height in heights], dtype=bool))


def _stated(tags: Mapping[str, str], key: str, largest: float) -> float | None:
    """The length stated in a tag [m]; None if it is missing, cannot be parsed or is out of bounds."""
    length = parse_length(tags.get(key))
    return length if length is not None and 0 < length <= largest else None


LEAST: Final = 2.0
"""Minimum height of vegetation that counts as trees [m], as in canopy models from laser scans."""

STEP: Final = 1.0
"""Step to which canopy heights are rounded [m], so that adjacent cells of equal height form one polygon. The step is
smaller than the errors of canopy models, which are several metres."""


def read_canopy(
    path: Path, frame: Frame, bounds: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Read the trees within bounds from a raster of canopy heights.

    Args:
        path: A GeoTIFF of heights above the ground, with the same requirements and limits as a height model
            (`open_height_model`); gaps and cells with negative values count as free of trees.
        frame: The scene's frame.
        bounds: West, south, east and north bounds in the frame [4], [m].

    Returns:
        Shapely polygons in the frame [n], [m], and the height of the trees in each polygon [n], [m].

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
        # Any negative value marks a cell without trees.
        heights = np.maximum(model.read(first, last, lowest=-np.inf).filled(0.0), 0.0)
        crs = model.crs
    classes = np.round(heights / STEP).astype(np.int32)
    a, b, c, d, e, f = (float(value) for value in tuple(affine)[:6])
    row, column = (int(value) for value in first)
    # The origin of this transform is the first cell that was read.
    window = type(affine)(a, b, c + a * column + b * row, d, e, f + d * column + e * row)
    polygons = [
        (shapely.from_geojson(json.dumps(shape)), value * STEP)
        for shape, value in rasterio.features.shapes(classes, classes * STEP >= LEAST, transform=window)
    ]
    outline = (
        project(np.array([polygon for polygon, _ in polygons], dtype=object), frame, crs)
        if polygons
        else np.zeros(0)
    )
    inside = shapely.intersects(outline, shapely.box(*bounds)) if polygons else np.zeros(0, dtype=bool)
    if not inside.any():
        raise InputError(
            f"canopy {path}: has no trees of {LEAST:g} m or more within the scene; give a canopy model that covers "
            "the scene"
        )
    return outline[inside], np.array([top for _, top in polygons])[inside]
