"""Determine the transmitter and receiver position of each row, and move receivers out of buildings."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.preparation import Preparation, Track
from calibray.measurements.source_table import Coordinates, SourceTable
from calibray.support.messages import first_line

TRACK_COLUMNS: Final = ("track_longitude", "track_latitude")
"""Columns that contain the position of each row on a track [deg]."""

NOT_ON_TRACK: Final = "rows without a position on the track, left out"
"""The entry in `changes` for rows that a track does not cover. If another time zone fits clearly better, the entry also
states the matching value of `links.track.clock`."""

MAX_FILE_SIZE: Final = 200_000_000
"""Size limit of a GPX file [bytes]. A track with one point per second reaches this size after three weeks."""


def join_track(table: SourceTable, track: Track) -> SourceTable:
    """Interpolate a track linearly at the times of the rows; rows that the track does not cover are left out.

    Times are in ISO 8601 (UTC unless a time zone is stated) or in seconds since 1970. Altitudes from satellite
    positioning are ignored, because they have errors of several metres. The new columns are `TRACK_COLUMNS`.

    Raises:
        InputError: The track or a time cannot be read, or the track covers no row.
    """
    points = _read_gpx(Path(track.file))
    seconds = _row_times(table, track) - track.clock
    times = _seconds(points["time"])
    covered = _covered(times, seconds, track.longest_gap)
    shift = _better_shift(times, seconds, track.longest_gap)
    clock = f"links.track.clock = {track.clock + shift:g}"
    if not covered.any():
        first, last = points["time"].iloc[0], points["time"].iloc[-1]
        remedy = (
            f"with {clock}, some times would lie on the track; check the time zone"
            if shift
            else "check the time zone and the clock"
        )
        raise InputError(
            f"{table.source} with {track.file}: no time in column {track.time!r} lies on the track, "
            f"which covers {first} to {last}; {remedy}"
        )
    table = table.keep(covered, NOT_ON_TRACK + (f"; {clock} would keep more of them" if shift else ""))
    # Where the track crosses the antimeridian, unwrapped longitudes continue beyond 180 degrees.
    longitude = np.interp(seconds[covered], times, np.unwrap(points["longitude"], period=360.0))
    latitude = np.interp(seconds[covered], times, points["latitude"])
    return table.assign(**dict(zip(TRACK_COLUMNS, ((longitude + 180) % 360 - 180, latitude), strict=True)))


def read_times(table: SourceTable, name: str) -> NDArray[np.float64]:
    """Read a column of times (ISO 8601 or seconds since 1970) as seconds since 1970 [rows], NaN if missing.

    Raises:
        InputError: There is no such column, or a time cannot be read.
    """
    column = table.column(name)
    try:
        if pd.api.types.is_numeric_dtype(column):
            return _seconds(pd.to_datetime(column, utc=True, unit="s"))
        # ISO 8601 allows a comma before the fraction of a second; pandas does not.
        return _seconds(pd.to_datetime(column.replace(",", ".", regex=True), utc=True, format="ISO8601"))
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"{table.source}, column {name!r}: a time cannot be read ({_reason(error)}); give ISO 8601, such as "
            "2026-05-31T14:05:09.2Z, or seconds since 1970"
        ) from None


def _row_times(table: SourceTable, track: Track) -> NDArray[np.float64]:
    """Times of the rows in seconds since 1970 [rows]; NaN if missing."""
    column = table.column(track.time)
    seconds = read_times(table, track.time)
    if pd.api.types.is_numeric_dtype(column):
        return seconds
    days = seconds[np.isfinite(seconds)] / 86_400
    if len(days) and (days % 1 == 0).all() and not column.astype(str).str.contains(":").any():
        raise InputError(
            f"{table.source}, column {track.time!r}: contains dates without times; write the date and time in one "
            "column, such as 2026-05-31T14:05:09.2Z"
        )
    return seconds


def _covered(
    times: NDArray[np.float64], seconds: NDArray[np.float64], longest_gap: float
) -> NDArray[np.bool_]:
    """Mask [rows] of the rows between two successive track points whose times differ by at most `longest_gap`."""
    after = np.clip(np.searchsorted(times, seconds, side="left"), 0, len(times) - 1)
    # If a row has exactly the time of a track point, the gaps before and after this point do not matter.
    before = np.where(times[after] == seconds, after, np.maximum(after - 1, 0))
    # For times before or after the track, and for missing times (NaN), at least one of the comparisons is false.
    between = (times[before] <= seconds) & (seconds <= times[after])
    return between & (times[after] - times[before] <= longest_gap)


def _better_shift(times: NDArray[np.float64], seconds: NDArray[np.float64], longest_gap: float) -> float:
    """Time-zone shift of the rows relative to the track [s]; 0 unless a shift places clearly more rows on the track.

    Shifts are tested only if at least a tenth of the rows are off the track. A shift is accepted only if it reduces the
    number of these rows by more than half.
    """
    seconds = seconds[np.isfinite(seconds)]
    seconds = seconds[:: 1 + len(seconds) // 10_000]
    if not len(seconds) or (kept := _covered(times, seconds, longest_gap).mean()) > 0.9:
        return 0.0
    # Time zones differ from UTC by multiples of a quarter of an hour, up to 14 h.
    zones = sorted(900.0 * np.arange(-56, 57), key=abs)
    shares = [_covered(times, seconds - zone, longest_gap).mean() for zone in zones]
    return float(zones[int(np.argmax(shares))]) if max(shares) > (1.0 + kept) / 2 else 0.0


def _reason(error: Exception) -> str:
    """The reason why pandas cannot read a time, without pandas's advice on function arguments."""
    return first_line(error).partition(". You might")[0]


def _seconds(times: pd.Series) -> NDArray[np.float64]:
    """Seconds since 1970; NaN if missing."""
    return np.asarray((times - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1), dtype=np.float64)


def _read_gpx(path: Path) -> pd.DataFrame:
    """Time (UTC), longitude and latitude [deg] of all track points, in chronological order."""
    try:
        if path.stat().st_size > MAX_FILE_SIZE:
            raise InputError(f"track {path}: the file is larger than {MAX_FILE_SIZE / 1e6:.0f} MB; split it")
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"track {path}: does not exist; check the path") from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"track {path}: the file is not UTF-8 text ({error.reason}); export the track as GPX again"
        ) from None
    # A GPX track needs no document type, and entities could expand until memory is exhausted.
    if "\0" in text or "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(
            f"track {path}: declares a document type, which GPX does not use; export the track again"
        )
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(
            f"track {path}: the file is not well-formed XML ({error}); export the track again"
        ) from None
    rows = [_point(path, element) for element in root.iter() if _tag(element) == "trkpt"]
    points = pd.DataFrame(rows, columns=["time", "longitude", "latitude"]).dropna(subset=["time"])
    if points.empty:
        raise InputError(f"track {path}: no track point has a time; export the track, not a route")
    try:
        points["time"] = pd.to_datetime(points["time"], utc=True, format="ISO8601")
        # pandas reads times in years before 1678 and after 2262, but cannot subtract these times.
        _seconds(points["time"])
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"track {path}: a time is not in ISO 8601 or is out of range ({_reason(error)}); export the track again"
        ) from None
    return points.sort_values("time", kind="stable").drop_duplicates("time").reset_index(drop=True)


def _point(path: Path, element: ElementTree.Element) -> tuple[str | None, float, float]:
    times = [(child.text or "").strip() for child in element if _tag(child) == "time"]
    try:
        longitude, latitude = float(element.get("lon", "")), float(element.get("lat", ""))
    except ValueError as error:
        raise InputError(f"track {path}: a point is malformed ({error}); export the track again") from None
    return (times[-1] or None) if times else None, longitude, latitude


def _tag(element: ElementTree.Element) -> str:
    """Name of an element without its XML namespace."""
    return element.tag.rpartition("}")[2]


TX_COLUMNS: Final = ("tx_x", "tx_y", "tx_z")
"""Columns of transmitter positions in the scene frame [m]."""

RX_COLUMNS: Final = ("rx_x", "rx_y", "rx_z")
"""Columns of receiver positions in the scene frame [m]."""

POSITION_COLUMNS: Final = (*TX_COLUMNS, *RX_COLUMNS)
"""Columns of transmitter and receiver positions in the scene frame [m]."""


def position_columns(tx: NDArray[np.float64], rx: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """`POSITION_COLUMNS` [m] of links from `tx` ([n, 3], or [3] for a single transmitter) to `rx` [n, 3]."""
    ends = np.hstack([np.broadcast_to(tx, rx.shape), rx])
    return dict(zip(POSITION_COLUMNS, ends.T, strict=True))


def ends_of(frame: pd.DataFrame) -> NDArray[np.float64] | None:
    """The positions [rows, 6], [m], in the columns `POSITION_COLUMNS` of a table; None if a column is missing."""
    if not set(POSITION_COLUMNS) <= set(frame.columns):
        return None
    return frame[list(POSITION_COLUMNS)].to_numpy(float)


def place_rows(
    table: SourceTable, steps: Preparation, tx: Coordinates, rx: Coordinates
) -> tuple[SourceTable, Coordinates, Coordinates]:
    """Write the positions of both ends to the columns `TX_COLUMNS` and `RX_COLUMNS` in metres.

    A position is x, y, z (numbers in metres, columns in units of `steps.unit_m`) or, with a frame, longitude, latitude
    [deg] and height [m]. Returns the table with these columns, and the names of the columns for both ends. If there is
    no step other than a filter, the arguments are returned unchanged.

    Raises:
        InputError: A column is missing or not numeric, or a geographic position is invalid.
    """
    if steps.is_filter_only:
        return table, tx, rx
    tx_position, rx_position = _positions(table, steps, "tx", tx), _positions(table, steps, "rx", rx)
    return table.assign(**position_columns(tx_position, rx_position)), TX_COLUMNS, RX_COLUMNS


def _positions(
    table: SourceTable, steps: Preparation, end: Literal["tx", "rx"], coordinates: Coordinates
) -> NDArray[np.float64]:
    """Positions [rows, 3], [m] of one end."""
    if steps.frame is None:
        # Numbers are in metres, and columns are in the unit of the table.
        scale = [steps.unit_m if isinstance(coordinate, str) else 1.0 for coordinate in coordinates]
        positions = table.positions(end, coordinates) * scale
        height = positions[:, 2]
    else:
        longitude, latitude, height = (table.numbers(coordinate) for coordinate in coordinates)
        try:
            positions = steps.frame.to_scene(longitude, latitude, height, steps.crs, rows=table.row)
        except InputError as error:
            raise InputError(f"{table.source}: {end}: {error}") from None
    if steps.ground is not None:
        try:
            ground = steps.ground(positions[:, 0], positions[:, 1])
        except InputError as error:
            raise InputError(f"{table.source}: {end}: {error}") from None
        # The given heights are relative to the ground, not to z = 0 or sea level.
        positions[:, 2] = ground + height
    return positions


def clear_buildings(table: SourceTable, steps: Preparation, rx: Coordinates) -> SourceTable:
    """Leave out receivers inside building outlines, or move them out.

    The function uses the steps `inside` and `outside`. Without these steps, it returns the table unchanged. With the
    step `ground`, moved receivers keep their heights above the ground.

    Raises:
        InputError: No row remains.
    """
    if steps.inside is None or steps.outside is None:
        return table
    before = table.positions("rx", rx)
    positions, moved = steps.outside(before)
    if steps.inside == "drop":
        return table.keep(moved == 0, "receivers inside buildings, left out")
    too_deep = np.isnan(positions).any(axis=1)
    if steps.ground is not None:
        changed = (moved > 0) & ~too_deep
        here, there = (steps.ground(*place[changed, :2].T) for place in (before, positions))
        positions[changed, 2] += there - here
    if count := int(((moved > 0) & ~too_deep).sum()):
        table = table.note("receivers inside buildings, moved out", count)
    table = table.assign(**{str(name): values for name, values in zip(rx, positions.T, strict=True)})
    return table.keep(np.asarray(~too_deep), "receivers deep inside buildings, left out")
