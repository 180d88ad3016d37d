"""Find the columns that describe transmitters.

Such a column contains the names of transmitters (in a table of links or transmitters), the values of one transmitter,
or data of transmit antennas. Planning tools and operators use different names for these columns.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.column_names import WATTS, is_named_value, matches, numeric_columns, words
from calibray.measurements.selection import comparison, naming_column, repeated_label
from calibray.measurements.source_table import SourceTable

MAX_DEVICES: Final = 12
"""Maximum number of receiving devices. A column with more distinct values probably contains a different quantity, such
as a location."""


def find_wide_columns(frame: pd.DataFrame, transmitters: Iterable[str]) -> dict[str, str]:
    """Find the columns of a wide table, and the transmitter of each column.

    The names of these columns differ only in the transmitter's name, which is delimited by separators. If the
    table contains several quantities, the columns of received power or path loss are chosen. The result is empty if
    fewer than two columns qualify.

    Example:
        >>> find_wide_columns(pd.DataFrame({"x": [1.0], "rss_a": [-50.0], "rss_b": [-60.0]}), ["a", "b"])
        {'rss_a': 'a', 'rss_b': 'b'}
        >>> list(find_wide_columns(pd.DataFrame(columns=["A RTT(mm)", "B RTT(mm)", "A RSS", "B RSS"]), ["A", "B"]))
        ['A RSS', 'B RSS']
    """
    # Columns, grouped by the parts of their names before and after the transmitter, such as " RSS(dBm)" in "AP1
    # RSS(dBm)".
    families: dict[tuple[str, str], dict[str, str]] = {}
    for name in transmitters:
        pattern = re.compile(rf"(|.*[^a-z0-9]){re.escape(name.lower())}(|[^a-z0-9].*)")
        for column in frame:
            if match := pattern.fullmatch(str(column).lower()):
                families.setdefault((match[1], match[2]), {})[str(column)] = name
    measured = {
        rest: columns
        for rest, columns in families.items()
        if len(columns) > 1 and not matches(" ".join(rest), "another quantity")
    }
    return max(
        measured.values(),
        key=lambda columns: (all(is_named_value(column) for column in columns), len(columns)),
        default={},
    )


def find_unknown_wide_columns(frame: pd.DataFrame, columns: Mapping[str, str]) -> list[str]:
    """Find columns of a wide table that are named like those of the known transmitters, but belong to other ones.

    Example:
        >>> table = pd.DataFrame(columns=["x", "rss_a", "rss_b", "rss_c"])
        >>> find_unknown_wide_columns(table, {"rss_a": "a", "rss_b": "b"})
        ['rss_c']
        >>> table = pd.DataFrame(columns=["x", "WAP1", "WAP2", "WAP13"])
        >>> find_unknown_wide_columns(table, {"WAP1": "WAP1", "WAP2": "WAP2"})
        ['WAP13']
    """
    column, name = next(iter(columns.items()))
    before, _, after = column.lower().rpartition(name.lower())
    # If column names consist only of the transmitter's name, unknown columns differ from known columns only in digits.
    middle = r"[^ _]+" if before + after else re.sub(r"\d+", r"\\d+", re.escape(name.lower()))
    pattern = re.compile(rf"{re.escape(before)}{middle}{re.escape(after)}")
    return [str(other) for other in frame if other not in columns and pattern.fullmatch(str(other).lower())]


def name_melted_values(columns: Iterable[str]) -> str:
    """Name for the column that combines the columns of a wide table, based on a word that all their names share.

    Example:
        >>> name_melted_values(["RSS AP1", "RSS AP2"])
        'rss_value'
    """
    shared = frozenset.intersection(*map(words, columns))
    terms = ("rsrp", "rss", "rssi", "loss", "pl", "gain")
    return next((term for term in terms if term in shared), "rss") + "_value"


def find_shared_key(links: pd.DataFrame, transmitters: pd.DataFrame) -> str | None:
    """Find the column that contains transmitter names in both tables; None if there is no such column.

    The values of this column are distinct in the table of transmitters. The first column that contains all values of
    the links is chosen. If no column contains all these values, the first column is chosen that shares a value with the
    links and whose name indicates a transmitter.
    """
    partial = None
    for name in transmitters:
        compared = comparison(transmitters[name])
        values = set(compared(transmitters[name]))
        if name not in links or len(values) != len(transmitters):
            continue
        labels = set(compared(links[name].dropna()))
        if labels <= values:
            return str(name)
        if partial is None and labels & values and matches(name, "transmitter", "name of a transmitter"):
            partial = str(name)
    return partial


def find_naming_key(links: pd.DataFrame, transmitters: pd.DataFrame) -> tuple[str, str] | None:
    """Find the column of transmitter names in the links, and the matching column in the table of transmitters.

    Columns whose names indicate transmitters are tried first, followed by other text columns.

    Example:
        >>> links = pd.DataFrame({"gateway_id": ["a", "b", "a"], "rssi": [-80, -90, -85]})
        >>> find_naming_key(links, pd.DataFrame({"id": ["a", "b", "c"], "x": [0, 50, 90]}))
        ('gateway_id', 'id')
    """
    for name in sorted(links, key=lambda name: not matches(name, "transmitter")):
        labels = links[name].dropna().drop_duplicates()
        is_likely = matches(name, "transmitter") or not pd.api.types.is_numeric_dtype(labels)
        if is_likely and len(labels):
            of_table = naming_column(transmitters, labels)
            if of_table is not None:
                return str(name), of_table
    return None


def find_transmitter_of_positions(frame: pd.DataFrame, position: Sequence[str]) -> str | None:
    """Find the column of transmitter names in a table that also contains the transmitter positions.

    Each name must have a single position.

    Example:
        >>> links = pd.DataFrame({"cell": ["a", "b", "a"], "tx_x": [0, 50, 0], "tx_y": 0, "rsrp": [-80, -90, -85]})
        >>> find_transmitter_of_positions(links, ["tx_x", "tx_y"])
        'cell'
        >>> find_transmitter_of_positions(links.rename(columns={"cell": "tx"}), ["tx_x", "tx_y"])
        'tx'
    """
    positions = frame.groupby(list(position), dropna=False).ngroup()
    quantities = ("x", "y", "longitude", "latitude", "height", "power", "frequency", "another quantity")
    for name in frame:
        is_number = pd.api.types.is_numeric_dtype(frame[name])
        is_name = pd.api.types.is_integer_dtype(frame[name]) or not is_number
        if not is_name or not matches(name, "transmitter") or name in position:
            continue
        is_quantity = is_number and matches(name, *quantities) and not matches(name, "name of a transmitter")
        if not is_quantity and positions.groupby(frame[name], dropna=False).nunique().max() == 1:
            return str(name)
    return None


def find_transmitter_names(transmitters: SourceTable) -> list[str]:
    """Find the columns of names, such as those of sites and cells, in a table with one row per transmitter.

    Raises:
        InputError: No column of names distinguishes the transmitters.
    """
    frame = transmitters.frame
    names = [str(name) for name in frame if matches(name, "name of a transmitter", "transmitter")]
    distinct = [name for name in names if frame[name].nunique() == len(frame)]
    if distinct:
        return distinct
    fullest = max(names, key=lambda name: frame[name].nunique(), default=None)
    repeated = "" if fullest is None else repeated_label(transmitters, fullest)
    raise InputError(
        repeated
        or f"{transmitters.source}: none of the columns {', '.join(map(str, frame))} contains distinct names; "
        "name a column with distinct names 'transmitter'"
    )


def find_devices(frame: pd.DataFrame) -> list[str]:
    """Find the columns whose values can identify receiving devices."""
    quantities = (
        "x", "y", "longitude", "latitude", "height", "altitude or floor", "azimuth", "downtilt", "path gain", "power",
        "received power", "path loss", "decibel", "frequency", "bandwidth or shift", "time", "distance",
    )  # fmt: skip
    return [
        str(name)
        for name in frame
        if matches(name, "receiving device")
        and not matches(name, *quantities)
        and 1 < frame[name].nunique() <= MAX_DEVICES
    ]


LARGEST_ANGLE: Final = {"azimuth_deg": 360.0, "downtilt_deg": 90.0, "electrical_downtilt_deg": 90.0}
"""Largest plausible angle in a column [deg], by the key of the column in ``[links.tx_antenna]``."""

POWERS: Final = (-30.0, 100.0)
"""Smallest and largest plausible transmitted power in a column [dBm]."""


def find_angles(frame: pd.DataFrame, of_transmitters: bool) -> dict[str, str]:
    """Find the columns of azimuth, mechanical and electrical downtilt; the keys are those of ``[links.tx_antenna]``.

    A downtilt column whose name does not state the kind is treated as mechanical downtilt. Columns with the sum of both
    tilts are ignored. If the rows are not transmitters, the column names must indicate a transmitter or an antenna.

    Example:
        >>> frame = pd.DataFrame(columns=["Azimuth (°)", "Mechanical Downtilt (°)", "E-Tilt", "Total Tilt"])
        >>> find_angles(frame, of_transmitters=True)
        {'azimuth_deg': 'Azimuth (°)', 'downtilt_deg': 'Mechanical Downtilt (°)', 'electrical_downtilt_deg': 'E-Tilt'}
    """
    names = [
        str(name)
        for name in frame
        if not matches(name, "receiver", "sum of both tilts")
        and (of_transmitters or matches(name, "transmitter", "antenna"))
    ]
    tilts = [name for name in names if matches(name, "downtilt")]
    electrical = [name for name in tilts if matches(name, "electrical")]
    mechanical = [name for name in tilts if matches(name, "mechanical") and name not in electrical]
    plain = [name for name in tilts if name not in (*electrical, *mechanical)]
    columns_of = {
        "azimuth_deg": [name for name in names if matches(name, "azimuth") and name not in tilts],
        "downtilt_deg": [*mechanical, *plain],
        "electrical_downtilt_deg": electrical,
    }
    return {key: columns[0] for key, columns in columns_of.items() if columns}


def lacks_angle(column: pd.Series, may_be_empty: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask [rows] of the cells without a number, except for empty cells in rows where `may_be_empty` [rows] is true."""
    lacking = pd.to_numeric(column, errors="coerce").isna() & ~(column.isna() & may_be_empty)
    return lacking.to_numpy(bool)


def unusable(frame: pd.DataFrame, key: str, column: str, lacking: NDArray[np.bool_]) -> str:
    """The reason why a column cannot contain the angles of the transmitters; empty if it can.

    `lacking` is the result of `lacks_angle`.
    """
    values = pd.to_numeric(frame[column], errors="coerce")
    missing = len(frame) if values.isna().all() else int(lacking.sum())
    if missing or column not in numeric_columns(frame):
        return f"no number in {missing or len(frame)} of {len(frame)} rows; add the numbers and state the key"
    if values.abs().max() > LARGEST_ANGLE[key]:
        return f"the value {values.abs().max():g} is not an angle in degrees"
    return ""


def find_antenna_names(frame: pd.DataFrame, known: Iterable[str] = ()) -> str | None:
    """Find the column that contains the names of antenna models or antenna files.

    If several columns qualify, the column with the most `known` names is chosen.
    """
    texts = [str(name) for name in frame if not pd.api.types.is_bool_dtype(frame[name])]
    names = [name for name in texts if matches(name, "antenna") and name not in numeric_columns(frame)]
    stems = {plain_name(name) for name in known}
    counts = {name: int(frame[name].map(plain_name).isin(stems).sum()) for name in texts}
    best = max([*names, *texts], key=lambda name: counts[name], default=None)
    if best is not None and counts[best]:
        return best
    return names[0] if names else None


def plain_name(label: object) -> str:
    """The name of an antenna in lower case, without punctuation or file extension.

    Example:
        >>> plain_name("80010677_0824 X-CO.MSI") == plain_name("80010677 0824_x_co")
        True
    """
    text = str(label).strip().lower()
    for suffix in (".msi", ".pln", ".ant"):
        text = text.removesuffix(suffix)
    return "".join(character for character in text if character.isalnum())


def find_powers(frame: pd.DataFrame) -> dict[str, str]:
    """Find the column of EIRP [dBm] or, failing that, of transmitted power [dBm], by its key in ``[links]``."""
    likely = [
        name
        for name in numeric_columns(frame)
        if frame[name].between(*POWERS).all() and not words(name) & WATTS
    ]
    for key, row in (("eirp_dbm", "EIRP"), ("tx_power_dbm", "power")):
        for name in likely:
            if matches(name, row):
                return {key: name}
    return {}
