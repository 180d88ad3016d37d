"""``[observables.NAME]``: what else was measured of the links, besides path loss."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from calibray.errors import InputError
from calibray.measurements.observables import KINDS, ROUND_TRIP, TIME_OF_FLIGHT, Statistic
from calibray.support.strict_models import Section, Text

UNITS: Final = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "dB": {"dB": 1.0},
    "rad": {"rad": 1.0, "deg": float(np.pi / 180)},
}
"""Units in which values of a dimension may be given, in SI units."""


class ObservableSection(Section):
    """``[observables.NAME]``: a statistic of the paths of each link, measured in addition to its path loss.

    Attributes:
        kind: What was measured.
        column: Column of the measured values; links without a value lack this observable.
        unit: Unit of the values: "s", "ms", "us" or "ns"; "dB"; "rad" or "deg".
        std: Standard deviation of a value's error, in the unit; estimated if absent.
        bias: "all" for one unknown bias of all values, or a column of labels for one bias per label; none if absent.
        path: Path of a time of flight: "mean" of all, "first" or "strongest".
        dynamic_range_db: How far below the strongest path the receiver sees paths [dB]; all if absent.
        floor_db: Path gain below which it sees none [dB]; no limit if absent.
        window: Longest delay after the first path [s]; no limit if absent.
    """

    kind: Literal[
        "rms_delay_spread",
        "mean_excess_delay",
        "time_of_flight",
        "round_trip_time",
        "k_factor",
        "azimuth_spread_departure",
        "azimuth_spread_arrival",
    ]
    column: Text
    unit: Text
    std: Annotated[float, Field(gt=0)] | None = None
    bias: Text | None = None
    path: Literal["mean", "first", "strongest"] = "mean"
    dynamic_range_db: Annotated[float, Field(gt=0)] | None = None
    floor_db: Annotated[float, Field(lt=0)] | None = None
    window: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _known_unit(self) -> Self:
        allowed = UNITS[KINDS[self.kind]]
        if self.unit not in allowed:
            raise InputError(f"unit = {self.unit!r}: a {self.kind} is given in {' or '.join(allowed)}")
        if self.path != "mean" and self.kind not in (TIME_OF_FLIGHT, ROUND_TRIP):
            raise InputError(
                f"path = {self.path!r}: only a time of flight or a round-trip time is that of one path"
            )
        return self

    @property
    def scale(self) -> float:
        """The unit in SI units."""
        return UNITS[KINDS[self.kind]][self.unit]

    @property
    def statistic(self) -> Statistic:
        """The statistic of the modelled paths."""
        return Statistic(self.kind, self.path, self.dynamic_range_db, self.floor_db, self.window)
