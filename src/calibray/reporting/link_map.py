"""The map of the report: links coloured by what is left of their path loss, over the outlines of buildings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.reporting.link_survey import Survey
from calibray.scenes import Triangles
from calibray.scenes.building_outlines import footprints

WIDTH: Final = 1000
"""Width of the map in its own units; its height follows."""

TALLEST: Final = 1000
MARGIN: Final = 0.08
"""What is shown around the links, as a share of their extent."""

LEAST: Final = 40.0
"""Least extent that is shown [m]."""

RAMP: Final = ("#1f5fa8", "#5b94cf", "#a9b4bd", "#e0953f", "#b34a00")
"""From less loss than measured, through none left, to more; colour-blind people tell its ends apart."""


@dataclass(frozen=True)
class Plan:
    """A map, drawn by the template.

    Attributes:
        height: Height, where the width is `WIDTH`.
        west: Coordinate of the left edge [m].
        north: Coordinate of the upper edge [m].
        scale: Units of the map per metre [1/m].
        buildings: Outlines of buildings, as data of an SVG path.
        bar: Length of the scale bar [m].
    """

    height: int
    west: float
    north: float
    scale: float
    buildings: str
    bar: float

    def place(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions on the map.

        Args:
            points: Positions [n, 2 or 3], [m].

        Returns:
            Units of the map, from its upper left corner [n, 2].
        """
        return np.stack(
            [(points[:, 0] - self.west) * self.scale, (self.north - points[:, 1]) * self.scale], axis=1
        )


def plan(survey: Survey, triangles: Triangles | None) -> Plan:
    """Lay out the map of a calibration's links.

    Args:
        survey: The links.
        triangles: The scene; None where it cannot be read.

    Returns:
        The map.
    """
    ends = np.concatenate([survey.tx, survey.rx])[:, :2]
    low, high = ends.min(axis=0), ends.max(axis=0)
    extent = np.maximum((high - low) * (1 + 2 * MARGIN), LEAST)
    # Neither a thin strip nor a tower of a map.
    extent[1] = max(extent[1], 0.45 * extent[0])
    extent[0] = max(extent[0], extent[1] * WIDTH / TALLEST)
    middle = (low + high) / 2
    west, north = middle[0] - extent[0] / 2, middle[1] + extent[1] / 2
    scale = WIDTH / extent[0]
    shown = Plan(round(extent[1] * scale), float(west), float(north), float(scale), "", _nice(extent[0] / 5))
    if triangles is None:
        return shown
    return Plan(**{**vars(shown), "buildings": _buildings(triangles, shown)})


def ramp(value: NDArray[np.float64], limit: float) -> list[str]:
    """Colours of values.

    Args:
        value: The values [n]; NaN for none.
        limit: Where the ramp ends, in both directions.

    Returns:
        Colours as CSS has them.
    """
    stops = np.array([[int(color[k : k + 2], 16) for k in (1, 3, 5)] for color in RAMP], dtype=float)
    place = np.clip((np.nan_to_num(value) / limit + 1) / 2, 0, 1) * (len(RAMP) - 1)
    channel = [np.interp(place, range(len(RAMP)), stops[:, k]).round().astype(int) for k in range(3)]
    colors = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in zip(*channel, strict=True)]
    return ["none" if np.isnan(each) else color for each, color in zip(value, colors, strict=True)]


def ramp_limit(value: NDArray[np.float64]) -> float:
    """Where the ramp of some values ends: a round number that 95 % of them do not exceed.

    Args:
        value: The values [n]; NaN for none.

    Returns:
        The limit, greater than 0.

    Example:
        >>> ramp_limit(np.linspace(-4.3, 4.3, 50))
        5.0
    """
    known = np.abs(value[np.isfinite(value)])
    largest = float(np.quantile(known, 0.95)) if len(known) else 0.0
    return _nice(max(largest, 0.1), up=True)


def _nice(value: float, up: bool = False) -> float:
    """The next of 1, 2, 5, 10, ... below a value, or above it."""
    power = 10.0 ** np.floor(np.log10(value))
    steps = np.array([1.0, 2.0, 5.0, 10.0]) * power
    return float(steps[steps >= value * 0.999].min() if up else steps[steps <= value * 1.001].max())


def _buildings(triangles: Triangles, shown: Plan) -> str:
    """Outlines of all that lies, the ground apart, within the map; those that look alike once."""
    south = shown.north - shown.height / shown.scale
    loops = footprints(triangles, shown.west, south, shown.west + WIDTH / shown.scale, shown.north)
    outlines: dict[frozenset[tuple[float, ...]], list[list[float]]] = {}
    for loop in loops:
        line = shown.place(loop).round(1)
        outlines.setdefault(frozenset(map(tuple, line.tolist())), line.tolist())
    return "".join(f"M{'L'.join(f'{x:g},{y:g}' for x, y in line)}Z" for line in outlines.values())
