"""From tables to links: positions, values and weights, with every fault named by its file, row and column."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.links import Measurements
from calibray.measurements.preparation import CENSORED, Coordinates, Preparation, positions, prepare
from calibray.measurements.table_files import SourceTable, read_table
from calibray.support.messages import did_you_mean

Quantity = Literal["path_loss", "path_gain", "received_power", "rsrp"]

PLAUSIBLE_PATH_LOSS_DB: Final = (20.0, 250.0)
"""The range [dB] outside which a path loss is taken for a mistake of sign, unit or column."""

PLAUSIBLE_RSRP_DBM: Final = (-200.0, 30.0)
"""The range [dBm] outside which a received power is taken for a mistake of sign, unit or column."""

LINK_COLUMNS: Final = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
"""The columns [m] of a table of links without measured values."""


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
    """Read measured links from a CSV or Parquet file.

    A link may be measured more than once; each of its values then counts. A row that repeats an earlier one
    in link, carrier, group and value is a copy and refused.

    Args:
        path: The table, .csv or .parquet.
        tx: Transmitter position (x, y, z) [m] in the scene's frame, each a number or the name of a column.
        rx: Receiver position, likewise.
        value: Column of the measured values.
        quantity: What they are: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm], whose
            transmitted power is not known (see `measured_links`).
        where: Filter over the columns (see `filters`); rows that do not pass are left out before any check.
        group: Column of group labels.
        weight: Column of relative weights [1], greater than 0.
        std: Standard deviation [dB] of the values, a number or a column; the weights become 1 / std^2.
        tx_power_dbm: Transmitted power [dBm], a number or a column, for "received_power" only: path loss is
            this power less the received one, antenna gains and cable losses included.
        frequency: Column of carrier frequencies [Hz], for links measured at several.

    Returns:
        The links that pass, in the order of the file.

    Raises:
        InputError: The file or a column is missing or malformed, a value is missing, not a number, or
            implausible, a row is a copy, or no row passes.
    """
    return measured_links(
        read_table(path), tx, rx, value, quantity, Preparation(where=where), group, weight, std, tx_power_dbm, frequency
    )  # fmt: skip


def measured_links(
    table: SourceTable,
    tx: Coordinates,
    rx: Coordinates,
    value: str,
    quantity: Quantity = "path_loss",
    steps: Preparation | None = None,
    group: str | Sequence[str] | None = None,
    weight: str | None = None,
    std: str | float | None = None,
    tx_power_dbm: str | float | None = None,
    frequency: str | None = None,
) -> Measurements:
    """Measured links from a table, prepared first.

    Args:
        table: The rows.
        tx: Transmitter position, as `Preparation` says.
        rx: Receiver position, likewise.
        value: Column of the measured values.
        quantity: What they are (see `read_measurements`); "rsrp" [dBm] is a received power whose transmitted power is
            not known: its "path loss" is less the received power, and an offset must take what was transmitted.
        steps: What is done to the rows before; nothing if None.
        group: Column of group labels, or several whose labels are joined.
        weight: Column of relative weights [1].
        std: Standard deviation [dB] of the values.
        tx_power_dbm: Transmitted power [dBm].
        frequency: Column of carrier frequencies [Hz].

    Returns:
        The links, with the counts of what was left out, averaged or moved.

    Raises:
        InputError: What `read_measurements` and `prepare` refuse.
    """
    _check_quantity(table, quantity, tx_power_dbm)
    made = prepare(
        table, steps or Preparation(), tx, rx, value, "loss" if quantity == "path_loss" else "power"
    )
    table = made.table
    limit = None
    if steps is not None and steps.noise_floor_dbm is not None:
        sent = 0.0 if tx_power_dbm is None else _number_or_column(table, tx_power_dbm)
        limit = np.full(len(table), sent - steps.noise_floor_dbm)
    measurements = Measurements(
        tx=positions(table, "tx", made.tx),
        rx=positions(table, "rx", made.rx),
        path_loss_db=_path_loss_db(table, value, quantity, tx_power_dbm),
        weight=_weights(table, weight, std),
        group=None if group is None else group_labels(table, group),
        frequency=None if frequency is None else table.numbers(frequency),
        limit_db=limit,
        censored=table.frame[CENSORED].to_numpy(bool) if steps is not None and steps.censored else None,
        table=table,
        prepared=made.counts,
    )
    _refuse_copies(measurements)
    return measurements


def group_labels(table: SourceTable, group: str | Sequence[str]) -> NDArray[np.str_]:
    """The label of every row's group.

    Args:
        table: The rows.
        group: Column of labels, or several whose labels are joined by a blank.

    Returns:
        The labels [rows].

    Raises:
        InputError: There is no such column, or a label is missing.
    """
    if isinstance(group, str):
        return table.labels(group)
    return np.array([" ".join(parts) for parts in zip(*map(table.labels, group), strict=True)], dtype=np.str_)


def links_from_frame(
    frame: pd.DataFrame, group: str | Sequence[str] | None = None, frequency: str | None = None
) -> Measurements:
    """Links without measured values, to predict at.

    Args:
        frame: SourceTable with the columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m] in the scene's frame.
        group: Column of group labels, or several whose labels are joined.
        frequency: Column of carrier frequencies [Hz]; without that column all links have the study's carrier.

    Returns:
        The links, their path losses NaN.

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
    tx: Coordinates = LINK_COLUMNS[:3],
    rx: Coordinates = LINK_COLUMNS[3:],
) -> Measurements:
    """Links without measured values from rows of a file.

    Args:
        table: The rows.
        group: Column of group labels, or several whose labels are joined.
        frequency: Column of carrier frequencies [Hz]; without that column all links have the study's carrier.
        steps: What makes positions of the rows, of which none is left out; nothing if None.
        tx: Transmitter position, as `Preparation` says; the columns of `links_from_frame` unless others are named.
        rx: Receiver position, likewise.

    Returns:
        The links, their path losses NaN.

    Raises:
        InputError: There are no rows, a column is missing or malformed, or a position is not finite.
    """
    if len(table) == 0:
        raise InputError(f"{table.source}: holds no rows; give at least one link")
    made = prepare(table, steps or Preparation(), tx, rx, "")
    table = made.table
    return Measurements(
        tx=positions(table, "tx", made.tx),
        rx=positions(table, "rx", made.rx),
        path_loss_db=np.full(len(table), np.nan),
        group=None if group is None else group_labels(table, group),
        frequency=table.numbers(frequency) if frequency is not None and frequency in table.frame else None,
        table=table,
    )


def _path_loss_db(
    table: SourceTable, value: str, quantity: str, tx_power_dbm: str | float | None
) -> NDArray[np.float64]:
    """Path losses [rows] [dB] from the measured column, refused where no radio link can have them."""
    measured = table.numbers(value)
    match quantity:
        case "path_loss":
            loss, remedy = measured, "say quantity = 'path_gain' or 'received_power' if it is one"
        case "path_gain":
            loss, remedy = -measured, "say quantity = 'path_loss' if it is one"
        case "rsrp":
            return _rsrp_loss_db(table, value, measured)
        case _:
            loss, remedy = (
                _number_or_column(table, tx_power_dbm) - measured,
                "check tx_power_dbm and the unit, dBm",
            )
    lowest, highest = PLAUSIBLE_PATH_LOSS_DB
    if (strange := (loss < lowest) | (loss > highest)).any():
        first = int(np.flatnonzero(strange)[0])
        raise InputError(
            f"{table.place(first, value)}: {measured[first]:g} means a path loss of {loss[first]:g} dB, must "
            f"be {lowest:g} to {highest:g} dB ({strange.sum()} of {len(table)} rows); {remedy}"
        )
    return loss


def _check_quantity(table: SourceTable, quantity: str, tx_power_dbm: str | float | None) -> None:
    if quantity not in get_args(Quantity):
        raise InputError(f"quantity = {quantity!r}: unknown, {did_you_mean(quantity, get_args(Quantity))}")
    if (quantity == "received_power") != (tx_power_dbm is not None):
        remedy = (
            "needs tx_power_dbm [dBm]; where it is not known, say quantity = 'rsrp' and give an [offset]"
            if tx_power_dbm is None
            else "takes no tx_power_dbm; leave it out"
        )
        raise InputError(f"{table.source}: quantity = {quantity!r} {remedy}")


def _rsrp_loss_db(table: SourceTable, value: str, measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """Less the received power [dB]; the offset adds what was transmitted."""
    lowest, highest = PLAUSIBLE_RSRP_DBM
    if (strange := (measured < lowest) | (measured > highest)).any():
        first = int(np.flatnonzero(strange)[0])
        raise InputError(
            f"{table.place(first, value)}: {measured[first]:g} dBm, must be {lowest:g} to {highest:g} dBm "
            f"({strange.sum()} of {len(table)} rows); check the sign and the unit"
        )
    return -measured


def _weights(table: SourceTable, weight: str | None, std: str | float | None) -> NDArray[np.float64]:
    """Relative weights [rows], from weights or from standard deviations."""
    if weight is not None and std is not None:
        raise InputError(f"weight = {weight!r} and std = {std!r}: give one of them")
    if weight is None and std is None:
        return np.ones(len(table))
    name = std if weight is None else weight
    values = _number_or_column(table, name)
    if (wrong := values <= 0).any():
        first = int(np.flatnonzero(wrong)[0])
        place = table.place(first, name) if isinstance(name, str) else "std"
        raise InputError(
            f"{place}: {values[first]:g} must be greater than 0; leave the row out with a where filter"
        )
    return values if std is None else 1 / values**2


def _number_or_column(table: SourceTable, source: str | float | None) -> NDArray[np.float64]:
    if isinstance(source, str):
        return table.numbers(source)
    if isinstance(source, bool) or not np.isfinite(source):  # type: ignore[arg-type]
        raise InputError(f"{table.source}: {source!r} must be a finite number or a column")
    return np.full(len(table), float(source))  # type: ignore[arg-type]


def _refuse_copies(links: Measurements) -> None:
    """Refuse a row that repeats an earlier one in link, carrier, group and value."""
    keys = pd.DataFrame(np.column_stack([links.tx, links.rx, links.path_loss_db]))
    keys["group"] = links.group_index
    if links.frequency is not None:
        keys["frequency"] = links.frequency
    copies = np.flatnonzero(keys.duplicated())
    if len(copies):
        copy = int(copies[0])
        first = int(np.flatnonzero((keys == keys.iloc[copy]).all(axis=1))[0])
        raise InputError(
            f"{links.source}, row {links.row[copy]}: duplicate link, same positions and value as row "
            f"{links.row[first]} ({len(copies)} in all); remove one"
        )
