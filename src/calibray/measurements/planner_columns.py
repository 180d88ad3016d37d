"""Guess which columns of a table describe transmit antennas, as planning tools and operators name them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import pandas as pd

from calibray.measurements.column_names import matches, numeric_columns, words

LARGEST_ANGLE: Final = {"azimuth_deg": 360.0, "downtilt_deg": 90.0, "electrical_downtilt_deg": 90.0}
"""Largest angle that a column can contain [deg], by its key in ``[links.tx_antenna]``."""

POWERS: Final = (-30.0, 100.0)
"""Smallest and largest transmitted power that a column can contain [dBm]."""


def find_angles(frame: pd.DataFrame, of_transmitters: bool) -> dict[str, str]:
    """Find the columns of azimuth, mechanical and electrical downtilt by the key of ``[links.tx_antenna]``.

    A downtilt whose name states no kind is mechanical, unless the name states that it is the sum of both.

    Args:
        frame: The table.
        of_transmitters: Whether each row is a transmitter; otherwise the names must state that the antenna is a
            transmitter's.

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


def unusable(frame: pd.DataFrame, key: str, column: str) -> str:
    """The reason why a column cannot be the angle of every transmitter; empty if it can."""
    values = pd.to_numeric(frame[column], errors="coerce")
    missing = int(values.isna().sum())
    if missing or column not in numeric_columns(frame):
        return f"{missing or len(frame)} of {len(frame)} rows contain no number; fill them and state the key"
    if values.abs().max() > LARGEST_ANGLE[key]:
        return f"the value {values.abs().max():g} is not an angle in degrees"
    return ""


def find_antenna_names(frame: pd.DataFrame, known: Iterable[str] = ()) -> str | None:
    """Column with the name of each antenna's model or file; of several, the one with the most `known` names."""
    texts = [str(name) for name in frame if not pd.api.types.is_bool_dtype(frame[name])]
    names = [name for name in texts if matches(name, "antenna") and name not in numeric_columns(frame)]
    stems = {plain_name(name) for name in known}
    counts = {name: int(frame[name].map(plain_name).isin(stems).sum()) for name in texts}
    best = max([*names, *texts], key=lambda name: counts[name], default=None)
    if best is not None and counts[best]:
        return best
    return names[0] if names else None


def plain_name(label: object) -> str:
    """An antenna's name without case, punctuation and file extension.

    Example:
        >>> plain_name("80010677_0824 X-CO.MSI") == plain_name("80010677 0824_x_co")
        True
    """
    text = str(label).strip().lower()
    for suffix in (".msi", ".pln", ".ant"):
        text = text.removesuffix(suffix)
    return "".join(character for character in text if character.isalnum())


def find_powers(frame: pd.DataFrame) -> dict[str, str]:
    """Column of EIRP, or otherwise transmitted power, of a table of transmitters, by the key of ``[links]`` [dBm]."""
    likely = [
        name
        for name in numeric_columns(frame)
        if frame[name].between(*POWERS).all() and not words(name) & {"w", "watt", "kw", "mw"}
    ]
    for key, row in (("eirp_dbm", "EIRP"), ("tx_power_dbm", "power")):
        for name in likely:
            if matches(name, row):
                return {key: name}
    return {}
