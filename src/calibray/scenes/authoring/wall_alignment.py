"""Wall alignment: walls whose planes differ only because of rounding are moved into one plane.

Coordinates are rounded to a centimetre in OpenStreetMap and to a millimetre in Calibray. Because of this rounding, the
front of a row of houses, or a wall divided where another wall meets it, consists of several planes that almost
coincide. Sionna RT treats planes that are much less than 1 cm apart as different planes, so it finds the same
reflection several times. Therefore, one straight line is fitted to collinear edges by least squares, and corners are
moved onto the lines of their walls. Inputs are in whole millimetres, and outputs are in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

TOLERANCE: Final = 25.0
"""Maximum deviation from a straight line that rounding can cause in collinear walls a few metres long [mm]."""

REACH: Final = 30_000.0
"""Maximum gap between two collinear walls, such as the width of a street [mm]."""

TURN: Final = 0.05
"""Sine of the maximum angle between two collinear walls; rounding can rotate short walls by this angle."""

CROSSING: Final = 0.2
"""Sine of the minimum angle between two lines whose intersection defines a corner."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Corners of walls in plan, sorted [n, 2], [mm], and their new positions [n, 2], [m]."""

    points: NDArray[np.int64]
    moved: NDArray[np.float64]

    def positions(self, corners: NDArray[np.int64]) -> NDArray[np.float64]:
        """New positions [n, 3], [m], of corners [n, 3], [mm]; in plan, each corner is one of `points`."""
        every = np.concatenate([self.points, corners[:, :2]])
        unique, index = np.unique(every, axis=0, return_inverse=True)
        moved = np.empty((len(unique), 2))
        moved[index[: len(self.points)]] = self.moved
        return np.column_stack([moved[index[len(self.points) :]], corners[:, 2] / 1000])


def align(triangles: NDArray[np.int64], tolerance: float = TOLERANCE) -> Alignment:
    """Align the collinear walls in a set of vertical and level triangles [F, 3, 3], [mm].

    Corners within `tolerance` [mm] of a straight line are moved onto this line, unless the move would reverse an edge
    or a level triangle.
    """
    points, index = np.unique(triangles[..., :2].reshape(-1, 2), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    original = points.astype(float)
    area = _area(original[faces])
    # A vertical triangle has no area in plan, and its sides in plan are edges of walls.
    is_wall = np.repeat(area == 0, 3)
    edges = np.unique(sides[is_wall & (sides[:, 0] != sides[:, 1])], axis=0)
    moved = _move_onto_lines(original, edges, tolerance)
    return Alignment(points, _undo_reversals(original, moved, edges, faces[area != 0]) / 1000)


def _area(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the signed area [F] of triangles in plan [F, 3, 2]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _move_onto_lines(
    points: NDArray[np.float64], edges: NDArray[np.int64], tolerance: float
) -> NDArray[np.float64]:
    """Move each point onto the line of its edges, or to the intersection of the two longest lines that meet at it."""
    moved = points.copy()
    line = _lines(points[edges], edges, tolerance)
    if not (line >= 0).any():
        return moved
    middle, direction, length = _fit_lines(points[edges], line)
    ends = np.column_stack([edges.reshape(-1), np.repeat(line, 2)])
    ends = np.unique(ends[np.repeat(line, 2) >= 0], axis=0)
    for pairs in np.split(ends, np.flatnonzero(np.diff(ends[:, 0])) + 1):
        point = pairs[0, 0]
        first, *others = sorted(pairs[:, 1].tolist(), key=lambda number: -length[number])
        along = direction[first]
        step = along * ((points[point] - middle[first]) @ along)
        crossing = next((other for other in others if abs(_cross(along, direction[other])) > CROSSING), None)
        if crossing is not None:
            # Intersection of the two lines, by Cramer's rule.
            reach = _cross(middle[crossing] - middle[first], direction[crossing])
            step = along * reach / _cross(along, direction[crossing])
        target = middle[first] + step
        # If the angle is small, the intersection can be far from the corner.
        if np.hypot(*(target - points[point])) <= 2 * tolerance:
            moved[point] = target
    return moved


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _lines(segments: NDArray[np.float64], edges: NDArray[np.int64], tolerance: float) -> NDArray[np.int64]:
    """Index [E] of the line to which each edge belongs; -1 if the edge is not collinear with any other edge.

    Edges that share a corner are first joined into runs; then, nearby runs are joined into lines.
    """
    if not len(segments):
        return np.zeros(0, dtype=np.int64)
    run = _group(segments, _parallel(segments, _touching(edges)), tolerance)
    single = run < 0
    # Each remaining edge forms its own run.
    run[single] = run.max() + 1 + np.arange(single.sum())
    middle, direction, _ = _fit_lines(segments, run)
    ends = ((segments - middle[run][:, None]) @ direction[run][..., None])[..., 0]
    first, last = np.full(len(middle), np.inf), np.full(len(middle), -np.inf)
    np.minimum.at(first, run, ends.min(axis=1))
    np.maximum.at(last, run, ends.max(axis=1))
    runs = middle[:, None] + np.stack([first, last], axis=1)[..., None] * direction[:, None]
    # Pairs of runs with ends within reach of each other.
    near = KDTree(runs.reshape(-1, 2)).query_pairs(REACH, output_type="ndarray").reshape(-1, 2) // 2
    line = _group(runs, _parallel(runs, near), tolerance)
    # A run of several edges is a line even if no other run is collinear with it.
    alone = (line < 0) & (np.bincount(run) > 1)
    line[alone] = line.max() + 1 + np.arange(alone.sum())
    return line[run]


def _touching(edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs [P, 2] of edges that share a corner; each edge is also paired with itself."""
    order = np.argsort(edges.reshape(-1), kind="stable")
    degree = np.bincount(edges.reshape(-1))
    first = np.cumsum(degree) - degree
    pairs = degree**2
    corner = np.repeat(np.arange(len(degree)), pairs)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    return np.column_stack([order[first[corner] + k] // 2 for k in divmod(within, degree[corner])])


def _parallel(segments: NDArray[np.float64], pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """The pairs [P, 2] of different segments that are nearly parallel, each pair once."""
    direction = segments[:, 1] - segments[:, 0]
    direction /= np.hypot(*direction.T)[:, None]
    one, other = direction[pairs[:, 0]], direction[pairs[:, 1]]
    turn = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    kept = np.sort(pairs[(pairs[:, 0] != pairs[:, 1]) & (np.abs(turn) < TURN)], axis=1)
    return np.unique(kept, axis=0)


def _group(segments: NDArray[np.float64], pairs: NDArray[np.int64], tolerance: float) -> NDArray[np.int64]:
    """Index [S] of the line that each segment shares with other segments; -1 if there is no such line."""
    line = np.full(len(segments), -1)
    closeness, count = tolerance, 0
    # Short segments of an arc can form a chain that no line fits; these segments are grouped again with a smaller
    # tolerance.
    while len(pairs) and closeness > 1:
        pairs = pairs[_continues(segments, pairs, closeness)]
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(segments), len(segments)))
        _, group = connected_components(graph, directed=False)
        candidate = (np.bincount(group)[group] > 1) & (line < 0)
        if candidate.any():
            _, group = np.unique(np.where(candidate, group, -1), return_inverse=True)
            group = group.reshape(-1) - (not candidate.all())
            middle, direction, _ = _fit_lines(segments, group)
            distance = np.abs(_across(segments, middle[group], direction[group])).max(axis=1)
            bent = np.zeros(len(middle), dtype=bool)
            bent[group[candidate & (distance > tolerance)]] = True
            straight = candidate & ~bent[group]
            line[straight] = count + group[straight]
            count += len(middle)
        pairs, closeness = pairs[(line[pairs] < 0).all(axis=1)], closeness / 3
    line[line >= 0] = np.unique(line[line >= 0], return_inverse=True)[1]
    return line


def _continues(
    segments: NDArray[np.float64], pairs: NDArray[np.int64], closeness: float
) -> NDArray[np.bool_]:
    """Mask [P] of the pairs in which the shorter segment lies on the line of the longer segment."""
    direction = segments[:, 1] - segments[:, 0]
    length = np.hypot(*direction.T)
    direction /= length[:, None]
    one, other = pairs.T
    longer, shorter = np.where(length[one] >= length[other], (one, other), (other, one))
    distance = np.abs(_across(segments[shorter], segments[longer, 0], direction[longer]))
    return distance.max(axis=1) <= closeness


def _across(
    segments: NDArray[np.float64], middle: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Signed distances [n, 2] of the ends of segments [n, 2, 2] from lines, given by points and directions [n, 2]."""
    offset = segments - middle[:, None]
    return offset[..., 0] * direction[:, None, 1] - offset[..., 1] * direction[:, None, 0]


def _fit_lines(
    segments: NDArray[np.float64], line: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A point on each line, the line's direction (by total least squares), and the total length of its segments."""
    used = line >= 0
    ends, number = segments[used], np.repeat(line[used], 2)
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    weight, points = np.repeat(length, 2), ends.reshape(-1, 2)
    total = np.bincount(number, weight).astype(np.float64)
    middle = np.column_stack([np.bincount(number, weight * axis) for axis in points.T]) / total[:, None]
    x, y = (points - middle[number]).T
    xx, xy, yy = (np.bincount(number, weight * product) for product in (x * x, x * y, y * y))
    # Angle of the principal axis of the weighted second moments.
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return middle, np.column_stack([np.cos(angle), np.sin(angle)]), total


def _undo_reversals(
    points: NDArray[np.float64],
    moved: NDArray[np.float64],
    edges: NDArray[np.int64],
    level: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Move points back until no edge reverses or shrinks below half its length, and no level triangle is flipped."""
    result = moved.copy()
    before, area = points[edges[:, 1]] - points[edges[:, 0]], _area(points[level])
    while True:
        after = result[edges[:, 1]] - result[edges[:, 0]]
        shrunk = (before * after).sum(axis=1) < 0.5 * (before**2).sum(axis=1)
        reversed_ = _area(result[level]) * area <= 0
        wrong = np.unique(np.concatenate([edges[shrunk].reshape(-1), level[reversed_].reshape(-1)]))
        wrong = wrong[(result[wrong] != points[wrong]).any(axis=1)]
        if not len(wrong):
            return result
        result[wrong] = points[wrong]
