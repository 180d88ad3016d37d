"""Observables of links from measured multipath components: delays, powers and angles of every path, link by link.

Each is the statistic that the model computes, with a hard limit of the receiver's range. If a link was measured several
times, for example with rotations of the receiving array, it is the mean over the measurements.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.observables import (
    DELAY_SPREAD,
    EXCESS_DELAY,
    FLIGHTS,
    K_FACTOR,
    KINDS,
    ROUND_TRIP,
    SECTORS,
    SHARE_RANGE_DB,
    Statistic,
)
from calibray.measurements.table_files import read_table

DELAY: Final = r"(^|_)(delay|tau|toa|tof)"
POWER: Final = r"(^|_)(path_?loss|pl|path_?gain|gain|power|rx_?power|level)(_|$)"
AZIMUTH: Final = r"(^|_)(azimuth|azi?|aoa|phi)(_|$)"
ELEVATION: Final = r"(^|_)(elevation|ele?|zenith|theta)(_|$)"
SNAPSHOT: Final = r"(^|_)(rotation|snapshot|sweep|scan|repetition|orientation)(_|$)"
ANGLES: Final = (*(kind for kind, unit in KINDS.items() if unit == "rad"), *SECTORS)
"""Kinds of statistics that need an angle."""

SECONDS: Final = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}


@dataclass(frozen=True, eq=False)
class Multipath:
    """Measured components of links.

    Attributes:
        link: Label of each component's link [n].
        snapshot: Label of the component's measurement of its link [n].
        delay: Delay [n], [s].
        level_db: Power gain [n], [dB].
        azimuth: Azimuth, counterclockwise from the x axis [n], [rad]; None if it was not measured.
        elevation: Elevation or zenith angle [n], [rad]; None if it was not measured.
    """

    link: NDArray[np.str_]
    snapshot: NDArray[np.str_]
    delay: NDArray[np.float64]
    level_db: NDArray[np.float64]
    azimuth: NDArray[np.float64] | None = None
    elevation: NDArray[np.float64] | None = None


def read_multipath(path: str | Path, link: str, compass: bool = False) -> Multipath:
    """Read a table with one row per component.

    The columns are recognised by their names: a delay (`delay_ns`), a path loss, path gain or power [dB]
    (`path_loss_db`), and if present an azimuth, an elevation, and the number of the rotation or snapshot.

    Args:
        path: The table.
        link: Column of the links' labels.
        compass: Whether azimuths are compass bearings, clockwise from north.

    Raises:
        InputError: The table cannot be read, or lacks links, delays or powers.
    """
    table = read_table(path)
    names = [str(name) for name in table.frame.columns if name != link]

    def find(pattern: str) -> str | None:
        return next((name for name in names if re.search(pattern, name.lower())), None)

    delay, power, snapshot = find(DELAY), find(POWER), find(SNAPSHOT)
    if delay is None or power is None:
        missing = (
            "delay, such as delay_ns" if delay is None else "power, such as path_loss_db or path_gain_db"
        )
        raise InputError(f"{path}: no column of a {missing}; its columns are {', '.join(names)}")
    labels = table.labels(link)
    unit = next((unit for unit in SECONDS if delay.lower().endswith(f"_{unit}")), "s")
    sign = -1.0 if re.search(r"loss|(^|_)pl(_|$)", power.lower()) else 1.0

    def angle(pattern: str) -> NDArray[np.float64] | None:
        name = find(pattern)
        if name is None:
            return None
        values = table.numbers(name)
        return values if name.lower().endswith("rad") else np.radians(values)

    azimuth = angle(AZIMUTH)
    if azimuth is not None and compass:
        azimuth = np.pi / 2 - azimuth
    return Multipath(
        labels,
        np.full(len(labels), "") if snapshot is None else table.labels(snapshot),
        table.numbers(delay) * SECONDS[unit],
        sign * table.numbers(power),
        azimuth,
        angle(ELEVATION),
    )


def measure(multipath: Multipath, statistic: Statistic) -> dict[str, float]:
    """A statistic of every link in SI units, by the link's label; the mean over its snapshots.

    Links of which the receiver detects no component are left out. The components already include the bandwidth of the
    receiver.

    Raises:
        InputError: The statistic needs an angle that was not measured.

    Example:
        >>> paths = Multipath(np.array(["a", "a"]), np.array(["", ""]), np.array([1e-7, 2e-7]), np.zeros(2))
        >>> round(1e9 * measure(paths, Statistic("rms_delay_spread"))["a"], 6)
        50.0
    """
    angle = None
    if statistic.kind in ANGLES:
        angle = multipath.elevation if "elevation" in statistic.kind else multipath.azimuth
        if angle is None:
            raise InputError(f"{statistic.kind} needs angles, which were not measured")
    snapshots: dict[str, list[float]] = {}
    keys = pd.DataFrame({"link": multipath.link, "snapshot": multipath.snapshot})
    for index in keys.groupby(["link", "snapshot"], sort=False).indices.values():
        seen = _seen(multipath, np.asarray(index), statistic)
        if len(seen):
            value = _value(multipath, seen, None if angle is None else angle[seen], statistic)
            snapshots.setdefault(str(multipath.link[seen[0]]), []).append(value)
    return {link: float(np.mean(values)) for link, values in snapshots.items()}


def _seen(multipath: Multipath, index: NDArray[np.int64], statistic: Statistic) -> NDArray[np.int64]:
    """The components of a snapshot that the receiver detects."""
    delay, level_db = multipath.delay[index], multipath.level_db[index]
    seen = np.isfinite(level_db)
    if statistic.floor_db is not None:
        seen &= level_db > statistic.floor_db
    if statistic.dynamic_range_db is not None and seen.any():
        seen &= level_db > level_db[seen].max() - statistic.dynamic_range_db
    if statistic.window is not None and seen.any():
        seen &= delay - delay[seen].min() <= statistic.window
    return index[seen]


def _value(
    multipath: Multipath, seen: NDArray[np.int64], angle: NDArray[np.float64] | None, statistic: Statistic
) -> float:
    """The statistic of the components of a snapshot, in SI units."""
    delay, power = multipath.delay[seen], 10 ** (multipath.level_db[seen] / 10)
    weight, first = power / power.sum(), float(delay.min())
    mean, kind = float(np.sum(weight * delay)), statistic.kind
    if kind == DELAY_SPREAD:
        return float(np.sqrt(np.sum(weight * (delay - mean) ** 2)))
    if kind == EXCESS_DELAY:
        return mean - first
    if kind in FLIGHTS:
        of_path = {"mean": mean, "first": first, "strongest": float(delay[weight.argmax()])}
        return of_path[statistic.path] * (2 if kind == ROUND_TRIP else 1)
    if kind == K_FACTOR:
        strongest = float(weight.max())
        return 10 * float(np.log10(strongest / (1 - strongest))) if strongest < 1 else np.nan
    if statistic.edges is not None:
        low, high = statistic.edges
        values = delay - first if angle is None else (angle - low) % (2 * np.pi) + low
        range_db = SHARE_RANGE_DB if statistic.dynamic_range_db is None else statistic.dynamic_range_db
        share = float(weight[(values >= low) & (values < high)].sum())
        return 10 * float(np.log10(share + 10 ** (-range_db / 10)))
    resultant = float(np.clip(abs(np.sum(weight * np.exp(1j * np.asarray(angle)))), 1e-300, 1.0))
    return float(np.sqrt(-2 * np.log(resultant)))
