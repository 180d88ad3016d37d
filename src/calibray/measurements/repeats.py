"""Merge rows that repeat a link, in linear power."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.measurements import column_names
from calibray.measurements.preparation import LinkColumns, Preparation
from calibray.measurements.source_table import SourceTable

SAME_POSITION: Final = 1e-4
"""Distance [m] per axis up to which positions are equal, as in meshes: coordinates are written to a millimetre at best,
and conversions of coordinates differ by micrometres."""


def merge_repeats(table: SourceTable, steps: Preparation, columns: LinkColumns) -> SourceTable:
    """Merge the rows of one link.

    Rows are of one link if their positions agree within `SAME_POSITION`, and transmitter, groups, carrier, transmitted
    power and times are equal. Rows at different times stay separate links. A link below the noise floor is not merged
    with one above it.

    Args:
        table: The rows, before receivers inside buildings are moved: two positions may be moved to one corner.
        steps: The steps that the rows went through; `keep`, `transmitter`, `noise_floor_dbm` and `averaging` are used
            here. Averages merge repeats already.
        columns: The columns that describe the links; positions in metres.

    Returns:
        For each link its first row, with the value of the mean linear power and the mean weight or standard
        deviation. The table itself if no row repeats a link.

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
    keys = pd.DataFrame({name: table.column(name) for name in _separating_columns(table, steps, columns)})
    floor = -np.inf if steps.noise_floor_dbm is None else steps.noise_floor_dbm
    keys["censored"] = value <= floor
    group = np.asarray(keys.groupby(list(keys), sort=False, dropna=False).ngroup(), dtype=np.int64)
    link = join_positions(positions, group)
    first = ~pd.Series(link).duplicated().to_numpy()
    if first.all():
        return table
    # A gain or power rises with the linear power, a loss falls with it.
    sign = -1.0 if columns.quantity == "path_loss" else 1.0
    level = sign * value
    # Relative to the strongest row of each link, so that equal values stay equal to the last digit.
    strongest = pd.Series(level).groupby(link).transform("max").to_numpy()
    mean = pd.Series(10 ** ((level - strongest) / 10)).groupby(link).mean().to_numpy()
    merged = {columns.value: sign * (strongest[first] + 10 * np.log10(mean))}
    for name in (columns.weight, columns.std):
        if isinstance(name, str):
            merged[name] = pd.Series(table.numbers(name)).groupby(link).mean().to_numpy()
    return table.note("rows that repeat a link, merged", int((~first).sum())).select(first).assign(**merged)


def _separating_columns(table: SourceTable, steps: Preparation, columns: LinkColumns) -> list[str]:
    """Columns whose values differ between different links at the same positions."""
    groups: Sequence[str] = [columns.group] if isinstance(columns.group, str) else columns.group or ()
    names = [*groups, *steps.keep]
    names += [name for name in (columns.frequency, columns.tx_power_dbm) if isinstance(name, str)]
    if steps.transmitter in table.frame:
        names.append(steps.transmitter)
    names += [str(name) for name in table.frame if column_names.matches(str(name), "time")]
    return list(dict.fromkeys(names))


def join_positions(
    positions: NDArray[np.float64], group: NDArray[np.int64] | None = None
) -> NDArray[np.int64]:
    """Number the places of positions: those within `SAME_POSITION` of each other, also step by step, are one place.

    Args:
        positions: The positions [N, axes], [m].
        group: Positions of different groups are different places [N]; one group if None.

    Returns:
        Number of each position's place [N], in the order of the first positions.

    Example:
        >>> join_positions(np.array([[1.0, 2.0], [1.0, 3.0], [1.0 + 1e-7, 2.0]])).tolist()
        [0, 1, 0]
    """
    place = np.zeros(len(positions), dtype=np.int64) if group is None else group
    count = 0
    # Splitting along one axis opens gaps along the others.
    while len(place) and place.max() + 1 != count:
        count = place.max() + 1
        for axis in positions.T:
            order = np.lexsort((axis, place))
            # A position that is not a number is never a repeat; it is refused later.
            starts = (np.diff(place[order]) > 0) | ~(np.diff(axis[order]) <= SAME_POSITION)
            place = place.copy()
            place[order] = np.concatenate([[0], np.cumsum(starts)])
    return pd.factorize(place)[0]
