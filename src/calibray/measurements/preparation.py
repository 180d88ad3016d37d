"""The meaning of a table's columns, and the steps that convert its rows to links."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import WGS84, Frame
from calibray.errors import InputError
from calibray.measurements.source_table import Coordinates, SourceTable
from calibray.support.messages import did_you_mean

Quantity = Literal["path_loss", "path_gain", "received_power", "rsrp"]

Ground = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Height of the ground [m] as a function of x and y [m]."""

MoveOutside = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Maps positions [n, 3] to positions outside buildings (NaN if too deep inside) and the distances of the moves [n],
[m]."""

Compute = Callable[[SourceTable], NDArray[np.float64] | None]
"""Function from the rows of a table to the values of a new column [rows]; None if a column that it needs is missing."""

Divide = Callable[[SourceTable], NDArray[Any]]
"""Function from the rows of a table to the labels of the parts to which they belong [rows]."""


@dataclass(frozen=True)
class LinkColumns:
    """The columns of a table that describe its links.

    Attributes:
        tx: Transmitter position: x, y, z [m], or longitude, latitude [deg] and height [m].
        rx: Receiver position, likewise.
        value: Column of the measured values.
        quantity: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm]: received power with
            unknown transmitted power. The path loss is then the negative of the received power, and an offset includes
            the transmitted power.
        group: Column of group labels, or several columns whose labels are joined.
        weight: Column of relative weights [1], greater than 0.
        std: Standard deviation [dB] of the values, a number or a column; the weights become 1 / std^2.
        tx_power_dbm: Transmitted power [dBm], a number or a column; only for "received_power".
        frequency: Column of carrier frequencies, in hertz or the unit in its name.

    Raises:
        InputError: The quantity is unknown or does not match `tx_power_dbm`, or both `weight` and `std` are given.
    """

    tx: Coordinates
    rx: Coordinates
    value: str
    quantity: Quantity = "path_loss"
    group: str | Sequence[str] | None = None
    weight: str | None = None
    std: str | float | None = None
    tx_power_dbm: str | float | None = None
    frequency: str | None = None

    def __post_init__(self) -> None:
        if self.quantity not in get_args(Quantity):
            remedy = did_you_mean(self.quantity, get_args(Quantity))
            raise InputError(f"quantity = {self.quantity!r}: unknown, {remedy}")
        if self.quantity == "received_power" and self.tx_power_dbm is None:
            raise InputError(
                "quantity = 'received_power' needs tx_power_dbm [dBm]; if it is unknown, set quantity = 'rsrp' and "
                "add an [offset]"
            )
        if self.quantity != "received_power" and self.tx_power_dbm is not None:
            raise InputError(f"quantity = {self.quantity!r} takes no tx_power_dbm; remove it")
        if self.weight is not None and self.std is not None:
            raise InputError(f"weight = {self.weight!r} and std = {self.std!r}: give one of them")


@dataclass(frozen=True)
class Averaging:
    """How samples are averaged, in linear power.

    Attributes:
        by: Which samples are averaged together: those at one "place" (equal receiver positions), in one "cell" of a
            square grid, in one stretch of "distance" travelled (in the order of the rows), or in one window of "time".
        size: Width or length [m], or duration [s]; not used for "place".
        time: Column of times, for "time".
        unbiased: Whether to correct the bias in the logarithm of a mean over few samples.
        minimum_count: Smallest number of samples in an average; averages of fewer samples are left out.
    """

    by: Literal["place", "cell", "distance", "time"]
    size: float | None = None
    time: str | None = None
    unbiased: bool = False
    minimum_count: int = 1


@dataclass(frozen=True)
class Track:
    """A GPX track, which gives rows a position at their times.

    Attributes:
        file: GPX file.
        time: Column with the times of the rows.
        longest_gap: Longest time between two track points [s]; rows between points farther apart in time are left out.
        clock: Time by which the rows' clock is ahead of the track's [s].
    """

    file: str
    time: str
    longest_gap: float = 10.0
    clock: float = 0.0


@dataclass(frozen=True)
class Preparation:
    """The steps that convert rows to links; none by default.

    Attributes:
        wide: Transmitter name for each column, for a table with one column per transmitter.
        track: Track that gives each row the columns `selection.TRACK_COLUMNS` [deg].
        where: Row filter.
        transmitters: Table with one row per transmitter, whose other columns are added to the links.
        transmitter: Column that names the transmitter in both tables.
        missing: Numbers that stand for a missing value, in addition to those that are recognized automatically.
        noise_floor_dbm: Noise floor [dBm]; missing powers count as below the floor.
        censored: Whether links at or below the noise floor are kept, as censored links at the floor.
        frame: Geographic frame of the scene, if positions are longitude, latitude and height; None if they are lengths.
        crs: Coordinate reference system of positions, if there is a frame.
        unit_m: Length of one unit of position columns in the scene's frame [m].
        ground: Function that gives the height of the ground; None if heights are not measured from the ground.
        averaging: How samples are averaged.
        keep: Columns whose groups are averaged separately, in addition to the transmitter column.
        held_out: Function that labels the parts held out separately; samples are not averaged or merged across parts.
        observables: Columns of additional measured values, which are averaged over rows that repeat a link.
        flights: Observables that are times of flight, in which certain numbers can stand for a missing value.
        computed: Functions that compute additional columns, by name, after the transmitters' columns are added. A
            function returns None if an optional column that it needs is missing.
        inside: What to do with receivers inside buildings: "drop", "move", or None to keep them where they are.
        outside: Function that moves positions out of buildings; required with `inside`.
    """

    wide: Mapping[str, str] = field(default_factory=dict)
    track: Track | None = None
    where: str | None = None
    transmitters: SourceTable | None = None
    transmitter: str = "transmitter"
    missing: Sequence[float] = ()
    noise_floor_dbm: float | None = None
    censored: bool = False
    frame: Frame | None = None
    crs: str = WGS84
    unit_m: float = 1.0
    ground: Ground | None = None
    averaging: Averaging | None = None
    keep: Sequence[str] = ()
    held_out: Divide | None = None
    observables: Sequence[str] = ()
    flights: Sequence[str] = ()
    computed: Mapping[str, Compute] = field(default_factory=dict)
    inside: Literal["drop", "move"] | None = None
    outside: MoveOutside | None = None

    @property
    def is_filter_only(self) -> bool:
        """Whether a filter is the only step, so that the remaining rows are already links."""
        steps = (
            *(self.track, self.transmitters, self.noise_floor_dbm, self.frame, self.ground),
            *(self.averaging, self.inside),
        )
        return not self.wide and self.unit_m == 1 and all(step is None for step in steps)
