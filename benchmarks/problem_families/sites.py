"""Sites drawn from a seed: scenes, their materials, and antenna positions. `family.py` plants problems in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes import write_scene
from calibray.scenes.authoring import Segment, SurfaceMaterial, make_plan_scene
from coastal_district import Layout, district, scene_objects

Range = tuple[float, float]


@dataclass(frozen=True)
class MaterialRange:
    """Ranges from which the constants of a material are drawn.

    Attributes:
        relative_permittivity: Smallest and largest relative permittivity [1].
        conductivity: Smallest and largest conductivity at 4 GHz [S/m]; it is proportional to the carrier frequency.
        thickness: Smallest and largest thickness [m].
        scattering_coefficient: Smallest and largest scattering coefficient, if the surface scatters [1].
    """

    relative_permittivity: Range
    conductivity: Range
    thickness: Range
    scattering_coefficient: Range


MATERIALS: Final = {
    "concrete": MaterialRange((4.0, 8.0), (0.05, 0.2), (0.15, 0.4), (0.2, 0.5)),
    "brick": MaterialRange((3.0, 5.5), (0.01, 0.08), (0.1, 0.3), (0.2, 0.5)),
    "glass": MaterialRange((4.0, 8.0), (0.005, 0.04), (0.006, 0.03), (0.05, 0.2)),
    "soil": MaterialRange((2.5, 9.0), (0.02, 0.1), (0.5, 2.0), (0.1, 0.4)),
    "asphalt": MaterialRange((3.0, 7.0), (0.02, 0.1), (0.1, 0.5), (0.1, 0.3)),
    "plasterboard": MaterialRange((2.0, 4.0), (0.01, 0.05), (0.05, 0.13), (0.05, 0.2)),
    "wood": MaterialRange((1.6, 3.0), (0.005, 0.03), (0.03, 0.06), (0.05, 0.2)),
}


@dataclass(frozen=True)
class Site:
    """A scene with positions for links.

    Attributes:
        materials: Ranges for each material of the scene, by name.
        write: Function that writes the scene into a folder, and returns the XML file.
        tx: Transmitter of each link [n, 3], [m].
        rx: Receiver of each link [n, 3], [m].
        indoors: Whether waves pass through walls.
    """

    materials: Mapping[str, MaterialRange]
    write: Callable[[Path], Path]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    indoors: bool


def district_site(rng: np.random.Generator, links: int) -> Site:
    """Draw a few blocks of a town.

    Args:
        rng: Random generator.
        links: Number of links.

    Returns:
        The site.
    """
    layout = _layout(rng)
    buildings = district(int(rng.integers(2**31)), layout)
    walls, panes = rng.integers(1, 3, 2)
    group = {building.name: rng.integers(0, (walls, panes)).tolist() for building in buildings}
    wall_kinds = [("concrete", "brick")[rng.integers(2)] for _ in range(walls)]

    def write(folder: Path) -> Path:
        objects = scene_objects(
            buildings,
            lambda building: f"walls_{group[building.name][0]}",
            lambda building: f"panes_{group[building.name][1]}",
            layout,
        )
        return write_scene(folder, objects, {name: _PLAIN for name in materials})

    materials = {
        **{f"walls_{index}": MATERIALS[kind] for index, kind in enumerate(wall_kinds)},
        **{f"panes_{index}": MATERIALS["glass"] for index in range(panes)},
        "soil": MATERIALS["soil"],
        "asphalt": MATERIALS["asphalt"],
    }
    used = {f"walls_{wall}" for wall, _ in group.values()} | {f"panes_{pane}" for _, pane in group.values()}
    materials = {name: ranges for name, ranges in materials.items() if name in {*used, "soil", "asphalt"}}
    stations = np.array([_on_a_street(layout, rng) for _ in range(rng.integers(1, 4))])
    stations = np.column_stack([stations, rng.uniform(3.0, 12.0, len(stations))])
    tx = stations[rng.integers(0, len(stations), links)]
    rx = np.array([[*_stop(layout, position[:2], rng), rng.uniform(1.5, 3.0)] for position in tx])
    return Site(materials, write, tx, rx, indoors=False)


_PLAIN: Final = {"relative_permittivity": 5.0, "conductivity": 0.05, "thickness": 0.3}
"""Constants required in the scene file; the family replaces them."""

_REACH: Final = (40.0, 400.0)  # [m], from a transmitter to a receiver


def _layout(rng: np.random.Generator) -> Layout:
    """Streets 110 m to 260 m apart."""
    lines = []
    for _ in range(2):
        gaps = np.round(rng.uniform(110.0, 260.0, rng.integers(2, 5)))
        lines.append(np.concatenate([[0.0], np.cumsum(gaps)]) - np.round(gaps.sum() / 2))
    margin = 130.0
    extent = tuple(float(2.0 * (np.abs(line).max() + margin)) for line in lines)
    lowest = float(np.round(rng.uniform(10.0, 50.0)))
    columns, rows = len(lines[0]) + 1, len(lines[1]) + 1
    park = (int(rng.integers(columns)), int(rng.integers(rows)))
    return Layout(
        tuple(lines[0].tolist()),
        tuple(lines[1].tolist()),
        (extent[0], extent[1]),
        frozenset({park}),
        (lowest, lowest + 12.0),
        beach=False,
    )


def _on_a_street(layout: Layout, rng: np.random.Generator) -> tuple[float, float]:
    """A position on a roadway, within the outermost streets."""
    aside = float(rng.uniform(-6.0, 6.0))
    low, high = layout.streets[0], layout.streets[-1]
    if rng.random() < 0.5:
        return float(rng.choice(layout.avenues)) + aside, float(rng.uniform(low, high))
    low, high = layout.avenues[0], layout.avenues[-1]
    return float(rng.uniform(low, high)), float(rng.choice(layout.streets)) + aside


def _stop(layout: Layout, station: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float]:
    """A position on a street within reach of a transmitter; after 50 draws, the last one is used."""
    position = _on_a_street(layout, rng)
    for _ in range(50):
        if _REACH[0] <= float(np.hypot(*(np.array(position) - station))) <= _REACH[1]:
            break
        position = _on_a_street(layout, rng)
    return position


CEILING: Final = 3.0  # [m]
SILL: Final = 1.0  # [m], height of the lower edge of a window
DOOR: Final = (0.9, 2.1)  # [m], width and height

SURFACES: Final = {
    "outer": ("concrete", "brick"),
    "inner": ("plasterboard", "brick", "wood"),
    "door": ("wood",),
    "window": ("glass",),
    "floor": ("concrete",),
    "ceiling": ("concrete", "plasterboard"),
}
"""Materials that each type of surface may have."""


def office_site(rng: np.random.Generator, links: int) -> Site:
    """Draw an office floor.

    Args:
        rng: Random generator.
        links: Number of links.

    Returns:
        The site.
    """
    length, depth, corridor = rng.uniform(20.0, 45.0), rng.uniform(4.0, 7.0), rng.uniform(1.6, 2.6)
    width = 2.0 * depth + corridor
    segments = _plan(float(length), float(depth), float(corridor), rng)
    chosen = {kind: str(rng.choice(names)) for kind, names in SURFACES.items()}
    # Each type has a separate material, whose constants the family sets.
    types = {kind: SurfaceMaterial(f"{kind}_sheet", "concrete", 0.1) for kind in chosen}

    def write(folder: Path) -> Path:
        return make_plan_scene(segments, folder, types, merge=False).path

    def positions(count: int, low: float, high: float) -> np.ndarray:
        ends = np.array([[0.5, 0.5, low], [length - 0.5, width - 0.5, high]])
        return rng.uniform(ends[0], ends[1], (count, 3))

    stations = positions(int(rng.integers(1, 4)), 2.0, 2.7)
    tx = stations[rng.integers(0, len(stations), links)]
    materials = {f"{kind}_sheet": MATERIALS[name] for kind, name in chosen.items()}
    return Site(materials, write, tx, positions(links, 0.8, 1.6), indoors=True)


def _plan(length: float, depth: float, corridor: float, rng: np.random.Generator) -> list[Segment]:
    """The lines of the plan."""
    width = 2.0 * depth + corridor
    corners = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width), (0.0, 0.0)]
    segments = [Segment(start, end, "outer", 0.0, CEILING) for start, end in pairwise(corners)]
    for near, far in ((depth, 0.0), (depth + corridor, width)):
        segments.append(Segment((0.0, near), (length, near), "inner", 0.0, CEILING))
        rooms = int(rng.integers(3, max(4, int(length / 4.0)) + 1))
        walls = np.round(np.linspace(0.0, length, rooms + 1) + rng.uniform(-0.4, 0.4, rooms + 1), 2)
        for west, east in pairwise([0.0, *walls[1:-1].tolist(), length]):
            if east < length:
                segments.append(Segment((east, near), (east, far), "inner", 0.0, CEILING))
            door = round(float(rng.uniform(west + 0.3, east - DOOR[0] - 0.3)), 2)
            segments.append(Segment((door, near), (door + DOOR[0], near), "door", 0.0, DOOR[1]))
            pane = round(float(rng.uniform(0.3, 0.8)) * (east - west - 0.6), 2)
            left = round(west + (east - west - pane) / 2, 2)
            segments.append(Segment((left, far), (left + pane, far), "window", SILL, CEILING - 0.5))
    return segments
