"""Measured links: positions, path losses, weights and groups, read from tables and checked at the boundary.

Positions are metres in the scene's frame. Positions on the globe will enter beside `reading`: what projects
them needs a `SourceTable` and ends in the same `Measurements`.
"""

from calibray.measurements.links import FREQUENCIES, Measurements
from calibray.measurements.reading import (
    LINK_COLUMNS,
    Coordinates,
    Quantity,
    links_from_frame,
    read_links,
    read_measurements,
)

__all__ = [
    "FREQUENCIES",
    "LINK_COLUMNS",
    "Coordinates",
    "Measurements",
    "Quantity",
    "links_from_frame",
    "read_links",
    "read_measurements",
]
