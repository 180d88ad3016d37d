"""Further observables of links besides path loss: what is measured of a link's paths, and in which unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

DELAY_SPREAD: Final = "rms_delay_spread"
EXCESS_DELAY: Final = "mean_excess_delay"
TIME_OF_FLIGHT: Final = "time_of_flight"
ROUND_TRIP: Final = "round_trip_time"
K_FACTOR: Final = "k_factor"
DEPARTURE_SPREAD: Final = "azimuth_spread_departure"
ARRIVAL_SPREAD: Final = "azimuth_spread_arrival"

KINDS: Final = {
    DELAY_SPREAD: "s",
    EXCESS_DELAY: "s",
    TIME_OF_FLIGHT: "s",
    ROUND_TRIP: "s",
    K_FACTOR: "dB",
    DEPARTURE_SPREAD: "rad",
    ARRIVAL_SPREAD: "rad",
}
"""Kinds of observables, with the unit of their values."""


@dataclass(frozen=True)
class Statistic:
    """What is measured of a link's paths.

    Attributes:
        kind: One of `KINDS`.
        path: Path of a time of flight: "mean", "first" or "strongest".
        dynamic_range_db: How far below the strongest path the receiver sees paths [dB]; None for all.
        floor_db: Path gain below which it sees none [dB]; None for no limit.
        window: Longest delay after the first path [s]; None for no limit.
    """

    kind: str
    path: str = "mean"
    dynamic_range_db: float | None = None
    floor_db: float | None = None
    window: float | None = None
