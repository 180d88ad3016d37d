"""Merge wall faces in plans that show both faces of each wall and therefore contain every wall twice.

Sionna RT models a wall as one sheet whose material has a thickness. `merge_faces` replaces two parallel lines of the
same type, one wall thickness apart, with one sheet midway between them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.authoring.floor_plan import OPENINGS, Segment
from calibray.support.lazy_imports import library

THICKEST: Final = 0.6
"""Maximum thickness of a wall whose faces are merged [m]."""

_PARALLEL: Final = np.cos(np.radians(2.0))
_TOUCHING: Final = 0.02  # distance below which two ends count as meeting [m]
_SAME: Final = ("kind", "bottom", "top", "thickness")  # attributes that sheets of one wall have in common


@dataclass(frozen=True)
class MergedPlan:
    """The sheets of a plan, and a report that states how its lines were used.

    Attributes:
        sheets: One sheet for each wall, door and window.
        lines: Number of lines that were merged as faces.
        report: Sentences that state which lines were merged, kept and left out.
    """

    sheets: Sequence[Segment]
    lines: int = 0
    report: Sequence[str] = field(default=())


def merge_faces(segments: Sequence[Segment]) -> MergedPlan:
    """Merge the two faces of each wall into one sheet.

    Two lines are faces of one wall if they are parallel and have the same type, bottom and top. The lines must also
    overlap over a length that exceeds both the distance between them and half of the shorter line. Neither line may
    have a closer opposite face. The distance between the lines is at most `THICKEST`. If the thickness of the wall is
    given, the distance differs from the thickness by at most a fifth of the thickness or 2 cm, whichever is greater.
    Where one long face is opposite several short faces, as between a corridor and its rooms, each pair becomes a sheet.
    Gaps of up to `THICKEST` between these sheets are closed. Each sheet ends midway between the ends of its two faces,
    so that sheets meet at corners.

    Where one face is longer than the opposite face, the excess is kept as a sheet in the plane of the merged sheet. The
    short lines that close the outline of a wall are left out. If the walls of a type have no given thickness, their
    thickness is the median distance between their faces, weighted by length.

    If less than half of a type's total line length has an opposite face, each line of the type is treated as a wall.
    In this case, two lines that are close together are separate walls, and both lines are kept.

    Returns the sheets, followed by the lines without an opposite face.
    """
    pairs = _face_pairs(segments)
    faced = _types_drawn_as_faces(segments, pairs)
    separate = [pair for pair in pairs if segments[pair[0]].kind not in faced]
    pairs = [pair for pair in pairs if segments[pair[0]].kind in faced]
    paired = {index for pair in pairs for index in pair}
    merged = [_merge_pair(segments[one], segments[other]) for one, other in pairs]
    distances = [abs(_offset(segments[one], segments[other])) for one, other in pairs]
    rest = [sheet for index in sorted(paired) for sheet in _left_over(index, pairs, segments)]
    single = [index for index in range(len(segments)) if index not in paired]
    closing = {index for index in single if _closes_wall(segments[index], pairs, segments)}
    thickness = _thicknesses(merged, distances)
    sheets = [*_close_gaps([*merged, *rest]), *(segments[k] for k in single if k not in closing)]
    report = [
        *_described("merged from two faces", merged, distances),
        *_described("kept from a face that is longer than the opposite face", rest),
        *_described("ends of outlined walls left out", [segments[index] for index in sorted(closing)]),
        *_described(
            "not merged with a parallel line, because most lines of this type have no opposite face",
            [segments[one] for one, _ in separate],
            [abs(_offset(segments[one], segments[other])) for one, other in separate],
        ),
        *(f"{kind}: walls without a thickness get {value:g} m" for kind, value in thickness.items()),
    ]
    return MergedPlan(
        [
            replace(sheet, thickness=thickness[sheet.kind])
            if sheet.thickness is None and sheet.kind in thickness
            else sheet
            for sheet in sheets
        ],
        len(paired),
        report,
    )


def _face_pairs(segments: Sequence[Segment]) -> list[tuple[int, int]]:
    """Pairs of lines that are the two faces of one wall."""
    shapely = library("shapely", "scenes")
    lines = np.array([shapely.LineString([segment.start, segment.end]) for segment in segments], dtype=object)
    near = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=THICKEST)
    distances: dict[tuple[int, int], float] = {}
    nearest = np.full(len(segments), np.inf)
    for one, other in near.T.tolist():
        distance = _face_distance(segments[one], segments[other]) if one > other else None
        if distance is not None:
            distances[other, one] = distance
            nearest[[one, other]] = np.minimum(nearest[[one, other]], distance)
    # A face has one opposite face, which may be drawn as several lines at nearly the same distance.
    return [
        pair for pair, distance in sorted(distances.items()) if (distance <= nearest[list(pair)] + 0.01).all()
    ]


def _types_drawn_as_faces(segments: Sequence[Segment], pairs: Sequence[tuple[int, int]]) -> set[str]:
    """The types whose lines, along at least half of their total length, have an opposite face."""
    length: dict[str, float] = defaultdict(float)
    faced: dict[str, float] = defaultdict(float)
    for segment in segments:
        length[segment.kind] += segment.length
    for one, other in pairs:
        # Each pair covers this length on both of its lines.
        low, high = _span(segments[one], segments[other])
        faced[segments[one].kind] += 2 * (high - low)
    # If a plan shows faces, nearly all of its lines are paired; if it shows walls as single lines, only a few lines are
    # paired.
    return {kind for kind in length if faced[kind] >= 0.5 * length[kind]}


def _face_distance(one: Segment, other: Segment) -> float | None:
    """Distance between two lines if they can be the faces of one wall [m]; otherwise None."""
    if (one.kind, one.bottom, one.top) != (other.kind, other.bottom, other.top):
        return None
    if abs(one.direction @ other.direction) < _PARALLEL:
        return None
    low, high = _span(one, other)
    distance = abs(_offset(one, other))
    if not 0.01 < distance <= THICKEST or high - low < max(0.5 * min(one.length, other.length), distance):
        return None
    for stated in (one.thickness, other.thickness):
        if stated is not None and abs(distance - stated) > max(0.2 * stated, 0.02):
            return None
    return distance


def _relative(one: Segment, other: Segment) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates of the ends of `other` along and across `one`, from the start of `one`, each [2], [m]."""
    direction = one.direction
    offset = np.array([other.start, other.end]) - np.array(one.start)
    return offset @ direction, offset @ [-direction[1], direction[0]]


def _span(one: Segment, other: Segment) -> tuple[float, float]:
    """The range along `one` that is opposite `other`, measured from the start of `one` [m]."""
    low, high = sorted(_relative(one, other)[0].tolist())
    return max(low, 0.0), min(high, one.length)


def _offset(one: Segment, other: Segment) -> float:
    """Mean distance of `other` to the left of `one` [m]."""
    return float(np.mean(_relative(one, other)[1]))


def _part(segment: Segment, start: float, end: float, offset: float) -> Segment:
    """The part of a segment between two distances from its start [m], moved to the left by `offset` [m]."""
    direction = segment.direction
    base = np.array(segment.start) + np.array([-direction[1], direction[0]]) * offset
    first, last = ((base + direction * distance).tolist() for distance in (start, end))
    return replace(segment, start=(first[0], first[1]), end=(last[0], last[1]))


def _merge_pair(one: Segment, other: Segment) -> Segment:
    """The sheet between two overlapping faces; where their ends are close, the sheet ends midway between the ends."""
    low, high = sorted(_relative(one, other)[0].tolist())
    # At a corner, one face ends one wall thickness before the opposite face. The point midway between their ends is on
    # the centre line of the other wall.
    start = low / 2 if abs(low) <= THICKEST else max(low, 0.0)
    end = (high + one.length) / 2 if abs(high - one.length) <= THICKEST else min(high, one.length)
    sheet = _part(one, start, end, _offset(one, other) / 2)
    return replace(sheet, thickness=one.thickness if one.thickness is not None else other.thickness)


def _left_over(index: int, pairs: Sequence[tuple[int, int]], segments: Sequence[Segment]) -> list[Segment]:
    """Parts of a face without an opposite face, if longer than `THICKEST`, moved into the plane of the sheet."""
    face = segments[index]
    opposite = [segments[sum(pair) - index] for pair in pairs if index in pair]
    spans = sorted((*_span(face, other), _offset(face, other)) for other in opposite)
    parts, covered, offset = [], 0.0, spans[0][2]
    for low, high, offset in [*spans, (face.length, face.length, spans[-1][2])]:
        if low - covered > THICKEST:
            parts.append(_part(face, covered, low, offset / 2))
        covered = max(covered, high)
    return parts


def _closes_wall(segment: Segment, pairs: Sequence[tuple[int, int]], segments: Sequence[Segment]) -> bool:
    """Whether a line connects the ends of the two faces of a wall."""
    if segment.length > THICKEST:
        return False
    for one, other in pairs:
        faces = [np.array([segments[index].start, segments[index].end]) for index in (one, other)]
        for first, second in (faces, faces[::-1]):
            gaps = [
                np.hypot(*(face - end).T).min()
                for face, end in ((first, segment.start), (second, segment.end))
            ]
            if max(gaps) <= _TOUCHING and segment.kind == segments[one].kind:
                return True
    return False


def _close_gaps(sheets: Sequence[Segment]) -> list[Segment]:
    """Join sheets of one wall that are separated only by a crossing wall."""
    joined: list[Segment] = []
    for sheet in sorted(sheets, key=lambda sheet: min(sheet.start, sheet.end)):
        for index, before in enumerate(joined):
            if any(getattr(sheet, name) != getattr(before, name) for name in _SAME):
                continue
            along, across = _relative(before, sheet)
            if (
                np.abs(across).max() < _TOUCHING
                and along.min() <= before.length + THICKEST
                and along.max() >= -THICKEST
            ):
                reach = min(0.0, float(along.min())), max(before.length, float(along.max()))
                joined[index] = _part(before, *reach, 0.0)
                break
        else:
            joined.append(sheet)
    return joined


def _thicknesses(sheets: Sequence[Segment], distances: Sequence[float]) -> dict[str, float]:
    """Thickness [m], by type, of walls without a given thickness: the median face distance, weighted by length."""
    thickness = {}
    for kind in sorted({sheet.kind for sheet in sheets if sheet.thickness is None} - OPENINGS):
        walls = sorted(
            (distance, sheet.length)
            for sheet, distance in zip(sheets, distances, strict=True)
            if sheet.kind == kind and sheet.thickness is None
        )
        lengths = np.cumsum([length for _, length in walls])
        thickness[kind] = round(walls[int(np.searchsorted(lengths, lengths[-1] / 2))][0], 3)
    return thickness


def _described(what: str, sheets: Sequence[Segment], distances: Sequence[float] = ()) -> list[str]:
    """Number and total length of sheets by type and, if given, by distance between faces, rounded to centimetres."""
    groups: dict[tuple[str, str], list[float]] = defaultdict(list)
    for index, sheet in enumerate(sheets):
        apart = f", {distances[index]:.2f} m apart" if distances else ""
        groups[sheet.kind, apart].append(sheet.length)
    return [
        f"{kind}: {len(lengths)} {what}{apart}, {sum(lengths):.1f} m long"
        for (kind, apart), lengths in sorted(groups.items())
    ]
