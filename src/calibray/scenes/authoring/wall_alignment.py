"""Walls in line: those that lie in one plane but for the rounding of a map are put into one.

Corners of maps are rounded: OpenStreetMap's to a centimetre, here to a millimetre at last. The front of a row of
houses, or a wall cut where another meets it, then is several planes, a hair apart. A ray tracer that takes one for the
other within a tolerance finds one reflection several times: Sionna RT accepts images that lie within 1 cm of each
other, and tells apart planes by far smaller differences. So edges that continue each other get one straight line by
least squares, and corners move onto the lines of their walls. Whole millimetres go in, metres come out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

APART: Final = 25.0
"""Distance from a straight line that rounding explains, of walls that continue each other over some metres [mm]."""
REACH: Final = 30_000.0
"""Gap between two walls, a street, over which one may continue the other [mm]."""
TURN: Final = 0.05
"""Sine of the angle by which two walls in line may differ, small ones among them."""
STEEP: Final = 0.2
"""Sine of the angle at which two lines must meet at least to tell where their corner is."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where corners lie once walls are in line.

    Attributes:
        points: Corners on the ground, sorted [n, 2], [mm].
        places: Where they lie [n, 2], [m].
    """

    points: NDArray[np.int64]
    places: NDArray[np.float64]

    def placed(self, corners: NDArray[np.int64]) -> NDArray[np.float64]:
        """Corners of walls and roofs where they lie.

        Args:
            corners: Corners [n, 3], [mm]; each is one of `points` at some height.

        Returns:
            Their places [n, 3], [m].
        """
        both, which = np.unique(np.concatenate([self.points, corners[:, :2]]), axis=0, return_inverse=True)
        where = np.empty((len(both), 2))
        where[which[: len(self.points)]] = self.places
        return np.column_stack([where[which[len(self.points) :]], corners[:, 2] / 1000])


def align(triangles: NDArray[np.int64], apart: float = APART) -> Alignment:
    """Put walls that continue each other into line.

    Args:
        triangles: Corners of all triangles, upright or level [F, 3, 3], [mm].
        apart: Distance from a straight line that rounding explains [mm].

    Returns:
        Where the corners lie; no edge and no level triangle is turned over by it, where that would happen corners stay.
    """
    points, index = np.unique(triangles[..., :2].reshape(-1, 2), axis=0, return_inverse=True)
    ground = index.reshape(-1, 3)
    sides = np.sort(ground[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    is_wall = np.repeat(_area(points[ground].astype(float)) == 0, 3)
    edges = np.unique(sides[is_wall & (sides[:, 0] != sides[:, 1])], axis=0)
    here = points.astype(float)
    moved = _moved(here, edges, apart)
    level = ground[_area(here[ground]) != 0]
    return Alignment(points, _unturned(here, moved, edges, level) / 1000)


def _area(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the signed area of triangles on the ground [F, 3, 2] -> [F]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _moved(points: NDArray[np.float64], edges: NDArray[np.int64], apart: float) -> NDArray[np.float64]:
    """Points moved onto the lines of the edges that end in them."""
    moved = points.copy()
    line = _lines(points[edges], edges, apart)
    if not (line >= 0).any():
        return moved
    middle, along, length = _fitted(points[edges], line)
    ends = np.column_stack([edges.reshape(-1), np.repeat(line, 2)])
    ends = np.unique(ends[np.repeat(line, 2) >= 0], axis=0)
    for point, lines in _grouped(ends):
        first, *others = sorted(lines, key=lambda one: -length[one])
        crossing = next((other for other in others if abs(_cross(along[first], along[other])) > STEEP), None)
        step = along[first] * ((points[point] - middle[first]) @ along[first])
        if crossing is not None:
            reach = _cross(middle[crossing] - middle[first], along[crossing])
            step = along[first] * reach / _cross(along[first], along[crossing])
        place = middle[first] + step
        if np.hypot(*(place - points[point])) <= 2 * apart:
            moved[point] = place
    return moved


def _grouped(ends: NDArray[np.int64]) -> list[tuple[int, list[int]]]:
    """Points with the lines through them, of pairs sorted by point."""
    starts = np.flatnonzero(np.diff(ends[:, 0], prepend=-1))
    return [(int(part[0, 0]), part[:, 1].tolist()) for part in np.split(ends, starts[1:]) if len(part)]


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _lines(segments: NDArray[np.float64], edges: NDArray[np.int64], most: float) -> NDArray[np.int64]:
    """The line that every edge lies in, from 0; -1 for those that continue no other [E].

    First edges that share a corner make runs, then runs that are near each other make lines.
    """
    if not len(segments):
        return np.zeros(0, dtype=np.int64)
    run = _in_one(segments, _alike(segments, _touching(edges)), most)
    alone = run < 0
    run[alone] = run.max() + 1 + np.arange(alone.sum())
    middle, along, _ = _fitted(segments, run)
    ends = ((segments - middle[run][:, None]) @ along[run][..., None])[..., 0]
    first, last = np.full(len(middle), np.inf), np.full(len(middle), -np.inf)
    np.minimum.at(first, run, ends.min(axis=1))
    np.maximum.at(last, run, ends.max(axis=1))
    whole = middle[:, None] + np.stack([first, last], axis=1)[..., None] * along[:, None]
    line = _in_one(whole, _alike(whole, _near(whole)), most)
    several = np.bincount(run) > 1
    single = (line < 0) & several
    line[single] = line.max() + 1 + np.arange(single.sum())
    return line[run]


def _touching(edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs of edges that share a corner [P, 2]."""
    order = np.argsort(edges.reshape(-1), kind="stable")
    degree = np.bincount(edges.reshape(-1))
    first = np.cumsum(degree) - degree
    many = degree**2
    corner = np.repeat(np.arange(len(degree)), many)
    place = np.arange(len(corner)) - np.repeat(np.cumsum(many) - many, many)
    pairs = [order[first[corner] + part] // 2 for part in divmod(place, degree[corner])]
    return np.column_stack(pairs)


def _near(segments: NDArray[np.float64]) -> NDArray[np.int64]:
    """Pairs of segments with ends within reach of each other [P, 2]."""
    return KDTree(segments.reshape(-1, 2)).query_pairs(REACH, output_type="ndarray").reshape(-1, 2) // 2


def _alike(segments: NDArray[np.float64], pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """The pairs of different segments that run alike, each once [P, 2]."""
    along = segments[:, 1] - segments[:, 0]
    along /= np.hypot(*along.T)[:, None]
    one, other = along[pairs[:, 0]], along[pairs[:, 1]]
    turn = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    kept = np.sort(pairs[(pairs[:, 0] != pairs[:, 1]) & (np.abs(turn) < TURN)], axis=1)
    return np.unique(kept, axis=0)


def _in_one(segments: NDArray[np.float64], pairs: NDArray[np.int64], most: float) -> NDArray[np.int64]:
    """The line that every segment shares with others, from 0; -1 for none [S]."""
    line = np.full(len(segments), -1)
    apart, count = most, 0
    # A bow of short segments leads away from any line: there, only what fits more closely is put into one.
    while len(pairs) and apart > 1:
        pairs = pairs[_continued(segments, pairs, apart)]
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(segments), len(segments)))
        _, group = connected_components(graph, directed=False)
        straight = (np.bincount(group)[group] > 1) & (line < 0)
        if straight.any():
            _, group = np.unique(np.where(straight, group, -1), return_inverse=True)
            group = group.reshape(-1) - (not straight.all())
            middle, along, _ = _fitted(segments, group)
            away = np.abs(_across(segments, middle[group], along[group])).max(axis=1)
            bent = np.zeros(len(middle), dtype=bool)
            bent[group[straight & (away > most)]] = True
            kept = straight & ~bent[group]
            line[kept] = count + group[kept]
            count += len(middle)
        pairs, apart = pairs[(line[pairs] < 0).all(axis=1)], apart / 3
    line[line >= 0] = np.unique(line[line >= 0], return_inverse=True)[1]
    return line


def _continued(segments: NDArray[np.float64], pairs: NDArray[np.int64], apart: float) -> NDArray[np.bool_]:
    """Whether the shorter segment of each pair lies on the line of the longer [P]."""
    along = segments[:, 1] - segments[:, 0]
    length = np.hypot(*along.T)
    along /= length[:, None]
    one, other = pairs.T
    longer, shorter = np.where(length[one] >= length[other], (one, other), (other, one))
    return np.abs(_across(segments[shorter], segments[longer, 0], along[longer])).max(axis=1) <= apart


def _across(
    corners: NDArray[np.float64], middle: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far the corners of edges [n, 2, 2] lie to the side of lines [n, 2]."""
    away = corners - middle[:, None]
    return away[..., 0] * along[:, None, 1] - away[..., 1] * along[:, None, 0]


def _fitted(
    segments: NDArray[np.float64], line: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A point and the direction of every line by total least squares of its segments' ends, and their length."""
    some = line >= 0
    ends, number = segments[some], np.repeat(line[some], 2)
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    weight, flat = np.repeat(length, 2), ends.reshape(-1, 2)
    total = np.bincount(number, weight).astype(np.float64)
    middle = np.column_stack([np.bincount(number, weight * axis) for axis in flat.T]) / total[:, None]
    x, y = (flat - middle[number]).T
    xx, xy, yy = (np.bincount(number, weight * product) for product in (x * x, x * y, y * y))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return middle, np.column_stack([np.cos(angle), np.sin(angle)]), total


def _unturned(
    points: NDArray[np.float64],
    moved: NDArray[np.float64],
    edges: NDArray[np.int64],
    level: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Places at which no edge shrinks below half its length or turns, and no level triangle turns over."""
    places = moved.copy()
    before, area = points[edges[:, 1]] - points[edges[:, 0]], _area(points[level])
    while True:
        after = places[edges[:, 1]] - places[edges[:, 0]]
        shrunk = (before * after).sum(axis=1) < 0.5 * (before**2).sum(axis=1)
        turned = _area(places[level]) * area <= 0
        wrong = np.unique(np.concatenate([edges[shrunk].reshape(-1), level[turned].reshape(-1)]))
        wrong = wrong[(places[wrong] != points[wrong]).any(axis=1)]
        if not len(wrong):
            return places
        places[wrong] = points[wrong]
