"""Turn measured values into path losses and weights, check them, and make the links."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.links import Measurements
from calibray.measurements.preparation import LinkColumns, Preparation
from calibray.measurements.source_table import SourceTable

PLAUSIBLE_PATH_LOSS_DB: Final = (20.0, 250.0)
"""Range [dB] of plausible path losses; a value outside usually has the wrong sign, unit or column."""

PLAUSIBLE_POWER_DBM: Final = (-200.0, 30.0)
"""Range [dBm] of plausible received powers; a value outside usually has the wrong sign, unit or column."""


def make_links(table: SourceTable, columns: LinkColumns, steps: Preparation) -> Measurements:
    """Make one link of each row; positions are in metres. Used here are `noise_floor_dbm` and `censored`.

    Raises:
        InputError: A column is missing, or a value is missing, not a number or implausible.
    """
    limit_db = censored = None
    if steps.noise_floor_dbm is not None:
        sent_dbm = 0.0 if columns.tx_power_dbm is None else table.numbers(columns.tx_power_dbm)
        limit_db = np.full(len(table), sent_dbm - steps.noise_floor_dbm)
        censored = table.numbers(columns.value) <= steps.noise_floor_dbm if steps.censored else None
    return Measurements(
        tx=table.positions("tx", columns.tx),
        rx=table.positions("rx", columns.rx),
        path_loss_db=_path_loss_db(table, columns),
        weight=_weights(table, columns),
        group=None if columns.group is None else table.labels(columns.group),
        frequency=None if columns.frequency is None else table.numbers(columns.frequency),
        limit_db=limit_db,
        censored=censored,
        table=table,
    )


def _path_loss_db(table: SourceTable, columns: LinkColumns) -> NDArray[np.float64]:
    """Path losses [rows], [dB]; minus the received power [dBm] if the transmitted power is unknown."""
    measured = table.numbers(columns.value)
    match columns.quantity:
        case "rsrp":
            _check_range(table, columns, measured, PLAUSIBLE_POWER_DBM, "check the sign and the unit")
            return -measured
        case "path_loss":
            loss, remedy = measured, "set quantity = 'path_gain' or 'received_power' if it is one"
        case "path_gain":
            loss, remedy = -measured, "set quantity = 'path_loss' if it is one"
        case "received_power":
            loss = table.numbers(columns.tx_power_dbm) - measured  # type: ignore[arg-type]
            remedy = "check tx_power_dbm and the unit, dBm"
    _check_range(table, columns, loss, PLAUSIBLE_PATH_LOSS_DB, remedy)
    return loss


def _check_range(
    table: SourceTable,
    columns: LinkColumns,
    values: NDArray[np.float64],
    bounds: tuple[float, float],
    remedy: str,
) -> None:
    lowest, highest = bounds
    implausible = (values < lowest) | (values > highest)
    if implausible.any():
        first = int(np.flatnonzero(implausible)[0])
        quantity, unit = ("received power", "dBm") if columns.quantity == "rsrp" else ("path loss", "dB")
        raise InputError(
            f"{table.cell(first, columns.value)}: {table.numbers(columns.value)[first]:g} means a {quantity} of "
            f"{values[first]:g} {unit}, must be {lowest:g} to {highest:g} {unit} ({implausible.sum()} of {len(table)} "
            f"rows); {remedy}"
        )


def _weights(table: SourceTable, columns: LinkColumns) -> NDArray[np.float64]:
    """Relative weights [rows], from weights or standard deviations."""
    source = columns.weight if columns.std is None else columns.std
    if source is None:
        return np.ones(len(table))
    values = table.numbers(source)
    if (wrong := values <= 0).any():
        first = int(np.flatnonzero(wrong)[0])
        name = table.cell(first, source) if isinstance(source, str) else "std"
        raise InputError(
            f"{name}: {values[first]:g} must be greater than 0; leave the row out with a where filter"
        )
    return values if columns.std is None else 1 / values**2
