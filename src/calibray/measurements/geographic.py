"""Positions on the globe: longitude and latitude to the scene's metres, and tracks joined with logs by time."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.coordinates import WGS84, Frame
from calibray.errors import InputError
from calibray.measurements.table_files import SourceTable

Ground = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Height of the ground [m] over x and y [m], as `Terrain.heights` gives it."""

_LARGEST_TRACK: Final = 200_000_000  # bytes


def with_scene_positions(
    rows: pd.DataFrame,
    end: str,
    frame: Frame,
    longitude: str | float,
    latitude: str | float,
    height: str | float,
    crs: str = WGS84,
    ground: Ground | None = None,
) -> pd.DataFrame:
    """Add the positions of one end of the links in the scene's frame.

    Args:
        rows: The log.
        end: Which end: "tx" or "rx"; the new columns are END_x, END_y and END_z [m].
        frame: The scene's frame.
        longitude: Column of longitudes [deg], or one for all; x in another reference system.
        latitude: Column of latitudes [deg], or one for all; y in another reference system.
        height: Column of heights [m], or one for all: above what the frame's height is above, or above the ground.
        crs: What the positions are given in.
        ground: The ground, if heights are above it; level ground at z = 0 needs none.

    Returns:
        The rows with the new columns.

    Raises:
        InputError: A column is missing or holds no number, or a position is not on the globe.

    Example:
        >>> frame = Frame.local(11.57, 48.14)
        >>> rows = pd.DataFrame({"lon": [11.57], "lat": [48.14], "rsrp": [-80.0]})
        >>> with_scene_positions(rows, "rx", frame, "lon", "lat", 1.5)[["rx_x", "rx_y", "rx_z"]].to_numpy()
        array([[0. , 0. , 1.5]])
    """
    table = SourceTable(rows, source="log")
    east, north, up = (
        table.numbers(part) if isinstance(part, str) else np.full(len(rows), float(part))
        for part in (longitude, latitude, height)
    )
    position = frame.to_scene(east, north, up if ground is None else 0.0, crs)
    if ground is not None:
        position[:, 2] = ground(position[:, 0], position[:, 1]) + up
    return rows.assign(**{f"{end}_{axis}": column for axis, column in zip("xyz", position.T, strict=True)})


def read_track(path: str | Path) -> pd.DataFrame:
    """Read the points of a GPX track.

    Args:
        path: The .gpx file; tracks and their segments follow one another, routes and waypoints are left out.

    Returns:
        Columns time (UTC), longitude [deg], latitude [deg] and height [m] (NaN where the file gives none), by time.

    Raises:
        InputError: The file does not exist, is no GPX, is too large, declares entities, holds no point with a time,
            or a point is malformed.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST_TRACK:
            raise InputError(f"track {path}: has more than {_LARGEST_TRACK / 1e6:.0f} MB; split it")
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"track {path}: does not exist; check the path") from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"track {path}: is not UTF-8 text ({error.reason}); export it as GPX again"
        ) from None
    # A track needs no document type; entities could blow it up beyond memory.
    if "\0" in text or "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(
            f"track {path}: declares a document type, which a GPX track has not; export it again"
        )
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"track {path}: is not well-formed XML ({error}); export it again") from None
    points = [_point(path, point) for point in root.iter() if _tag(point) == "trkpt"]
    track = pd.DataFrame(points, columns=["time", "longitude", "latitude", "height"]).dropna(subset=["time"])
    if track.empty:
        raise InputError(f"track {path}: holds no track point with a time; export the track, not a route")
    try:
        track["time"] = pd.to_datetime(track["time"], utc=True, format="ISO8601")
    except ValueError as error:
        raise InputError(f"track {path}: a time is not ISO 8601 ({error}); export it again") from None
    return track.sort_values("time", kind="stable").drop_duplicates("time").reset_index(drop=True)


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _point(path: Path, point: ElementTree.Element) -> tuple[str | None, float, float, float]:
    parts = {_tag(child): (child.text or "").strip() for child in point}
    try:
        place = float(point.get("lon", "")), float(point.get("lat", ""))
        return parts.get("time") or None, *place, float(parts.get("ele") or "nan")
    except ValueError as error:
        raise InputError(f"track {path}: a point is malformed ({error}); export it again") from None


def joined_by_time(
    log: pd.DataFrame, track: pd.DataFrame, time: str, longest_gap: float = 10.0, clock: float = 0.0
) -> tuple[pd.DataFrame, int]:
    """Give the rows of a log the positions of a track, linearly between its points.

    Args:
        log: A power log.
        track: Columns time, longitude, latitude and height, as `read_track` gives them.
        time: The log's column of times: texts with a time zone (or UTC), or seconds since 1970.
        longest_gap: Rows between two points further apart than this [s] get no position.
        clock: How much the log's clock is ahead of the track's [s].

    Returns:
        The rows that have a position, with the columns track_longitude, track_latitude and track_height; and how many
        had none.

    Raises:
        InputError: There is no such column, a time cannot be read, or no row has a position.
    """
    column = SourceTable(log, source="log").column(time)
    try:
        if pd.api.types.is_numeric_dtype(column):
            when = pd.to_datetime(column, utc=True, unit="s")
        else:
            when = pd.to_datetime(column, utc=True, format="ISO8601")
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"log, column {time!r}: a time cannot be read ({error}); give ISO 8601 or seconds"
        ) from None
    seconds = _seconds(when) - clock
    points = _seconds(pd.Series(track["time"]))
    after = np.clip(np.searchsorted(points, seconds, side="left"), 0, len(points) - 1)
    before = np.where(points[after] == seconds, after, np.maximum(after - 1, 0))
    # Outside the track, and at times that are missing, neither bound holds.
    here = (
        (points[before] <= seconds)
        & (seconds <= points[after])
        & (points[after] - points[before] <= longest_gap)
    )
    if not here.any():
        raise InputError(
            f"log, column {time!r}: none of {len(log)} times lies on the track, {track['time'].iloc[0]} to "
            f"{track['time'].iloc[-1]}; check the time zone and the clock"
        )
    # Longitudes count on across 180 degrees.
    east = np.unwrap(track["longitude"].to_numpy(dtype=float), period=360.0)
    found = {
        "track_longitude": (np.interp(seconds[here], points, east) + 180) % 360 - 180,
        "track_latitude": np.interp(seconds[here], points, track["latitude"]),
        "track_height": np.interp(seconds[here], points, track["height"]),
    }
    return log.loc[here].assign(**found).reset_index(drop=True), int((~here).sum())


def _seconds(times: pd.Series) -> NDArray[np.float64]:
    """Seconds since 1970; NaN where there is none."""
    since = (times - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
    return np.asarray(since.to_numpy(), dtype=np.float64)


def degree_columns(names: list[str]) -> tuple[str | None, str | None]:
    """Which columns are called like longitude and latitude.

    Args:
        names: The columns.

    Returns:
        The first that is called like a longitude and the first like a latitude; None where there is none.

    Example:
        >>> degree_columns(["time", "GPS Lat", "GPS Lon", "rsrp"])
        ('GPS Lon', 'GPS Lat')
    """
    words = {name: set(re.split(r"[^a-z]+", name.lower())) for name in names}
    east = (name for name in names if words[name] & {"lon", "lng", "long", "longitude"})
    north = (name for name in names if words[name] & {"lat", "latitude"})
    return next(east, None), next(north, None)
