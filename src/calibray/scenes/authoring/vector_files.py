"""Footprints from geographic vector files: GeoJSON, Shapefile, GeoPackage and what else GDAL reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import WGS84, Frame, transformer
from calibray.errors import InputError
from calibray.scenes.authoring.footprints import (
    Footprints,
    HeightRule,
    HeightSource,
    cleaned,
    in_frame,
    parse_length,
)
from calibray.support.extras import library
from calibray.support.messages import did_you_mean, shortened
from calibray.support.output_files import exists


def read_footprints(
    path: str | Path,
    height: str | float,
    bottom: str | float = 0.0,
    name: str | None = None,
    levels: str | None = None,
    layer: str | None = None,
    frame: Frame | None = None,
    rule: HeightRule | None = None,
) -> tuple[Footprints, Frame]:
    """Read footprints with their heights.

    Args:
        path: The file; its reference system is taken from it.
        height: Column of the buildings' heights above the ground [m], or one height for all.
        bottom: Column of the heights at which they begin [m], or one for all.
        name: Column of their names; without one they are numbered.
        levels: Column of the numbers of their storeys, for those without a height.
        layer: Layer of the file, if it has several.
        frame: The scene's frame; without one, the local frame centred on the footprints.
        rule: How high a building is whose height is not given.

    Returns:
        The footprints, and the frame that they are in.

    Raises:
        InputError: The file does not exist or cannot be read, has no reference system, lacks a column, holds no
            polygon, or a height is negative or no number.
    """
    path, rule = Path(path), rule or HeightRule()
    outlines, columns, crs = _read(path, layer)
    if frame is None:
        frame = _centred(outlines, crs)
    count = len(outlines)
    tops, bottoms = _numbers(path, columns, height, count), _numbers(path, columns, bottom, count)
    bottoms = np.where(np.isfinite(bottoms), bottoms, 0.0)
    storeys = np.full(count, np.nan) if levels is None else _numbers(path, columns, levels, count)
    known = np.isfinite(tops) & (tops > bottoms)
    by_levels = ~known & (storeys * rule.level > bottoms)
    sources = np.select([known, by_levels], ["height", "levels"], "default")
    tops = np.select([known, by_levels], [tops, storeys * rule.level], bottoms + rule.default)
    names = range(1, count + 1) if name is None else _column(path, columns, name)
    raw = Footprints(
        polygon=in_frame(outlines, frame, crs),
        bottom=bottoms,
        top=tops,
        name=tuple(f"building-{each}" if name is None else str(each) for each in names),
        height_from=tuple(_source(each) for each in sources),
        part=np.zeros(count, dtype=bool),
        repairs={},
    )
    return cleaned(raw), frame


def _source(text: str) -> HeightSource:
    return "height" if text == "height" else "levels" if text == "levels" else "default"


def _read(path: Path, layer: str | None) -> tuple[NDArray[Any], dict[str, NDArray[Any]], str]:
    """Polygons [n], the columns of their table, and the reference system."""
    pyogrio, shapely = library("pyogrio", "scenes"), library("shapely", "scenes")
    # A geodatabase is a folder; a device is neither.
    if not (path.is_dir() or exists(path)):
        raise InputError(f"footprints {path}: does not exist; check the path")
    try:
        meta, _, geometry, fields = pyogrio.raw.read(path, layer=layer)
        outlines = shapely.from_wkb(geometry)
    except (
        pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, shapely.GEOSException, UnicodeDecodeError,
    ) as error:  # fmt: skip
        raise InputError(
            f"footprints {path}: cannot be read ({error}); give GeoJSON, a Shapefile or a GeoPackage"
        ) from None
    if meta["crs"] is None:
        raise InputError(
            f"footprints {path}: has no reference system; add its .prj file, or convert it to GeoJSON"
        )
    is_polygon = np.isin(shapely.get_type_id(outlines), (3, 6))
    if not is_polygon.any():
        raise InputError(f"footprints {path}: holds {len(outlines)} features and no polygon among them")
    columns = dict(zip(map(str, meta["fields"]), (values[is_polygon] for values in fields), strict=True))
    return outlines[is_polygon], columns, str(meta["crs"])


def _centred(outlines: NDArray[Any], crs: str) -> Frame:
    west, south, east, north = library("shapely", "scenes").total_bounds(outlines)
    longitude, latitude = transformer(crs, WGS84).transform((west + east) / 2, (south + north) / 2)
    return Frame.local(longitude, latitude)


def _column(path: Path, columns: dict[str, NDArray[Any]], name: str) -> NDArray[Any]:
    if name not in columns:
        raise InputError(f"footprints {path}: no column {shortened(name)!r}; {did_you_mean(name, columns)}")
    return columns[name]


def _numbers(
    path: Path, columns: dict[str, NDArray[Any]], source: str | float, count: int
) -> NDArray[np.float64]:
    """One number for each footprint [count]: NaN where none is given; texts are read as lengths."""
    values = _column(path, columns, source) if isinstance(source, str) else np.full(count, float(source))
    if values.dtype == object:
        lengths = [parse_length(None if each is None else str(each)) for each in values]
        unread = [each for each, length in zip(values, lengths, strict=True) if each and length is None]
        if unread:
            raise InputError(f"footprints {path}: column {source!r} holds {unread[0]!r}, must hold metres")
        values = np.array([np.nan if length is None else length for length in lengths])
    numbers = np.asarray(values, dtype=float)
    if (bad := np.flatnonzero((numbers < 0) | np.isinf(numbers))).size:
        raise InputError(
            f"footprints {path}, feature {bad[0] + 1}: {source} = {numbers[bad[0]]:g}, must not be below 0; correct it"
        )
    return numbers
