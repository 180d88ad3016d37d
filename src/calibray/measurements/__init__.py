"""Read measured links from tables, and check the positions, path losses, weights and groups of the links.

`reading.measured_links` converts the rows of a table to a `Measurements` object.
"""

from calibray.measurements.links import FEW as FEW
from calibray.measurements.links import MIN_DISTANCE as MIN_DISTANCE
from calibray.measurements.links import Measurements as Measurements
from calibray.measurements.placement import POSITION_COLUMNS as POSITION_COLUMNS
from calibray.measurements.placement import TRACK_COLUMNS as TRACK_COLUMNS
from calibray.measurements.placement import position_columns as position_columns
from calibray.measurements.preparation import Averaging as Averaging
from calibray.measurements.preparation import Ground as Ground
from calibray.measurements.preparation import LinkColumns as LinkColumns
from calibray.measurements.preparation import MoveOutside as MoveOutside
from calibray.measurements.preparation import Preparation as Preparation
from calibray.measurements.preparation import Quantity as Quantity
from calibray.measurements.preparation import Track as Track
from calibray.measurements.reading import links_from_table as links_from_table
from calibray.measurements.reading import measured_links as measured_links
from calibray.measurements.reading import read_measurements as read_measurements
from calibray.measurements.selection import mask_codes as mask_codes
from calibray.measurements.selection import melt as melt
from calibray.measurements.selection import select_rows as select_rows
from calibray.measurements.source_table import SourceTable as SourceTable
from calibray.measurements.table_files import PiecedTable as PiecedTable
from calibray.measurements.table_files import read_table as read_table
