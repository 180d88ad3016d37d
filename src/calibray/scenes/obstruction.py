"""Obstruction of links by buildings and regions of extra loss, and link columns computed from the scene.

The straight line between the ends of a link can pass through buildings, over roofs and through walls. Buildings extend
from the ground to their roofs, so a line is inside a building wherever a roof is above the line. All lengths are
computed from the points at which the line crosses the scene's triangles, in plan for roofs and in three dimensions for
walls. Regions of extra loss, such as trees, are vertical prisms over polygons, through which rays pass undeflected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements import Measurements
from calibray.scenes.scene import Scene
from calibray.scenes.triangles import BATCH, LEVEL, Triangles, read_triangles, vertical_crossings
from calibray.support.lazy_imports import library

STEP: Final = 5.0
"""Spacing of the points at which a line's height above ground is computed [m]. With this spacing, the path length
through a wood on hills 50 m high has an error of 0.1 m."""

LINES: Final = 5000
"""Maximum number of lines processed at once; each line can have hundreds of steps."""


@dataclass(frozen=True, eq=False)
class Region:
    """Vertical prisms over polygons; a length inside overlapping prisms counts once.

    Attributes:
        outline: Shapely polygons [n] in the scene's frame [m].
        bottom: Height of the bottom of each prism [n], [m].
        top: Height of the top of each prism [n], [m].
        ground: Function that returns the height of the ground [k], [m], at x and y [k], [m], or NaN where there is no
            ground. The heights of the prisms are measured from this ground or, if `ground` is None, from z = 0.
    """

    outline: NDArray[Any]
    bottom: NDArray[np.float64]
    top: NDArray[np.float64]
    ground: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]] | None = None

    def length_inside(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Length [k], [m], of the part inside the region of each straight line from `start` to `end` [k, 3], [m].

        Raises:
            InputError: shapely is not installed.

        Example:
            >>> import shapely
            >>> belt = Region(np.array([shapely.box(10, -5, 30, 5)]), np.zeros(1), np.full(1, 8.0))
            >>> start, end = np.array([[0, 0, 2.0], [0, 0, 9.0]]), np.array([[40, 0, 2.0], [40, 0, 9.0]])
            >>> belt.length_inside(start, end).tolist()
            [20.0, 0.0]
        """
        # Over hilly ground, each line is divided into many steps, so lines are processed in batches to limit memory
        # use.
        parts = [self._lengths(start[k : k + LINES], end[k : k + LINES]) for k in range(0, len(start), LINES)]
        return np.concatenate([np.zeros(0), *parts])

    def _lengths(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        shapely = library("shapely", "scenes")
        total = np.zeros(len(start))
        lines = shapely.linestrings(np.stack([start[:, :2], end[:, :2]], axis=1))
        line, prism = shapely.STRtree(self.outline).query(lines, predicate="intersects")
        low, high = np.zeros(len(line)), np.ones(len(line))
        if self.ground is None:
            low, high = _between(start[line, 2], end[line, 2], self.bottom[prism], self.top[prism])
        # Lines above or below a prism are dropped before the expensive intersection in plan.
        near = high > low
        line, prism, low, high = line[near], prism[near], low[near], high[near]
        step = (end - start)[line]
        plan = np.hypot(step[:, 0], step[:, 1])
        upright = plan < 1e-6
        spans = [np.column_stack([line, low, high, prism])[upright]]
        sloping = np.flatnonzero(~upright)
        parts, of = shapely.get_parts(
            shapely.intersection(lines[line[sloping]], self.outline[prism[sloping]]), return_index=True
        )
        piece = shapely.get_type_id(parts) == 1  # a line that only touches a corner gives a point
        parts, of = parts[piece], sloping[of[piece]]
        ends = np.stack([shapely.get_coordinates(shapely.get_point(parts, k)) for k in (0, -1)], axis=1)
        # Fractions of the line at which the parts inside a prism begin and end, by projection in plan.
        away = ((ends - start[line[of], None, :2]) * step[of, None, :2]).sum(axis=2) / plan[of, None] ** 2
        away = np.clip(np.sort(away, axis=1), low[of, None], high[of, None])
        spans.append(np.column_stack([line[of], away, prism[of]])[away[:, 1] > away[:, 0]])
        for number, lower, upper in united(self._over_ground(np.concatenate(spans), start, end)):
            np.add.at(total, number, upper - lower)
        return total * np.linalg.norm(end - start, axis=1)

    def _over_ground(
        self, spans: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The parts of spans (line, lower, upper, prism) inside prisms over uneven ground, computed step by step."""
        if self.ground is None:
            return spans
        step = (end - start)[spans[:, 0].astype(np.int64)]
        count = np.ceil((spans[:, 2] - spans[:, 1]) * np.hypot(step[:, 0], step[:, 1]) / STEP)
        count = np.maximum(count, 1).astype(np.int64)
        span = np.repeat(np.arange(len(spans)), count)
        number = np.arange(len(span)) - np.repeat(np.cumsum(count) - count, count)
        line, lower, upper, prism = spans[span].T
        line, prism = line.astype(np.int64), prism.astype(np.int64)
        share = np.array([lower + (upper - lower) * (number + k) / count[span] for k in (0, 1)])
        x, y, z = np.moveaxis(start[line] + share[..., None] * (end - start)[line], -1, 0)
        first, last = z - self.ground(x.ravel(), y.ravel()).reshape(z.shape)
        low, high = _between(first, last, self.bottom[prism], self.top[prism])
        length = share[1] - share[0]
        return np.column_stack([line, share[0] + low * length, share[0] + high * length])[high > low]


def united(
    spans: NDArray[np.float64],
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
    """Merge overlapping spans (line, lower, upper, ...), and yield the line and both ends of each merged span."""
    count = len(spans)
    if not count:
        return
    event = np.concatenate([spans[:, [0, 1]], spans[:, [0, 2]]])
    change = np.repeat([1, -1], count)
    # Where one span ends and another begins, the beginning is sorted first, so that the two spans are merged.
    order = np.lexsort((-change, event[:, 1], event[:, 0]))
    depth = np.cumsum(change[order])
    begins = (depth == 1) & (change[order] == 1)
    ends = depth == 0
    line = event[order][begins, 0].astype(np.int64)
    yield line, event[order][begins, 1], event[order][ends, 1]


def _between(
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    bottom: NDArray[np.float64],
    top: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The part of each line between two heights, as two fractions [k]; the part is empty if the first is larger."""
    rise = last - first
    # A level line is between the heights along its whole length or nowhere.
    level = np.abs(rise) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.sort([(bottom - first) / rise, (top - first) / rise], axis=0)
    inside = (first > bottom) & (first < top)
    low = np.where(level, 0.0, np.clip(shares[0], 0.0, 1.0))
    high = np.where(level, np.where(inside, 1.0, 0.0), np.clip(shares[1], 0.0, 1.0))
    return low, high


OUT_OF_SIGHT: Final = "out_of_sight"
WALLS: Final = "walls_crossed"

OBSTACLES: Final = (OUT_OF_SIGHT, WALLS, "obstruction_m", "knife_edge_db")
"""Link columns computed from a scene: whether the line of sight is blocked, the number of walls that the straight line
between the ends crosses, the length of this line inside buildings [m], and the knife-edge diffraction loss of the
dominant roof edge [dB]."""

SAME_CROSSING: Final = 1e-3
"""Distance below which two crossings count as one, for example on an edge that two triangles share [m]."""

CLEAR: Final = -0.78
"""Fresnel parameter at or below which an edge causes no loss (ITU-R P.526-15, section 4.1)."""


@dataclass(frozen=True, eq=False)
class Obstruction:
    """Obstacles on the straight lines between the ends of links.

    Attributes:
        length_m: Length inside buildings [n], [m].
        walls: Number of walls crossed [n].
        clearance: Largest Fresnel parameter of a roof edge at a wavelength of 1 m [n]; -inf for a line that crosses no
            roof.
        other_floor: Mask [n] of the links with a floor that spans the scene between their ends.
    """

    length_m: NDArray[np.float64]
    walls: NDArray[np.int64]
    clearance: NDArray[np.float64]
    other_floor: NDArray[np.bool_]

    def columns(self, wavelength: NDArray[np.float64] | float) -> dict[str, NDArray[np.float64]]:
        """The columns listed in `OBSTACLES` [n], keyed by name, for one wavelength [m], or one for each link [n]."""
        values = (self.out_of_sight, self.walls, self.length_m, self.knife_edge_db(wavelength))
        return {name: value.astype(np.float64) for name, value in zip(OBSTACLES, values, strict=True)}

    @property
    def out_of_sight(self) -> NDArray[np.bool_]:
        """Mask [n] of the links without line of sight: a wall, a roof or a floor is between the ends."""
        return (self.length_m > 0) | (self.walls > 0) | self.other_floor

    def knife_edge_db(self, wavelength: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Knife-edge diffraction loss of the dominant roof edge [n], [dB], according to ITU-R P.526-15 equation 31.

        The wavelength [m] is one value for all links, or one value for each link [n].
        """
        parameter = self.clearance / np.sqrt(wavelength)
        # The bound also replaces -inf, the clearance of lines that cross no roof, for which the equation is undefined.
        above = np.maximum(parameter, CLEAR) - 0.1
        loss_db = 6.9 + 20 * np.log10(np.sqrt(above**2 + 1) + above)
        return np.where(parameter > CLEAR, loss_db, 0.0)


def obstruction(triangles: Triangles, start: NDArray[np.float64], end: NDArray[np.float64]) -> Obstruction:
    """Compute the obstruction of links with ends [n, 3], [m]; ground blocks a link only as a floor between its ends.

    Example:
        A roof 10 m high over the square from (0, 0) to (10, 10) m, and one wall at x = 0:

        >>> vertex = np.array([[0, 0, 10], [10, 0, 10], [10, 10, 10], [0, 10, 10], [0, 0, 0], [0, 10, 0.0]])
        >>> face = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [3, 5, 4]])
        >>> box = Triangles(vertex, face, np.zeros(4, int), np.zeros(4, bool))
        >>> found = obstruction(box, np.array([[-5, 3, 2.0]]), np.array([[15, 3, 2.0]]))
        >>> found.length_m.tolist(), found.walls.tolist()
        ([10.0], [1])
    """
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    obstacles, normal = triangles.corners[~triangles.ground], triangles.normal[~triangles.ground]
    area = np.linalg.norm(normal, axis=1)
    level = np.abs(normal[:, 2]) > LEVEL * area
    length, clearance = np.zeros(len(start)), np.full(len(start), -np.inf)
    walls = np.zeros(len(start), dtype=np.int64)
    # Lines with a common end are sorted by azimuth; the ends with fewer distinct positions are used as origins.
    swap = len(np.unique(end[:, :2], axis=0)) < len(np.unique(start[:, :2], axis=0))
    first, last = (end, start) if swap else (start, end)
    roofs, sides = obstacles[level & (area > 0)], obstacles[~level & (area > 0)]
    spans: list[NDArray[np.float64]] = []
    for line, face in _pairs(first, last, roofs):
        below, parameter = _under(first[line], last[line], roofs[face])
        np.maximum.at(clearance, line, parameter)
        # Roofs below the line give a clearance but no span.
        inside = below[:, 1] > below[:, 0]
        spans.append(np.column_stack([line.astype(np.float64), below])[inside])
    # A length below several level surfaces, such as the roof and floors of one building, counts once.
    for line, lower, upper in united(np.concatenate([np.zeros((0, 3)), *spans])):
        np.add.at(length, line, upper - lower)
    length *= np.linalg.norm(end - start, axis=1)
    crossings = [
        np.column_stack([line, distance])[np.isfinite(distance)]
        for line, face in _pairs(first, last, sides)
        for distance in (crossing(first[line], last[line], sides[face]),)
    ]
    crossed = np.concatenate([np.zeros((0, 2)), *crossings])
    # Sort by line, then by distance.
    crossed = crossed[np.lexsort(crossed.T[::-1])]
    separate = np.ones(len(crossed), dtype=bool)
    separate[1:] = (np.diff(crossed[:, 0]) > 0) | (np.diff(crossed[:, 1]) > SAME_CROSSING)
    np.add.at(walls, crossed[separate, 0].astype(np.int64), 1)
    return Obstruction(length, walls, clearance, _on_other_floor(triangles, start, end))


def _on_other_floor(
    triangles: Triangles, start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Mask [n] of the links of which one end has fewer ground sheets below it and more above it than the other end.

    If one count is equal at both ends, for example where a floor has a hole, the result is False.
    """
    points, index = np.unique(np.concatenate([start, end]), axis=0, return_inverse=True)
    below, above = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
    for _, point, height in vertical_crossings(triangles.corners[triangles.ground], points):
        is_above = height > points[point, 2]
        np.add.at(above, point, is_above)
        np.add.at(below, point, ~is_above)
    first, last = np.split(index.reshape(-1), 2)
    higher, fewer = below[last] - below[first], above[last] - above[first]
    return higher * fewer < 0


def _pairs(
    first: NDArray[np.float64], last: NDArray[np.float64], corners: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Indices of lines and triangles that may cross in plan, in batches.

    The azimuth of such a line lies between the azimuths of the triangle's corners.
    """
    if not len(corners):
        return
    origins, of = np.unique(first[:, :2], axis=0, return_inverse=True)
    step = last[:, :2] - first[:, :2]
    azimuth = np.arctan2(step[:, 1], step[:, 0])
    for number, origin in enumerate(origins):
        lines = np.flatnonzero(of.reshape(-1) == number)
        lines = lines[np.argsort(azimuth[lines], kind="stable")]
        sorted_azimuth = azimuth[lines]
        # The azimuths are repeated with one full turn added, so that a range of azimuths across 180 degrees is
        # contiguous.
        twice = np.concatenate([sorted_azimuth, sorted_azimuth + 2 * np.pi])
        relative = corners[:, :, :2] - origin
        direction = np.arctan2(relative[..., 1], relative[..., 0])
        # Azimuths are relative to the first corner, in (-pi, pi], so that a range across 180 degrees stays contiguous.
        turn = np.angle(np.exp(1j * (direction - direction[:, :1])))
        low, high = direction[:, 0] + turn.min(axis=1), direction[:, 0] + turn.max(axis=1)
        around = high - low > np.pi * (1 - 1e-9)  # the origin is inside the triangle or on one of its sides
        low, high = np.where(around, -np.pi, low) - 1e-12, np.where(around, np.pi, high) + 1e-12
        # `twice` covers -pi to 3 pi; ranges that begin below -pi are shifted by a full turn.
        shift = np.where(low < -np.pi, 2 * np.pi, 0.0)
        begin = np.searchsorted(twice, low + shift, "left")
        count = np.searchsorted(twice, high + shift, "right") - begin
        count = np.where(around, len(lines), count)
        begin = np.where(around, 0, begin)
        total = np.cumsum(count)
        face = 0
        while face < len(corners):
            done = total[face - 1] if face else 0
            until = max(face + 1, int(np.searchsorted(total, done + BATCH, "right")))
            number_of = count[face:until]
            index = np.repeat(np.arange(face, until), number_of)
            within = np.arange(len(index)) - np.repeat(np.cumsum(number_of) - number_of, number_of)
            yield lines[(begin[index] + within) % len(lines)], index
            face = until


def _under(
    first: NDArray[np.float64], last: NDArray[np.float64], corners: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parts [n, 2] of lines below level triangles, as fractions of the line, and Fresnel parameters of the edges.

    In plan, the line is clipped at the three sides of the triangle.
    """
    step = last - first
    low, high = np.zeros(len(first)), np.ones(len(first))
    orientation = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        # Clip the line at the three sides of the triangle in plan (Cyrus and Beck); `sign` makes distances inside the
        # triangle positive.
        for k in range(3):
            side = corners[:, (k + 1) % 3] - corners[:, k]
            sign = np.sign(orientation)
            distance = sign * _cross(side, first - corners[:, k])  # inside where positive
            slope = sign * _cross(side, step)
            share = -distance / slope
            low = np.where(slope > 0, np.maximum(low, share), low)
            high = np.where(slope < 0, np.minimum(high, share), high)
            # A line that is parallel to a side and outside it misses the triangle.
            high = np.where((slope == 0) & (distance < 0), -1.0, high)
        over = high > low
        # Height of the triangle's plane above the line; this height varies linearly along the line.
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        ends = np.stack([low, high])
        point = first + ends[..., None] * step
        offset = point[..., :2] - corners[:, 0, :2]
        roof = corners[:, 0, 2] - (normal[:, :2] * offset).sum(axis=-1) / normal[:, 2]
        above = np.where(over, roof - point[..., 2], -1.0)
        # Fraction at which the line passes through the plane; it is used only where the signs at the two ends differ.
        zero = low + (high - low) * above[0] / (above[0] - above[1])
        lower = np.where(above[0] > 0, low, zero)
        upper = np.where(above[1] > 0, high, zero)
        # Fresnel parameter h sqrt(2 / lambda (1 / d1 + 1 / d2)), ITU-R P.526-15 equation 26, for a wavelength of 1 m
        length = np.linalg.norm(step, axis=1)
        # A roof directly above an antenna would give an infinite parameter.
        away = np.clip(ends, 1e-6, 1 - 1e-6)
        parameter = above * np.sqrt(2 / length * (1 / away + 1 / (1 - away)))
    below = over & ((above[0] > 0) | (above[1] > 0))
    spans = np.where(below[:, None], np.column_stack([lower, upper]), 0.0)
    return spans, np.where(over, parameter.max(axis=0), -np.inf)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def crossing(
    first: NDArray[np.float64], last: NDArray[np.float64], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance [n], [m], from each line's first end to its crossing with its triangle; NaN without a crossing.

    Intersection with the triangle in barycentric coordinates u and v (Moeller and Trumbore, J. Graphics Tools 2(1),
    1997). For a line parallel to the triangle, the division by zero yields NaN, which fails all comparisons.
    """
    step = last - first
    one, other = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    # u, v and the fraction of the line all follow from triple products.
    across = np.cross(step, other)
    offset = first - corners[..., 0, :]
    normal = np.cross(offset, one)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (across * one).sum(axis=-1)
        u, v = (offset * across).sum(axis=-1) * inverse, (step * normal).sum(axis=-1) * inverse
        share = (other * normal).sum(axis=-1) * inverse
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (share > 0) & (share < 1)
    return np.where(hit, share * np.linalg.norm(step, axis=-1), np.nan)


REGION: Final = "region_m"
"""Column with the length of the straight line inside regions of extra loss [m]."""

CLUTTER: Final = "clutter_db"
"""Column with the clutter loss at one end according to ITU-R P.2108 [dB]."""

CLUSTER: Final = "cluster"
"""Column with the label of the grid square that contains the receiver, for grouping links."""

COLUMNS: Final = (*OBSTACLES, REGION, CLUTTER)
"""The numeric columns that are computed from the scene and the positions."""


def with_obstruction(
    links: Measurements,
    scene: Scene,
    frequency: float,
    regions: Mapping[str, Region],
    *,
    clutter: bool = False,
    cluster_m: float | None = None,
) -> Measurements:
    """Add to links the columns computed from the scene; existing columns with these names are kept.

    Args:
        links: The links.
        scene: The scene.
        frequency: Carrier frequency [Hz], used if the links do not state a frequency.
        regions: The regions of extra loss by name; `REGION` is added only if there are regions.
        clutter: Whether to add `CLUTTER`.
        cluster_m: Side length [m] of the grid squares for `CLUSTER`; the origin is a corner of the grid. None omits the
            column.

    Raises:
        InputError: A carrier frequency is outside the range of the clutter loss.
    """
    carrier = frequency if links.frequency is None else links.frequency
    added: dict[str, NDArray[np.float64] | NDArray[np.str_]] = {}
    if any(name not in links.frame for name in OBSTACLES):
        obstacles = obstruction(read_triangles(scene), links.tx, links.rx)
        added |= obstacles.columns(speed_of_light / np.asarray(carrier))
    if regions:
        added[REGION] = np.sum([item.length_inside(links.tx, links.rx) for item in regions.values()], axis=0)
    if clutter:
        added[CLUTTER] = clutter_loss_db(links.distance, carrier)
    if cluster_m is not None:
        added[CLUSTER] = cluster_labels(links.rx, cluster_m)
    missing = {name: values for name, values in added.items() if name not in links.frame}
    return replace(links, table=links.table.assign(**missing)) if missing else links


def cluster_labels(position: NDArray[np.float64], side: float) -> NDArray[np.str_]:
    """Label "column row" [n] of the grid square of each position [n, 3], [m]; the squares are `side` [m] wide."""
    return np.array([f"{column} {row}" for column, row in np.floor(position[:, :2] / side).astype(int)])


SHORTEST: Final = 250.0
"""Minimum path length for which ITU-R P.2108 specifies the clutter loss at one end [m]."""

CARRIERS: Final = (0.5e9, 67e9)
"""Range of carrier frequencies that ITU-R P.2108 covers [Hz]."""


def clutter_loss_db(distance: ArrayLike, frequency: ArrayLike) -> NDArray[np.float64]:
    """Median loss in urban or suburban clutter at one end [n], [dB], according to ITU-R P.2108-1 section 3.2.

    `distance` is the length of each path [n], [m]; `frequency` is one carrier frequency for all paths, or one frequency
    for each path [n], [Hz]. The loss is 0 for paths shorter than `SHORTEST`, which the recommendation does not cover.

    Raises:
        InputError: A carrier frequency is outside `CARRIERS`.

    Example:
        >>> clutter_loss_db([100.0, 1000.0, 5000.0], 3.5e9).round(2).tolist()
        [0.0, 30.11, 30.38]
    """
    carrier_ghz = np.asarray(frequency, dtype=float) / 1e9
    low, high = CARRIERS
    if not ((carrier_ghz * 1e9 >= low) & (carrier_ghz * 1e9 <= high)).all():
        wrong = carrier_ghz[(carrier_ghz * 1e9 < low) | (carrier_ghz * 1e9 > high)].reshape(-1)[0]
        raise InputError(
            f"clutter_db: ITU-R P.2108 section 3.2 covers {low / 1e9:g} to {high / 1e9:g} GHz, not {wrong:g} GHz; "
            "omit this nuisance"
        )
    length_km = np.asarray(distance, dtype=float) / 1e3
    # Beyond 2 km, the loss equals the loss at 2 km (equation 6).
    capped_km = np.clip(length_km, SHORTEST / 1e3, 2.0)
    long_db = -2 * np.log10(10 ** (-5 * np.log10(carrier_ghz) - 12.5) + 10**-16.5)  # equation 4
    short_db = 32.98 + 23.9 * np.log10(capped_km) + 3 * np.log10(carrier_ghz)  # equation 5
    median_db = -5 * np.log10(
        10 ** (-0.2 * long_db) + 10 ** (-0.2 * short_db)
    )  # equation 3, for 50 % of locations
    return np.where(length_km < SHORTEST / 1e3, 0.0, median_db)
