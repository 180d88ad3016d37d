"""Floor plans: walls drawn as lines, with doors and windows, read into upright rectangles.

Sionna RT models a wall as one sheet whose material has a thickness. A plan that draws both faces of a wall therefore
contains every wall twice. `merge_faces` replaces two parallel lines of one type, a wall's thickness apart, by one sheet
midway between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.scenes.authoring.footprints import HIGHEST, WIDEST
from calibray.support.messages import did_you_mean, first_line, shortened
from calibray.support.output_files import exists

OPENINGS: Final = frozenset({"door", "window"})
"""Types that replace the wall on which they are drawn."""

SHORTEST: Final = 0.001  # length of a segment [m]
_PARALLEL: Final = np.cos(np.radians(2.0))
_ENDS: Final = ("x0", "y0", "x1", "y1")


@dataclass(frozen=True)
class Segment:
    """An upright rectangle over a line of a plan.

    Attributes:
        start: x and y of one end [m].
        end: x and y of the other end [m].
        kind: Its type, such as `brick` or `door`.
        bottom: Height at which it begins [m].
        top: Height at which it ends [m].
        thickness: Its thickness [m]; None if unknown.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    kind: str
    bottom: float
    top: float
    thickness: float | None = None

    @property
    def length(self) -> float:
        """Its length [m]."""
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector from start to end [2]."""
        step = np.subtract(self.end, self.start)
        return step / np.hypot(*step)


def read_plan(path: str | Path, height: float = 3.0, unit: float = 1.0) -> list[Segment]:
    """Read a floor plan.

    Args:
        path: A CSV table with the columns x0, y0, x1, y1 and type, and optionally thickness, bottom and height.
        height: Height of the top of segments without a height [m].
        unit: The table's unit of length [m]: 0.001 for millimetres.

    Returns:
        The segments in the table's order.

    Raises:
        InputError: The file or a column is missing or malformed, or a segment has no length, height or thickness.
    """
    for name, value in (("height", height), ("unit", unit)):
        if not 0 < value <= HIGHEST:
            raise InputError(
                f"{name} = {value!r}: must be a number of metres greater than 0, at most {HIGHEST:g}"
            )
    if not exists(path):
        raise InputError(f"floor plan {path}: is not a file; check the path")
    try:
        # A file of compressed data, which some kilobytes of could fill the memory, is no text and is refused.
        frame = pd.read_csv(path, skipinitialspace=True, compression=None)
    except OSError as error:
        raise InputError(f"floor plan {path}: cannot be read ({error.strerror}); check the file") from None
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"floor plan {path}: is not a table ({first_line(error)}); give a CSV file"
        ) from None
    for column in (*_ENDS, "type"):
        if column not in frame:
            raise InputError(
                f"floor plan {path}: no column {column!r}; {did_you_mean(column, map(str, frame))}"
            )
    numbers = {name: _numbers(path, frame, name) * unit for name in (*_ENDS, "thickness", "bottom", "height")}
    segments = []
    for index, kind in enumerate(frame["type"]):
        x0, y0, x1, y1, thickness, bottom, extent = (float(values[index]) for values in numbers.values())
        row = f"floor plan {path}, row {index + 2}"
        if not isinstance(kind, str) or not np.isfinite([x0, y0, x1, y1]).all():
            raise InputError(f"{row}: lacks its type or a coordinate; complete or remove it")
        bottom = 0.0 if np.isnan(bottom) else bottom
        extent = height - bottom if np.isnan(extent) else extent
        segment = Segment(
            (x0, y0), (x1, y1), kind.strip().lower(), bottom, bottom + extent,
            None if np.isnan(thickness) else thickness,
        )  # fmt: skip
        if segment.length < SHORTEST or extent <= 0 or thickness <= 0:
            raise InputError(
                f"{row}: its length, height and thickness must be greater than 0; correct or remove it"
            )
        size = max(map(abs, (x0, y0, x1, y1)))
        if size > WIDEST or max(abs(bottom), extent, thickness) > HIGHEST:
            raise InputError(
                f"{row}: {size:g} m from the origin, {extent:g} m high and {thickness:g} m thick; coordinates may be "
                f"{WIDEST:g} m, heights and thicknesses {HIGHEST:g} m at most; correct it or its unit"
            )
        segments.append(segment)
    if not segments:
        raise InputError(f"floor plan {path}: holds no segment; give at least one wall")
    return segments


def _numbers(path: str | Path, frame: pd.DataFrame, name: str) -> NDArray[np.float64]:
    """A column as numbers [n], NaN where it is empty or absent."""
    if name not in frame:
        return np.full(len(frame), np.nan)
    column = frame[name]
    if column.dtype == object:
        # Integers of any length, which pandas keeps as Python's, overflow a float; as text they are infinite.
        column = column.astype("string")
    values = pd.Series(pd.to_numeric(column, errors="coerce")).to_numpy(dtype=np.float64, na_value=np.nan)
    if (bad := np.flatnonzero((np.isnan(values) & frame[name].notna().to_numpy()) | np.isinf(values))).size:
        raise InputError(
            f"floor plan {path}, row {bad[0] + 2}: {name} = {shortened(repr(frame[name].iloc[bad[0]]))} is not a "
            "number; correct it"
        )
    return values


def merge_faces(segments: Sequence[Segment], thickest: float = 0.6) -> tuple[list[Segment], int]:
    """Merge the two faces of each wall into one sheet.

    Two lines are faces of one wall if they have the same type, bottom and top, are parallel, lie next to each other at
    the distance of a wall's thickness, and no line nearer to one of them could be its other face. The distance is at
    most `thickest`, and within a fifth or 2 cm of the thickness if that is given. Where one long face has several
    short ones opposite, as between the rooms along a corridor, each pair makes a sheet, and gaps between the sheets up
    to `thickest` are closed. Ends lie midway between the faces' ends, so that corners meet.

    Args:
        segments: Lines of a plan.
        thickest: Largest thickness of a wall [m].

    Returns:
        The sheets, as thick as the distance of their faces, followed by the lines without another face; and the number
        of lines merged.
    """
    pairs = _face_pairs(segments, thickest)
    merged = [_merge_pair(segments[one], segments[other], thickest) for one, other in pairs]
    paired = {index for pair in pairs for index in pair}
    single = [segment for index, segment in enumerate(segments) if index not in paired]
    return [*_close_gaps(merged, thickest), *single], len(paired)


def _face_pairs(segments: Sequence[Segment], thickest: float) -> list[tuple[int, int]]:
    """Pairs of lines that are the two faces of one wall."""
    distances: dict[tuple[int, int], float] = {}
    nearest = np.full(len(segments), np.inf)
    for one, first in enumerate(segments):
        for other, second in enumerate(segments[:one]):
            distance = _face_distance(first, second, thickest)
            if distance is not None:
                distances[other, one] = distance
                nearest[[one, other]] = np.minimum(nearest[[one, other]], distance)
    # A wall has one other face, but that may be drawn in pieces at nearly the same distance.
    return [
        pair for pair, distance in sorted(distances.items()) if (distance <= nearest[list(pair)] + 0.01).all()
    ]


def _face_distance(one: Segment, other: Segment, thickest: float) -> float | None:
    """Distance of two lines that may be faces of one wall [m]; None if they cannot be."""
    if (one.kind, one.bottom, one.top) != (other.kind, other.bottom, other.top):
        return None
    if abs(one.direction @ other.direction) < _PARALLEL:
        return None
    along, across = _relative(one, other)
    distance = abs(float(np.mean(across)))
    low, high = sorted(along)
    overlap = min(high, one.length) - max(low, 0.0)
    if not 0.01 < distance <= thickest or overlap < 0.5 * min(one.length, other.length):
        return None
    for stated in (one.thickness, other.thickness):
        if stated is not None and abs(distance - stated) > max(0.2 * stated, 0.02):
            return None
    return distance


def _relative(one: Segment, other: Segment) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The ends of a segment along and across another one, from that one's start [2], [m]."""
    direction = one.direction
    offset = np.array([other.start, other.end]) - np.array(one.start)
    return offset @ direction, offset @ [-direction[1], direction[0]]


def _merge_pair(one: Segment, other: Segment, thickest: float) -> Segment:
    """The sheet between two faces: over their overlap, its ends midway where both faces end near each other."""
    along, across = _relative(one, other)
    low, high = sorted(along)
    start = low / 2 if abs(low) <= thickest else max(low, 0.0)
    end = (high + one.length) / 2 if abs(high - one.length) <= thickest else min(high, one.length)
    distance = float(np.mean(across))
    direction = one.direction
    base = np.array(one.start) + np.array([-direction[1], direction[0]]) * distance / 2
    ends = [tuple((base + direction * position).tolist()) for position in (start, end)]
    # A pane is thinner than the wall around it.
    thickness = one.thickness if one.kind in OPENINGS else round(abs(distance), 3)
    return replace(one, start=ends[0], end=ends[1], thickness=thickness)


def _close_gaps(sheets: Sequence[Segment], longest: float) -> list[Segment]:
    """Join sheets of one wall that only a crossing wall separates."""
    joined: list[Segment] = []
    for sheet in sorted(sheets, key=lambda sheet: min(sheet.start, sheet.end)):
        for index, before in enumerate(joined):
            if (sheet.kind, sheet.bottom, sheet.top) != (before.kind, before.bottom, before.top):
                continue
            along, across = _relative(before, sheet)
            if (
                np.abs(across).max() < 0.02
                and along.min() <= before.length + longest
                and along.max() >= -longest
            ):
                reach = min(0.0, along.min()), max(before.length, along.max())
                ends = [
                    tuple((np.array(before.start) + before.direction * distance).tolist())
                    for distance in reach
                ]
                joined[index] = replace(before, start=ends[0], end=ends[1])
                break
        else:
            joined.append(sheet)
    return joined
