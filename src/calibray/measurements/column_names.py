"""Guessing: what the columns of a table of links are, by their names and checked against their values."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.measurements.links import FREQUENCIES
from calibray.measurements.reading import Quantity
from calibray.measurements.table_files import SourceTable

ENDS: Final = {
    "tx": frozenset({"tx", "transmitter", "bs", "site", "cell", "ap", "gnb", "enb", "base", "anchor"}),
    "rx": frozenset({"rx", "receiver", "ue", "phone", "mobile", "device"}),
}
_X: Final = frozenset({"x", "east", "easting"})
_Y: Final = frozenset({"y", "north", "northing"})
_LONGITUDE: Final = frozenset({"lon", "lng", "long", "longitude"})
_LATITUDE: Final = frozenset({"lat", "latitude"})
_HEIGHT: Final = frozenset({"z", "h", "height"})
_QUANTITIES: Final = (
    ("path_loss", frozenset({"pl", "loss", "pathloss"})),
    ("path_gain", frozenset({"gain", "pathgain"})),
    ("rsrp", frozenset({"rsrp", "rssi", "rss", "dbm", "prx", "power", "level", "rxlev", "signal"})),
)
_OTHER: Final = frozenset(
    {
        "std",
        "sigma",
        "snr",
        "sinr",
        "rsrq",
        "count",
        "n",
        "number",
        "noise",
        "floor",
        "eirp",
        "tx",
        "id",
        "error",
    }
)
_GROUPS: Final = frozenset({"device", "phone", "ue", "receiver", "rx", "handset"})
_TIME: Final = frozenset({"time", "timestamp", "date", "datetime", "utc", "epoch"})
_NAMES: Final = frozenset({"id", "name", "transmitter", *ENDS["tx"]})


@dataclass(frozen=True)
class Place:
    """The columns of one end's position.

    Attributes:
        position: "scene" for metres, "geographic" for degrees.
        x: Column of x, or of longitudes.
        y: Column of y, or of latitudes.
        height: Column of heights; None where there is none.
    """

    position: Literal["scene", "geographic"]
    x: str
    y: str
    height: str | None


@dataclass(frozen=True)
class Value:
    """The column of measured values.

    Attributes:
        column: The column.
        quantity: What it holds.
        reason: Why it is taken for that.
    """

    column: str
    quantity: Quantity
    reason: str


def words(name: object) -> frozenset[str]:
    """The words of a column's name, in lower case.

    Args:
        name: The name.

    Returns:
        Its words.

    Example:
        >>> sorted(words("Rx_X [m]"))
        ['m', 'rx', 'x']
    """
    return frozenset(filter(None, re.split(r"[^a-z0-9]+", str(name).lower())))


def place(frame: pd.DataFrame, end: Literal["tx", "rx"], own: bool) -> Place | None:
    """Find the columns of one end's position; metres are preferred to degrees.

    Args:
        frame: The table.
        end: Which end.
        own: Whether columns that name no end are this one's.

    Returns:
        The columns, or None.

    Example:
        >>> place(pd.DataFrame({"time": [0], "lat": [50.0], "lon": [10.0]}), "rx", own=True)
        Place(position='geographic', x='lon', y='lat', height=None)
    """
    other = ENDS["rx" if end == "tx" else "tx"]
    named = [name for name in numeric(frame) if words(name) & ENDS[end] and not words(name) & other]
    free = [name for name in numeric(frame) if own and not words(name) & (ENDS["tx"] | ENDS["rx"])]
    for names in (named, free):
        height = _first(names, _HEIGHT)
        for position, east, north in (("scene", _X, _Y), ("geographic", _LONGITUDE, _LATITUDE)):
            x, y = _first(names, east), _first(names, north)
            if x is not None and y is not None:
                return Place(position, x, y, height)  # type: ignore[arg-type]
    return None


def height(frame: pd.DataFrame, end: Literal["tx", "rx"]) -> str | None:
    """The column of an end's heights, where it has no other coordinates.

    Args:
        frame: The table.
        end: Which end.

    Returns:
        The column, or None.
    """
    return _first([name for name in numeric(frame) if words(name) & ENDS[end]], _HEIGHT)


def measured(table: SourceTable, source: str) -> Value:
    """Find the column of measured values.

    Args:
        table: The links.
        source: Their file, for messages.

    Returns:
        The column and its quantity.

    Raises:
        InputError: No column looks like one.
    """
    found = []
    for name in numeric(table.frame):
        told = words(name)
        if told & _OTHER:
            continue
        for rank, (quantity, terms) in enumerate(_QUANTITIES):
            if told & terms:
                found.append((not told & {"db", "dbm"}, rank, quantity, name))
                break
    fitting = [
        entry for entry in sorted(found, key=lambda entry: entry[:2]) if _fits(table, entry[3], entry[2])
    ]
    if not fitting:
        raise InputError(
            f"{source}: no column looks like path loss, path gain or received power "
            f"({', '.join(map(str, table.frame))}); name it path_loss_db, path_gain_db or rsrp_dbm"
        )
    _, _, quantity, name = fitting[0]
    middle = float(np.nanmedian(table.frame[name]))
    reason = f"its name, and values about {middle:.0f}"
    if quantity == "path_loss" and middle < 0:
        quantity, reason = "path_gain", f"called a loss, but values are negative, about {middle:.0f}: a gain"
    elif quantity == "path_gain" and middle > 0:
        quantity, reason = "path_loss", f"called a gain, but values are positive, about {middle:.0f}: a loss"
    others = [entry[3] for entry in fitting[1:]]
    return Value(name, quantity, reason + (f"; not {', '.join(others)}" if others else ""))  # type: ignore[arg-type]


def transmitted(frame: pd.DataFrame) -> str | None:
    """The column of transmitted powers [dBm], or None.

    Args:
        frame: The links.

    Returns:
        The column.
    """
    for name in numeric(frame):
        told = words(name)
        if "eirp" in told or (told & {"tx", "transmit", "transmitted"} and told & {"power", "dbm"}):
            return name
    return None


def wide(frame: pd.DataFrame, names: Iterable[str]) -> dict[str, str]:
    """The columns of a table with one column a transmitter.

    Args:
        frame: The table.
        names: The transmitters' names.

    Returns:
        Transmitter by column: columns called like it, or ending in its name after a sign; empty if fewer than two.

    Example:
        >>> wide(pd.DataFrame({"x": [1.0], "rss_a": [-50.0], "rss_b": [-60.0]}), ["a", "b"])
        {'rss_a': 'a', 'rss_b': 'b'}
    """
    found = {
        str(column): name
        for name in names
        for column in frame
        if re.fullmatch(rf"(.*[^a-z0-9])?{re.escape(name.lower())}", str(column).lower())
    }
    return found if len(found) > 1 else {}


def common_value(columns: Iterable[str]) -> str:
    """What the column of values is called that columns of transmitters become: by the words that all have in common.

    Args:
        columns: The columns, at least one.

    Returns:
        The name.

    Example:
        >>> common_value(["RSS AP1", "RSS AP2"])
        'rss_value'
    """
    common = frozenset.intersection(*map(words, columns))
    terms = ("rsrp", "rss", "rssi", "loss", "pl", "gain")
    return next((term for term in terms if term in common), "rss") + "_value"


def shared_name(links: pd.DataFrame, transmitters: pd.DataFrame) -> str | None:
    """The column by which two tables name the transmitter.

    Args:
        links: The links.
        transmitters: A row for every transmitter.

    Returns:
        The first column of both whose values in the links are all known, or None.
    """
    for name in transmitters:
        known = set(transmitters[name].astype(str))
        if name in links and len(known) == len(transmitters) and set(links[name].astype(str)) <= known:
            return str(name)
    return None


def own_name(transmitters: pd.DataFrame) -> str:
    """The column of names of a table of transmitters.

    Args:
        transmitters: A row for every transmitter.

    Returns:
        The column.

    Raises:
        InputError: No column is called like one and tells the transmitters apart.
    """
    for name in transmitters:
        if words(name) & _NAMES and transmitters[name].nunique() == len(transmitters):
            return str(name)
    raise InputError(
        f"transmitters: no column names them ({', '.join(map(str, transmitters))}); call it 'transmitter'"
    )


def devices(frame: pd.DataFrame, most: int = 12) -> list[str]:
    """Columns that tell receiving devices apart.

    Args:
        frame: The links.
        most: Devices beyond which a column is taken for something else, such as a place.

    Returns:
        The columns.
    """
    coordinates = _X | _Y | _LONGITUDE | _LATITUDE | _HEIGHT | {"alt", "altitude", "level"}
    return [
        str(name)
        for name in frame
        if words(name) & _GROUPS and not words(name) & coordinates and 1 < frame[name].nunique() <= most
    ]


def frequency(frame: pd.DataFrame) -> tuple[str, np.ndarray] | None:
    """The column of carriers, and their values [Hz].

    Args:
        frame: The links.

    Returns:
        The column and every row's carrier, the unit taken from its name or its size; None if there is none.
    """
    units = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}
    for name in numeric(frame):
        told = words(name)
        if told & {"freq", "frequency", "carrier", "fc"}:
            values = frame[name].to_numpy(dtype=float)
            size = float(np.nanmedian(values))
            guess = "ghz" if size < 300 else "mhz" if size < 3e5 else "hz"
            carrier = values * units[next((unit for unit in units if unit in told), guess)]
            if FREQUENCIES[0] <= np.nanmin(carrier) and np.nanmax(carrier) <= FREQUENCIES[1]:
                return name, carrier
    return None


def time(frame: pd.DataFrame) -> str | None:
    """The column of times, or None.

    Args:
        frame: The links.

    Returns:
        The first column called like one.

    Example:
        >>> time(pd.DataFrame({"power": [-70.0], "UTC time": ["2026-05-04T09:00:00Z"]}))
        'UTC time'
    """
    return next((str(name) for name in frame if words(name) & _TIME), None)


def distance(frame: pd.DataFrame) -> str | None:
    """The column of distances from transmitter to receiver, or None.

    Args:
        frame: The links.

    Returns:
        The column.
    """
    return next(
        (name for name in numeric(frame) if any(part.startswith("dist") for part in words(name))), None
    )


def numeric(frame: pd.DataFrame) -> list[str]:
    """The columns that hold numbers.

    Args:
        frame: A table.

    Returns:
        Their names.
    """
    return [
        str(name)
        for name in frame
        if pd.api.types.is_numeric_dtype(frame[name]) and not pd.api.types.is_bool_dtype(frame[name])
    ]


def _first(names: Iterable[str], terms: frozenset[str]) -> str | None:
    return next((name for name in names if words(name) & terms), None)


def _fits(table: SourceTable, name: str, quantity: str) -> bool:
    """Whether values can be what their name says, the sign apart for loss and gain."""
    middle = float(np.nanmedian(table.frame[name])) if table.frame[name].notna().any() else 0.0
    return -200 < middle < -10 if quantity == "rsrp" else 20 < abs(middle) < 250
