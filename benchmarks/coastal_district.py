"""The coastal high-rise district: streets, buildings and ground like those of the paper's measurement area.

The real district (Golden Beach, Huangdao, Qingdao; section III of the paper) covers 2.1 km x 1.7 km. Its buildings are
60 m to 70 m high, made of concrete with glass windows, and stand on soil and asphalt. Its map is not published. This
district has the same extent, heights and materials; a seeded generator draws the rest. The sea is to the south.

All coordinates are multiples of 1/64 m. These coordinates are exact in 32-bit floats, so all panels of a wall lie in
exactly one plane, as the image method of the ray tracer requires.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes import Mesh, MeshObject, join_meshes

SEED: Final = 2026
EXTENT: Final = (2100.0, 1700.0)  # [m], east-west and north-south
AVENUES: Final = (-905.0, -650.0, -385.0, -120.0, 150.0, 420.0, 665.0, 915.0)
"""x coordinates of the centre lines of north-south streets [m]."""
STREETS: Final = (-690.0, -455.0, -215.0, 30.0, 265.0, 500.0, 735.0)
"""y coordinates of the centre lines of east-west streets [m]; the first is the coast road."""
STREET_HALF_WIDTH: Final = 17.0  # [m], from the centre line to the building line
ROADWAY_HALF_WIDTH: Final = (
    7.0  # [m], from the centre line to the kerb; the ground between kerb and building is soil
)
PARKS: Final = frozenset({(2, 4), (5, 2), (7, 5)})
"""Blocks without buildings, column and row."""
HEIGHTS: Final = (60.0, 70.0)  # [m]
BAND: Final = 1.5  # [m], height of the concrete above the topmost windows
MODULE: Final = 22.0  # [m], approximate length of a window bay and a pier together
LAMP_SPACING: Final = 45.0  # [m]
LAMP_HEIGHT: Final = 10.0  # [m]
LAMP_HALF_WIDTH: Final = 0.125  # [m]


@dataclass(frozen=True)
class Layout:
    """Streets and building heights of a district; the defaults are those of the paper's area.

    Attributes:
        avenues: x coordinates of the centre lines of north-south streets, ascending [m].
        streets: y coordinates of the centre lines of east-west streets, ascending [m].
        extent: Extent from west to east and from south to north [m].
        parks: Blocks without buildings, column and row.
        heights: Heights of the lowest and the highest building [m].
        beach: Whether the southernmost row of blocks has no buildings.
    """

    avenues: tuple[float, ...] = AVENUES
    streets: tuple[float, ...] = STREETS
    extent: tuple[float, float] = EXTENT
    parks: frozenset[tuple[int, int]] = PARKS
    heights: tuple[float, float] = HEIGHTS
    beach: bool = True


GOLDEN_BEACH: Final = Layout()
"""The layout of the demo."""


@dataclass(frozen=True)
class Building:
    """A building: a prism with window bays from the ground to a concrete band below the roof.

    Attributes:
        name: "b000", "b001", ...
        footprint: Corners, counter-clockwise, convex [n, 2], [m].
        height: Height [m].
        window_share: Share of glass in the length of a wall [1].
    """

    name: str
    footprint: NDArray[np.float64]
    height: float
    window_share: float


def district(seed: int = SEED, layout: Layout = GOLDEN_BEACH) -> tuple[Building, ...]:
    """Draw the buildings of the district, west to east and south to north; the seed does not change the streets."""
    rng = np.random.Generator(np.random.PCG64(seed))
    columns = _between(layout.avenues, layout.extent[0])
    rows = _between(layout.streets, layout.extent[1])[layout.beach :]  # the southernmost row is the beach
    footprints = [
        footprint
        for column, (west, east) in enumerate(columns)
        for row, (south, north) in enumerate(rows)
        if (column, row) not in layout.parks
        for footprint in _block((west, south, east, north), rng)
    ]
    return tuple(
        Building(
            f"b{index:03d}",
            footprint,
            float(_snapped(rng.uniform(*layout.heights))),
            float(rng.uniform(0.4, 0.6)),
        )
        for index, footprint in enumerate(footprints)
    )


def scene_objects(
    buildings: Iterable[Building],
    concrete: Callable[[Building], str] = lambda building: "concrete",
    glass: Callable[[Building], str] = lambda building: "glass",
    layout: Layout = GOLDEN_BEACH,
) -> list[MeshObject]:
    """The district as objects of a scene, one per material.

    The objects are structures, windows, ground (soil) and streets (asphalt); structures and windows of several
    materials are numbered. The arguments give the names of each building's concrete and glass.
    """
    structures: dict[str, list[Mesh]] = {}
    windows: dict[str, list[Mesh]] = {}
    for building in buildings:
        structure, bays = building_meshes(building)
        structures.setdefault(concrete(building), []).append(structure)
        windows.setdefault(glass(building), []).append(bays)
    soil, asphalt = _ground(layout)
    return [
        *_by_material("structures", structures),
        *_by_material("windows", windows),
        MeshObject("ground", "soil", soil),
        MeshObject("streets", "asphalt", asphalt),
    ]


def building_meshes(building: Building) -> tuple[Mesh, Mesh]:
    """The surface of a building: concrete (piers, band, roof) and glass (bays), without gap or overlap.

    A wall consists of alternating piers (concrete) and bays (glass), with a pier at both ends. Corners, band and roof
    are connected concrete, so that the ray tracer finds the wedges for diffraction.
    """
    outline, is_window = _outline(building)
    rings = _rings(outline, (0.0, building.height - BAND, building.height))
    count = len(outline)
    start, end = np.arange(count), np.roll(np.arange(count), -1)
    apex = [*_snapped(outline.mean(axis=0)), building.height]
    walls = _quads(start, end, count)
    roof = np.column_stack([start + 2 * count, end + 2 * count, np.full(count, 3 * count)])
    concrete = [walls[~is_window].reshape(-1, 3), walls.reshape(-1, 3) + count, roof]
    return (
        join_meshes([Mesh(np.vstack([rings, apex]), np.concatenate(concrete))]),
        join_meshes([Mesh(rings, walls[is_window].reshape(-1, 3))]),
    )


def lamp_positions() -> NDArray[np.float64]:
    """Positions of the lamp posts [n, 2], [m]: along the kerbs, on alternating sides, none at a crossing."""
    kerb = ROADWAY_HALF_WIDTH + 0.5
    positions = []
    for lines, across, length in ((AVENUES, STREETS, EXTENT[1]), (STREETS, AVENUES, EXTENT[0])):
        along = np.arange(-length / 2 + LAMP_SPACING / 2, length / 2, LAMP_SPACING)
        along = along[np.abs(along[:, None] - np.array(across)).min(axis=1) > STREET_HALF_WIDTH]
        for line in lines:
            side = line + kerb * (-1.0) ** np.arange(len(along))
            positions.append(np.column_stack([side, along] if lines is AVENUES else [along, side]))
    return np.concatenate(positions)


def lamp_posts() -> Mesh:
    """The lamp posts as square columns."""
    corner = np.arange(4)
    sides = _quads(corner, np.roll(corner, -1), 4).reshape(-1, 3)
    faces = np.concatenate([sides, [[4, 5, 6], [4, 6, 7]]])
    corners = LAMP_HALF_WIDTH * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return join_meshes(
        Mesh(_rings(position + corners, (0.0, LAMP_HEIGHT)), faces) for position in lamp_positions()
    )


def inside(building: Building, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points in plan [n, 2], [m], are inside a building's footprint or on its outline [n]."""
    edge = np.roll(building.footprint, -1, axis=0) - building.footprint
    to_point = np.asarray(points)[:, None, :] - building.footprint
    left_of = edge[:, 0] * to_point[..., 1] - edge[:, 1] * to_point[..., 0] >= 0.0
    return np.asarray(left_of.all(axis=1))


def _between(lines: Sequence[float], length: float) -> list[tuple[float, float]]:
    """The ranges between streets, from one border of the district to the opposite border [m]."""
    return list(pairwise(_edges(lines, STREET_HALF_WIDTH, length)))[::2]


def _edges(lines: Sequence[float], half_width: float, length: float) -> list[float]:
    """The border of the district, both edges of every street, and the opposite border [m]."""
    return [-length / 2, *(line + side for line in lines for side in (-half_width, half_width)), length / 2]


def _block(bounds: tuple[float, float, float, float], rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Footprints of the buildings of a block (west, south, east, north), with the block's corners cut off.

    The cut corners, common in Chinese and Spanish cities, reflect waves into crossing streets.
    """
    west, south, east, north = bounds
    footprints = []
    for x_low, x_high, from_street, to_street in _lots(west, east, rng):
        for y_low, y_high, up_from_street, up_to_street in _lots(south, north, rng):
            setback = _snapped(rng.uniform(0.0, 4.0, 4))
            cut = _snapped(rng.uniform(8.0, 14.0))
            x = x_low + setback[0] * from_street, x_high - setback[2] * to_street
            y = y_low + setback[1] * up_from_street, y_high - setback[3] * up_to_street
            corners = (  # counter-clockwise: position, whether the block ends here, steps to both ends of the cut
                ((x[0], y[0]), from_street and up_from_street, ((0.0, 1.0), (1.0, 0.0))),
                ((x[1], y[0]), to_street and up_from_street, ((-1.0, 0.0), (0.0, 1.0))),
                ((x[1], y[1]), to_street and up_to_street, ((0.0, -1.0), (-1.0, 0.0))),
                ((x[0], y[1]), from_street and up_to_street, ((1.0, 0.0), (0.0, -1.0))),
            )
            points = [
                np.array(corner) + cut * np.array(step)
                for corner, is_cut, steps in corners
                for step in (steps if is_cut else ((0.0, 0.0),))
            ]
            footprints.append(np.array(points))
    return footprints


def _lots(low: float, high: float, rng: np.random.Generator) -> list[tuple[float, float, bool, bool]]:
    """The lots along one side of a block: both ends [m], and whether each faces a street."""
    if high - low < 140.0:
        return [(low, high, True, True)]
    half_gap = float(_snapped(rng.uniform(8.0, 16.0)))
    middle = float(_snapped((low + high) / 2 + rng.uniform(-12.0, 12.0)))
    return [(low, middle - half_gap, True, False), (middle + half_gap, high, False, True)]


def _outline(building: Building) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The footprint with the ends of all panels [n, 2], [m], and which panel is a window [n]."""
    points: list[NDArray[np.float64]] = []
    is_window: list[bool] = []
    for start, end in pairwise([*building.footprint, building.footprint[0]]):
        bays = max(1, round(float(np.hypot(*(end - start))) / MODULE))
        bay = building.window_share / bays
        pier = (1.0 - building.window_share) / (bays + 1)
        for share in np.cumsum([0.0, *([pier, bay] * bays)]):
            points.append(start + _snapped((end - start) * share))
        is_window += [False, True] * bays + [False]
    return np.array(points), np.array(is_window)


def _rings(outline: NDArray[np.float64], levels: Sequence[float]) -> NDArray[np.float64]:
    """The outline repeated at every level [levels * n, 3], [m]."""
    return np.concatenate([np.column_stack([outline, np.full(len(outline), level)]) for level in levels])


def _quads(start: NDArray[np.int64], end: NDArray[np.int64], rise: int) -> NDArray[np.int64]:
    """Two triangles per panel between a ring of vertices and the next one above it [n, 2, 3]."""
    first = np.column_stack([start, end, end + rise])
    second = np.column_stack([start, end + rise, start + rise])
    return np.stack([first, second], axis=1)


def _ground(layout: Layout) -> tuple[Mesh, Mesh]:
    """The plane z = 0 over the whole extent: soil, and the asphalt of the roadways."""
    x = _edges(layout.avenues, ROADWAY_HALF_WIDTH, layout.extent[0])
    y = _edges(layout.streets, ROADWAY_HALF_WIDTH, layout.extent[1])
    vertices = np.array([[east, north, 0.0] for north in y for east in x])
    column, row = (index.ravel() for index in np.meshgrid(np.arange(len(x) - 1), np.arange(len(y) - 1)))
    corner = row * len(x) + column
    cells = _quads(corner, corner + 1, len(x))
    is_roadway = (column % 2 == 1) | (row % 2 == 1)
    return (
        join_meshes([Mesh(vertices, cells[~is_roadway].reshape(-1, 3))]),
        join_meshes([Mesh(vertices, cells[is_roadway].reshape(-1, 3))]),
    )


def _by_material(name: str, meshes: dict[str, list[Mesh]]) -> list[MeshObject]:
    several = len(meshes) > 1
    return [
        MeshObject(f"{name}_{index}" if several else name, material, join_meshes(meshes[material]))
        for index, material in enumerate(sorted(meshes))
    ]


def _snapped(value: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Lengths rounded to 1/64 [m]."""
    return np.round(np.asarray(value) * 64.0) / 64.0
