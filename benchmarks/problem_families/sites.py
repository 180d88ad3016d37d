"""Places to calibrate in, drawn from a seed: what stands there, of what, and where antennas may be put.

A site knows no carrier, tracer or measurement; `family.py` plants a problem in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenarios.district import Layout, district, scene_objects
from calibray.scenes import write_scene

Range = tuple[float, float]


@dataclass(frozen=True)
class Stuff:
    """What a surface may be made of: ranges that a truth is drawn from.

    Attributes:
        relative_permittivity: Least and most [1].
        conductivity: Least and most at 4 GHz [S/m]; it grows in proportion to the carrier.
        thickness: Least and most [m].
        scattering_coefficient: Least and most, where the surface scatters [1].
    """

    relative_permittivity: Range
    conductivity: Range
    thickness: Range
    scattering_coefficient: Range


STUFFS: Final = {
    "concrete": Stuff((4.0, 8.0), (0.05, 0.2), (0.15, 0.4), (0.2, 0.5)),
    "brick": Stuff((3.0, 5.5), (0.01, 0.08), (0.1, 0.3), (0.2, 0.5)),
    "glass": Stuff((4.0, 8.0), (0.005, 0.04), (0.006, 0.03), (0.05, 0.2)),
    "soil": Stuff((2.5, 9.0), (0.02, 0.1), (0.5, 2.0), (0.1, 0.4)),
    "asphalt": Stuff((3.0, 7.0), (0.02, 0.1), (0.1, 0.5), (0.1, 0.3)),
    "plasterboard": Stuff((2.0, 4.0), (0.01, 0.05), (0.05, 0.13), (0.05, 0.2)),
    "wood": Stuff((1.6, 3.0), (0.005, 0.03), (0.03, 0.06), (0.05, 0.2)),
}


@dataclass(frozen=True)
class Site:
    """A place to calibrate in.

    Attributes:
        stuffs: What each material of its scene is made of, by the material's name.
        write: Writes its scene into a folder, and answers with the XML file.
        tx: Where the transmitter of each link may stand [n, 3], [m].
        rx: Where its receiver may stand [n, 3], [m].
        indoors: Whether waves pass through its walls.
    """

    stuffs: Mapping[str, Stuff]
    write: Callable[[Path], Path]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    indoors: bool


def district_site(rng: np.random.Generator, links: int) -> Site:
    """Draw some blocks of a town.

    Args:
        rng: Where the randomness comes from.
        links: Number of links.

    Returns:
        The site.
    """
    layout = _layout(rng)
    buildings = district(int(rng.integers(2**31)), layout)
    walls, panes = rng.integers(1, 3, 2)
    group = {building.name: rng.integers(0, (walls, panes)).tolist() for building in buildings}
    wall_stuffs = [("concrete", "brick")[rng.integers(2)] for _ in range(walls)]

    def write(folder: Path) -> Path:
        objects = scene_objects(
            buildings,
            lambda building: f"walls_{group[building.name][0]}",
            lambda building: f"panes_{group[building.name][1]}",
            layout,
        )
        return write_scene(folder, objects, {name: _PLAIN for name in stuffs})

    stuffs = {
        **{f"walls_{index}": STUFFS[stuff] for index, stuff in enumerate(wall_stuffs)},
        **{f"panes_{index}": STUFFS["glass"] for index in range(panes)},
        "soil": STUFFS["soil"],
        "asphalt": STUFFS["asphalt"],
    }
    used = {f"walls_{wall}" for wall, _ in group.values()} | {f"panes_{pane}" for _, pane in group.values()}
    stuffs = {name: stuff for name, stuff in stuffs.items() if name in {*used, "soil", "asphalt"}}
    stations = np.array([_on_a_street(layout, rng) for _ in range(rng.integers(1, 4))])
    stations = np.column_stack([stations, rng.uniform(3.0, 12.0, len(stations))])
    tx = stations[rng.integers(0, len(stations), links)]
    rx = np.array([[*_stop(layout, place[:2], rng), rng.uniform(1.5, 3.0)] for place in tx])
    return Site(stuffs, write, tx, rx, indoors=False)


_PLAIN: Final = {"relative_permittivity": 5.0, "conductivity": 0.05, "thickness": 0.3}
"""Constants that a scene's file needs and nobody reads."""

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
    """A place on the roadway of some street, within the outermost streets."""
    aside = float(rng.uniform(-6.0, 6.0))
    low, high = layout.streets[0], layout.streets[-1]
    if rng.random() < 0.5:
        return float(rng.choice(layout.avenues)) + aside, float(rng.uniform(low, high))
    low, high = layout.avenues[0], layout.avenues[-1]
    return float(rng.uniform(low, high)), float(rng.choice(layout.streets)) + aside


def _stop(layout: Layout, station: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float]:
    """A place on a street within reach of a transmitter; the last one drawn if none is."""
    place = _on_a_street(layout, rng)
    for _ in range(50):
        if _REACH[0] <= float(np.hypot(*(np.array(place) - station))) <= _REACH[1]:
            break
        place = _on_a_street(layout, rng)
    return place
