"""Floor plans: walls drawn as lines, doors and windows among them, to upright slabs.

Sionna RT models a wall as one sheet whose material has a thickness. A plan that draws both faces of a wall therefore
has every wall twice; two parallel lines of one type, a wall's thickness apart, become one sheet midway between them.
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
from calibray.support.messages import did_you_mean
from calibray.support.output_files import exists

OPENINGS: Final = frozenset({"door", "window"})
"""Types that take the place of the wall that they are drawn on."""

SHORTEST: Final = 0.001  # [m]
_PARALLEL: Final = np.cos(np.radians(2.0))
_ENDS: Final = ("x0", "y0", "x1", "y1")


@dataclass(frozen=True)
class Segment:
    """An upright rectangle over a line of a plan.

    Attributes:
        start: x and y of one end [m].
        end: x and y of the other [m].
        kind: Its type, such as `brick` or `door`.
        bottom: Where it begins [m].
        top: Where it ends [m].
        thickness: How thick it is [m]; None if that is not known.
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


def read_plan(path: str | Path, height: float = 3.0, unit: float = 1.0) -> list[Segment]:
    """Read a floor plan.

    Args:
        path: A CSV table with the columns x0, y0, x1, y1 and type, and perhaps thickness, bottom and height.
        height: Height of a segment that has none [m].
        unit: The table's unit of length [m]: 0.001 for millimetres.

    Returns:
        The segments in the table's order.

    Raises:
        InputError: The file or a column is missing or malformed, a segment has no length or ends below its bottom.
    """
    if not exists(path):
        raise InputError(f"floor plan {path}: is no file; check the path")
    try:
        frame = pd.read_csv(path, skipinitialspace=True)
    except OSError as error:
        raise InputError(f"floor plan {path}: cannot be read ({error.strerror}); check the file") from None
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise InputError(f"floor plan {path}: is not a table ({error}); give a CSV file") from None
    for column in (*_ENDS, "type"):
        if column not in frame:
            raise InputError(
                f"floor plan {path}: no column {column!r}; {did_you_mean(column, map(str, frame))}"
            )
    numbers = {name: _numbers(path, frame, name) * unit for name in (*_ENDS, "thickness", "bottom", "height")}
    segments = []
    for index, kind in enumerate(frame["type"]):
        x0, y0, x1, y1, thickness, bottom, high = (float(values[index]) for values in numbers.values())
        place = f"floor plan {path}, row {index + 2}"
        if not isinstance(kind, str) or not np.isfinite([x0, y0, x1, y1]).all():
            raise InputError(f"{place}: lacks its type or a coordinate; complete or remove it")
        bottom = 0.0 if np.isnan(bottom) else bottom
        high = height - bottom if np.isnan(high) else high
        found = Segment(
            (x0, y0), (x1, y1), kind.strip().lower(), bottom, bottom + high,
            None if np.isnan(thickness) else thickness,
        )  # fmt: skip
        if found.length < SHORTEST or high <= 0 or thickness <= 0:
            raise InputError(
                f"{place}: its length, height and thickness must be greater than 0; correct or remove it"
            )
        segments.append(found)
    if not segments:
        raise InputError(f"floor plan {path}: holds no segment; give at least one wall")
    return segments


def _numbers(path: str | Path, frame: pd.DataFrame, name: str) -> NDArray[np.float64]:
    if name not in frame:
        return np.full(len(frame), np.nan)
    values = pd.Series(pd.to_numeric(frame[name], errors="coerce")).to_numpy(dtype=np.float64)
    if (bad := np.flatnonzero((np.isnan(values) & frame[name].notna().to_numpy()) | np.isinf(values))).size:
        raise InputError(
            f"floor plan {path}, row {bad[0] + 2}: {name} = {frame[name].iloc[bad[0]]!r} is not a number; correct it"
        )
    return values


def merge_faces(segments: Sequence[Segment], thickest: float = 0.6) -> tuple[list[Segment], int]:
    """Make one sheet of a wall whose two faces are drawn.

    Two lines are faces of one wall if they have type, bottom and top in common, are parallel, lie side by side, and
    are as far apart as the wall is thick (where a thickness is given, at most a fifth or 2 cm from it; at most
    `thickest` otherwise), and no line nearer to one of them could be its other face. Where a longer face has several
    shorter ones before it, as between the rooms along a corridor, each pair makes a sheet, and gaps between the
    sheets no longer than `thickest` are closed. Ends lie midway between the faces' ends, so that corners meet.

    Args:
        segments: Lines of a plan.
        thickest: Thickness beyond which two lines are two walls [m].

    Returns:
        The sheets, as thick as their faces were apart, with the lines that had no other face; and how many lines
        were merged.
    """
    pairs = _faces(segments, thickest)
    merged: list[Segment] = []
    for one, other in pairs:
        merged.append(_midway(segments[one], segments[other], thickest))
    paired = {index for pair in pairs for index in pair}
    alone = [segment for index, segment in enumerate(segments) if index not in paired]
    return [*_without_gaps(merged, thickest), *alone], len(paired)


def _faces(segments: Sequence[Segment], thickest: float) -> list[tuple[int, int]]:
    """Pairs of lines that are the two faces of one wall."""
    distance: dict[tuple[int, int], float] = {}
    nearest = np.full(len(segments), np.inf)
    for one, first in enumerate(segments):
        for other, second in enumerate(segments[:one]):
            apart = _apart(first, second, thickest)
            if apart is not None:
                distance[other, one] = abs(apart)
                nearest[[one, other]] = np.minimum(nearest[[one, other]], abs(apart))
    # A wall has one other face, but that may be drawn in pieces.
    return [pair for pair, apart in sorted(distance.items()) if (apart <= nearest[list(pair)] + 0.01).all()]


def _apart(one: Segment, other: Segment, thickest: float) -> float | None:
    """How far apart two lines are if they may be faces of one wall [m]."""
    if (one.kind, one.bottom, one.top) != (other.kind, other.bottom, other.top):
        return None
    along, origin = _direction(one), np.array(one.start)
    if abs(along @ _direction(other)) < _PARALLEL:
        return None
    relative = np.array([other.start, other.end]) - origin
    across = float(np.mean(relative @ [-along[1], along[0]]))
    low, high = sorted(relative @ along)
    overlap = min(high, one.length) - max(low, 0.0)
    if not 0.01 < abs(across) <= thickest or overlap < 0.5 * min(one.length, other.length):
        return None
    for stated in (one.thickness, other.thickness):
        if stated is not None and abs(abs(across) - stated) > max(0.2 * stated, 0.02):
            return None
    return across


def _direction(segment: Segment) -> NDArray[np.float64]:
    step = np.subtract(segment.end, segment.start)
    return step / np.hypot(*step)


def _midway(one: Segment, other: Segment, thickest: float) -> Segment:
    """The sheet between two faces: over what they have in common, its ends midway where both end near each other."""
    along = _direction(one)
    across = np.array([-along[1], along[0]])
    relative = np.array([other.start, other.end]) - np.array(one.start)
    low, high = sorted(relative @ along)
    start = low / 2 if abs(low) <= thickest else max(low, 0.0)
    end = (high + one.length) / 2 if abs(high - one.length) <= thickest else min(high, one.length)
    apart = float(np.mean(relative @ across))
    base = np.array(one.start) + across * apart / 2
    ends = [tuple((base + along * at).tolist()) for at in (start, end)]
    # A pane is thinner than the wall that it is in.
    thickness = one.thickness if one.kind in OPENINGS else round(abs(apart), 3)
    return replace(one, start=ends[0], end=ends[1], thickness=thickness)


def _without_gaps(sheets: Sequence[Segment], longest: float) -> list[Segment]:
    """Sheets of one wall joined where only a crossing wall parts them."""
    joined: list[Segment] = []
    for sheet in sorted(sheets, key=lambda each: min(each.start, each.end)):
        for index, before in enumerate(joined):
            if (sheet.kind, sheet.bottom, sheet.top) != (before.kind, before.bottom, before.top):
                continue
            along, origin = _direction(before), np.array(before.start)
            relative = np.array([sheet.start, sheet.end]) - origin
            off, at = np.abs(relative @ [-along[1], along[0]]), relative @ along
            if off.max() < 0.02 and at.min() <= before.length + longest and at.max() >= -longest:
                low, high = min(0.0, at.min()), max(before.length, at.max())
                ends = [tuple((origin + along * distance).tolist()) for distance in (low, high)]
                joined[index] = replace(before, start=ends[0], end=ends[1])
                break
        else:
            joined.append(sheet)
    return joined
