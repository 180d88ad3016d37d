"""Footprints: the outlines of buildings in the scene's frame, with bottom and top heights, read from files.

OpenStreetMap extracts are read with pyosmium, OpenStreetMap's own library. Pyosmium reads .osm and .pbf files,
assembles multipolygon relations with holes according to OpenStreetMap's rules, and returns all tags. GDAL's driver, in
contrast, combines `building:levels` with other tags in one string. Nothing is downloaded.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import WGS84, Frame, transformer
from calibray.errors import InputError
from calibray.measurements.column_names import find_length_unit
from calibray.scenes.authoring.geodata import read_features
from calibray.scenes.meshes import WIDEST
from calibray.scenes.scene_file import unique_names
from calibray.support.lazy_imports import library
from calibray.support.messages import did_you_mean, shortened

GRID: Final = 0.01
"""Spacing of the grid to which the corners of buildings are rounded [m]."""

SMALLEST: Final = 1.0
"""Minimum area of a building [m^2]."""

HIGHEST: Final = 1000.0
"""Maximum height of a building or building part [m]; the world's tallest building is 828 m high."""

HeightSource = Literal["height", "levels", "default"]

_METRES: Final = {
    **dict.fromkeys(("", "m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("ft", "'"), 0.3048),
}
_LENGTH: Final = re.compile(r"\s*(-?\d+(?:[.,]\d+)?)\s*([a-z]*|')\s*", re.IGNORECASE)
_FEET_AND_INCHES: Final = re.compile(r"\s*(\d+)'\s*(\d+(?:\.\d+)?)\"\s*")


@dataclass(frozen=True)
class HeightRule:
    """Assumptions for buildings without a stated height.

    Attributes:
        storey: Height of one storey [m].
        default: Assumed height of a building without a stated height or number of storeys [m].

    Raises:
        InputError: A height is not a finite number greater than 0.
    """

    storey: float = 3.0
    default: float = 9.0

    def __post_init__(self) -> None:
        for name in ("storey", "default"):
            if not 0 < (value := getattr(self, name)) <= HIGHEST:
                raise InputError(f"{name} = {value!r}: must be greater than 0 and at most {HIGHEST:g} m")

    def heights(self, tags: Mapping[str, str]) -> tuple[float, float, HeightSource]:
        """Derive the bottom [m] and top [m] of a building, and the source of the top, from OpenStreetMap tags.

        `height` and `min_height` have priority, followed by `building:levels` and `building:min_level`, each multiplied
        by `storey`, and finally `default`. All heights are above the ground. Heights above `HIGHEST` are ignored, as is
        a stated top that is not above the bottom. Roof shapes are ignored: the roof is flat at `height`.

        Example:
            >>> HeightRule().heights({"building": "yes", "building:levels": "4"})
            (0.0, 12.0, 'levels')
            >>> HeightRule().heights({"height": "40 ft", "min_height": "2.5"})
            (2.5, 12.192, 'height')
        """
        low, floor = parse_length(tags.get("min_height")), parse_length(tags.get("building:min_level"))
        bottom = max(low if low is not None else (floor or 0.0) * self.storey, 0.0)
        bottom = bottom if bottom <= HIGHEST else 0.0
        height, levels = parse_length(tags.get("height")), parse_length(tags.get("building:levels"))
        if height is not None and bottom < height <= HIGHEST:
            return bottom, height, "height"
        if levels is not None and bottom < levels * self.storey <= HIGHEST:
            return bottom, levels * self.storey, "levels"
        return bottom, bottom + self.default, "default"


def parse_length(text: str | None) -> float | None:
    r"""Parse a length [m] as written in map data, with or without a unit; None if it cannot be parsed.

    Example:
        >>> parse_length("12,5 m"), parse_length("10'6\""), parse_length("tall")
        (12.5, 3.2004, None)
    """
    if text is None:
        return None
    if feet := _FEET_AND_INCHES.fullmatch(text):
        return round((float(feet[1]) + float(feet[2]) / 12) * 0.3048, 6)
    length = _LENGTH.fullmatch(text)
    if length is None or length[2].lower() not in _METRES:
        return None
    return round(float(length[1].replace(",", ".")) * _METRES[length[2].lower()], 6)


@dataclass(frozen=True, eq=False)
class Footprints:
    """Outlines and heights of buildings.

    Attributes:
        polygon: Outline of each building [n], a shapely Polygon or MultiPolygon in the scene's frame [m].
        bottom: Height above the ground of the bottom of each building [n], [m].
        top: Height above the ground of the top of each building [n], [m].
        name: Name of each building [n].
        height_from: Source of each top [n].
        part: Whether each outline [n] is a part of a building; parts take precedence over the outline of the whole
            building.
        repairs: Number of buildings that were changed, were left out or have no usable height, by reason.
    """

    polygon: NDArray[Any]
    bottom: NDArray[np.float64]
    top: NDArray[np.float64]
    name: tuple[str, ...]
    height_from: tuple[HeightSource, ...]
    part: NDArray[np.bool_]
    repairs: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.polygon)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """West, south, east and north bounds [4], [m]."""
        return library("shapely", "scenes").total_bounds(self.polygon)

    def guessed(self) -> dict[HeightSource, list[str]]:
        """Names of the buildings with an assumed height, grouped by the source of the assumption."""
        guesses: dict[HeightSource, list[str]] = {"levels": [], "default": []}
        for name, source in zip(self.name, self.height_from, strict=True):
            if source != "height":
                guesses[source].append(name)
        return guesses


def clean_footprints(raw: Footprints) -> Footprints:
    """Prepare outlines for extrusion: round corners to a grid, remove self-intersections, and drop small outlines.

    Corners are rounded to multiples of `GRID`, outlines with an area below `SMALLEST` are left out, and repeated names
    are made unique. The result states the number of repairs.

    Raises:
        InputError: A height is not a number or is above `HIGHEST`, or the buildings are farther apart than `WIDEST`.
    """
    shapely = library("shapely", "scenes")
    valid = shapely.is_valid(raw.polygon)
    polygons = raw.polygon.copy()
    polygons[~valid] = shapely.make_valid(polygons[~valid], method="structure", keep_collapsed=False)
    polygons = shapely.set_precision(polygons, GRID)
    large = shapely.area(polygons) >= SMALLEST
    repairs = {
        **raw.repairs,
        "crossing or touching themselves, repaired": int((~valid & large).sum()),
        f"of less than {SMALLEST:g} m2, left out": int((~large).sum()),
    }
    keep = np.flatnonzero(large)
    _check_heights(raw, keep)
    _check_extent(polygons[keep], [raw.name[index] for index in keep])
    return Footprints(
        polygon=polygons[keep],
        bottom=raw.bottom[keep],
        top=raw.top[keep],
        name=tuple(unique_names([raw.name[index] for index in keep])),
        height_from=tuple(raw.height_from[index] for index in keep),
        part=raw.part[keep],
        repairs={reason: count for reason, count in repairs.items() if count},
    )


def _check_heights(raw: Footprints, keep: NDArray[np.int64]) -> None:
    for which, heights in (("top", raw.top), ("bottom", raw.bottom)):
        wrong = keep[~((heights[keep] >= 0) & (heights[keep] <= HIGHEST))]
        if len(wrong):
            raise InputError(
                f"building {raw.name[wrong[0]]!r}: its {which} is {heights[wrong[0]]:g} m above the ground, but must "
                f"be 0 to {HIGHEST:g} m; correct the height or its unit"
            )


def _check_extent(polygons: NDArray[Any], names: Sequence[str]) -> None:
    """Refuse a building that is far from the others, for example at (0, 0) or across 180 degrees of longitude."""
    if not len(polygons):
        return
    bounds = library("shapely", "scenes").bounds(polygons)
    centre = (bounds[:, :2] + bounds[:, 2:]) / 2
    if np.ptp(bounds.reshape(-1, 2), axis=0).max() <= WIDEST:
        return
    distance = np.linalg.norm(centre - np.median(centre, axis=0), axis=1)
    size = (bounds[:, 2:] - bounds[:, :2]).max(axis=1)
    furthest = int(np.argmax(distance + size))
    problem = f"lies {distance[furthest] / 1000:,.0f} km from the others"
    if size[furthest] > WIDEST:
        problem = f"is {size[furthest] / 1000:,.0f} km wide"
    raise InputError(
        f"building {names[furthest]!r} {problem}, but scenes may be at most {WIDEST / 1000:g} km wide; remove it, or "
        "cut out the area that you need (on one side of 180 degrees of longitude, if the map crosses it)"
    )


def project(polygons: NDArray[Any], frame: Frame, crs: str) -> NDArray[Any]:
    """Project outlines [n] from a coordinate reference system to the scene's frame [m]; z coordinates are dropped.

    Raises:
        InputError: A corner is outside the area of the frame's projection.
    """
    shapely = library("shapely", "scenes")
    return shapely.transform(
        shapely.force_2d(polygons), lambda corner: frame.to_scene(corner[:, 0], corner[:, 1], crs=crs)[:, :2]
    )


_LOG: Final = logging.getLogger(__name__)

_KEYS: Final = ("building", "building:part")
_HEIGHT_KEYS: Final[dict[str, HeightSource]] = {"height": "height", "building:levels": "levels"}
_SOURCES: Final[tuple[HeightSource, ...]] = ("default", "levels", "height")


def read_openstreetmap(
    path: str | Path, frame: Frame | None = None, rule: HeightRule | None = None
) -> tuple[Footprints, Frame]:
    """Read the buildings in an extract: closed ways and multipolygon relations tagged `building` or `building:part`.

    Returns the footprints and their frame, which by default is a local frame centred on the buildings. `rule` contains
    the assumptions for buildings whose height the map does not state.

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
            # "no" negates a tag: an outline with building:part=no is not a part that takes precedence.
            stated = any(item.tags.get(key, "no") != "no" for key in _KEYS)
            if not stated or item.tags.get("location") == "underground":
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
        raise InputError(
            f"extract {path}: contains no complete building; choose an extract that covers buildings"
        )
    degrees = np.array(outlines, dtype=object)
    frame = frame or _local_frame(degrees, WGS84)
    bottoms, tops, sources = zip(*(rule.heights(building) for building in tags), strict=True)
    incomplete = announced - len(outlines)
    # Stated heights or numbers of storeys that cannot be used, such as "~25", so a less reliable source replaces them.
    unused = [
        building[key]
        for building, source in zip(tags, sources, strict=True)
        for key in [next((key for key in _HEIGHT_KEYS if key in building), None)]
        if key is not None and _HEIGHT_KEYS[key] != source
    ]
    repairs = {"incomplete in the extract, left out": max(incomplete, 0)}
    if unused:
        repairs[
            f"buildings with an unusable height or number of storeys, such as {shortened(unused[0])!r}"
        ] = len(unused)
    raw = Footprints(
        polygon=project(degrees, frame, WGS84),
        bottom=np.array(bottoms),
        top=np.array(tops),
        name=tuple(names),
        height_from=sources,
        part=np.array([building.get("building:part", "no") != "no" for building in tags]),
        repairs=repairs,
    )
    return clean_footprints(raw), frame


@dataclass(frozen=True)
class FootprintColumns:
    """Columns of a vector file other than the column of building heights.

    Attributes:
        bottom: Column with the height of each building's base [m], or one base height for all buildings.
        name: Column with the names of buildings; buildings without a name are numbered.
        levels: Column with the number of storeys, for buildings without a height.
    """

    bottom: str | float = 0.0
    name: str | None = None
    levels: str | None = None


def read_footprints(
    path: str | Path,
    height: str | float | None,
    columns: FootprintColumns | None = None,
    layer: str | None = None,
    frame: Frame | None = None,
    rule: HeightRule | None = None,
) -> tuple[Footprints, Frame]:
    """Read footprints and their heights from a vector file.

    Args:
        path: A GeoJSON file, Shapefile, GeoPackage, FlatGeobuf file or Esri geodatabase that states its coordinate
            reference system.
        height: Column with the height of each building above the ground, in metres or in the unit stated in the column
            name (as in `height_ft`), or one height for all buildings [m]. Text that is both a number and the name of a
            column is interpreted as the name. `height` can be None if `columns` names a column with the number of
            storeys.
        columns: Additional columns.
        layer: Layer to read if the file has more than one layer.
        frame: The scene's frame; by default, a local frame centred on the footprints.
        rule: Assumptions for buildings without a stated height.

    Raises:
        InputError: The file does not exist, cannot be read, states no coordinate reference system, lacks a column or
            contains no polygon. A height is missing, negative or not a number.
    """
    path, rule, named = Path(path), rule or HeightRule(), columns or FootprintColumns()
    outlines, table, crs = _read(path, layer)
    frame = frame or _local_frame(outlines, crs)
    count = len(outlines)
    if height is None and named.levels is None:
        raise InputError(
            f"footprints {path}: the heights of the buildings are not given; give a column of heights or one height "
            "for all buildings in --height, or a column of numbers of storeys in --levels (columns: "
            f"{', '.join(map(str, table)) or 'none'})"
        )
    bottoms = _numbers(path, table, named.bottom, count)
    tops = np.full(count, np.nan) if height is None else _numbers(path, table, height, count)
    bottoms = np.where(np.isfinite(bottoms), bottoms, 0.0)
    storeys = np.full(count, np.nan)
    if named.levels is not None:
        storeys = _numbers(path, table, named.levels, count, "a number of storeys")
    has_height = np.isfinite(tops) & (tops > bottoms)
    has_levels = ~has_height & (storeys * rule.storey > bottoms)
    labels = [None] * count if named.name is None else _column(path, table, named.name)
    raw = Footprints(
        polygon=project(outlines, frame, crs),
        bottom=bottoms,
        top=np.select([has_height, has_levels], [tops, storeys * rule.storey], bottoms + rule.default),
        # None, NaN and empty text count as missing names.
        name=tuple(
            f"building-{number}" if label in (None, "") or label != label else str(label)
            for number, label in enumerate(labels, start=1)
        ),
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
    """Read the polygons [n], their attributes by column, and the coordinate reference system."""
    shapely = library("shapely", "scenes")
    features = read_features(path, layer)
    outlines = features.outline
    if features.crs is None:
        raise InputError(
            f"footprints {path}: has no coordinate reference system; add its .prj file, or convert it to GeoJSON"
        )
    # Polygons with one or more parts.
    is_polygon = np.isin(shapely.get_type_id(outlines), (3, 6))
    if not is_polygon.any():
        raise InputError(
            f"footprints {path}: none of the {len(outlines)} features is a polygon; give outlines of buildings"
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
    path: Path,
    columns: dict[str, NDArray[Any]],
    source: str | float,
    count: int,
    quantity: str = "a length in metres",
) -> NDArray[np.float64]:
    """Read numbers [count] from a column, or repeat a constant; missing values of the column become NaN.

    Numbers are in metres, or in the unit stated in the name of the column. Text is parsed as a length.

    Raises:
        InputError: The column does not exist, or one of its values is not a height.
    """
    if isinstance(source, str) and source not in columns:
        with suppress(ValueError):
            source = float(source)
    elif isinstance(source, str) and _is_number(source):
        _LOG.warning("%s: %s is interpreted as the name of a column, not as a number", path, source)
    values = _column(path, columns, source) if isinstance(source, str) else np.full(count, float(source))
    unit = find_length_unit([source]) if isinstance(source, str) else 1.0
    if values.dtype == object:
        lengths = [parse_length(None if value is None else str(value)) for value in values]
        for number, (value, length) in enumerate(zip(values, lengths, strict=True), start=1):
            if value and length is None:
                raise InputError(
                    f"footprints {path}, polygon {number}: {source} = {shortened(repr(value))}, but must be "
                    f"{quantity}; correct it, or leave it empty"
                )
        stated = [1.0 if value is None or not _is_number(str(value)) else unit for value in values]
        values, unit = np.array([np.nan if length is None else length for length in lengths]) * stated, 1.0
    numbers = np.asarray(values, dtype=float) * unit
    bad = np.flatnonzero(
        (numbers < 0) | (numbers > HIGHEST) | (np.isnan(numbers) & (not isinstance(source, str)))
    )
    if bad.size:
        raise InputError(
            f"footprints {path}, polygon {bad[0] + 1}: {source} = {numbers[bad[0]]:g}, but must be finite, not "
            f"negative and at most {HIGHEST:g}; correct it"
        )
    return numbers
