"""Floor plans: walls, doors and windows drawn as lines, polylines or outlines, converted to vertical rectangles."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.column_names import LENGTH_UNITS, find_length_unit, without_accents, words
from calibray.measurements.delimited_text import parse_text, read_text
from calibray.scenes.authoring.footprints import HIGHEST
from calibray.scenes.authoring.geodata import read_features, stated_unit
from calibray.scenes.meshes import MILLIMETRE, WIDEST
from calibray.support.lazy_imports import library
from calibray.support.messages import did_you_mean, first_line, shortened
from calibray.support.output_files import exists

_LOG: Final = logging.getLogger(__name__)

OPENINGS: Final = frozenset({"door", "window"})
"""Types of segment that replace the wall on which they are drawn."""

THICKNESS: Final = (0.0005, 3.0)
"""Minimum and maximum thickness of a wall [m]; other values suggest that thickness and coordinates have different
units."""

USUAL_EXTENT: Final = (2.0, 300.0)
"""Usual range of plan extents [m]; outside this range, a warning recommends stating the unit. Large halls are
300 m long."""

VECTOR_SUFFIXES: Final = (".dxf", ".geojson", ".json", ".gpkg", ".shp", ".fgb", ".gdb")
"""Extensions of vector files; a file with any other extension is read as CSV."""

Lines = list[list[NDArray[np.float64]]]
"""The lines of each row of a plan; each line is an array of points [n, 2]."""

_ENDS: Final = ("x0", "y0", "x1", "y1")
_OTHER_ENDS: Final = (
    ("x1", "y1", "x2", "y2"),
    ("xstart", "ystart", "xend", "yend"),
    ("xa", "ya", "xe", "ye"),
)
_OTHER_NAMES: Final = {
    "type": ("material", "kind", "class", "category", "typ", "tipo"),
    "thickness": ("width", "dicke", "starke", "staerke", "espesor", "epaisseur"),
    "height": ("hohe", "hoehe", "altura", "hauteur"),
    "bottom": ("sill", "base"),
    "wkt": ("geometry", "geom"),
}


@dataclass(frozen=True)
class Segment:
    """A vertical rectangle above a line of a plan.

    Attributes:
        start: x and y of one end [m].
        end: x and y of the other end [m].
        kind: Type of the segment, such as `brick` or `door`.
        bottom: Height of the bottom [m].
        top: Height of the top [m].
        thickness: Thickness [m]; None if unknown.
        source: Name of the plan, for messages.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    kind: str
    bottom: float
    top: float
    thickness: float | None = None
    source: str = field(default="floor plan", compare=False)

    @property
    def length(self) -> float:
        """Horizontal length of the segment [m]."""
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector from start to end [2]."""
        step = np.subtract(self.end, self.start)
        return step / np.hypot(*step)


def read_plan(path: str | Path, height: float = 3.0, unit: float | None = None) -> list[Segment]:
    """Read a floor plan.

    Args:
        path: A text table with the columns x0, y0, x1, y1 and type. Instead of coordinates, the table can have a column
            wkt with lines, polylines or outlines. The columns thickness, bottom and height are optional. Similar column
            names are recognized, and a unit of length in a column name, as in `width_cm`, applies to that column. The
            file can also be a DXF, GeoJSON or other vector file in the plan's coordinates. The attributes of a vector
            file must have exactly these names, with or without a unit. If a DXF file has no type attribute, the layer
            name is used as the type. Points and text in vector files are ignored.
        height: Height of the top of segments for which the plan states no height [m].
        unit: The plan's unit of length [m], such as 0.001 for millimetres; if None, the unit stated in a DXF file or,
            if no unit is stated, metres.

    Returns:
        The segments in file order; a polyline or outline becomes one segment per side.

    Raises:
        InputError: The file or a column is missing or malformed, or a segment's length, height or thickness is not
            greater than 0.
    """
    for name, value in (("height", height), ("unit", 1.0 if unit is None else unit)):
        if not 0 < value <= HIGHEST:
            raise InputError(f"{name} = {value!r}: must be greater than 0 and at most {HIGHEST:g} m")
    path = Path(path)
    is_vector = path.suffix.lower() in VECTOR_SUFFIXES
    if unit is None:
        unit = (stated_unit(path) if exists(path) else None) or 1.0
        if unit != 1:
            _LOG.warning("floor plan %s: its header states a unit of %g m; --unit overrides it", path, unit)
    source = f"floor plan {path}"
    frame, lines = (_read_vector if is_vector else _read_table)(path, unit)
    numbers = {name: _numbers(path, frame, name) * unit for name in ("thickness", "bottom", "height")}
    segments = []
    for index, (kind, parts) in enumerate(zip(frame["type"], lines, strict=True)):
        thickness, bottom, extent = (float(values[index]) for values in numbers.values())
        row = f"{source}, {frame.index[index]}"
        points = np.concatenate(parts) * unit if parts else np.empty((0, 2))
        if pd.isna(kind) or not len(points) or not np.isfinite(points).all():
            raise InputError(f"{row}: has no type or lacks a coordinate; complete or remove it")
        bottom = 0.0 if np.isnan(bottom) else bottom
        extent = height - bottom if np.isnan(extent) else extent
        sides = [(tuple(a), tuple(b)) for part in parts for a, b in pairwise((part * unit).tolist())]
        # An outline in a file may end with a repeated point.
        sides = [(a, b) for a, b in sides if np.hypot(b[0] - a[0], b[1] - a[1]) >= MILLIMETRE]
        if not sides or extent <= 0 or thickness <= 0:
            raise InputError(
                f"{row}: its length, height and thickness must be greater than 0; correct or remove it"
            )
        size = float(np.abs(points).max())
        if size > WIDEST or max(abs(bottom), extent, thickness) > HIGHEST:
            raise InputError(
                f"{row}: {size:g} m from the origin, {extent:g} m high and {thickness:g} m thick; the segment must "
                f"be at most {WIDEST:g} m from the origin, {HIGHEST:g} m high and thick; correct the row or its unit"
            )
        if not (np.isnan(thickness) or THICKNESS[0] <= thickness <= THICKNESS[1]):
            raise InputError(
                f"{row}: thickness = {thickness:g} m, but must be {THICKNESS[0]:g} to {THICKNESS[1]:g} m; state its "
                "unit in the name of the column, such as thickness_cm, or the plan's unit (--unit 0.01 for cm)"
            )
        stated = None if np.isnan(thickness) else thickness
        segments += [
            Segment(a, b, str(kind).strip().lower(), bottom, bottom + extent, stated, source)
            for a, b in sides
        ]
    if not segments:
        raise InputError(f"floor plan {path}: contains no segment; give at least one wall")
    widest = float(
        np.ptp([end for segment in segments for end in (segment.start, segment.end)], axis=0).max()
    )
    if not USUAL_EXTENT[0] <= widest <= USUAL_EXTENT[1]:
        _LOG.warning(
            "floor plan %s: is %g m wide; if this width is wrong, state the unit of its coordinates, such as --unit "
            "0.01 for centimetres", path, widest,
        )  # fmt: skip
    return segments


def _read_table(path: Path, unit: float) -> tuple[pd.DataFrame, Lines]:
    """The columns of a table, renamed by `_with_known_names`, and the lines of each row."""
    if not exists(path):
        raise InputError(f"floor plan {path}: is not a file; check the path")
    table = parse_text(path, read_text(path))
    rows = [f"row {row}" for row in table.row]
    frame = _with_known_names(path, table.frame.set_axis(rows), unit, _OTHER_NAMES)
    for column in ("type",) if "wkt" in frame else (*_ENDS, "type"):
        if column not in frame:
            raise InputError(
                f"floor plan {path}: no column {column!r}; {did_you_mean(column, map(str, table.frame))}; a plan has "
                "x0, y0, x1, y1 (or wkt) and type"
            )
    if "wkt" not in frame:
        ends = np.stack([_numbers(path, frame, name) for name in _ENDS], axis=1)
        return frame, [[row.reshape(2, 2)] for row in ends]
    shapely = library("shapely", "scenes")
    lines = []
    for row, text in frame["wkt"].items():
        try:
            with np.errstate(invalid="ignore"):  # NaN is refused by the caller
                lines.append(_parts(shapely.from_wkt(text)))
        except (shapely.GEOSException, TypeError) as error:
            raise InputError(
                f"floor plan {path}, {row}: wkt = {shortened(repr(text))} is not a geometry "
                f"({first_line(error)}); write LINESTRING (0 0, 4 0, 4 3), for example"
            ) from None
    return frame, lines


def _read_vector(path: Path, unit: float) -> tuple[pd.DataFrame, Lines]:
    """The attributes of a vector file, renamed by `_with_known_names`, and the lines of each feature."""
    features = read_features(path, None)
    lines = [_parts(geometry) for geometry in features.outline]
    has_lines = [bool(parts) for parts in lines]
    blocks = pd.Series(features.columns.get("BlockName", []), dtype=object).dropna()
    if len(blocks):
        _LOG.warning(
            "floor plan %s: blocks are not read (%d inserted: %s); explode them in a CAD program if they contain walls",
            path, len(blocks), shortened(", ".join(map(str, blocks.unique()))),
        )  # fmt: skip
    names = [f"feature {number}" for number in range(1, len(lines) + 1)]
    frame = pd.DataFrame(features.columns, index=names)[has_lines]
    frame = _with_known_names(path, frame, unit, dict.fromkeys(_OTHER_NAMES, ()))
    if "type" not in frame and "Layer" in frame:
        frame = frame.rename(columns={"Layer": "type"})
    if "type" not in frame:
        raise InputError(f"floor plan {path}: no attribute 'type'; {did_you_mean('type', map(str, frame))}")
    return frame, [parts for parts in lines if parts]


def _with_known_names(
    path: Path, frame: pd.DataFrame, unit: float, others: Mapping[str, Sequence[str]]
) -> pd.DataFrame:
    """Rename known columns to this module's names, and convert lengths with a stated unit to the plan's unit."""
    known = _known_names(map(str, frame), others)
    frame = frame.rename(columns=known)
    for column, name in known.items():
        if (frame.columns == name).sum() > 1:
            raise InputError(
                f"floor plan {path}: column {column!r} and another column both state {name}; keep one"
            )
        if words(column) & {*LENGTH_UNITS, "m"}:
            frame[name] = _numbers(path, frame, name) * find_length_unit([column]) / unit
    return frame


def _known_names(columns: Iterable[str], other_names: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Map column names to the names that this module uses, ignoring case and unit.

    Example:
        >>> _known_names(["X1 [cm]", "Y1 [cm]", "X2 [cm]", "Y2 [cm]", "width_cm"], _OTHER_NAMES)["X2 [cm]"]
        'x1'
    """
    plain = {}
    for name in columns:
        parts = re.split(r"[^a-z0-9]+", without_accents(name).lower())
        joined = "".join(part for part in parts if part not in {*LENGTH_UNITS, "m"})
        plain[name] = re.sub(r"^(start|end|a|e)([xy])$", r"\2\1", joined)
    known: dict[str, str] = {}
    for ends in (_ENDS, *_OTHER_ENDS):
        if set(ends) <= set(plain.values()):
            known = dict(zip(ends, _ENDS, strict=True))
            break
    for name, others in other_names.items():
        stated = next((other for other in (name, *others) if other in plain.values()), name)
        known[stated] = name
    return {column: known[name] for column, name in plain.items() if name in known}


def _parts(geometry: Any) -> list[NDArray[np.float64]]:
    """The points [n, 2] of each line in a geometry; the outlines of areas count as lines."""
    shapely = library("shapely", "scenes")
    parts = shapely.get_parts(geometry)
    is_area = shapely.get_dimensions(parts) == 2
    rings = shapely.get_rings(parts[is_area])
    lines = [*parts[shapely.get_dimensions(parts) == 1], *rings]
    return [shapely.get_coordinates(line) for line in lines]


def _numbers(path: str | Path, frame: pd.DataFrame, name: str) -> NDArray[np.float64]:
    """Convert a column to numbers [n]; empty cells and absent columns become NaN."""
    if name not in frame:
        return np.full(len(frame), np.nan)
    column = frame[name]
    if column.dtype == object:
        # pandas keeps long integers as Python integers, which overflow a float; when parsed from text, long integers
        # become infinite.
        column = column.astype("string")
    values = pd.Series(pd.to_numeric(column, errors="coerce")).to_numpy(dtype=np.float64, na_value=np.nan)
    if (bad := np.flatnonzero((np.isnan(values) & frame[name].notna().to_numpy()) | np.isinf(values))).size:
        cell = shortened(repr(frame[name].iloc[bad[0]]))
        raise InputError(
            f"floor plan {path}, {frame.index[bad[0]]}: {name} = {cell} is not a number; correct it"
        )
    return values
