"""An office floor, drawn from a seed: rooms on both sides of a corridor, with doors and windows."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from calibray.scenes.authoring import Segment, SurfaceMaterial, make_plan_scene
from problem_families.sites import STUFFS, Site

HEIGHT: Final = 3.0  # [m]
SILL: Final = 1.0  # [m], bottom of a window
DOOR: Final = (0.9, 2.1)  # [m], width and height

STUFF_OF: Final = {
    "outer": ("concrete", "brick"),
    "inner": ("plasterboard", "brick", "wood"),
    "door": ("wood",),
    "window": ("glass",),
    "floor": ("concrete",),
    "ceiling": ("concrete", "plasterboard"),
}
"""What each type of surface may be made of."""


def office_site(rng: np.random.Generator, links: int) -> Site:
    """Draw an office floor.

    Args:
        rng: Where the randomness comes from.
        links: Number of links.

    Returns:
        The site.
    """
    length, depth, corridor = rng.uniform(20.0, 45.0), rng.uniform(4.0, 7.0), rng.uniform(1.6, 2.6)
    width = 2.0 * depth + corridor
    segments = _plan(float(length), float(depth), float(corridor), rng)
    chosen = {kind: str(rng.choice(stuffs)) for kind, stuffs in STUFF_OF.items()}
    # A name of its own for each type; what the constants are, the family says.
    types = {kind: SurfaceMaterial(f"{kind}_sheet", "concrete", 0.1) for kind in chosen}

    def write(folder: Path) -> Path:
        return make_plan_scene(segments, folder, types, merge=False).path

    def places(count: int, low: float, high: float) -> np.ndarray:
        ends = np.array([[0.5, 0.5, low], [length - 0.5, width - 0.5, high]])
        return rng.uniform(ends[0], ends[1], (count, 3))

    stations = places(int(rng.integers(1, 4)), 2.0, 2.7)
    tx = stations[rng.integers(0, len(stations), links)]
    stuffs = {f"{kind}_sheet": STUFFS[stuff] for kind, stuff in chosen.items()}
    return Site(stuffs, write, tx, places(links, 0.8, 1.6), indoors=True)


def _plan(length: float, depth: float, corridor: float, rng: np.random.Generator) -> list[Segment]:
    """The lines of the plan, doors and windows before the walls that they are in."""
    width = 2.0 * depth + corridor
    corners = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width), (0.0, 0.0)]
    segments = [Segment(start, end, "outer", 0.0, HEIGHT) for start, end in pairwise(corners)]
    for near, far in ((depth, 0.0), (depth + corridor, width)):
        segments.append(Segment((0.0, near), (length, near), "inner", 0.0, HEIGHT))
        rooms = int(rng.integers(3, max(4, int(length / 4.0)) + 1))
        walls = np.round(np.linspace(0.0, length, rooms + 1) + rng.uniform(-0.4, 0.4, rooms + 1), 2)
        for west, east in pairwise([0.0, *walls[1:-1].tolist(), length]):
            if east < length:
                segments.append(Segment((east, near), (east, far), "inner", 0.0, HEIGHT))
            door = round(float(rng.uniform(west + 0.3, east - DOOR[0] - 0.3)), 2)
            segments.append(Segment((door, near), (door + DOOR[0], near), "door", 0.0, DOOR[1]))
            pane = round(float(rng.uniform(0.3, 0.8)) * (east - west - 0.6), 2)
            left = round(west + (east - west - pane) / 2, 2)
            segments.append(Segment((left, far), (left + pane, far), "window", SILL, HEIGHT - 0.5))
    return segments
