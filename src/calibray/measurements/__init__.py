"""Measured links: positions, path losses, weights and groups, read from tables and checked.

`reading.measured_links` is the pipeline from the rows of a table to `Measurements`.
"""

from calibray.measurements.links import FEW, MIN_DISTANCE, Measurements
from calibray.measurements.placement import RX_COLUMNS, TRACK_COLUMNS, TX_COLUMNS
from calibray.measurements.preparation import (
    Averaging,
    Ground,
    LinkColumns,
    MoveOutside,
    Preparation,
    Quantity,
    Track,
)
from calibray.measurements.reading import (
    links_from_table,
    measured_links,
    read_measurements,
)
from calibray.measurements.selection import mask_codes, melt, select_rows
from calibray.measurements.source_table import SourceTable
from calibray.measurements.table_files import PiecedTable, read_table

LINK_COLUMNS = (*TX_COLUMNS, *RX_COLUMNS)
"""The columns [m] of a table of links without measured values."""

__all__ = [
    "FEW",
    "LINK_COLUMNS",
    "MIN_DISTANCE",
    "TRACK_COLUMNS",
    "Averaging",
    "Ground",
    "LinkColumns",
    "Measurements",
    "MoveOutside",
    "PiecedTable",
    "Preparation",
    "Quantity",
    "SourceTable",
    "Track",
    "links_from_table",
    "mask_codes",
    "measured_links",
    "melt",
    "read_measurements",
    "read_table",
    "select_rows",
]
