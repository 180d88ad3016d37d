"""Selection of rows, and addition of columns: wide tables, tracks, filters, transmitters, noise floor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.measurements.placement import join_track
from calibray.measurements.preparation import Preparation
from calibray.measurements.source_table import SourceTable
from calibray.support.messages import MAX_LISTED, did_you_mean, shortened
from calibray.tables import rows_text


def select_rows(table: SourceTable, steps: Preparation, value: str = "") -> SourceTable:
    """Select the rows that become links.

    The steps `wide`, `track`, `where`, `missing`, `flights`, `transmitters`, `check`, `computed`, `noise_floor_dbm` and
    `censored` are applied in this order. A filter can therefore use the columns of the track, but not those of the
    transmitters. `value` is the column of the measured values; with `wide`, it is the name of the new column. Codes for
    missing values (`find_codes`) are treated as missing. With a noise floor, missing values and values below the floor
    are set to the floor.

    Raises:
        InputError: A column is missing or malformed, a transmitter is unknown, or no row remains.

    Example:
        >>> wide = pd.DataFrame({"x": [0.0, 5.0], "ap1": [-40.0, -52.0], "ap2": [-61.0, np.nan]})
        >>> steps = Preparation(wide={"ap1": "AP 1", "ap2": "AP 2"})
        >>> select_rows(SourceTable(wide), steps, "rss").frame
             x transmitter   rss
        0  0.0        AP 1 -40.0
        1  0.0        AP 2 -61.0
        2  5.0        AP 1 -52.0
    """
    return complete_rows(choose_rows(table, steps, value), steps, value)


def choose_rows(table: SourceTable, steps: Preparation, value: str) -> SourceTable:
    """Apply the steps of `select_rows` that choose rows: `wide`, `track` and `where`."""
    if steps.wide:
        counted = sum(table.changes.values())
        table, _ = mask_codes(table, list(steps.wide), steps.missing)
        coded = sum(table.changes.values()) - counted
        table = melt(table, steps.wide, value, steps.transmitter, coded=coded)
    if steps.track is not None:
        table = join_track(table, steps.track)
    if steps.where is not None:
        mask = table.where(steps.where)
        if not mask.any():
            raise InputError(
                f"{table.source}: where = {shortened(steps.where)!r} selects no rows (out of {len(table)}); change the "
                "filter"
            )
        table = table.select(mask)
    return table


def complete_rows(table: SourceTable, steps: Preparation, value: str) -> SourceTable:
    """Apply the other steps of `select_rows`, which add columns and leave out rows without a usable value."""
    if value in table.frame:
        table, coded = mask_codes(table, [value], steps.missing)
        # If there is a noise floor, a missing power was too weak to be measured. Otherwise, a missing power carries no
        # information.
        if steps.noise_floor_dbm is None and coded.any():
            if coded.all():
                raise InputError(
                    f"{table.source}: column {value!r} contains no measured value; check links.missing"
                )
            table = table.select(~coded)
    for name in dict.fromkeys([*steps.flights, *steps.observables]):
        if name not in table.frame:
            continue
        numbers = _numbers(table.frame[name])
        # A K-factor of -1 dB is valid, so only numbers of large magnitude are treated as codes, except in times of
        # flight.
        smallest = 0.0 if name in steps.flights else LARGEST_LEVEL
        found = [code for code in find_codes(numbers, np.inf) if abs(code) >= smallest]
        coded = np.isin(numbers, [*found, *steps.missing])
        if coded.any():
            codes = ", ".join(f"{code:g}" for code in np.unique(numbers[coded]))
            cause = f"codes for missing values in {name} ({codes})"
            table = table.assign(**{name: table.frame[name].mask(coded)}).note(cause, coded.sum())
    if steps.transmitters is not None:
        table = _join_transmitters(table, steps.transmitters, steps.transmitter)
    if steps.check is not None:
        steps.check(table)
    for name, compute in steps.computed.items():
        values = compute(table)
        table = table if values is None else table.assign(**{name: values})
    if steps.noise_floor_dbm is not None:
        table = _apply_noise_floor(table, steps, steps.noise_floor_dbm, value)
    return table


def melt(
    table: SourceTable,
    columns: Mapping[str, str],
    value: str,
    transmitter: str,
    *,
    keep_empty: bool = False,
    coded: int = 0,
) -> SourceTable:
    """Convert a table with one column per transmitter to one row per link. Links from the same row stay together.

    `value` and `transmitter` are the names of the new columns. With `keep_empty`, cells without a value also become
    links, as prediction requires. `coded` is the number of empty cells that contained codes; these cells have already
    been counted.

    Raises:
        InputError: A column is missing, not numeric or has the name of a new column, or no cell has a value.
    """
    if len(set(columns.values())) != len(columns):
        raise InputError(
            f"wide = {dict(columns)}: two columns have the same transmitter; use a different transmitter name for each "
            "column"
        )
    others = [name for name in table.frame if name not in columns]
    for name in (value, transmitter):
        if name in others:
            raise InputError(f"{table.source}: column {name!r} already exists; choose another name")
    values = np.column_stack([table.numbers(name, gaps=True) for name in columns])
    # In row-major order, links from the same row stay together.
    row, column = np.nonzero(~np.isnan(values) | keep_empty)
    if not len(row):
        raise InputError(f"{table.source}: the columns {', '.join(columns)} contain no value")
    frame = table.frame[others].iloc[row].reset_index(drop=True)
    frame[transmitter] = np.array(list(columns.values()))[column]
    frame[value] = values[row, column]
    long = replace(table, frame=frame, row=table.row[row])
    empty = values.size - len(row) - coded
    return long.note("cells without a value", empty) if empty else long


def plain_labels(column: Iterable[object]) -> list[str]:
    """Normalize labels: lower case, no leading or trailing white space, 5 instead of 5.0, colons instead of hyphens.

    Tools write the same address in different forms, such as `AA-BB` and `aa:bb`, and write whole numbers as floats if a
    column has gaps.

    Example:
        >>> plain_labels(["C4-64", "c4:64 ", 5.0])
        ['c4:64', 'c4:64', '5']
    """
    texts = (
        f"{label:.0f}" if isinstance(label, float) and label % 1 == 0 else str(label) for label in column
    )
    return [text.strip().casefold().replace("-", ":") for text in texts]


def comparison(names: Iterable[object]) -> Callable[[Iterable[object]], list[str]]:
    """Choose how to normalize names for comparison: `plain_labels`, or `str` if `plain_labels` merges two names."""
    texts = list(map(str, names))
    if len(set(plain_labels(texts))) == len(set(texts)):
        return plain_labels
    return lambda labels: list(map(str, labels))


def naming_column(transmitters: pd.DataFrame, labels: Iterable[object]) -> str | None:
    """Find the column of transmitter names in a table of transmitters; None unless exactly one column qualifies.

    The values of a qualifying column are distinct and include at least half of the given labels.

    Example:
        >>> naming_column(pd.DataFrame({"id": ["a", "b"], "height": [5.0, 5.0]}), ["b", "b"])
        'id'
    """
    labels, columns = list(labels), []
    for name in transmitters:
        compared = comparison(transmitters[name])
        names, wanted = set(compared(transmitters[name])), set(compared(labels))
        if len(names) == len(transmitters) and len(wanted & names) >= max(len(wanted) / 2, 1):
            columns.append(str(name))
    return columns[0] if len(columns) == 1 else None


def distinct_rows(transmitters: SourceTable) -> SourceTable:
    """The distinct rows of a table of transmitters."""
    return transmitters.select(~transmitters.frame.duplicated().to_numpy())


def repeated_label(transmitters: SourceTable, column: str) -> str:
    """Message that names the first repeated label in a column, and its rows; empty if all labels are distinct."""
    names = transmitters.frame[column]
    if not (repeated := names.duplicated() & names.notna()).any():
        return ""
    label = names[repeated].iloc[0]
    rows = rows_text(transmitters.row[(names == label).to_numpy(bool)].tolist())
    return (
        f"{transmitters.source}: {shortened(str(label))!r} appears in {rows} of column {column!r}; give each "
        "transmitter its own name, or remove all but one of these rows"
    )


def _join_transmitters(table: SourceTable, transmitters: SourceTable, key: str) -> SourceTable:
    """Add the columns of the transmitter table to the links, and adopt the spelling of its transmitter names.

    The column of names in the transmitter table can have a name other than `key`.

    Raises:
        InputError: A name is repeated or unknown, or a new column would have the name of an existing column.
    """
    transmitters = distinct_rows(transmitters)
    label_of_link = table.labels(key).tolist()
    name = key if key in transmitters.frame else naming_column(transmitters.frame, label_of_link) or key
    labels = transmitters.labels(name).tolist()
    if repeated := repeated_label(transmitters, name):
        raise InputError(repeated)
    compared = comparison(labels)
    index_of_label = {label: index for index, label in enumerate(compared(labels))}
    compared_of_link = compared(label_of_link)
    lacking = np.array([label not in index_of_label for label in compared_of_link])
    if lacking.any():
        unknown = table.frame.loc[lacking, key].unique().tolist()
        cells = ", ".join(map(repr, unknown[:MAX_LISTED]))
        more = f" and {len(unknown) - MAX_LISTED} more" if len(unknown) > MAX_LISTED else ""
        raise InputError(
            f"{table.source}: {transmitters.source} lacks {cells}{more}, the {key} of {lacking.sum()} of {len(table)} "
            f"rows; {did_you_mean(str(unknown[0]), labels)}; or add the names to that table, or remove these rows: "
            f'in a study, set links.where = "`{key}` not in [{cells}]"'
        )
    index = [index_of_label[label] for label in compared_of_link]
    spelled = np.array(labels)[index]
    # Two spellings of one name must not become two groups.
    if (spelled != label_of_link).any():
        table = table.assign(**{key: spelled})
    joined = transmitters.frame.drop(columns=name).iloc[index]
    # Columns of the links keep their names, because filters and positions refer to these names.
    renamed = {name: f"{key}_{name}" if name in table.frame else str(name) for name in joined}
    for name, new in renamed.items():
        if new in table.frame or list(renamed.values()).count(new) > 1:
            raise InputError(
                f"{transmitters.source}: column {name!r} would become {new!r}, because {table.source} also has a "
                f"column {name!r}, but a column {new!r} already exists; rename column {name!r} in one of these tables"
            )
    joined = joined.rename(columns=renamed)
    origin = {new: (transmitters.source, str(name), key) for name, new in renamed.items()}
    frame = pd.concat([table.frame.reset_index(drop=True), joined.reset_index(drop=True)], axis=1)
    return replace(table, frame=frame, joined=origin)


def _apply_noise_floor(table: SourceTable, steps: Preparation, floor: float, value: str) -> SourceTable:
    """Set powers at or below the noise floor to the floor. These rows are left out unless a later step uses them."""
    power = table.numbers(value, gaps=True)
    below = ~(power > floor)  # A missing power counts as below the floor.
    table = table.assign(**{value: np.where(below, floor, power)})
    if steps.censored:
        return table.note("at or below the noise floor, treated as censored", below.sum())
    if steps.averaging is None:
        return table.keep(~below, "at or below the noise floor, left out")
    return table


CODES: Final = (
    *(0, 1, -1, 99, 100, 101, 127, 128, 255, 500, 999, 1000, 9999, 32767, 65535, 99999, 2147483647),
    *(-200, -255, -256, -500, -999, -1000, -9999, -32768, -99999, -2147483648),
)  # fmt: skip
"""Numbers that loggers write as codes for missing values, for example in UJIIndoorLoc (100), Wi-Fi RTT logs (-200) and
Android logs (2147483647)."""

MIN_GAP_DB: Final = 20.0
"""Minimum difference between a code and any measured value [dB]."""

LARGEST_LEVEL: Final = 190.0
"""Largest plausible magnitude of a power [dBm] or gain [dB]. A number in `CODES` with a larger magnitude is a code
regardless of its sign."""


def find_codes(values: ArrayLike, largest: float = LARGEST_LEVEL) -> tuple[float, ...]:
    """Find the codes for missing values among values [n], such as powers [dBm], in ascending order.

    A number in `CODES` is a code if it is far from all other values and has either the opposite sign or a magnitude
    above `largest`. For example, 100 is a code among powers, but a value among path losses.

    Example:
        >>> find_codes([-70.0, 100.0, -200.0]), find_codes([70.0, 100.0, 130.0])
        ((-200.0, 100.0), ())
    """
    numbers = np.asarray(values, dtype=np.float64)
    distinct = np.unique(numbers[np.isfinite(numbers)])
    is_candidate = np.isin(distinct, CODES)
    # A path loss of 100 dB is a candidate, but it is close to other path losses.
    measured = distinct[~is_candidate]
    if not len(measured):
        return ()
    # Losses are positive, whereas powers and gains are negative.
    sign = np.sign(np.median(measured))
    return tuple(
        float(code)
        for code in distinct[is_candidate]
        if (np.sign(code) != sign or abs(code) > largest) and np.min(np.abs(measured - code)) >= MIN_GAP_DB
    )


def without_codes(column: pd.Series) -> pd.Series:
    """A column of numbers with NaN in place of codes."""
    return column.mask(column.isin(find_codes(_numbers(column))))


def mask_codes(
    table: SourceTable, columns: Sequence[str], stated: Sequence[float] = ()
) -> tuple[SourceTable, NDArray[np.bool_]]:
    """Replace codes in columns of measured values by missing values, and record the number of replaced codes.

    Codes are detected in all columns together, so all columns must contain the same quantity. The `stated` codes are
    always replaced. Returns the table, and a mask [rows] of the rows that contained a code.

    Raises:
        InputError: A column does not exist.
    """
    values = np.column_stack([_numbers(table.column(name)) for name in columns])
    codes = sorted({*find_codes(values), *map(float, stated)})
    coded = np.isin(values, codes)
    if not coded.any():
        return table, np.zeros(len(table), dtype=bool)
    changed = {
        name: table.frame[name].mask(coded[:, index])
        for index, name in enumerate(columns)
        if coded[:, index].any()
    }
    present = ", ".join(f"{code:g}" for code in codes if (values == code).any())
    table = table.assign(**changed).note(f"codes for missing values ({present})", int(coded.sum()))
    return table, np.asarray(coded.any(axis=1))


def _numbers(column: pd.Series) -> NDArray[np.float64]:
    """The numbers [rows] in a column. Text becomes NaN; later steps that need the values reject text."""
    if not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_string_dtype(column)):
        return np.full(len(column), np.nan)
    return pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
