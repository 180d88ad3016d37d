"""Read vector files and height models with a fixed list of drivers.

GDAL has drivers that fetch URLs, open other files or run pipelines named in a file (VRT, WMS, WFS, GDALG). GDAL chooses
the driver from the content of the file. This module opens only files in formats that cannot refer to other files. A
file is recognized by its first bytes, and the sizes that it declares are checked before the data are read.
"""

from __future__ import annotations

import json
import logging
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import WGS84, parse_crs
from calibray.errors import InputError
from calibray.support.lazy_imports import library
from calibray.support.memory import available_memory
from calibray.support.messages import did_you_mean, first_line, shortened
from calibray.support.output_files import exists

RASTER_DRIVER: Final = "GTiff"
"""GDAL's driver for rasters: GeoTIFF, including cloud-optimized files."""

VECTOR_FORMATS: Final = "GeoJSON, a Shapefile, a GeoPackage, a FlatGeobuf file or an Esri geodatabase"
"""Supported formats of vector files, as named in messages."""

MOST_CELLS: Final = 25_000_000
"""Maximum number of cells that are read from a height model; filling gaps needs about 40 bytes per cell."""

LARGEST_BLOCK: Final = 2**28
"""Maximum size of a raster block [bytes]; GDAL decompresses whole blocks."""

TEXT_GROWTH: Final = 15
"""Memory needed to parse GeoJSON or DXF, as a multiple of the file size [1]."""

HEIGHTS: Final = (-500.0, 9000.0)
"""Range of heights on land [m]; values outside this range, such as -999, usually mark gaps that the file does not
declare as nodata. The shore of the Dead Sea is at about -440 m, and the top of Mount Everest at 8849 m."""

_MAGIC: Final = (
    (b"SQLite format 3\0", "GPKG"),
    (b"\0\0\x27\x0a", "ESRI Shapefile"),
    (b"fgb\x03fgb", "FlatGeobuf"),
)

_LOG: Final = logging.getLogger(__name__)
_DXF: Final = re.compile(rb"\s*(?:999\s*\n[^\n]*\n\s*)*0\s*\n\s*SECTION\s*\n[^<{]*", re.DOTALL)
"""Start of a DXF file, without `<` or `{`, which occur in formats that other drivers read."""

_INSUNITS: Final = {1: 0.0254, 2: 0.3048, 4: 0.001, 5: 0.01, 6: 1.0, 14: 0.1}
"""Length of each DXF unit [m], by code: inch, foot, millimetre, centimetre, metre and decimetre."""

_METRES: Final = {
    **dict.fromkeys(("", "m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(
        ("us survey foot", "us-ft", "ftus", "foot_us", "survey foot", "us_survey_foot"), 1200 / 3937
    ),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), 0.01),
    **dict.fromkeys(("dm", "decimetre", "decimeter"), 0.1),
}
"""Length of each unit of height [m], by name."""


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a vector file.

    Attributes:
        outline: Geometries [n].
        columns: Values of each attribute [n], by name.
        crs: Coordinate reference system of the geometries; None if the file states no system.
    """

    outline: NDArray[Any]
    columns: dict[str, NDArray[Any]]
    crs: str | None


def read_features(path: Path, layer: str | None) -> Features:
    """Read the features of a vector file, or of one of its layers, in one of the `VECTOR_FORMATS`.

    Raises:
        InputError: The file does not exist, has an unsupported format, is damaged, or does not fit into memory.
    """
    # A geodatabase is a folder.
    if not (path.is_dir() or exists(path)):
        raise InputError(f"{path}: does not exist; check the path")
    try:
        head = b"" if path.is_dir() else _head(path)
        if head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"{":
            return _read_geojson(path)
        driver = next((name for magic, name in _MAGIC if head.startswith(magic)), None)
        if path.is_dir() and path.suffix == ".gdb" and (path / "a00000001.gdbtable").is_file():
            driver = "OpenFileGDB"
        if driver == "GPKG" and head[68:70] != b"GP":
            driver = None
        if driver is None and not path.is_dir() and _DXF.fullmatch(_head(path, 4096)):
            _check_text_size(path, "DXF")
            driver = "DXF"
        if driver is None:
            raise InputError(f"{path}: is not in a supported format; give {VECTOR_FORMATS}")
        return _read_with_gdal(path, layer, driver)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    except MemoryError:
        raise InputError(f"{path}: does not fit into memory; cut out the area that you need") from None


def _head(path: Path, size: int = 100) -> bytes:
    with path.open("rb") as file:
        return file.read(size)


def stated_unit(path: Path) -> float | None:
    """The unit of length [m] in the header of a DXF file ($INSUNITS); None if it is missing or the file is not DXF."""
    code = (
        re.search(rb"\$INSUNITS\s+70\s+(\d+)\s", _head(path, 65536))
        if path.suffix.lower() == ".dxf"
        else None
    )
    return _INSUNITS.get(int(code[1])) if code else None


def _check_text_size(path: Path, what: str) -> None:
    size = path.stat().st_size
    if size * TEXT_GROWTH > available_memory():
        raise InputError(
            f"{path}: {size / 1e6:,.0f} MB of {what} need about {TEXT_GROWTH * size / 1e9:,.1f} GB of memory; convert "
            "it to a GeoPackage, or cut out the area that you need"
        )


def _read_with_gdal(path: Path, layer: str | None, driver: str) -> Features:
    pyogrio, shapely = library("pyogrio", "scenes"), library("shapely", "scenes")
    # GDAL does not interpret any part of an absolute path as a prefix, such as /vsicurl or WFS:.
    file = str(path.resolve())
    # DXF blocks can be nested, and nested blocks can expand from a few kilobytes to gigabytes.
    pyogrio.set_gdal_config_options({"DXF_INLINE_BLOCKS": False})
    try:
        layers = pyogrio.list_layers(file)[:, 0].tolist()
        if layer is not None and layer not in layers:
            raise InputError(f"{path}: no layer {shortened(layer)!r}; {did_you_mean(layer, layers)}")
        if layer is None:
            layer = "entities" if driver == "DXF" else layers[0]
            if len(layers) > 1 and driver != "DXF":
                _LOG.warning("%s has the layers %s; %r is read", path, shortened(", ".join(layers)), layer)
        info = pyogrio.read_info(file, layer=layer)
        count = int(info["features"])
        if info["driver"] != driver:
            raise InputError(f"{path}: is damaged; give {VECTOR_FORMATS}")
        # A feature, including its outline and attributes, needs at least 500 bytes of memory.
        if count * 500 > available_memory():
            raise InputError(
                f"{path}: declares {count:,} features, more than fit into memory; cut out the area that you need"
            )
        meta, _, geometry, fields = pyogrio.raw.read(file, layer=layer)
        outline = shapely.from_wkb(geometry)
    except InputError:
        raise  # it is a ValueError
    except (
        pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, pyogrio.errors.FeatureError,
        pyogrio.errors.GeometryError, shapely.GEOSException, ValueError, IndexError,
    ) as error:  # fmt: skip
        raise InputError(f"{path}: cannot be read ({first_line(error)}); give {VECTOR_FORMATS}") from None
    crs = None if meta["crs"] is None else str(meta["crs"])
    return Features(outline, dict(zip(map(str, meta["fields"]), fields, strict=True)), crs)


def _read_geojson(path: Path) -> Features:
    """Read GeoJSON (RFC 7946, with the obsolete member `crs`) without GDAL, which would also try other drivers."""
    shapely = library("shapely", "scenes")
    _check_text_size(path, "GeoJSON")
    try:
        content = json.loads(path.read_bytes().decode("utf-8-sig"))
        kind = content["type"]
        if kind not in ("FeatureCollection", "Feature"):
            raise ValueError(f"type {shortened(repr(kind))} is neither FeatureCollection nor Feature")
        features = content["features"] if kind == "FeatureCollection" else [content]
        features = [feature for feature in features if feature.get("geometry") is not None]
        outline = shapely.from_geojson([json.dumps(feature["geometry"]) for feature in features])
        properties = [feature.get("properties") or {} for feature in features]
        names = list(dict.fromkeys(name for record in properties for name in record))
        columns = {name: _column([record.get(name) for record in properties]) for name in names}
        stated = content.get("crs", {"properties": {"name": WGS84}})
        crs = None if stated is None else str(stated["properties"]["name"])
    except (
        ValueError,
        LookupError,
        AttributeError,
        TypeError,
        RecursionError,
        shapely.GEOSException,
    ) as error:
        raise InputError(
            f"{path}: cannot be read ({first_line(error)}); give a valid Feature or FeatureCollection in UTF-8"
        ) from None
    # CRS84 is WGS 84 with longitude first, the order assumed for all coordinates here.
    return Features(outline, columns, WGS84 if crs is not None and crs.endswith("CRS84") else crs)


def _column(values: list[Any]) -> NDArray[Any]:
    """Convert a column to numbers if all values are numbers or missing, otherwise to objects."""
    if all(
        value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in values
    ):
        return np.array([np.nan if value is None else float(value) for value in values])
    column = np.empty(len(values), dtype=object)
    column[:] = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
    return column


@dataclass(frozen=True)
class HeightModel:
    """An open height model.

    Attributes:
        path: The file.
        dataset: The raster, as opened by rasterio.
        crs: Horizontal coordinate reference system as WKT.
        metres: Unit of the heights [m], after scale and offset have been applied to the stored numbers.
    """

    path: Path
    dataset: Any
    crs: str
    metres: float

    def read(
        self, first: NDArray[np.integer], last: NDArray[np.integer], lowest: float = HEIGHTS[0]
    ) -> np.ma.MaskedArray:
        """Read heights [rows, columns], [m], from the first to the last row and column, both included; gaps are masked.

        Raises:
            InputError: There are too many heights, the heights cannot be read, or a value is less than `lowest` [m] or
                greater than any height on land.
        """
        rasterio = library("rasterio", "scenes")
        rows, columns = (last - first + 1).tolist()
        if rows * columns > MOST_CELLS:
            raise InputError(
                f"height model {self.path}: {rows * columns:,} cells are in the scene, but at most "
                f"{MOST_CELLS:,} are supported; give a coarser model, or reduce the margin"
            )
        window = rasterio.windows.Window(first[1], first[0], columns, rows)
        try:
            stored = self.dataset.read(1, window=window, masked=True).astype(float)
        except (rasterio.errors.RasterioError, MemoryError) as error:
            raise InputError(
                f"height model {self.path}: cannot be read ({first_line(error)}); check the file"
            ) from None
        heights = (stored * self.dataset.scales[0] + self.dataset.offsets[0]) * self.metres
        heights = np.ma.masked_invalid(heights)
        wrong = (heights < lowest) | (heights > HEIGHTS[1])
        if np.ma.filled(wrong, False).any():
            value = stored[np.ma.filled(wrong, False)][0]
            below = f"below {lowest:g} m or " if np.isfinite(lowest) else ""
            raise InputError(
                f"height model {self.path}: {int(wrong.sum())} of {rows * columns} values are {below}above "
                f"{HEIGHTS[1]:g} m and therefore not heights on land, such as {value:g}; "
                f"declare this value as nodata (gdal_edit.py -a_nodata {value:g}), or correct the unit"
            )
        return heights

    def stored(self, height: float) -> float:
        """The number that represents a height [m] in the file."""
        return (height / self.metres - self.dataset.offsets[0]) / self.dataset.scales[0]


@contextmanager
def open_height_model(path: Path) -> Iterator[HeightModel]:
    """Open a height model, which must be a GeoTIFF.

    Raises:
        InputError: The file does not exist or is not a GeoTIFF, its coordinate reference system or unit is unknown, its
            grid is not regular, or an auxiliary file next to it changes its heights.
    """
    rasterio = library("rasterio", "scenes")
    if not path.is_file():
        raise InputError(f"height model {path}: does not exist; check the path")
    _check_sidecars(path)
    # No file next to the model is opened, because a mask or overview may have any format, including VRT.
    environment = rasterio.Env(
        GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO", GDAL_CACHEMAX=256
    )
    try:
        with environment, rasterio.open(str(path.resolve()), driver=RASTER_DRIVER) as dataset:
            _check_layout(path, dataset)
            if dataset.crs is None:
                raise InputError(
                    f"height model {path}: has no coordinate reference system; give a GeoTIFF that states it"
                )
            horizontal, metres = _systems(path, dataset)
            yield HeightModel(path, dataset, horizontal, metres)
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as error:
        raise InputError(
            f"height model {path}: cannot be read ({first_line(error)}); give a GeoTIFF"
        ) from None


def _check_sidecars(path: Path) -> None:
    """Refuse a model whose auxiliary files would change its heights, because these files are not read."""
    mask, auxiliary = Path(f"{path}.msk"), Path(f"{path}.aux.xml")
    if mask.exists():
        raise InputError(f"height model {path}: its mask {mask.name} is not read; write it into the GeoTIFF")
    if not auxiliary.is_file():
        return
    try:
        text = auxiliary.read_bytes()[:10_000_000]
        tags = {element.tag for element in ElementTree.fromstring(text).iter()}
    except (OSError, ElementTree.ParseError):
        return
    if changed := sorted(tags & {"NoDataValue", "Scale", "Offset", "UnitType", "SRS", "GeoTransform"}):
        raise InputError(
            f"height model {path}: {auxiliary.name} states {', '.join(changed)}, which is not read; write it into the "
            "GeoTIFF, with gdal_translate"
        )


def _check_layout(path: Path, dataset: Any) -> None:
    affine = dataset.transform
    determinant = affine.a * affine.e - affine.b * affine.d
    if not np.isfinite([*affine]).all() or not np.isfinite(determinant) or determinant == 0:
        raise InputError(
            f"height model {path}: its geotransform {shortened(str(tuple(affine)[:6]), 200)} is not a grid; "
            "give a model with cells of finite size"
        )
    height, width = dataset.block_shapes[0]
    bands = dataset.count if dataset.interleaving is not None and dataset.interleaving.name == "pixel" else 1
    size = height * width * bands * np.dtype(dataset.dtypes[0]).itemsize
    if size > LARGEST_BLOCK:
        raise InputError(
            f"height model {path}: is stored in blocks of {size / 2**20:,.0f} MiB; tile it "
            "(gdal_translate -co TILED=YES)"
        )


def _systems(path: Path, dataset: Any) -> tuple[str, float]:
    """The horizontal coordinate reference system as WKT, and the unit of heights [m]."""
    crs = parse_crs(dataset.crs.to_wkt())
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    horizontal = next((part for part in parts if part.is_projected or part.is_geographic), None)
    if horizontal is None:
        raise InputError(
            f"height model {path}: its reference system {shortened(crs.name, 100)!r} has no position on the globe; "
            f"give a model with a map projection, or with longitude and latitude"
        )
    axes = [axis for part in parts for axis in part.axis_info if axis.direction in ("up", "down")]
    if any(axis.direction == "down" for axis in axes):
        raise InputError(f"height model {path}: contains depths, not heights; invert the sign")
    declared = {axis.unit_conversion_factor for axis in axes}
    unit = (dataset.units[0] or "").strip()
    if unit:
        factor = _METRES.get(re.sub(r"\s+", " ", unit.lower()))
        if factor is None:
            raise InputError(
                f"height model {path}: the unit {shortened(unit, 40)!r} of its heights is not known; convert it to "
                "metres"
            )
        declared.add(factor)
    if len(declared) > 1 and not np.allclose(list(declared), min(declared), rtol=1e-4):
        raise InputError(
            f"height model {path}: its band states heights in {unit!r}, but its reference system states another unit; "
            "correct one of them"
        )
    return horizontal.to_wkt(), max(declared, default=1.0)
