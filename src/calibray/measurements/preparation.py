"""Preparation: what phones, scanners and tracks wrote becomes one row a link, in metres, and each loss is counted."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements.averaging import Sense, averaged, by_cell, by_distance, by_time
from calibray.measurements.geographic import Ground, joined_by_time, read_track, with_scene_positions
from calibray.measurements.received_power import long_table, marked_censored, with_transmitters
from calibray.measurements.table_files import SourceTable, read_table
from calibray.support.messages import shortened

Coordinates = Sequence[float | str]

_DEGREES: Final = frozenset({"lat", "latitude", "lon", "lng", "long", "longitude"})
_ROW: Final = "calibray row"
CENSORED: Final = "censored"
"""Column that marks the rows below the noise floor, if these are kept."""

_UNHEARD: Final = "calibray unheard"

MOST_UNHEARD_DB: Final = 1.0
"""How far samples below the noise floor may leave an average open [dB]; where further, it is left out."""

PREPARED: Final = {end: tuple(f"{end}_{axis}" for axis in "xyz") for end in ("tx", "rx")}
"""The columns of positions in the scene's metres that preparation writes."""

TRACKED: Final = ("track_longitude", "track_latitude")
"""The columns of a row's position on a track [deg]."""

Inside = Literal["drop", "move"]
Way = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Positions [n, 3] to positions outside of buildings, NaN where given up, and how far each was moved [n], [m]."""


@dataclass(frozen=True)
class Averaging:
    """How samples are averaged, in linear power.

    Attributes:
        by: "cell" of a square grid, stretch of "distance", or window of "time".
        size: Its width or length [m], or duration [s].
        time: Column of times, for "time".
        unbiased: Whether what the logarithm of a mean of few samples lies too low by is added.
    """

    by: Literal["cell", "distance", "time"]
    size: float
    time: str | None = None
    unbiased: bool = False


@dataclass(frozen=True)
class Track:
    """A track that tells where rows were measured.

    Attributes:
        file: GPX file.
        time: Column of the rows' times.
        longest_gap: Rows between two points further apart than this are left out [s].
        clock: How much the rows' clock is ahead of the track's [s].
    """

    file: str
    time: str
    longest_gap: float = 10.0
    clock: float = 0.0


@dataclass(frozen=True)
class Preparation:
    """What is done to a table before its rows are links; nothing by default.

    Attributes:
        wide: Name of the transmitter by column, of a table with one column a transmitter.
        where: Row filter.
        track: Track that gives each row the columns `TRACKED` [deg].
        ground: Height of the ground, if heights are above it.
        transmitters: File with a row for every transmitter, whose columns each link gets.
        transmitter: Column, of both tables, that says which transmitter it is.
        frame: Where the scene lies on the globe, for positions as longitude, latitude and height; None for metres.
        noise_floor_dbm: Values at or below it, and missing ones, were not heard [dBm].
        censored: Whether rows that were not heard are kept, at the floor, and marked in the column `CENSORED`.
        averaging: How samples are averaged.
        keep: Columns that no average crosses, beside the transmitter.
        inside: What becomes of receivers on what buildings cover; nothing if None.
        outside: What leads positions outside.
    """

    wide: Mapping[str, str] = field(default_factory=dict)
    where: str | None = None
    track: Track | None = None
    ground: Ground | None = None
    transmitters: str | None = None
    transmitter: str = "transmitter"
    frame: Frame | None = None
    noise_floor_dbm: float | None = None
    censored: bool = False
    averaging: Averaging | None = None
    keep: Sequence[str] = ()
    inside: Inside | None = None
    outside: Way | None = None

    @property
    def idle(self) -> bool:
        """Whether rows are links as they are, but for the filter."""
        steps = (
            self.wide,
            self.track,
            self.ground,
            self.transmitters,
            self.frame,
            self.averaging,
            self.inside,
        )
        return not any(steps) and self.noise_floor_dbm is None


@dataclass(frozen=True)
class Prepared:
    """A table of links.

    Attributes:
        table: Its rows; each stands for the first of the rows that it was made of.
        tx: Transmitter positions, numbers or columns [m].
        rx: Receiver positions, likewise.
        counts: What was left out, averaged or moved, and how many of them.
    """

    table: SourceTable
    tx: Coordinates
    rx: Coordinates
    counts: dict[str, int]


def prepare(
    table: SourceTable,
    steps: Preparation,
    tx: Coordinates,
    rx: Coordinates,
    value: str,
    sense: Sense = "power",
) -> Prepared:
    """Make links of the rows of a table.

    The order is: transmitters in columns, the track, the filter, the transmitters' positions, the noise floor,
    positions on the globe, averages, positions inside buildings. An average holds the samples not heard at half of the
    floor, between nothing and the floor itself; where that leaves it open by more than 1 dB it is left out, because
    those heard would only be the strong ones.

    Args:
        table: The rows.
        steps: What is done.
        tx: Transmitter position: x, y and z [m], or longitude, latitude [deg] and height [m]; numbers or columns.
        rx: Receiver position, likewise.
        value: Column of the values [dB] or [dBm]; with `wide` the new column of them.
        sense: Whether more decibels are more power or less.

    Returns:
        The links. Averages have the columns `std_db`, the spread of their samples, and `count`.

    Raises:
        InputError: A column is missing or malformed, a transmitter is not known, or no row is left.
    """
    counts: dict[str, int] = {}
    if steps.wide:
        table = _long(table, steps, value, counts)
    if steps.track is not None:
        table = tracked(table, steps.track, counts)
    if steps.where is not None:
        table = _passed(table, steps.where)
    if steps.idle:
        return Prepared(table, tx, rx, counts)
    if steps.transmitters is not None:
        table = _with_transmitters(table, steps)
    unheard = np.zeros(len(table), dtype=bool)
    if steps.noise_floor_dbm is not None:
        marked = marked_censored(table.frame, value, steps.noise_floor_dbm, mark=CENSORED)
        unheard = (marked[CENSORED] if steps.censored else marked.pop(CENSORED)).to_numpy()
        table = SourceTable(marked, table.row, table.source)
        if steps.censored:
            counts["at or below the noise floor, counted as censored"] = int(unheard.sum())
        elif steps.averaging is None:
            table = _kept(table, ~unheard, "at or below the noise floor, left out", counts)
    table, tx, rx = _placed(table, steps, tx, rx)
    if steps.averaging is not None:
        table = _averaged(table, steps, steps.averaging, unheard, (tx, rx), value, sense, counts)
    if steps.inside is not None and steps.outside is not None:
        table = _outside(table, steps.inside, steps.outside, rx, counts)
    return Prepared(table, tx, rx, counts)


def positions(table: SourceTable, name: str, coordinates: Coordinates) -> NDArray[np.float64]:
    """Positions from three numbers or columns.

    Args:
        table: The rows.
        name: Which end, for messages.
        coordinates: x, y and z, each a number [m] or a column.

    Returns:
        Positions [rows, 3], [m].

    Raises:
        InputError: There are not three, a column is missing, holds no numbers or is called like degrees.
    """
    if isinstance(coordinates, str) or len(coordinates) != 3:
        raise InputError(f"{name} = {coordinates!r}: must be x, y and z, each a number [m] or a column")
    columns = []
    for coordinate in coordinates:
        if isinstance(coordinate, str):
            if _DEGREES & set(re.split(r"[^a-z]+", coordinate.lower())):
                raise InputError(
                    f"{table.source}: column {coordinate!r} of {name} looks like degrees on the globe; "
                    "give metres in the scene's frame, or say position = 'geographic' in a study"
                )
            columns.append(table.numbers(coordinate))
        elif isinstance(coordinate, bool) or not np.isfinite(coordinate):
            raise InputError(
                f"{name} = {coordinates!r}: {coordinate!r} must be a finite number [m] or a column"
            )
        else:
            columns.append(np.full(len(table), float(coordinate)))
    return np.stack(columns, axis=1)


def _long(table: SourceTable, steps: Preparation, value: str, counts: dict[str, int]) -> SourceTable:
    place = table.frame.assign(**{_ROW: table.row})
    long = long_table(place, steps.wide, value, steps.transmitter)
    if empty := len(table) * len(steps.wide) - len(long):
        counts["cells without a value"] = empty
    row = long.pop(_ROW).to_numpy(dtype=np.int64)
    return SourceTable(long, row, table.source)


def tracked(table: SourceTable, track: Track, counts: dict[str, int]) -> SourceTable:
    """Rows with the positions of a track.

    Args:
        table: The rows.
        track: The track.
        counts: Gets how many rows were left out, if any.

    Returns:
        The rows at times that the track covers, with the columns `TRACKED`. Altitudes are not taken: those of
        satellite receivers are metres off.

    Raises:
        InputError: The track cannot be read, a time cannot, or no row lies on it.
    """
    rows = table.frame.assign(**{_ROW: table.row})
    try:
        found, lost = joined_by_time(rows, read_track(track.file), track.time, track.longest_gap, track.clock)
    except InputError as error:
        raise InputError(f"{table.source} with {track.file}: {error}") from None
    if lost:
        counts["rows at no time of the track, left out"] = lost
    row = found.pop(_ROW).to_numpy(dtype=np.int64)
    return SourceTable(found.drop(columns="track_height"), row, table.source)


def _passed(table: SourceTable, where: str) -> SourceTable:
    mask = table.where(where)
    if not mask.any():
        raise InputError(
            f"{table.source}: where = {shortened(where)!r} lets none of {len(table)} rows pass; change the filter"
        )
    return table.select(mask)


def _kept(table: SourceTable, mask: NDArray[np.bool_], reason: str, counts: dict[str, int]) -> SourceTable:
    if not mask.any():
        raise InputError(f"{table.source}: {reason}: all of {len(table)} rows; change [links] of the study")
    if lost := int((~mask).sum()):
        counts[reason] = lost
    return table.select(mask)


def _with_transmitters(table: SourceTable, steps: Preparation) -> SourceTable:
    others = read_table(str(steps.transmitters))
    name = steps.transmitter
    if twice := [column for column in others.frame if column in table.frame and column != name]:
        # The links' own columns keep their names: theirs are what filters and positions mean.
        others = SourceTable(others.frame.rename(columns={each: f"{name}_{each}" for each in twice}))
    try:
        frame = with_transmitters(table.frame, others.frame, name)
    except InputError as error:
        raise InputError(f"{table.source} with {steps.transmitters}: {error}") from None
    return SourceTable(frame, table.row, table.source)


def _placed(
    table: SourceTable, steps: Preparation, tx: Coordinates, rx: Coordinates
) -> tuple[SourceTable, Coordinates, Coordinates]:
    """The positions of both ends as columns of metres."""
    rows = table.frame
    for end, place in (("tx", tx), ("rx", rx)):
        try:
            if steps.frame is not None:
                longitude, latitude, height = place
                rows = with_scene_positions(
                    rows, end, steps.frame, longitude, latitude, height, ground=steps.ground
                )
                continue
            position = positions(table, end, place)
            if steps.ground is not None:
                position[:, 2] += steps.ground(position[:, 0], position[:, 1])
        except InputError as error:
            raise InputError(f"{table.source}: {end}: {error}") from None
        rows = rows.assign(**dict(zip(PREPARED[end], position.T, strict=True)))
    return SourceTable(rows, table.row, table.source), PREPARED["tx"], PREPARED["rx"]


def _averaged(
    table: SourceTable,
    steps: Preparation,
    averaging: Averaging,
    unheard: NDArray[np.bool_],
    place: tuple[Coordinates, Coordinates],
    value: str,
    sense: Sense,
    counts: dict[str, int],
) -> SourceTable:
    rows = table.frame.assign(**{_UNHEARD: unheard.astype(float)})
    label = _labels(rows, averaging)
    tx = [str(name) for name in place[0]]
    known = [steps.transmitter] if steps.transmitter in rows and steps.transmitter not in steps.keep else []
    keep = [*steps.keep, *known, *tx]
    mean = averaged(rows, value, label, sense, keep, [*map(str, place[1]), _UNHEARD])
    first = ~rows[keep].assign(**{_ROW: label}).duplicated().to_numpy()
    named = {str(name): mean[name].to_numpy() for name in (value, *place[1], "std_db", "count")}
    low = mean["low_db"].to_numpy() if averaging.unbiased else np.zeros(len(mean))
    faint = np.zeros(len(mean), dtype=bool)
    counts["samples averaged"] = len(table)
    if steps.noise_floor_dbm is not None and unheard.any():
        counts["of them at or below the noise floor"] = int(unheard.sum())
        # Powers: with the samples not heard at the floor itself, and what they are of it.
        most = 10 ** (named[value].astype(float) / 10)
        theirs = mean[_UNHEARD].to_numpy() * 10 ** (steps.noise_floor_dbm / 10)
        faint = most > np.maximum(most - theirs, 0.0) * 10 ** (MOST_UNHEARD_DB / 10)
        named[value] = 10 * np.log10(most - theirs / 2)
    named[value] = named[value] + (low if sense == "power" else -low)
    joined = table.frame.loc[first].reset_index(drop=True).assign(**named)
    made = SourceTable(joined, table.row[first], table.source)
    return _kept(made, ~faint, "averages too near the noise floor, left out", counts)


def _labels(rows: pd.DataFrame, averaging: Averaging) -> NDArray[np.int64]:
    match averaging.by:
        case "cell":
            return by_cell(rows, averaging.size)
        case "distance":
            return by_distance(rows, averaging.size)
        case _:
            return by_time(rows, averaging.size, str(averaging.time))


def _outside(
    table: SourceTable, inside: Inside, way: Way, rx: Coordinates, counts: dict[str, int]
) -> SourceTable:
    names = [str(name) for name in rx]
    places, moved = way(table.frame[names].to_numpy(dtype=float))
    if inside == "drop":
        return _kept(table, moved == 0, "receivers inside buildings, left out", counts)
    lost = np.isnan(places).any(axis=1)
    if went := int(((moved > 0) & ~lost).sum()):
        counts["receivers inside buildings, moved out"] = went
    frame = table.frame.assign(**dict(zip(names, places.T, strict=True)))
    return _kept(
        SourceTable(frame, table.row, table.source),
        np.asarray(~lost),
        "receivers deep inside buildings, left out",
        counts,
    )
