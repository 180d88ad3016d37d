"""Footprints: the outlines of buildings in the scene's frame, with their lower and upper heights."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.scenes.scene_file import unique_names
from calibray.support.lazy_imports import library

GRID: Final = 0.01
"""Grid to which the corners of buildings are rounded [m]."""

SMALLEST: Final = 1.0
"""Smallest area of a building [m^2]."""

HIGHEST: Final = 1000.0
"""Largest height of a building or part of one [m]; the highest building is 828 m high."""

WIDEST: Final = 50_000.0
"""Largest extent of a scene that is made [m]."""

HeightSource = Literal["height", "levels", "default"]

_METRES: Final = {
    **dict.fromkeys(("", "m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("ft", "'"), 0.3048),
}
_LENGTH: Final = re.compile(r"\s*(-?\d+(?:[.,]\d+)?)\s*([a-z]*|')\s*", re.IGNORECASE)
_FEET_AND_INCHES: Final = re.compile(r"\s*(\d+)'\s*(\d+(?:\.\d+)?)\"\s*")


@dataclass(frozen=True)
class HeightRule:
    """Assumptions for the height of a building whose height is not given.

    Attributes:
        storey: Height of one storey [m].
        default: Height of a building whose number of storeys is not given either [m].

    Raises:
        InputError: A height is not a finite number greater than 0.
    """

    storey: float = 3.0
    default: float = 9.0

    def __post_init__(self) -> None:
        for name in ("storey", "default"):
            if not 0 < (value := getattr(self, name)) <= HIGHEST:
                raise InputError(
                    f"{name} = {value!r}: must be a number of metres greater than 0, at most {HIGHEST:g}"
                )

    def heights(self, tags: Mapping[str, str]) -> tuple[float, float, HeightSource]:
        """Find bottom [m], top [m] and the source of the top of a building from its OpenStreetMap tags.

        `height` and `min_height` have priority, then `building:levels` and `building:min_level` times `storey`, then
        `default`. All heights are above the ground; those above `HIGHEST` are ignored, as is a stated top that is not
        above the bottom. Roof shapes are ignored: the roof is flat at `height`.

        Example:
            >>> HeightRule().heights({"building": "yes", "building:levels": "4"})
            (0.0, 12.0, 'levels')
            >>> HeightRule().heights({"height": "40 ft", "min_height": "2.5"})
            (2.5, 12.192, 'height')
        """
        low, floor = parse_length(tags.get("min_height")), parse_length(tags.get("building:min_level"))
        bottom = max(low if low is not None else (floor or 0.0) * self.storey, 0.0)
        bottom = bottom if bottom <= HIGHEST else 0.0
        height, levels = parse_length(tags.get("height")), parse_length(tags.get("building:levels"))
        if height is not None and bottom < height <= HIGHEST:
            return bottom, height, "height"
        if levels is not None and bottom < levels * self.storey <= HIGHEST:
            return bottom, levels * self.storey, "levels"
        return bottom, bottom + self.default, "default"


def parse_length(text: str | None) -> float | None:
    r"""Parse a length as written on maps, with or without a unit [m]; None if it cannot be read.

    Example:
        >>> parse_length("12,5 m"), parse_length("10'6\""), parse_length("tall")
        (12.5, 3.2004, None)
    """
    if text is None:
        return None
    if feet := _FEET_AND_INCHES.fullmatch(text):
        return round((float(feet[1]) + float(feet[2]) / 12) * 0.3048, 6)
    length = _LENGTH.fullmatch(text)
    if length is None or length[2].lower() not in _METRES:
        return None
    return round(float(length[1].replace(",", ".")) * _METRES[length[2].lower()], 6)


@dataclass(frozen=True, eq=False)
class Footprints:
    """Outlines and heights of buildings.

    Attributes:
        polygon: Outline of each building, a shapely Polygon or MultiPolygon in the scene's frame [n], [m].
        bottom: Height above the ground at which it begins [n], [m].
        top: Height above the ground at which it ends [n], [m].
        name: Its name [n].
        height_from: Source of its top [n].
        part: Whether it is a part of a building, which takes precedence over the building's outline [n].
        repairs: Number of outlines that were changed or left out, by reason.
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
        """Names of the buildings whose height is assumed, by the source of the assumption."""
        guesses: dict[HeightSource, list[str]] = {"levels": [], "default": []}
        for name, source in zip(self.name, self.height_from, strict=True):
            if source != "height":
                guesses[source].append(name)
        return guesses


def clean_footprints(raw: Footprints) -> Footprints:
    """Repair outlines so that buildings can be raised on them: on a grid, without self-crossings, not too small.

    Corners are rounded to multiples of `GRID`; outlines of less area than `SMALLEST` are left out. Repairs
    are counted, and names are unique.

    Raises:
        InputError: A height is not a number or above `HIGHEST`, or the buildings are farther apart than `WIDEST`.
    """
    shapely = library("shapely", "scenes")
    valid = shapely.is_valid(raw.polygon)
    polygons = raw.polygon.copy()
    polygons[~valid] = shapely.make_valid(polygons[~valid], method="structure", keep_collapsed=False)
    polygons = shapely.set_precision(polygons, GRID)
    large = shapely.area(polygons) >= SMALLEST
    repairs = {
        **raw.repairs,
        "crossing or touching themselves, repaired": int((~valid & large).sum()),
        f"of less than {SMALLEST:g} m2, left out": int((~large).sum()),
    }
    keep = np.flatnonzero(large)
    _check_heights(raw, keep)
    _check_extent(polygons[keep], [raw.name[index] for index in keep])
    return Footprints(
        polygon=polygons[keep],
        bottom=raw.bottom[keep],
        top=raw.top[keep],
        name=tuple(unique_names([raw.name[index] for index in keep])),
        height_from=tuple(raw.height_from[index] for index in keep),
        part=raw.part[keep],
        repairs={reason: count for reason, count in repairs.items() if count},
    )


def _check_heights(raw: Footprints, keep: NDArray[np.int64]) -> None:
    for which, heights in (("top", raw.top), ("bottom", raw.bottom)):
        wrong = keep[~((heights[keep] >= 0) & (heights[keep] <= HIGHEST))]
        if len(wrong):
            raise InputError(
                f"building {raw.name[wrong[0]]!r}: its {which} is {heights[wrong[0]]:g} m above the ground, must be "
                f"0 to {HIGHEST:g} m; correct the height or its unit"
            )


def _check_extent(polygons: NDArray[Any], names: Sequence[str]) -> None:
    """Refuse buildings far from the others, such as one at 0, 0, and maps across 180 degrees of longitude."""
    if not len(polygons):
        return
    bounds = library("shapely", "scenes").bounds(polygons)
    centre = (bounds[:, :2] + bounds[:, 2:]) / 2
    if np.ptp(bounds.reshape(-1, 2), axis=0).max() <= WIDEST:
        return
    distance = np.linalg.norm(centre - np.median(centre, axis=0), axis=1)
    size = (bounds[:, 2:] - bounds[:, :2]).max(axis=1)
    furthest = int(np.argmax(distance + size))
    problem = f"lies {distance[furthest] / 1000:,.0f} km from the others"
    if size[furthest] > WIDEST:
        problem = f"is {size[furthest] / 1000:,.0f} km wide"
    raise InputError(
        f"building {names[furthest]!r} {problem}, scenes may be {WIDEST / 1000:g} km wide; remove it, or cut out the "
        "area that you need (a map that crosses 180 degrees of longitude: on one side of it)"
    )


def project(polygons: NDArray[Any], frame: Frame, crs: str) -> NDArray[Any]:
    """Project outlines [n] from a reference system to the scene's frame [m]; their heights are ignored.

    Raises:
        InputError: A corner lies outside the area of the frame's projection.
    """
    shapely = library("shapely", "scenes")
    return shapely.transform(
        shapely.force_2d(polygons), lambda corner: frame.to_scene(corner[:, 0], corner[:, 1], crs=crs)[:, :2]
    )
