"""From a table to links: read the file, select rows, place them, average or merge, clear buildings, check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.averaging import average_samples, merge_repeats
from calibray.measurements.links import Measurements
from calibray.measurements.placement import RX_COLUMNS, TX_COLUMNS, clear_buildings, place_rows
from calibray.measurements.preparation import LinkColumns, Preparation, Quantity
from calibray.measurements.selection import select_rows
from calibray.measurements.source_table import Coordinates, SourceTable
from calibray.measurements.table_files import read_table


def read_measurements(
    path: str | Path,
    tx: Coordinates,
    rx: Coordinates,
    value: str,
    quantity: Quantity = "path_loss",
    where: str | None = None,
    group: str | None = None,
    weight: str | None = None,
    std: str | float | None = None,
    tx_power_dbm: str | float | None = None,
    frequency: str | None = None,
) -> Measurements:
    """Read measured links from a CSV, Parquet or Excel file.

    Rows that repeat a link are merged in linear power (see `repeats.merge_repeats`).

    Args:
        path: The table: .csv, .parquet or .xlsx.
        tx: Transmitter position (x, y, z) [m] in the scene's frame, each a number or the name of a column.
        rx: Receiver position, likewise.
        value: Column of the measured values.
        quantity: The measured quantity: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm], a
            received power with unknown transmitted power (see `LinkColumns`).
        where: Filter over the columns (see `filters`); rows that do not pass are left out before any check.
        group: Column of group labels.
        weight: Column of relative weights [1], greater than 0.
        std: Standard deviation [dB] of the values, a number or a column; the weights become 1 / std^2.
        tx_power_dbm: Transmitted power [dBm], a number or a column, only for "received_power": the path loss is this
            power minus the received power, including antenna gains and cable losses.
        frequency: Column of carrier frequencies [Hz], for links measured at several carriers.

    Returns:
        The links that pass, in the order of the file.

    Raises:
        InputError: The file or a column is missing or malformed, a value is missing, not a number or implausible, or
            no row passes.
    """
    columns = LinkColumns(tx, rx, value, quantity, group, weight, std, tx_power_dbm, frequency)
    return measured_links(read_table(path), columns, Preparation(where=where))


def measured_links(
    table: SourceTable, columns: LinkColumns, steps: Preparation | None = None
) -> Measurements:
    """Convert the rows of a table to measured links; `prepared` counts what was left out, averaged or changed.

    Raises:
        InputError: A column is missing or malformed, a value is missing or implausible, a transmitter is unknown, or
            no row remains.
    """
    steps = steps or Preparation()
    table = select_rows(table, steps, columns.value)
    table, tx, rx = place_rows(table, steps, columns.tx, columns.rx)
    columns = replace(columns, tx=tx, rx=rx)
    table = average_samples(table, steps, columns)
    table = merge_repeats(table, steps, columns)
    table = clear_buildings(table, steps, columns.rx)
    return make_links(table, columns, steps)


def links_from_frame(
    frame: pd.DataFrame, group: str | Sequence[str] | None = None, frequency: str | None = None
) -> Measurements:
    """Links without measured values from a table with the columns of positions [m]; see `links_from_table`.

    Raises:
        InputError: A column is missing, or a position is not finite.
    """
    return links_from_table(SourceTable(frame.reset_index(drop=True), source="links"), group, frequency)


def links_from_table(
    table: SourceTable,
    group: str | Sequence[str] | None = None,
    frequency: str | None = None,
    *,
    steps: Preparation | None = None,
    tx: Coordinates = TX_COLUMNS,
    rx: Coordinates = RX_COLUMNS,
) -> Measurements:
    """Links without measured values, with NaN as path loss, from the rows of a file.

    Labels of several columns in `group` are joined. If the table lacks the column `frequency` [Hz], all links have the
    study's carrier. No step may leave out rows.

    Raises:
        InputError: There are no rows, a column is missing or malformed, or a position is not finite.
    """
    if len(table) == 0:
        raise InputError(f"{table.source}: contains no rows; give at least one link")
    steps = steps or Preparation()
    table, tx, rx = place_rows(select_rows(table, steps), steps, tx, rx)
    return Measurements(
        tx=table.positions("tx", tx),
        rx=table.positions("rx", rx),
        path_loss_db=np.full(len(table), np.nan),
        group=None if group is None else table.labels(group),
        frequency=table.numbers(frequency) if frequency is not None and frequency in table.frame else None,
        table=table,
    )


PLAUSIBLE_PATH_LOSS_DB: Final = (20.0, 250.0)
"""Range [dB] of plausible path losses; a value outside usually has the wrong sign, unit or column."""

PLAUSIBLE_POWER_DBM: Final = (-200.0, 30.0)
"""Range [dBm] of plausible received powers; a value outside usually has the wrong sign, unit or column."""


def make_links(table: SourceTable, columns: LinkColumns, steps: Preparation) -> Measurements:
    """Make one link of each row; positions are in metres. The steps `noise_floor_dbm` and `censored` are used here.

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
    """Path loss [rows], [dB]; minus the received power [dBm] if the transmitted power is unknown."""
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
            f"{name}: {values[first]:g} must be greater than 0; remove the row with a where filter"
        )
    return values if columns.std is None else 1 / values**2
