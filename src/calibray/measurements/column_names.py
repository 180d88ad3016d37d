"""Infer what each column of a table contains from its name and its values."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.materials import FREQUENCIES
from calibray.measurements.preparation import Quantity
from calibray.measurements.selection import without_codes
from calibray.measurements.source_table import SourceTable
from calibray.support.messages import shortened

_DEVICES: Final = (
    "(tele)?phone|smartphone|terminale?|empf(a|ae)nger|(end|mess)?ger(a|ae)t|(mobil)?telefon|handy|receptor|"
    "dispositivo|telefono|movil|celular|recepteur|appareil|ricevitore|apparecchio|cellulare"
)
"""Regular expression for words that mean a receiving device in English, German, Spanish, French and Italian."""

PATTERNS: Final = {
    # The possible contents of a column, each with the regular expression that a whole word of the column name must
    # match.
    "transmitter": r"tx|transmitter|bs|bts|site|cell|cell_?(id|name)|[enp]?ci|ap|bssid|[ge]nb|[ge]?nodeb|base|"
    r"basestation|anchor|beacon|gateway|gw|sender|basisstation|((mobil)?funk)?zelle|celda|cellule|cella|celula|emisor|"
    r"transmisor|emetteur|trasmettitore|estacion|station|stazione",
    "receiver": rf"rx|receiver|ue|phone|mobile|device|mobil|{_DEVICES}",
    "receiving device": rf"rx|receiver|ue|phone|device|handset|eui|imei|(phone|user|device|dev)_?id|{_DEVICES}",
    "name of a transmitter": r"id|name|mac|address|bssid",
    "x": r"x|east|easting|pos_?x|x_?pos|ost(wert)?|rechtswert|este",
    "y": r"y|north|northing|pos_?y|y_?pos|nord(wert)?|hochwert|norte",
    "longitude": r"lon|lng|long|longitude|longitud|longitudine|l(a|ae)nge|l(a|ae)ngengrad",
    "latitude": r"lat|latitude|latitud|latitudine|breite|breitengrad",
    "height": r"z|h|height|heights|ht|hgt|agl|hba|ant(enna)?height|(antennen)?h(o|oe)he|altura|hauteur|altezza",
    "another height": r"ground|terrain|amsl|asl|msl|nn|nhn|msnm|building|tower|clutter|mast",
    "speed": r"speed|velocity|km_?h|kmph|kph|geschwindigkeit|velocidad|vitesse|velocita",
    "altitude or floor": r"alt|altitude|level|altitud|elevation|elev",
    "path loss": r"pl|loss|pathloss|(pfad|strecken|funkfeld)?d(a|ae)mpfung|pfadverlust|perdidas?|pertes?|perdita",
    "path gain": r"gain|pathgain",
    "reference signal": r"(n|ss|csi|ssb)?rsrp",
    "received power": r"(n|ss|csi|ssb)?rsrp|rscp|n?rssi|rss|dbm|prx|power|level|rxlev(el)?|rxpower|signal|strength|"
    r"(empfangs|signal)?pegel|(empfangs)?leistung|nivel|senal|potencia|sinal|puissance|niveau|livello|potenza|segnale",
    "another quantity": r"std|sigma|n?sinr|snr|cinr|n?rsrq|cqi|count|n|nr?x|ncell|number|noise|floor|eirp|tx|id|error|"
    r"rtt|rtd|toa|tof|aoa|distance|ecio|ecno|ec|ta|neighbou?r|neigh|nbr|adj|quality|accuracy|asu|bitrate|speed|channel|"
    r"rauschen|ruido|bruit|rumore|qualit(a|ae)t|calidad|qualite|qualita|nachbar(zelle)?|vecin[ao]|voisine?",
    "round-trip time": r"rtt|ftm|rtd",
    "time of flight": r"tof|toa",
    "delay spread": r"ds|laufzeitspreizung",
    "accuracy": r"std|sigma|var|variance|error|accuracy|count|n|num|number|status|success.*|attempt.*|quality",
    "EIRP": r"eirp",
    "transmitted": r"tx|transmit|transmitted|sende(r|leistung)|transmitida|emise",
    "power": r"power|pwr|dbm|(sende)?leistung|potencia|puissance|potenza",
    "decibel": r"db|dbm",
    "antenna": r"antennas?|ant|aerial",
    "azimuth": r"azimuths?|azimut|azi|bearing|boresight",
    "downtilt": r"[em]?(down)?tilt|[em]dt|ret",
    "mechanical": r"m|mech.*|m(down)?tilt|mdt",
    "electrical": r"e|elec.*|e(down)?tilt|edt|ret|remote",
    "additional": r"add.*|extra",
    "sum of both tilts": r"total|tot|sum|combined|effective",
    "frequency": r"freq|frequency|carrier|fc|frequenz|frecuencia|frequence|frequenza",
    "bandwidth or shift": r"[rv]?bw|bandwidth|bandbreite|span|step|spacing|scs|rate|doppler|shift|offset|cfo|error|std",
    "time": r"time|timestamp|date|datetime|utc|epoch|zeit(stempel)?|uhrzeit|datum|fecha|hora|heure",
    "distance": r"dist.*|separation|abstand|entfernung",
}
"""Recognized words in column names, without accents, by the content of the column. Case and punctuation are ignored.
To add a word, extend the pattern for the content."""

LENGTH_UNITS: Final = {
    "cm": 0.01,
    "mm": 0.001,
    "km": 1e3,
    "ft": 0.3048,
    "feet": 0.3048,
    "foot": 0.3048,
    "inch": 0.0254,
}
"""Units of length other than the metre that can appear in column names, and their values in metres."""

WATTS: Final = frozenset({"w", "watt", "watts", "kw", "mw", "dbw"})
"""Words that indicate, in a column name, powers in watts or dBW instead of dBm."""

FREQUENCY_UNITS: Final = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}
"""Units of frequency that can appear in column names, and their values in hertz."""


@dataclass(frozen=True)
class PositionColumns:
    """Columns that contain the positions of one end of the links.

    Attributes:
        position: "scene" for coordinates in metres, "geographic" for degrees.
        x: Column of x coordinates, or of longitudes.
        y: Column of y coordinates, or of latitudes.
        height: Column of heights; None if the table has no heights.
    """

    position: Literal["scene", "geographic"]
    x: str
    y: str
    height: str | None


@dataclass(frozen=True)
class ValueColumn:
    """The column of measured values.

    Attributes:
        column: Name of the column.
        quantity: The measured quantity.
        reason: Why this column was chosen.
    """

    column: str
    quantity: Quantity
    reason: str


def without_accents(name: object) -> str:
    """Remove the accents from a name.

    Example:
        >>> without_accents("Höhe (straße)")
        'Hohe (strasse)'
    """
    parts = unicodedata.normalize("NFKD", str(name).replace("\u00df", "ss"))
    return "".join(character for character in parts if not unicodedata.combining(character))


def words(name: object) -> frozenset[str]:
    """Split a column name into lower-case words. A camel-case word is included both as a whole and in parts.

    Example:
        >>> sorted(words("Rx_X [m]"))
        ['m', 'rx', 'x']
        >>> sorted(words("BSLatitude(deg)"))
        ['bs', 'bslatitude', 'deg', 'latitude']
        >>> sorted(words("Time of Flight [ns]")), sorted(words("round_trip_time_us"))
        (['ns', 'tof'], ['rtt', 'us'])
        >>> sorted(words("delay (\u00b5s)")), sorted(words("Speed [km/h]"))
        (['delay', 'us'], ['speed'])
    """
    # A time of flight must not be mistaken for a time of day.
    text = re.sub(r"(?i)time[ _-]*of[ _-]*flight", "tof", without_accents(name).replace("\u03bc", "u"))
    text = re.sub(r"(?i)round[ _-]*trip[ _-]*time", "rtt", text)
    text = re.sub(r"(?i)delay[ _-]*spread", "ds", text)
    # The h in a unit of speed or time does not indicate a column of heights.
    text = re.sub(r"(?i)(?<![a-z])k?m\s*/\s*[hs](?![a-z])|[\[(]\s*h\s*[\])]", " ", text)
    # Units with several capitals, such as "dBm", stay one word.
    text = re.sub(r"[dD][bB][mM]|dB|[kMG]?Hz", lambda unit: f" {unit[0].lower()} ", text)
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text)
    split = (re.split(r"[^a-z0-9]+", spelling.lower()) for spelling in (text, parts))
    return frozenset(word for spelling in split for word in spelling if word)


def matches(name: object, *rows: str) -> bool:
    """Whether any word of a column name matches one of the given entries of `PATTERNS`.

    Example:
        >>> matches("RSRP [dBm]", "received power"), matches("RSRP [dBm]", "x", "y")
        (True, False)
    """
    return any(re.fullmatch(PATTERNS[row], word) for row in rows for word in words(name))


def find_flight_time(frame: pd.DataFrame) -> tuple[str, str, str] | None:
    """Find a column of round-trip times or times of flight, its kind and its unit; None if there is no such column.

    Some Wi-Fi devices report a distance in metres instead of a time; metres therefore also count as a unit.

    Example:
        >>> find_flight_time(pd.DataFrame({"rtt_std_ns": [2.0], "rtt_ns": [80.0]}))
        ('rtt_ns', 'round_trip_time', 'ns')
        >>> find_flight_time(pd.DataFrame({"FTM distance [m]": [12.0]}))
        ('FTM distance [m]', 'time_of_flight', 'm')
    """
    for name in numeric_columns(frame):
        if matches(name, "accuracy") or not matches(name, "round-trip time", "time of flight"):
            continue
        unit = _unit_of_delay(name, "m")
        if unit is not None and (without_codes(frame[name]).dropna() > 0).mean() > 0.5:
            # Devices that report the round trip in metres give the one-way distance.
            returned = matches(name, "round-trip time") and unit != "m"
            return name, "round_trip_time" if returned else "time_of_flight", unit
    return None


def find_delay_spread(frame: pd.DataFrame) -> tuple[str, str] | None:
    """Find a column of delay spreads and its unit; None if there is no such column.

    Example:
        >>> find_delay_spread(pd.DataFrame({"ds_std_ns": [2.0], "RMS Delay Spread [ns]": [80.0]}))
        ('RMS Delay Spread [ns]', 'ns')
    """
    for name in numeric_columns(frame):
        unit = _unit_of_delay(name)
        if unit is not None and matches(name, "delay spread") and not matches(name, "accuracy"):
            return name, unit
    return None


def _unit_of_delay(name: str, *others: str) -> str | None:
    """Find a unit of time, or one of `others`, in a column name; None if the name contains no such unit."""
    return next((unit for unit in ("ps", "ns", "us", "ms", "s", *others) if unit in words(name)), None)


def numeric_columns(frame: pd.DataFrame) -> list[str]:
    """Names of the columns that contain numbers."""
    return [
        str(name)
        for name in frame
        if pd.api.types.is_numeric_dtype(frame[name]) and not pd.api.types.is_bool_dtype(frame[name])
    ]


def text_instead(frame: pd.DataFrame, *rows: str) -> str:
    """Hint about a text column whose name matches one of the given entries of `PATTERNS`; empty if there is none.

    Example:
        >>> text_instead(pd.DataFrame({"Lat": ["51.2N", "51.3N"], "cell": "A"}), "latitude")
        "; column 'Lat' contains text such as '51.2N'; write numbers"
    """
    for name in frame:
        if str(name) not in numeric_columns(frame) and matches(name, *rows):
            cells = frame[name].dropna()
            bad = cells[pd.to_numeric(cells, errors="coerce").isna()]
            if len(bad):
                cell = shortened(str(bad.iloc[0]))
                return f"; column {shortened(str(name))!r} contains text such as {cell!r}; write numbers"
    return ""


def no_degrees(frame: pd.DataFrame) -> str:
    """Hint about a column of longitudes or latitudes whose values are not in degrees; empty if there is none.

    Example:
        >>> no_degrees(pd.DataFrame({"lat": [4734.12], "lon": [1041.84]}))
        "; column 'lat' has values of about 4734, not degrees; convert NMEA values, or rename metres to x and y"
    """
    for name in numeric_columns(frame):
        largest = 90 if matches(name, "latitude") else 180
        if matches(name, "latitude", "longitude") and (median := abs(frame[name].median())) > largest:
            return (
                f"; column {shortened(name)!r} has values of about {median:.0f}, not degrees; convert NMEA "
                "values, or rename metres to x and y"
            )
    return ""


def find_position(frame: pd.DataFrame, end: Literal["tx", "rx"], unnamed: bool) -> PositionColumns | None:
    """Find the columns with the positions of one end of the links; metres are preferred to degrees.

    With `unnamed`, columns whose names mention neither transmitter nor receiver also qualify.

    Example:
        >>> find_position(pd.DataFrame({"time": [0], "lat": [50.0], "lon": [10.0]}), "rx", unnamed=True)
        PositionColumns(position='geographic', x='lon', y='lat', height=None)
    """
    this, other = ("transmitter", "receiver") if end == "tx" else ("receiver", "transmitter")
    columns = numeric_columns(frame)
    candidates = [[name for name in columns if matches(name, this) and not matches(name, other)]]
    if unnamed:
        candidates.append([name for name in columns if not matches(name, this, other)])
    for names in candidates:
        height = _height(names)
        if height is None and unnamed:
            height = _height([name for name in columns if not matches(name, other)]) if end == "tx" else None
        x, y = _first(names, "x"), _first(names, "y")
        if x is not None and y is not None:
            return PositionColumns("scene", x, y, height)
        longitude, latitude = _first(names, "longitude"), _first(names, "latitude")
        if longitude is not None and latitude is not None and _are_degrees(frame[longitude], frame[latitude]):
            return PositionColumns("geographic", longitude, latitude, height)
    return None


def _height(names: Iterable[str]) -> str | None:
    """Find the first column of antenna heights or, failing that, of other heights.

    Heights of the ground or of buildings are ignored, and so are speeds such as "Speed km h".
    """
    heights = [
        name for name in names if matches(name, "height") and not matches(name, "another height", "speed")
    ]
    return min(heights, key=lambda name: not matches(name, "antenna"), default=None)


def find_transmitter_height(frame: pd.DataFrame) -> str | None:
    """Find the column of transmitter heights; None if there is no such column."""
    return _first([name for name in numeric_columns(frame) if matches(name, "transmitter")], "height")


def find_value(table: SourceTable) -> ValueColumn:
    """Find the column of measured values and identify the measured quantity.

    Path loss is preferred to path gain, and path gain to received power. Columns of received power, other than that of
    reference signals, come last if their names contain no decibel unit. The sign of the values determines whether the
    column contains losses or gains.

    Raises:
        InputError: No column appears to contain path loss, path gain or received power.
    """
    kinds: tuple[tuple[str, Quantity], ...] = (
        ("path loss", "path_loss"), ("path gain", "path_gain"), ("received power", "rsrp"),
    )  # fmt: skip
    candidates: list[tuple[bool, int, bool, str, Quantity]] = []
    unlikely = ""
    for name in numeric_columns(table.frame):
        rank = next((rank for rank, (row, _) in enumerate(kinds) if matches(name, row)), None)
        if rank is None or matches(name, "another quantity"):
            continue
        if _is_plausible(without_codes(table.frame[name]), kinds[rank][1]):
            # Powers of reference signals are preferred to RSSI, because their bandwidth is known and RSSI includes
            # interference.
            secondary = rank == 2 and not matches(name, "reference signal")
            has_unit = matches(name, "decibel") or not secondary
            candidates.append((not has_unit, rank, secondary, name, kinds[rank][1]))
        elif table.frame[name].notna().any():
            median = float(table.frame[name].median())
            unlikely = (
                f"; column {name!r} has values of about {median:.0f}, but received powers in dBm are negative"
            )
    if not candidates:
        raise InputError(
            f"{table.source}: no column appears to contain path loss, path gain or received power "
            f"({', '.join(map(str, table.frame))}); name the column path_loss_db, path_gain_db or "
            f"rsrp_dbm{unlikely or text_instead(table.frame, *(row for row, _ in kinds))}"
        )
    # The order is losses, gains, powers of reference signals, other powers in decibels, powers without a unit.
    candidates.sort(key=lambda candidate: candidate[:3])
    *_, name, quantity = candidates[0]
    median = float(np.nanmedian(without_codes(table.frame[name])))
    reason = f"by its name and values of about {median:.0f}"
    if quantity == "path_loss" and median < 0:
        quantity, reason = "path_gain", f"named as a loss, but values of about {median:.0f} indicate a gain"
    elif quantity == "path_gain" and median > 0:
        quantity, reason = "path_loss", f"named as a gain, but values of about {median:.0f} indicate a loss"
    others = [candidate[3] for candidate in candidates[1:]]
    return ValueColumn(name, quantity, reason + (f"; not {', '.join(others)}" if others else ""))


def find_transmit_power(frame: pd.DataFrame) -> str | None:
    """Find the column of transmitted powers [dBm]; None if there is none. Columns in watts or dBW are ignored.

    Example:
        >>> find_transmit_power(pd.DataFrame({"tx_power_w": [20.0], "EIRP [dBW]": [30.0], "TX power (dBm)": [43.0]}))
        'TX power (dBm)'
    """
    for name in numeric_columns(frame):
        if words(name) & WATTS:
            continue
        if matches(name, "EIRP") or (matches(name, "transmitted") and matches(name, "power")):
            return name
    return None


def find_length_unit(names: Iterable[str]) -> float:
    """Find the unit of length in column names, and return its value in metres; 1 if no name contains a unit.

    Raises:
        InputError: The names contain different units.

    Example:
        >>> find_length_unit(["X [cm]", "Y [cm]", "device"]), find_length_unit(["x", "y_m"])
        (0.01, 1.0)
    """
    stated = {str(name): words(name) & {*LENGTH_UNITS, "m"} for name in names}
    units = {next(iter(marks)) for marks in stated.values() if len(marks) == 1}
    if len({LENGTH_UNITS.get(unit, 1.0) for unit in units}) > 1:
        listed = ", ".join(name for name, marks in stated.items() if marks)
        raise InputError(f"positions are in different units ({listed}); give all positions in metres")
    return LENGTH_UNITS.get(next(iter(units), "m"), 1.0)


def find_frequency_unit(name: str, default: str = "hz") -> float:
    """Find the unit of frequency in a column name, and return its value in hertz; if there is none, use `default`.

    Example:
        >>> find_frequency_unit("Downlink [MHz]"), find_frequency_unit("carrier")
        (1000000.0, 1.0)
    """
    return FREQUENCY_UNITS[next((unit for unit in FREQUENCY_UNITS if unit in words(name)), default)]


def find_frequency(frame: pd.DataFrame) -> tuple[str, np.ndarray] | None:
    """Find the column of carrier frequencies and convert its values to hertz; None if there is no such column.

    The name of this column contains a word for frequency or a unit of frequency. If the name contains no unit, the unit
    is inferred from the magnitude of the values.

    Example:
        >>> find_frequency(pd.DataFrame({"BW [MHz]": [20.0], "Frq [MHz]": [763.0]}))
        ('Frq [MHz]', array([7.63e+08]))
    """
    for name in _frequency_columns(frame):
        values = frame[name].to_numpy(dtype=float)
        if np.isnan(values).all():
            continue
        median = float(np.nanmedian(values))
        # Carrier frequencies are below 300 GHz, so larger numbers must be in a smaller unit.
        likely_unit = "ghz" if median < 300 else "mhz" if median < 3e5 else "hz"
        carriers = values * find_frequency_unit(name, likely_unit)
        if FREQUENCIES[0] <= np.nanmin(carriers) and np.nanmax(carriers) <= FREQUENCIES[1]:
            return name, carriers
    return None


def no_frequency(frame: pd.DataFrame) -> str:
    """Hint about a column of carrier frequencies with values out of range; empty if there is no such column.

    Example:
        >>> no_frequency(pd.DataFrame({"Frequency (Hz)": [1842.5]}))
        "column 'Frequency (Hz)' has values of about 1842.5; it must be 1e+06 to 1e+12 Hz: correct the unit in its name"
    """
    for name in _frequency_columns(frame):
        if frame[name].notna().any() and not matches(name, "bandwidth or shift"):
            return (
                f"column {shortened(name)!r} has values of about {frame[name].median():g}; it must be "
                f"{FREQUENCIES[0]:.0e} to {FREQUENCIES[1]:.0e} Hz: correct the unit in its name"
            )
    return ""


def _frequency_columns(frame: pd.DataFrame) -> list[str]:
    """Numeric columns whose names contain a word for frequency, followed by columns whose names contain only a unit."""
    names = numeric_columns(frame)
    in_hertz = [
        name for name in names if words(name) & {*FREQUENCY_UNITS} and not matches(name, "bandwidth or shift")
    ]
    return list(dict.fromkeys([*(name for name in names if matches(name, "frequency")), *in_hertz]))


def find_time(frame: pd.DataFrame) -> str | None:
    """Find the first column whose name indicates times; None if there is no such column."""
    return _first([str(name) for name in frame], "time")


def find_distance(frame: pd.DataFrame) -> str | None:
    """Find the column of distances from transmitter to receiver; None if there is no such column."""
    return _first(numeric_columns(frame), "distance")


def _are_degrees(longitude: pd.Series, latitude: pd.Series) -> bool:
    """Whether the coordinates can be in degrees; some tables contain metres in columns named longitude and latitude."""
    return bool(longitude.abs().median() <= 180 and latitude.abs().median() <= 90)


def is_named_value(name: str) -> bool:
    """Whether a column name contains a word for path loss, path gain or received power."""
    return matches(name, "path loss", "path gain", "received power")


def _first(names: Iterable[str], row: str) -> str | None:
    return next((name for name in names if matches(name, row)), None)


def _is_plausible(values: pd.Series, quantity: Quantity) -> bool:
    """Whether the median of the values is plausible for a quantity; for losses and gains, the sign is ignored."""
    median = float(np.nanmedian(values)) if values.notna().any() else 0.0
    # The median is used because single values may be logging errors.
    return -200 < median < -10 if quantity == "rsrp" else 20 < abs(median) < 250
