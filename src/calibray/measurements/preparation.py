"""The meaning of the columns of a table, and the steps that convert the rows to links."""

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
"""Function that moves positions [n, 3], [m] out of buildings. It returns the new positions, which are NaN for positions
too deep inside a building, and the distances [n], [m] by which positions were moved."""

Compute = Callable[[SourceTable], NDArray[np.float64] | None]
"""Function that computes a new column [rows] from the rows of a table; it returns None if a required column is
missing."""

Divide = Callable[[SourceTable], NDArray[Any]]
"""Function that splits a table into parts; it returns, for each row, the label of the part [rows]."""


@dataclass(frozen=True)
class LinkColumns:
    """The columns of a table that describe the links.

    Attributes:
        tx: Transmitter position: x, y, z [m], or longitude, latitude [deg] and height [m].
        rx: Receiver position, in the same form.
        value: Column of the measured values.
        quantity: "path_loss" [dB], "path_gain" [dB], "received_power" [dBm], or "rsrp" [dBm] for received power if the
            transmitted power is unknown. With "rsrp", the path loss is the negative of the received power, and the
            offset of the study includes the transmitted power.
        group: Column of group labels, or several columns whose labels are joined.
        weight: Column of relative weights [1], greater than 0.
        std: Standard deviation of the values [dB], as a number or a column; the weights are then 1 / std^2.
        tx_power_dbm: Transmitted power [dBm], as a number or a column; allowed only with "received_power".
        frequency: Column of carrier frequencies, in hertz or in the unit stated in the column name.

    Raises:
        InputError: The quantity is unknown or is inconsistent with `tx_power_dbm`, or both `weight` and `std` are
            given.
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
                "quantity = 'received_power' needs tx_power_dbm [dBm]; if this power is unknown, set quantity = 'rsrp' "
                "and add an [offset]"
            )
        if self.quantity != "received_power" and self.tx_power_dbm is not None:
            raise InputError(
                f"quantity = {self.quantity!r} cannot be combined with tx_power_dbm; remove tx_power_dbm"
            )
        if self.weight is not None and self.std is not None:
            raise InputError(f"weight = {self.weight!r} and std = {self.std!r}: give only one of these")


@dataclass(frozen=True)
class Averaging:
    """How samples are averaged in linear power.

    Attributes:
        by: Which samples are averaged together: those at the same "place" (receiver position), in the same "cell" of a
            square grid, in the same interval of "distance" travelled, or in the same window of "time". Distance is
            summed in row order, separately for groups of rows that are never averaged together, such as rows of
            different devices.
        size: Width of a cell or length of an interval [m], or duration of a window [s]; not used for "place".
        time: Column of times, for "time".
        unbiased: Whether to correct the bias that arises from taking the logarithm of a mean over few samples.
        minimum_count: Smallest number of samples per average; averages over fewer samples are left out.
    """

    by: Literal["place", "cell", "distance", "time"]
    size: float | None = None
    time: str | None = None
    unbiased: bool = False
    minimum_count: int = 1


@dataclass(frozen=True)
class Track:
    """A GPX track, from which the position of each row is interpolated in time.

    Attributes:
        file: The GPX file.
        time: Column that contains the times of the rows.
        longest_gap: Longest permitted time between two successive track points [s]; rows in longer gaps are left out.
        clock: Time by which the logger's clock is ahead of the clock of the track [s].
    """

    file: str
    time: str
    longest_gap: float = 10.0
    clock: float = 0.0


@dataclass(frozen=True)
class Preparation:
    """The steps that convert rows to links; none by default.

    Attributes:
        wide: Name of the transmitter of each column, for a table with one column per transmitter.
        track: Track from which the columns `placement.TRACK_COLUMNS` [deg] are added to the rows.
        where: Row filter.
        transmitters: Table with one row per transmitter. The columns other than the name are added to the links.
        transmitter: Column with the name of the transmitter, in both tables.
        missing: Numbers that represent missing values, in addition to the codes that are recognized automatically.
        noise_floor_dbm: Noise floor [dBm]. Missing powers are treated as below the noise floor.
        censored: Whether measurements at or below the noise floor are kept as censored links.
        frame: Georeference of the scene if positions are geographic; None if positions are in the scene frame.
        crs: Coordinate reference system of the positions; used only with `frame`.
        unit_m: Length of the unit of the position columns in the scene frame [m].
        ground: Function that returns the height of the ground; None if heights are not relative to the ground.
        averaging: Rule for averaging samples; None if samples are not averaged.
        keep: Columns whose labels define groups that are averaged separately, in addition to the transmitter column.
        held_out: Function that labels the parts of the table that are held out separately. Samples are not averaged or
            merged across parts.
        observables: Columns of additional measured values, such as delays, which are averaged over the rows of a link.
            Codes for missing values in these columns are treated as missing.
        means: Columns of other numbers that are averaged over the rows of a link, such as the columns of nuisances.
        flights: Columns of times of flight, in which codes of any magnitude are treated as missing values.
        computed: Functions that compute additional columns, by the name of the new column. They are called after the
            columns of the transmitters have been added. A function returns None if an optional column that it requires
            is missing.
        check: Function that rejects a table without a required column. It is called after the columns of the
            transmitters have been added.
        inside: Treatment of receivers inside buildings: "drop", "move", or None to keep their positions.
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
    means: Sequence[str] = ()
    flights: Sequence[str] = ()
    computed: Mapping[str, Compute] = field(default_factory=dict)
    check: Callable[[SourceTable], None] | None = None
    inside: Literal["drop", "move"] | None = None
    outside: MoveOutside | None = None

    @property
    def is_filter_only(self) -> bool:
        """Whether no step other than a filter is set; the remaining rows are then already links."""
        steps = (
            *(self.track, self.transmitters, self.noise_floor_dbm, self.frame, self.ground),
            *(self.averaging, self.inside),
        )
        return not self.wide and self.unit_m == 1 and all(step is None for step in steps)
