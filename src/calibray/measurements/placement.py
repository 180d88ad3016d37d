"""Place both ends of every row in the scene's frame, and receivers outside buildings."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.preparation import Preparation
from calibray.measurements.source_table import Coordinates, SourceTable

TX_COLUMNS: Final = ("tx_x", "tx_y", "tx_z")
"""The columns of transmitter positions in the scene's frame [m]."""

RX_COLUMNS: Final = ("rx_x", "rx_y", "rx_z")
"""The columns of receiver positions in the scene's frame [m]."""


def place_rows(
    table: SourceTable, steps: Preparation, tx: Coordinates, rx: Coordinates
) -> tuple[SourceTable, Coordinates, Coordinates]:
    """Write the positions of both ends as the columns `TX_COLUMNS` and `RX_COLUMNS` in metres.

    A position is x, y, z (numbers [m], columns in `steps.unit_m`), or with a frame longitude, latitude [deg] and height
    [m]. Returns the rows and the names of the columns; the arguments unchanged if the only step is a filter.

    Raises:
        InputError: A column is missing or not numeric, or a position is not on the globe.
    """
    if steps.is_filter_only:
        return table, tx, rx
    tx_position, rx_position = _positions(table, steps, "tx", tx), _positions(table, steps, "rx", rx)
    placed = table.assign(
        **dict(zip(TX_COLUMNS, tx_position.T, strict=True)),
        **dict(zip(RX_COLUMNS, rx_position.T, strict=True)),
    )
    return placed, TX_COLUMNS, RX_COLUMNS


def _positions(
    table: SourceTable, steps: Preparation, end: Literal["tx", "rx"], coordinates: Coordinates
) -> NDArray[np.float64]:
    """Positions [rows, 3], [m] of one end."""
    if steps.frame is None:
        # Numbers are metres; columns are in the table's unit.
        scale = [steps.unit_m if isinstance(coordinate, str) else 1.0 for coordinate in coordinates]
        positions = table.positions(end, coordinates) * scale
        height = positions[:, 2]
    else:
        longitude, latitude, height = (table.numbers(coordinate) for coordinate in coordinates)
        try:
            positions = steps.frame.to_scene(longitude, latitude, height)
        except InputError as error:
            raise InputError(f"{table.source}: {end}: {error}") from None
    if steps.ground is not None:
        try:
            ground = steps.ground(positions[:, 0], positions[:, 1])
        except InputError as error:
            raise InputError(f"{table.source}: {end}: {error}") from None
        positions[:, 2] = ground + height
    return positions


def clear_buildings(table: SourceTable, steps: Preparation, rx: Coordinates) -> SourceTable:
    """Leave out or move receivers that stand inside buildings, seen from above.

    Of the steps, `inside` and `outside` are used; the table itself is returned without them.

    Raises:
        InputError: No row remains.
    """
    if steps.inside is None or steps.outside is None:
        return table
    positions, moved = steps.outside(table.positions("rx", rx))
    if steps.inside == "drop":
        return table.keep(moved == 0, "receivers inside buildings, left out")
    too_deep = np.isnan(positions).any(axis=1)
    if count := int(((moved > 0) & ~too_deep).sum()):
        table = table.note("receivers inside buildings, moved out", count)
    table = table.assign(**{str(name): values for name, values in zip(rx, positions.T, strict=True)})
    return table.keep(np.asarray(~too_deep), "receivers deep inside buildings, left out")
