"""Observables of links other than path loss: measured statistics of the propagation paths, and their units."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

DELAY_SPREAD: Final = "rms_delay_spread"
EXCESS_DELAY: Final = "mean_excess_delay"
TIME_OF_FLIGHT: Final = "time_of_flight"
ROUND_TRIP: Final = "round_trip_time"
K_FACTOR: Final = "k_factor"
DEPARTURE_SPREAD: Final = "azimuth_spread_departure"
ARRIVAL_SPREAD: Final = "azimuth_spread_arrival"
DEPARTURE_ELEVATION: Final = "elevation_spread_departure"
ARRIVAL_ELEVATION: Final = "elevation_spread_arrival"
DELAY_BIN: Final = "power_delay_profile"
DEPARTURE_SECTOR: Final = "azimuth_power_departure"
ARRIVAL_SECTOR: Final = "azimuth_power_arrival"

KINDS: Final = {
    DELAY_SPREAD: "s",
    EXCESS_DELAY: "s",
    TIME_OF_FLIGHT: "s",
    ROUND_TRIP: "s",
    K_FACTOR: "dB",
    DEPARTURE_SPREAD: "rad",
    ARRIVAL_SPREAD: "rad",
    DEPARTURE_ELEVATION: "rad",
    ARRIVAL_ELEVATION: "rad",
    DELAY_BIN: "dB",
    DEPARTURE_SECTOR: "dB",
    ARRIVAL_SECTOR: "dB",
}
"""Kinds of observables and the units of their values."""

FLIGHTS: Final = (TIME_OF_FLIGHT, ROUND_TRIP)
"""Kinds of observables that are travel times. Measured travel times can include a device bias."""

SECTORS: Final = (DEPARTURE_SECTOR, ARRIVAL_SECTOR)
PROFILES: Final = (DELAY_BIN, *SECTORS)
"""Kinds of observables whose value is the fraction of a link's power in a bin. Each bin is a separate observable."""

SIGNED: Final = (K_FACTOR, *FLIGHTS, *PROFILES)
"""Kinds of observables whose measured values can be negative: decibels, and times from a clock with a bias."""

SHARE_RANGE_DB: Final = 30.0
"""Default dynamic range of the power fraction in a bin [dB]."""

ROUNDING: Final = 1e-12
"""Tolerance within which a delay [s] or azimuth [rad] counts as equal to a limit. Samples at multiples of 1 / bandwidth
can lie exactly on a limit. The tolerance exceeds the rounding error of a difference between delays or azimuths, but is
smaller than the resolution of any receiver."""


@dataclass(frozen=True)
class Statistic:
    """A measured statistic of a link's paths.

    Attributes:
        kind: One of `KINDS`.
        path: Path whose delay is the time of flight: "first", "strongest", or "mean" (the mean over all paths).
        dynamic_range_db: Range of powers below the strongest path within which the receiver detects paths [dB]; None if
            the receiver detects all paths.
        floor_db: Path gain below which the receiver detects no paths [dB]; None for no limit.
        window: Longest detected delay relative to the first path [s]; None for no limit.
        bandwidth: Bandwidth of the receiver [Hz]; None if the receiver resolves all paths.
        edges: Edges of the bin, for a kind in `PROFILES`: delays relative to the first path [s], or azimuths [rad].
    """

    kind: str
    path: str = "mean"
    dynamic_range_db: float | None = None
    floor_db: float | None = None
    window: float | None = None
    bandwidth: float | None = None
    edges: tuple[float, float] | None = None

    @property
    def bin(self) -> tuple[float, float]:
        """Edges of the bin, both reduced by `ROUNDING`.

        A value at the lower edge therefore lies inside the bin, and a value at the upper edge lies outside.

        Raises:
            ValueError: The statistic has no bin.
        """
        if self.edges is None:
            raise ValueError(f"{self.kind}: the edges of the bin are required")
        low, high = self.edges
        return low - ROUNDING, high - ROUNDING

    def limited(self, share_db: ArrayLike) -> NDArray[np.float64]:
        """Add the power fraction at the lower end of the dynamic range to the power fractions of bins [dB].

        Empty bins then have a finite value, both in the model and in the measurements.

        Example:
            >>> Statistic(DELAY_BIN).limited([-np.inf, -30.0, 0.0]).round(2).tolist()
            [-30.0, -26.99, 0.0]
        """
        range_db = SHARE_RANGE_DB if self.dynamic_range_db is None else self.dynamic_range_db
        return 10 * np.log10(10 ** (np.asarray(share_db) / 10) + 10 ** (-range_db / 10))


@dataclass(frozen=True)
class Wanted:
    """A statistic that an external program computes.

    Attributes:
        name: Name of the observable in the study.
        statistic: The statistic.
        unit: Unit in which the program returns the statistic.
        scale: Factor that converts values in this unit to SI units.
    """

    name: str
    statistic: Statistic
    unit: str
    scale: float

    def record(self) -> dict[str, object]:
        """The description sent to the program: name, kind, unit, and the limits stated in the study."""
        limits = {key: value for key, value in asdict(self.statistic).items() if value is not None}
        return {"name": self.name, "unit": self.unit, **limits}
