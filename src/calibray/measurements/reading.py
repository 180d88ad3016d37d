"""Convert a table to links: read the file, select and position rows, average or merge them, and check the links.

Samples in the same area or at the same position are averaged in linear power into one row. Along a street, the power
fades by several dB within a wavelength. Ray tracing to a single point does not predict this fading, but it does predict
the power averaged over a few tens of wavelengths (W. C. Y. Lee, "Estimate of local average power of a mobile radio
signal", IEEE Trans. Veh. Technol. 34(1), 1985: 40 wavelengths, 36 to 50 samples). Averages of decibel values are not
used, because they are 2.5 dB too low for Rayleigh fading.

The logarithm of a mean over few samples is also biased: to second order, it is too low by (10 / ln 10) var / (2 n
mean^2) (delta method). This bias is 0.2 dB for ten samples with Rayleigh fading, and zero for a single path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements import column_names
from calibray.measurements.links import FEW, Measurements
from calibray.measurements.placement import RX_COLUMNS, TX_COLUMNS, clear_buildings, place_rows, read_times
from calibray.measurements.preparation import Averaging, LinkColumns, Preparation, Quantity
from calibray.measurements.selection import choose_rows, comparison, complete_rows, select_rows
from calibray.measurements.source_table import Coordinates, SourceTable
from calibray.measurements.table_files import read_table
from calibray.support.messages import shortened


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

    Rows that repeat a link are merged in linear power (see `merge_repeats`).

    Args:
        path: The table: .csv, .parquet or .xlsx.
        tx: Transmitter position (x, y, z) [m] in the scene frame. Each coordinate is a number or the name of a column.
        rx: Receiver position, in the same form.
        value: Column of the measured values.
        quantity: The measured quantity: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm] for
            received power if the transmitted power is unknown (see `LinkColumns`).
        where: Row filter on the columns (see `filters`). Rows that do not pass are removed before any check.
        group: Column of group labels.
        weight: Column of relative weights [1], greater than 0.
        std: Standard deviation of the values [dB], as a number or a column; the weights are then 1 / std^2.
        tx_power_dbm: Transmitted power [dBm], as a number or a column; allowed only with "received_power". The path
            loss is the transmitted power minus the received power; it therefore includes antenna gains and cable
            losses.
        frequency: Column of carrier frequencies, in hertz or in the unit stated in the column name, for links at
            several frequencies.

    Returns:
        The links that pass the filter, in the order of the file.

    Raises:
        InputError: The file or a column is missing or malformed, a value is missing, not a number or implausible, or
            no row passes the filter.
    """
    columns = LinkColumns(tx, rx, value, quantity, group, weight, std, tx_power_dbm, frequency)
    return measured_links(read_table(path), columns, Preparation(where=where))


def measured_links(
    table: SourceTable, columns: LinkColumns, steps: Preparation | None = None
) -> Measurements:
    """Convert the rows of a table to measured links; the attribute `prepared` counts the excluded and changed rows.

    Raises:
        InputError: A column is missing or malformed, a value is missing or implausible, a transmitter is unknown, or
            no row remains.
    """
    steps = steps or Preparation()
    chosen = choose_rows(table, steps, columns.value)
    table = complete_rows(chosen, steps, columns.value)
    table, tx, rx = place_rows(table, steps, columns.tx, columns.rx)
    columns = replace(columns, tx=tx, rx=rx)
    # A missing value can be an error or a power too weak to be measured, so the user decides what to do with the row.
    remedy = f'leave out these rows: in a study, set links.where = "`{columns.value}`.notna()"'
    if columns.quantity in ("rsrp", "received_power"):
        remedy += "; if the powers were too weak to measure, state links.noise_floor_dbm"
    table.numbers(columns.value, remedy=remedy)
    table = average_samples(table, steps, columns)
    table = merge_repeats(table, steps, columns)
    table = clear_buildings(table, steps, columns.rx)
    return make_links(_note_unused(table, chosen, steps, columns), columns, steps)


def _note_unused(
    table: SourceTable, chosen: SourceTable, steps: Preparation, columns: LinkColumns
) -> SourceTable:
    """Record the transmitters and groups none of whose selected rows remain in the table."""
    groups = [columns.group] if isinstance(columns.group, str) else columns.group or ()
    for name in dict.fromkeys([*groups, steps.transmitter]):
        if name not in table.frame or name not in chosen.frame:
            continue
        used, rows = table.frame[name], chosen.frame[name]
        if name == steps.transmitter and steps.transmitters is not None:
            # Joining the table of transmitters can change the spelling of their names.
            compared = comparison(used.unique())
            used, rows = pd.Series(compared(used)), pd.Series(compared(rows))
        unused = ~rows.isin(used)
        labels = chosen.frame[name][unused].dropna().unique().tolist()
        if labels:
            listed = ", ".join(shortened(str(label)) for label in labels[:5]) + (
                ", ..." if labels[5:] else ""
            )
            number = int((unused & chosen.frame[name].notna()).sum())
            table = table.note(f"rows of {shortened(name)} {listed}, none of which is used", number)
    return table


def links_from_table(
    table: SourceTable,
    group: str | Sequence[str] | None = None,
    frequency: str | None = None,
    *,
    steps: Preparation | None = None,
    tx: Coordinates = TX_COLUMNS,
    rx: Coordinates = RX_COLUMNS,
) -> Measurements:
    """Create links without measured values from the rows of a table. Their path loss is NaN.

    If `group` names several columns, their labels are joined. `frequency` is a column of carrier frequencies. If
    `frequency` is None or missing in the table, all links have the carrier frequency of the study. No step may remove
    rows.

    Raises:
        InputError: There are no rows, a column is missing or malformed, or a position is not finite.
    """
    if len(table) == 0:
        raise InputError(f"{table.source}: contains no rows; at least one link is required")
    steps = steps or Preparation()
    table, tx, rx = place_rows(select_rows(table, steps), steps, tx, rx)
    return Measurements(
        tx=table.positions("tx", tx),
        rx=table.positions("rx", rx),
        path_loss_db=np.full(len(table), np.nan),
        group=None if group is None else table.labels(group),
        frequency=_carriers(table, frequency) if frequency in table.frame else None,
        table=table,
    )


PLAUSIBLE_PATH_LOSS_DB: Final = (20.0, 250.0)
"""Range of plausible path losses [dB]. A value outside this range usually has the wrong sign or unit, or comes from the
wrong column."""

PLAUSIBLE_POWER_DBM: Final = (-200.0, 30.0)
"""Range of plausible received powers [dBm]. A value outside this range usually has the wrong sign or unit, or comes
from the wrong column."""


LINEAR: Final = 0.1
"""If the magnitudes of all received powers in a table are below this limit, the powers are probably not in dBm, but for
example in watts."""


def make_links(table: SourceTable, columns: LinkColumns, steps: Preparation) -> Measurements:
    """Create one link from each row. Positions are in metres.

    The function uses the steps `noise_floor_dbm` and `censored`.

    Raises:
        InputError: A column is missing, or a value is missing, not a number or implausible.
    """
    limit_db = censored = None
    if steps.noise_floor_dbm is not None:
        sent_dbm = 0.0 if columns.tx_power_dbm is None else table.numbers(columns.tx_power_dbm)
        # The path loss at which the received power equals the noise floor.
        limit_db = np.full(len(table), sent_dbm - steps.noise_floor_dbm)
        censored = table.numbers(columns.value) <= steps.noise_floor_dbm if steps.censored else None
    return Measurements(
        tx=table.positions("tx", columns.tx),
        rx=table.positions("rx", columns.rx),
        path_loss_db=_path_loss_db(table, columns),
        weight=_weights(table, columns),
        group=None if columns.group is None else table.labels(columns.group),
        frequency=_carriers(table, columns.frequency),
        limit_db=limit_db,
        censored=censored,
        table=table,
    )


def _carriers(table: SourceTable, column: str | None) -> NDArray[np.float64] | None:
    """Carrier frequencies [rows], [Hz], from a column in hertz or in the unit stated in its name; None if no column."""
    if column is None:
        return None
    return table.numbers(column) * column_names.find_frequency_unit(column)


def _path_loss_db(table: SourceTable, columns: LinkColumns) -> NDArray[np.float64]:
    """Path loss [rows], [dB]; the negative of the received power [dBm] if the transmitted power is unknown."""
    measured = table.numbers(columns.value)
    if columns.quantity in ("rsrp", "received_power") and np.abs(measured).max() < LINEAR:
        raise InputError(
            f"{table.source}: column {columns.value!r} has values up to {measured.max():g}, which are typical of "
            "watts; convert the values to dBm"
        )
    match columns.quantity:
        case "rsrp":
            _check_range(table, columns, measured, PLAUSIBLE_POWER_DBM, "check the sign and the unit")
            return -measured
        case "path_loss":
            loss, remedy = (
                measured,
                "set quantity = 'path_gain' or 'received_power' if the column contains one of these",
            )
        case "path_gain":
            loss, remedy = -measured, "set quantity = 'path_loss' if the column contains path loss"
        case "received_power":
            loss = table.numbers(columns.tx_power_dbm) - measured  # type: ignore[arg-type]
            remedy = "check tx_power_dbm, and check that all powers are in dBm"
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
            f"{table.cell(first, columns.value)}: {table.numbers(columns.value)[first]:g} corresponds to a {quantity} "
            f"of {values[first]:g} {unit}; it must be {lowest:g} to {highest:g} {unit} ({implausible.sum()} of "
            f"{len(table)} rows); {remedy}"
        )


def _weights(table: SourceTable, columns: LinkColumns) -> NDArray[np.float64]:
    """Relative weights [rows], from a column of weights or from standard deviations."""
    source = columns.weight if columns.std is None else columns.std
    if source is None:
        return np.ones(len(table))
    values = table.numbers(source)
    if (wrong := values <= 0).any():
        first = int(np.flatnonzero(wrong)[0])
        if not isinstance(source, str):
            raise InputError(f"std: {source:g} must be greater than 0 dB")
        raise InputError(
            f"{table.cell(first, source)}: {values[first]:g} must be greater than 0; remove the row with a where filter"
        )
    # Inverse variances are the optimal weights for independent normal errors.
    return values if columns.std is None else 1 / values**2


MAX_UNCERTAINTY_DB: Final = 1.0
"""Maximum uncertainty of an average due to samples below the noise floor [dB]; averages that are more uncertain are
left out."""

_AREA: Final = "calibray area"
_PART: Final = "calibray part"


def average_samples(table: SourceTable, steps: Preparation, columns: LinkColumns) -> SourceTable:
    """Average samples of the same area, transmitter, frequency and group, if `steps.averaging` is set.

    A sample below the noise floor has a power between zero and the floor, so half the power of the floor enters the
    average. Averages with an uncertainty above `MAX_UNCERTAINTY_DB` are left out, because only their strongest samples
    are above the floor. The function uses the steps `averaging`, `keep`, `held_out`, `transmitter` and
    `noise_floor_dbm`. Each average is the row of its first sample, with receiver position, value, weight and other
    observables replaced by their means. The added columns are `std_db` (standard deviation of the samples [dB], NaN for
    one sample) and `count`.

    Raises:
        InputError: A column is missing or not numeric, a time cannot be read, or no average remains.

    Example:
        >>> rows = pd.DataFrame({"rx_x": [0.0, 1.0], "power": [-80.0, -90.0]})
        >>> rows[["tx_x", "tx_y", "tx_z", "rx_y", "rx_z"]] = 0.0
        >>> columns = LinkColumns(("tx_x", "tx_y", "tx_z"), ("rx_x", "rx_y", "rx_z"), "power", "rsrp")
        >>> steps = Preparation(averaging=Averaging("cell", 5.0))
        >>> averages = average_samples(SourceTable(rows), steps, columns)
        >>> averages.frame[["rx_x", "power", "std_db", "count"]].round(3).to_dict("records")
        [{'rx_x': 0.5, 'power': -82.596, 'std_db': 7.071, 'count': 2}]
    """
    averaging = steps.averaging
    if averaging is None:
        return table
    # A gain or power increases with the linear power, whereas a loss decreases.
    sign = -1.0 if columns.quantity == "path_loss" else 1.0
    level = sign * table.numbers(columns.value)
    rx = [str(name) for name in columns.rx]
    keys = [*_separating_columns(table, steps, columns), *map(str, columns.tx)]
    labels = pd.DataFrame({name: table.column(name) for name in keys})
    labels[_PART] = 0 if steps.held_out is None else steps.held_out(table)
    apart = np.asarray(labels.groupby(list(labels), sort=False, dropna=False).ngroup(), dtype=np.int64)
    labels[_AREA] = _areas(table, averaging, rx, apart)
    group = np.asarray(labels.groupby(list(labels), sort=False, dropna=False).ngroup(), dtype=np.int64)

    samples = pd.DataFrame({name: table.numbers(name) for name in rx})
    # Powers are relative to the strongest sample, so that weak samples do not underflow.
    samples["power"] = 10 ** ((level - level.max()) / 10)
    samples["level"] = level
    samples["below"] = 0.0
    if steps.noise_floor_dbm is not None:
        samples["below"] = (level <= steps.noise_floor_dbm).astype(float)
    groups = samples.groupby(group)
    mean = groups[[*rx, "power", "below"]].mean()
    count = groups.size()
    mean_level = (10 * np.log10(mean["power"]) + level.max()).to_numpy()

    table = table.note("samples averaged", len(table))
    uncertain = np.zeros(len(mean), dtype=bool)
    if steps.noise_floor_dbm is not None and samples["below"].any():
        table = table.note("of them at or below the noise floor", int(samples["below"].sum()))
        highest = 10 ** (mean_level / 10)  # Samples below the floor count as equal to the floor.
        from_below = mean["below"].to_numpy() * 10 ** (steps.noise_floor_dbm / 10)
        lowest = np.maximum(highest - from_below, 0.0)
        # The true mean power lies between `lowest` and `highest`.
        uncertain = highest > lowest * 10 ** (MAX_UNCERTAINTY_DB / 10)
        mean_level = 10 * np.log10(highest - from_below / 2)
    if averaging.unbiased:
        # Delta method: E[ln m] is less than ln E[m] by var / (2 n mean^2), here converted to decibels.
        bias_db = 5 / np.log(10) * groups["power"].var() / (count * mean["power"] ** 2)
        mean_level = mean_level + bias_db.fillna(0.0).to_numpy()
    table = _note_steps(table, group, level, samples["below"].to_numpy() == 0, keys)

    # `std_db` and `count` are computed for the averages, so they are not columns of the samples.
    stated = {columns.weight, columns.std, *steps.observables, *steps.means} - {"std_db", "count"}
    numeric = [str(name) for name in stated if name in table.frame]
    averages = table.select(~pd.Series(group).duplicated().to_numpy()).assign(
        **{columns.value: sign * mean_level},
        **{name: mean[name].to_numpy() for name in rx},
        **{name: _means(table, name, group) for name in numeric},
        std_db=groups["level"].std().to_numpy(),
        count=count.to_numpy(),
    )
    averages = averages.keep(~uncertain, "averages too near the noise floor, left out")
    enough = averages.numbers("count") >= averaging.minimum_count
    return averages.keep(enough, f"averages of fewer than {averaging.minimum_count} samples, left out")


def _areas(
    table: SourceTable, averaging: Averaging, rx: Sequence[str], apart: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Index of the position, cell, interval or window of each row [rows]; `rx` names the columns of x, y and z [m].

    `apart` [rows] numbers the groups of rows that are averaged separately; the distance travelled is therefore summed
    separately for each group.

    Raises:
        InputError: A column is not numeric, a time cannot be read, or the size is not a number greater than 0.
    """
    if averaging.by == "place":
        positions = np.stack([table.numbers(name) for name in rx], axis=1)
        return join_positions(positions)
    if averaging.size is None or not (np.isfinite(averaging.size) and averaging.size > 0):
        raise InputError(f"average.size = {averaging.size!r}: must be a finite number greater than 0")
    if averaging.by == "time":
        elapsed = _elapsed(table, str(averaging.time))
        return np.floor((elapsed - elapsed.min()) / averaging.size).astype(np.int64)
    positions = np.stack([table.numbers(name) for name in rx[:2]], axis=1)
    if averaging.by == "distance":
        # Intervals of equal length along each track, in row order.
        steps = pd.DataFrame(positions).groupby(apart).diff().fillna(0.0)
        travelled = pd.Series(np.linalg.norm(steps, axis=1)).groupby(apart).cumsum()
        return np.floor(travelled.to_numpy() / averaging.size).astype(np.int64)
    cells = np.floor(positions / averaging.size).astype(np.int64)
    return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)


LATEST: Final = 1e11
"""Largest plausible number of seconds since 1970. Loggers on phones write milliseconds, which are 1000 times larger."""


def _elapsed(table: SourceTable, time: str) -> NDArray[np.float64]:
    """Times of the rows [rows], [s], relative to an arbitrary start."""
    column = table.column(time)
    if pd.api.types.is_numeric_dtype(column):
        seconds = table.numbers(time)
        if seconds.max() > LATEST:
            raise InputError(
                f"{table.source}, column {time!r}: {seconds.max():g} s since 1970 is after the year 5000; give seconds"
            )
        return seconds
    seconds = read_times(table, time)
    if np.isnan(seconds).any():
        raise InputError(f"{table.source}, column {time!r}: a time is missing; remove the row")
    return seconds


SAME_POSITION: Final = 1e-4
"""Difference along each axis up to which positions are treated as equal [m]. Coordinates in files have a resolution of
a millimetre at best, and coordinate conversions differ by micrometres."""


def merge_repeats(table: SourceTable, steps: Preparation, columns: LinkColumns) -> SourceTable:
    """Merge the rows of each link into its first row, with the means of linear power, weights and other numbers.

    Rows belong to the same link if their positions agree to within `SAME_POSITION`, and if they have the same
    transmitter, kept columns, carrier frequency, transmitted power and time. Rows at different times remain separate
    links. Rows below the noise floor are not merged with rows above the floor, and held-out rows are not merged with
    other rows. Receivers inside buildings are moved after merging, because two positions can be moved to the same
    corner. The function uses the steps `keep`, `held_out`, `observables`, `means`, `transmitter`, `noise_floor_dbm` and
    `averaging`. If samples have been averaged, the table is returned unchanged, because no repeats remain.

    Raises:
        InputError: A column is missing or not numeric.

    Example:
        >>> rows = pd.DataFrame({"x": [1.0, 1.0, 2.0], "gain_db": [-80.0, -90.0, -85.0]})
        >>> columns = LinkColumns((0.0, 0.0, 5.0), ("x", 0.0, 1.5), "gain_db", "path_gain")
        >>> merged = merge_repeats(SourceTable(rows), Preparation(), columns)
        >>> merged.frame["gain_db"].round(2).tolist(), merged.changes
        ([-82.6, -85.0], {'rows that repeat a link, merged': 1})
    """
    if steps.averaging is not None:
        return table
    value = table.numbers(columns.value)
    positions = np.hstack([table.positions("tx", columns.tx), table.positions("rx", columns.rx)])
    times = [str(name) for name in table.frame if column_names.matches(name, "time")]
    names = [*_separating_columns(table, steps, columns), *times]
    keys = pd.DataFrame({name: table.column(name) for name in names})
    floor = -np.inf if steps.noise_floor_dbm is None else steps.noise_floor_dbm
    keys["censored"] = value <= floor
    keys[_PART] = 0 if steps.held_out is None else steps.held_out(table)
    group = np.asarray(keys.groupby(list(keys), sort=False, dropna=False).ngroup(), dtype=np.int64)
    link = join_positions(positions, group)
    first = ~pd.Series(link).duplicated().to_numpy()
    if first.all():
        return table
    # A gain or power increases with the linear power, whereas a loss decreases.
    sign = -1.0 if columns.quantity == "path_loss" else 1.0
    level = sign * value
    # Powers are relative to the strongest row of each link, so that the mean of equal values is exactly that value.
    strongest = pd.Series(level).groupby(link).transform("max").to_numpy()
    mean = pd.Series(10 ** ((level - strongest) / 10)).groupby(link).mean().to_numpy()
    merged = {columns.value: sign * (strongest[first] + 10 * np.log10(mean))}
    for name in (columns.weight, columns.std):
        if isinstance(name, str):
            merged[name] = pd.Series(table.numbers(name)).groupby(link).mean().to_numpy()
    for name in [name for name in (*steps.observables, *steps.means) if name in table.frame]:
        merged[name] = _means(table, name, link)
    table = table.note("rows that repeat a link, merged", int((~first).sum()))
    return _note_steps(table, link, level, value > floor, list(map(str, keys))).select(first).assign(**merged)


def _means(table: SourceTable, name: str, group: NDArray[np.int64]) -> NDArray[np.float64]:
    """Mean of a column over each group of rows, ignoring missing values; `group` is the index of the group [rows]."""
    return np.asarray(pd.Series(table.numbers(name, gaps=True)).groupby(group).mean(), dtype=np.float64)


LEAST_STEP_DB: Final = 1.0
"""Smallest effect of a label on the power [dB] that is recorded if rows with different labels are merged into one
link."""

LEAST_RATIO: Final = 5.0
"""Smallest ratio of an effect to its standard error for the effect to be recorded. By chance alone, one in two million
labels exceeds this ratio."""

MOST_LABELS: Final = 50
"""Maximum number of labels in a column that is tested for effects on the power. A column with more labels probably
contains the names of links or positions."""


def _note_steps(
    table: SourceTable,
    link: NDArray[np.int64],
    level: NDArray[np.float64],
    usable: NDArray[np.bool_],
    apart: Sequence[str],
) -> SourceTable:
    """Record text columns (for example, of days) whose labels affect the power, but do not distinguish links.

    Each link counts as one observation of the effect, because the rows of a link can share errors.

    Args:
        table: The rows.
        link: Index of the link or average to which each row belongs [rows].
        level: Power or gain [rows], [dB].
        usable: Mask of the rows with a level above the noise floor [rows].
        apart: Columns whose labels are averaged separately.
    """
    rows = pd.DataFrame({"link": link, "level": level})[usable]
    for name in [str(name) for name in table.frame if name not in apart]:
        labels = table.frame[name][usable]
        few = 2 <= labels.nunique() <= MOST_LABELS
        if pd.api.types.is_numeric_dtype(labels) or labels.isna().any() or not few:
            continue
        largest_db, at = 0.0, ""
        for label in labels.unique():
            own = rows.assign(member=(labels == label).astype(float))
            centred = own - own.groupby("link").transform("mean").assign(link=0)
            products = centred[["level"]].assign(square=centred["member"]).mul(centred["member"], axis=0)
            sums = products.groupby(rows["link"]).sum()
            sums = sums[sums["square"] > 0]
            if len(sums) < FEW:
                continue
            step_db = float(sums["level"].sum() / sums["square"].sum())
            score = sums["level"] - step_db * sums["square"]
            error_db = float(np.sqrt(np.sum(score**2)) / sums["square"].sum())
            if abs(step_db) > max(LEAST_STEP_DB, LEAST_RATIO * error_db, abs(largest_db)):
                largest_db, at = step_db, str(label)
        if at:
            cause = (
                f"rows averaged over several values of {shortened(name)}: the power at {shortened(at)} differs by "
                f"{largest_db:+.1f} dB; name the column in offset.per"
            )
            table = table.note(cause, int(usable.sum()))
    return table


def _separating_columns(table: SourceTable, steps: Preparation, columns: LinkColumns) -> list[str]:
    """Columns that distinguish links at the same positions; samples that differ in such a column are kept apart."""
    groups: Sequence[str] = [columns.group] if isinstance(columns.group, str) else columns.group or ()
    names = [*groups, *steps.keep]
    names += [name for name in (columns.frequency, columns.tx_power_dbm) if isinstance(name, str)]
    if steps.transmitter in table.frame:
        names.append(steps.transmitter)
    return names


def join_positions(
    positions: NDArray[np.float64], group: NDArray[np.int64] | None = None
) -> NDArray[np.int64]:
    """Index [N] of each position [N, axes], [m], among the distinct positions in order of first occurrence.

    Positions within `SAME_POSITION` of each other, directly or through a chain of other positions, are treated as
    equal, unless they belong to different groups [N].

    Example:
        >>> join_positions(np.array([[1.0, 2.0], [1.0, 3.0], [1.0 + 1e-7, 2.0]])).tolist()
        [0, 1, 0]
    """
    place = np.zeros(len(positions), dtype=np.int64) if group is None else group
    count = 0
    # Splitting along one axis can open gaps along the other axes, so splitting is repeated until nothing changes.
    while len(place) and place.max() + 1 != count:
        count = place.max() + 1
        for axis in positions.T:
            order = np.lexsort((axis, place))
            # A position with a missing coordinate (NaN) is never a repeat; a later check rejects it.
            starts = (np.diff(place[order]) > 0) | ~(np.diff(axis[order]) <= SAME_POSITION)
            place = place.copy()
            place[order] = np.concatenate([[0], np.cumsum(starts)])
    return pd.factorize(place)[0]
