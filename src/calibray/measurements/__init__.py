"""Measured links: positions, path losses, weights and groups, read from tables and checked at the boundary.

Positions are metres in the scene's frame once rows are links; `preparation` makes them so.
"""

from calibray.measurements.links import FREQUENCIES, Measurements
from calibray.measurements.parquet import PiecedTable
from calibray.measurements.preparation import Averaging, Coordinates, Preparation, Track
from calibray.measurements.reading import (
    LINK_COLUMNS,
    Quantity,
    links_from_frame,
    links_from_table,
    measured_links,
    read_measurements,
)
from calibray.measurements.table_files import SourceTable

__all__ = [
    "FREQUENCIES",
    "LINK_COLUMNS",
    "Averaging",
    "Coordinates",
    "Measurements",
    "PiecedTable",
    "Preparation",
    "Quantity",
    "SourceTable",
    "Track",
    "links_from_frame",
    "links_from_table",
    "measured_links",
    "read_measurements",
]
