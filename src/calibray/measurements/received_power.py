"""Powers as phones and scanners log them: several transmitters in columns, RSRP, RSSI, noise floors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.measurements.table_files import SourceTable
from calibray.support.messages import did_you_mean

SUBCARRIERS: Final = 12  # of one resource block (3GPP TS 36.211 section 6.2.3, TS 38.211 section 4.4.4.1)
LTE_RESOURCE_BLOCKS: Final = {1.4e6: 6, 3e6: 15, 5e6: 25, 10e6: 50, 15e6: 75, 20e6: 100}
"""Resource blocks N_RB of LTE by channel bandwidth [Hz] (3GPP TS 36.101, table 5.6-1)."""

BOLTZMANN: Final = 1.380649e-23  # [J/K]
ROOM_TEMPERATURE: Final = 290.0  # [K]


def long_table(
    wide: pd.DataFrame, columns: Mapping[str, str], value: str = "value", transmitter: str = "transmitter"
) -> pd.DataFrame:
    """One row a link, from a table with one column a transmitter.

    Args:
        wide: One row a place, a column of values for every transmitter.
        columns: Name of the transmitter by column of the table.
        value: What the new column of values is called.
        transmitter: What the new column of transmitters is called.

    Returns:
        The other columns, transmitter and value, the rows of one place together; cells without a value are left out.

    Raises:
        InputError: A column is missing or holds no number, two have one transmitter, a new name is taken, or there
            is no value at all.

    Example:
        >>> wide = pd.DataFrame({"x": [0.0, 5.0], "ap1": [-40.0, -52.0], "ap2": [-61.0, np.nan]})
        >>> long_table(wide, {"ap1": "AP 1", "ap2": "AP 2"}, "rss")
             x transmitter   rss
        0  0.0        AP 1 -40.0
        1  0.0        AP 2 -61.0
        2  5.0        AP 1 -52.0
    """
    table = SourceTable(wide, source="wide table")
    if len(set(columns.values())) != len(columns):
        raise InputError(
            f"columns = {dict(columns)}: two columns have one transmitter; name each differently"
        )
    others = [name for name in wide if name not in columns]
    for name in columns:
        cells = pd.Series(pd.to_numeric(table.column(name), errors="coerce"))
        if (text := (cells.isna() & wide[name].notna()).to_numpy()).any():
            first = int(np.flatnonzero(text)[0])
            raise InputError(
                f"{table.place(first, name)}: {wide[name].iloc[first]!r} is not a number; correct it"
            )
    for name in (value, transmitter):
        if name in others:
            raise InputError(f"wide table: has a column {name!r} already; choose another name")
    numbers = wide[list(columns)].apply(pd.to_numeric)
    kept = wide[others].loc[wide.index.repeat(len(columns))].reset_index(drop=True)
    kept[transmitter] = np.tile(list(columns.values()), len(wide))
    kept[value] = numbers.to_numpy(dtype=float).ravel()
    long = kept.dropna(subset=[value]).reset_index(drop=True)
    if long.empty:
        raise InputError(f"wide table: there is no value in the columns {', '.join(columns)}")
    return long


def with_transmitters(
    links: pd.DataFrame, transmitters: pd.DataFrame, name: str = "transmitter"
) -> pd.DataFrame:
    """Give links the columns of their transmitters.

    Args:
        links: One row a link.
        transmitters: One row a transmitter.
        name: The column, of both tables, that says which transmitter it is.

    Returns:
        The links with the other columns of their transmitters, in their order.

    Raises:
        InputError: A table lacks the column, a transmitter stands twice, or one of a link is not known.
    """
    of_link = SourceTable(links, source="links").labels(name)
    known = SourceTable(transmitters, source="transmitters").labels(name)
    if len(set(known)) != len(known):
        raise InputError(f"transmitters: one of {', '.join(known[:5])} stands twice; remove one")
    if lost := sorted(set(of_link.tolist()) - set(known.tolist())):
        raise InputError(f"links: transmitter {lost[0]!r} is not known; {did_you_mean(lost[0], known)}")
    row = {label: index for index, label in enumerate(known.tolist())}
    found = transmitters.drop(columns=name).iloc[[row[label] for label in of_link.tolist()]]
    return pd.concat([links.reset_index(drop=True), found.reset_index(drop=True)], axis=1)


def total_power_dbm(rsrp_dbm: ArrayLike, resource_blocks: int) -> NDArray[np.float64]:
    """Received power over the whole channel, from RSRP, which is the mean power of one resource element.

    The reference signals must be as strong as the other resource elements, and all be sent: P = RSRP + 10 lg(12 N_RB).

    Args:
        rsrp_dbm: Reference signal received power, any shape [dBm].
        resource_blocks: Resource blocks N_RB of the channel, 100 of a 20 MHz LTE carrier (`LTE_RESOURCE_BLOCKS`).

    Returns:
        Received power, likewise [dBm].

    Raises:
        InputError: The number of resource blocks is less than 1.

    Example:
        >>> total_power_dbm(-100.0, LTE_RESOURCE_BLOCKS[20e6]).round(2)
        np.float64(-69.21)
    """
    if resource_blocks < 1:
        raise InputError(f"resource_blocks = {resource_blocks!r}: must be 1 or more")
    return np.asarray(rsrp_dbm, dtype=float) + 10 * np.log10(SUBCARRIERS * resource_blocks)


def noise_floor_dbm(bandwidth: float, noise_figure_db: float) -> float:
    """Thermal noise of a receiver at 290 K.

    Args:
        bandwidth: Of the receiver [Hz]; that of one resource element, 15 kHz in LTE, for RSRP.
        noise_figure_db: Its noise figure [dB]; about 7 for a phone.

    Returns:
        k T B and the noise figure [dBm].

    Raises:
        InputError: The bandwidth is not greater than 0.

    Example:
        >>> round(noise_floor_dbm(15e3, 7.0), 1)
        -125.2
    """
    if not (np.isfinite(bandwidth) and bandwidth > 0):
        raise InputError(f"bandwidth = {bandwidth!r}: must be a finite number of Hz greater than 0")
    return float(10 * np.log10(BOLTZMANN * ROOM_TEMPERATURE * bandwidth * 1e3) + noise_figure_db)


def marked_censored(
    rows: pd.DataFrame, value: str, floor: float, margin_db: float = 0.0, mark: str = "censored"
) -> pd.DataFrame:
    """Mark the values at or below the noise floor: of them it is known only that the power was no more than it.

    Args:
        rows: One row a link.
        value: Column of received powers [dBm]; where one is missing the transmitter was not heard.
        floor: The noise floor [dBm].
        margin_db: How far above the floor values begin to count [dB]; below, noise adds to them.
        mark: What the new column is called.

    Returns:
        The rows with the mark; marked values, and missing ones, are set to the limit, floor and margin [dBm].

    Raises:
        InputError: There is no such column, it holds no numbers, or a bound is not finite.

    Example:
        >>> marked_censored(pd.DataFrame({"p": [-90.0, -118.0, np.nan]}), "p", -120.0, 3.0).to_numpy().tolist()
        [[-90.0, False], [-117.0, True], [-117.0, True]]
    """
    if not np.isfinite([floor, margin_db]).all():
        raise InputError(f"floor = {floor!r}, margin_db = {margin_db!r}: must be finite numbers")
    column = SourceTable(rows, source="links").column(value)
    present = column.notna().to_numpy()
    numbers = np.full(len(rows), np.nan)
    if present.any():
        numbers[present] = SourceTable(rows.loc[present], source="links").numbers(value)
    limit = floor + margin_db
    censored = ~(numbers > limit)
    return rows.assign(**{value: np.where(censored, limit, numbers), mark: censored})
