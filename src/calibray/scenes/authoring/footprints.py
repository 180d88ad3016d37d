"""Footprints: the outlines of buildings in a scene's frame, with the heights between which they stand."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.support.extras import library

GRID: Final = 0.01
"""The grid that the corners of buildings are moved to [m]."""

HeightSource = Literal["height", "levels", "default"]

_UNITS: Final = {
    "": 1.0,
    "m": 1.0,
    "metre": 1.0,
    "meter": 1.0,
    "metres": 1.0,
    "meters": 1.0,
    "ft": 0.3048,
    "'": 0.3048,
}
_LENGTH: Final = re.compile(r"\s*(-?\d+(?:[.,]\d+)?)\s*([a-z]*|')\s*", re.IGNORECASE)
_FEET_AND_INCHES: Final = re.compile(r"\s*(\d+)'\s*(\d+(?:\.\d+)?)\"\s*")


@dataclass(frozen=True)
class HeightRule:
    """How high a building is whose height is not given.

    Attributes:
        level: Height of one storey [m].
        default: Height where not even the storeys are given [m].

    Raises:
        InputError: One is not a finite number greater than 0.
    """

    level: float = 3.0
    default: float = 9.0

    def __post_init__(self) -> None:
        for name in ("level", "default"):
            if not (np.isfinite(value := getattr(self, name)) and value > 0):
                raise InputError(f"{name} = {value!r}: must be a finite number of metres greater than 0")

    def heights(self, tags: Mapping[str, str]) -> tuple[float, float, HeightSource]:
        """Where a building begins and ends above the ground, from OpenStreetMap's tags.

        `height` and `min_height` count first, then `building:levels` and `building:min_level` times `level`, then
        `default`. Both heights are from the ground, the roof's shape is left aside: the roof is flat at `height`.

        Args:
            tags: The building's tags.

        Returns:
            Bottom [m], top [m], and what the top comes from. A top that is not above its bottom is not believed.

        Example:
            >>> HeightRule().heights({"building": "yes", "building:levels": "4"})
            (0.0, 12.0, 'levels')
            >>> HeightRule().heights({"height": "40 ft", "min_height": "2.5"})
            (2.5, 12.192, 'height')
        """
        low, floor = parse_length(tags.get("min_height")), parse_length(tags.get("building:min_level"))
        bottom = max(low if low is not None else (floor or 0.0) * self.level, 0.0)
        height, levels = parse_length(tags.get("height")), parse_length(tags.get("building:levels"))
        if height is not None and height > bottom:
            return bottom, height, "height"
        if levels is not None and levels * self.level > bottom:
            return bottom, levels * self.level, "levels"
        return bottom, bottom + self.default, "default"


def parse_length(text: str | None) -> float | None:
    r"""A length as people write it on maps.

    Args:
        text: A number, with a unit or without: `12`, `12.5 m`, `40 ft`, `40'6"`.

    Returns:
        The length [m]; None if there is none, or it cannot be read.

    Example:
        >>> parse_length("12,5 m"), parse_length("10'6\""), parse_length("tall")
        (12.5, 3.2004, None)
    """
    if text is None:
        return None
    if found := _FEET_AND_INCHES.fullmatch(text):
        return round((float(found[1]) + float(found[2]) / 12) * 0.3048, 6)
    found = _LENGTH.fullmatch(text)
    if found is None or found[2].lower() not in _UNITS:
        return None
    return round(float(found[1].replace(",", ".")) * _UNITS[found[2].lower()], 6)


@dataclass(frozen=True, eq=False)
class Footprints:
    """Outlines of buildings.

    Attributes:
        polygon: Outline of every building, a shapely Polygon or MultiPolygon in the scene's frame [n], [m].
        bottom: Where it begins above the ground [n], [m].
        top: Where it ends above the ground [n], [m].
        name: What it is called [n].
        height_from: What its top comes from [n].
        part: Whether it is a part of a building, which then tells more than the building's outline [n].
        repairs: How many outlines were changed or left out, by what was the matter.
    """

    polygon: NDArray[Any]
    bottom: NDArray[np.float64]
    top: NDArray[np.float64]
    name: tuple[str, ...]
    height_from: tuple[HeightSource, ...]
    part: NDArray[np.bool_]
    repairs: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.polygon)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """West, south, east and north [4], [m]."""
        return library("shapely", "scenes").total_bounds(self.polygon)

    def guessed(self) -> dict[HeightSource, list[str]]:
        """The buildings whose height is a guess, by what it was guessed from."""
        guesses: dict[HeightSource, list[str]] = {"levels": [], "default": []}
        for name, source in zip(self.name, self.height_from, strict=True):
            if source != "height":
                guesses[source].append(name)
        return guesses


def cleaned(raw: Footprints, grid: float = GRID, smallest: float = 1.0) -> Footprints:
    """Footprints with outlines that can be built on: on a grid, without crossings, not too small.

    Args:
        raw: Footprints with outlines as they were found.
        grid: Corners are moved to multiples of this [m].
        smallest: Outlines of less area [m^2] are left out.

    Returns:
        The footprints, every name once; what was repaired is counted.
    """
    shapely = library("shapely", "scenes")
    valid = shapely.is_valid(raw.polygon)
    whole = raw.polygon.copy()
    whole[~valid] = shapely.make_valid(whole[~valid], method="structure", keep_collapsed=False)
    snapped = shapely.set_precision(whole, grid)
    large = shapely.area(snapped) >= smallest
    repairs = {
        **raw.repairs,
        "crossing or touching themselves, repaired": int((~valid & large).sum()),
        f"of less than {smallest:g} m2, left out": int((~large).sum()),
    }
    keep = np.flatnonzero(large)
    return Footprints(
        polygon=snapped[keep],
        bottom=raw.bottom[keep],
        top=raw.top[keep],
        name=tuple(unique_names([raw.name[index] for index in keep])),
        height_from=tuple(raw.height_from[index] for index in keep),
        part=raw.part[keep],
        repairs={what: count for what, count in repairs.items() if count},
    )


def in_frame(polygons: NDArray[Any], frame: Frame, crs: str) -> NDArray[Any]:
    """Outlines in a scene's frame.

    Args:
        polygons: Outlines in some reference system [n]; their heights are left aside.
        frame: The scene's frame.
        crs: The reference system.

    Returns:
        Outlines [n], [m].

    Raises:
        InputError: A corner lies where the frame's projection cannot be used.
    """
    shapely = library("shapely", "scenes")
    return shapely.transform(
        shapely.force_2d(polygons), lambda corner: frame.to_scene(corner[:, 0], corner[:, 1], crs=crs)[:, :2]
    )


def unique_names(names: list[str]) -> list[str]:
    """Names that can be those of files and objects: letters, digits, `_`, `-`; every one once.

    Args:
        names: Names as they were found.

    Returns:
        As many names, in their order.

    Example:
        >>> unique_names(["Town hall", "Town/hall", '"><x'])
        ['Town_hall', 'Town_hall-2', '_x']
    """
    seen: Counter[str] = Counter()
    taken: set[str] = set()
    found = []
    for name in names:
        plain = re.sub(r"[^0-9A-Za-z_-]+", "_", name)[:80] or "_"
        own = plain
        while own in taken:
            seen[plain] += 1
            own = f"{plain}-{seen[plain] + 1}"
        taken.add(own)
        found.append(own)
    return found
