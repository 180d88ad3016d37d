"""Measured links: positions, path losses, weights and groups, read from tables and checked at the boundary.

Positions are metres in the scene's frame once rows are links; `preparation` makes them so.
"""

from calibray.measurements.links import FREQUENCIES, Measurements
from calibray.measurements.preparation import Averaging, Coordinates, Preparation, Track
from calibray.measurements.reading import (
    LINK_COLUMNS,
    Quantity,
    links_from_frame,
    measured_links,
    read_links,
    read_measurements,
)

__all__ = [
    "FREQUENCIES",
    "LINK_COLUMNS",
    "Averaging",
    "Coordinates",
    "Measurements",
    "Preparation",
    "Quantity",
    "Track",
    "links_from_frame",
    "measured_links",
    "read_links",
    "read_measurements",
]
