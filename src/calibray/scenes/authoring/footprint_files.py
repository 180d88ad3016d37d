"""Footprints read from OpenStreetMap extracts, and from GeoJSON, Shapefile, GeoPackage and other vector files.

Extracts are read with pyosmium, OpenStreetMap's own library. It assembles multipolygon relations with their holes by
the map's rules, reads .osm and .pbf, and gives all tags, while GDAL's driver hides `building:levels` in a text of other
tags. Nothing is downloaded.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import WGS84, Frame, transformer
from calibray.errors import InputError
from calibray.scenes.authoring.footprints import (
    HIGHEST,
    Footprints,
    HeightRule,
    HeightSource,
    clean_footprints,
    parse_length,
    project,
)
from calibray.scenes.authoring.geodata import read_features
from calibray.support.lazy_imports import library
from calibray.support.messages import did_you_mean, shortened

_LOG: Final = logging.getLogger(__name__)

_KEYS: Final = ("building", "building:part")
_SOURCES: Final[tuple[HeightSource, ...]] = ("default", "levels", "height")


def read_openstreetmap(
    path: str | Path, frame: Frame | None = None, rule: HeightRule | None = None
) -> tuple[Footprints, Frame]:
    """Read the buildings of an extract: closed ways and multipolygon relations tagged `building` or `building:part`.

    Returns the footprints and their frame, by default a local one centred on the buildings. `rule` states the heights
    that the map does not.

    Raises:
        InputError: The file does not exist, is not an extract or contains no building, or pyosmium is not installed.
    """
    path, rule = Path(path), rule or HeightRule()
    osmium, shapely = library("osmium", "scenes"), library("shapely", "scenes")
    if not path.is_file():
        raise InputError(f"extract {path}: does not exist; check the path")
    is_building = osmium.filter.KeyFilter(*_KEYS)
    geometry = osmium.geom.WKBFactory()
    outlines, names, tags = [], [], []
    announced = 0  # ways and relations that should become areas
    try:
        for item in osmium.FileProcessor(path).with_areas(is_building).with_filter(is_building):
            if item.tags.get("building") == "no" or item.tags.get("location") == "underground":
                continue
            if item.is_area():
                outlines.append(shapely.from_wkb(geometry.create_multipolygon(item)))
                names.append(f"{'way' if item.from_way() else 'relation'}-{item.orig_id()}")
                tags.append({tag.k: tag.v for tag in item.tags})
            elif item.is_way() or item.is_relation():
                announced += item.is_relation() or item.is_closed()
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:
        raise InputError(f"extract {path}: cannot be read ({error}); give an .osm or .osm.pbf file") from None
    if not outlines:
        raise InputError(f"extract {path}: contains no complete building; choose an extract that covers some")
    degrees = np.array(outlines, dtype=object)
    frame = frame or _local_frame(degrees, WGS84)
    bottoms, tops, sources = zip(*(rule.heights(building) for building in tags), strict=True)
    incomplete = announced - len(outlines)
    raw = Footprints(
        polygon=project(degrees, frame, WGS84),
        bottom=np.array(bottoms),
        top=np.array(tops),
        name=tuple(names),
        height_from=sources,
        part=np.array(["building:part" in building for building in tags]),
        repairs={"incomplete in the extract, left out": incomplete} if incomplete > 0 else {},
    )
    return clean_footprints(raw), frame


@dataclass(frozen=True)
class FootprintColumns:
    """Columns of a vector file besides the heights of buildings.

    Attributes:
        bottom: Column with the heights at which the buildings begin [m], or one height for all.
        name: Column with their names; by default they are numbered.
        levels: Column with the numbers of storeys, for buildings without a height.
    """

    bottom: str | float = 0.0
    name: str | None = None
    levels: str | None = None


def read_footprints(
    path: str | Path,
    height: str | float,
    columns: FootprintColumns | None = None,
    layer: str | None = None,
    frame: Frame | None = None,
    rule: HeightRule | None = None,
) -> tuple[Footprints, Frame]:
    """Read footprints with their heights from a vector file.

    Args:
        path: A GeoJSON file, Shapefile, GeoPackage, FlatGeobuf file or Esri geodatabase that states its reference
            system.
        height: Column with the heights of the buildings above the ground [m], or one height for all; a text that is
            both a number and the name of a column means the column.
        columns: Further columns.
        layer: Layer of the file, if it has several.
        frame: The scene's frame; by default a local frame centred on the footprints.
        rule: Assumptions for heights that are not given.

    Returns:
        The footprints, and their frame.

    Raises:
        InputError: The file does not exist, cannot be read, states no reference system, lacks a column or contains no
            polygon; or a height is negative or not a number.
    """
    path, rule, named = Path(path), rule or HeightRule(), columns or FootprintColumns()
    outlines, table, crs = _read(path, layer)
    frame = frame or _local_frame(outlines, crs)
    count = len(outlines)
    tops, bottoms = (_numbers(path, table, source, count) for source in (height, named.bottom))
    bottoms = np.where(np.isfinite(bottoms), bottoms, 0.0)
    storeys = np.full(count, np.nan) if named.levels is None else _numbers(path, table, named.levels, count)
    has_height = np.isfinite(tops) & (tops > bottoms)
    has_levels = ~has_height & (storeys * rule.storey > bottoms)
    names = range(1, count + 1) if named.name is None else _column(path, table, named.name)
    raw = Footprints(
        polygon=project(outlines, frame, crs),
        bottom=bottoms,
        top=np.select([has_height, has_levels], [tops, storeys * rule.storey], bottoms + rule.default),
        name=tuple(f"building-{label}" if named.name is None else str(label) for label in names),
        height_from=tuple(_SOURCES[code] for code in 2 * has_height + has_levels),
        part=np.zeros(count, dtype=bool),
        repairs={},
    )
    return clean_footprints(raw), frame


def _local_frame(outlines: NDArray[Any], crs: str) -> Frame:
    """The local frame centred on outlines."""
    west, south, east, north = library("shapely", "scenes").total_bounds(outlines)
    longitude, latitude = (west + east) / 2, (south + north) / 2
    if crs != WGS84:
        longitude, latitude = transformer(crs, WGS84).transform(longitude, latitude)
    return Frame.local(longitude, latitude)


def _read(path: Path, layer: str | None) -> tuple[NDArray[Any], dict[str, NDArray[Any]], str]:
    """Polygons [n], the columns of their table, and the reference system."""
    shapely = library("shapely", "scenes")
    features = read_features(path, layer)
    outlines = features.outline
    if features.crs is None:
        raise InputError(
            f"footprints {path}: has no reference system; add its .prj file, or convert it to GeoJSON"
        )
    is_polygon = np.isin(shapely.get_type_id(outlines), (3, 6))
    if not is_polygon.any():
        raise InputError(
            f"footprints {path}: none of its {len(outlines)} features is a polygon; give outlines of buildings"
        )
    columns = {name: values[is_polygon] for name, values in features.columns.items()}
    return outlines[is_polygon], columns, features.crs


def _column(path: Path, columns: dict[str, NDArray[Any]], name: str) -> NDArray[Any]:
    if name not in columns:
        raise InputError(f"footprints {path}: no column {shortened(name)!r}; {did_you_mean(name, columns)}")
    return columns[name]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(
    path: Path, columns: dict[str, NDArray[Any]], source: str | float, count: int
) -> NDArray[np.float64]:
    """Numbers from a column or a constant [count]; NaN if the column has none; texts are parsed as lengths."""
    if isinstance(source, str) and source not in columns:
        with suppress(ValueError):
            source = float(source)
    elif isinstance(source, str) and _is_number(source):
        _LOG.warning("%s: %s is interpreted as the column of that name, not as a number", path, source)
    values = _column(path, columns, source) if isinstance(source, str) else np.full(count, float(source))
    if values.dtype == object:
        lengths = [parse_length(None if value is None else str(value)) for value in values]
        unread = [value for value, length in zip(values, lengths, strict=True) if value and length is None]
        if unread:
            raise InputError(
                f"footprints {path}: column {source!r} contains {unread[0]!r}, must contain metres"
            )
        values = np.array([np.nan if length is None else length for length in lengths])
    numbers = np.asarray(values, dtype=float)
    bad = np.flatnonzero(
        (numbers < 0) | (numbers > HIGHEST) | (np.isnan(numbers) & (not isinstance(source, str)))
    )
    if bad.size:
        raise InputError(
            f"footprints {path}, feature {bad[0] + 1}: {source} = {numbers[bad[0]]:g}, must be finite, not "
            f"negative and at most {HIGHEST:g}; correct it"
        )
    return numbers
