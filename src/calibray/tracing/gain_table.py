"""Measured antenna patterns: the gain of an antenna on a grid of directions, from a CSV file.

Between grid points the gain is interpolated bilinearly in decibel, and across the seam of the azimuth. Decibel, because
main lobes are close to a parabola there (3GPP TR 38.901, Table 7.3-1, is one), so that the error is least where the
antenna radiates; what is lost is the depth of nulls narrower than the grid.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.measurements import SourceTable, read_table

COLUMNS: Final = ("azimuth_deg", "elevation_deg", "gain_dbi")
RANGES: Final = {"azimuth_deg": (-180.0, 360.0), "elevation_deg": (-90.0, 90.0), "gain_dbi": (-200.0, 60.0)}
LARGEST_STEP_DEG: Final = 15.0
LARGEST_EFFICIENCY: Final = 1.5
"""Radiated over accepted power beyond which the gains are taken for another quantity."""
SEAM_TOLERANCE_DB: Final = 0.1
"""How far the gains at the first azimuth and a full turn later may lie apart."""
_UNEVEN: Final = 0.01
"""How far a step may differ from the others, as a share of it."""


@dataclass(frozen=True, eq=False)
class GainTable:
    """The gain of an antenna on a regular grid over all directions.

    Attributes:
        first_azimuth_deg: Azimuth of the first column [deg], from the antenna's x axis towards its y axis.
        gain_dbi: Gain [elevations, azimuths], [dBi]. Elevations run from -90 to 90 degrees in equal steps, ends
            included; azimuths in equal steps round a full turn, whose end is not repeated.

    Example:
        >>> GainTable(-180.0, np.zeros((181, 360))).efficiency
        1.0
    """

    first_azimuth_deg: float
    gain_dbi: NDArray[np.float64]

    @property
    def steps_deg(self) -> tuple[float, float]:
        """The steps of elevation and azimuth [deg]."""
        elevations, azimuths = self.gain_dbi.shape
        return 180.0 / (elevations - 1), 360.0 / azimuths

    @property
    def efficiency(self) -> float:
        """Radiated over accepted power [1]: the mean of the gain over the sphere; 1 for a lossless antenna."""
        step = np.radians(self.steps_deg[0])
        angle = np.radians(np.linspace(-90, 90, len(self.gain_dbi)))
        # Integrals of cos(elevation) times the hat functions of linear interpolation, so that gain 0 dBi gives 1.
        weight = 2 * np.cos(angle) * (1 - np.cos(step)) / step
        weight[[0, -1]] = 1 - np.sin(step) / step
        return round(float(weight @ (10 ** (self.gain_dbi / 10)).mean(axis=1)) / 2, 12)

    def gain(self, azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> NDArray[np.float64]:
        """Gain in some directions.

        Args:
            azimuth_deg: Azimuth [...], [deg].
            elevation_deg: Elevation [...], [deg], from -90 to 90.

        Returns:
            Gain [...], [dBi].
        """
        rise, turn = self.steps_deg
        row = (np.asarray(elevation_deg, dtype=float) + 90) / rise
        column = (
            (np.asarray(azimuth_deg, dtype=float) - self.first_azimuth_deg) / turn
        ) % self.gain_dbi.shape[1]
        i = np.clip(row.astype(int), 0, len(self.gain_dbi) - 2)
        j = column.astype(int) % self.gain_dbi.shape[1]
        k = (j + 1) % self.gain_dbi.shape[1]
        u, v = row - i, column - j
        low, high = ((1 - v) * self.gain_dbi[at, j] + v * self.gain_dbi[at, k] for at in (i, i + 1))
        return (1 - u) * low + u * high

    def digest(self) -> str:
        """A fingerprint of the gains, the same however the file is laid out."""
        content = np.array([self.first_azimuth_deg, *self.gain_dbi.shape, *self.gain_dbi.ravel()])
        return hashlib.sha256(content.astype("<f8").tobytes()).hexdigest()


def is_gain_file(pattern: str) -> bool:
    """Whether the name of a pattern is that of a file of gains: one that ends in ".csv"."""
    return pattern.lower().endswith(".csv")


def read_gain_table(path: str | Path) -> GainTable:
    """Read the gain of an antenna.

    Args:
        path: CSV file with the columns azimuth_deg, elevation_deg and gain_dbi, one row per direction, in any order.
            Azimuths go round a full turn (-180 to 180 or 0 to 360, the end repeated or not), elevations from -90 to
            90, both in equal steps of at most 15 degrees, and every pair of them has its row. Principal cuts alone
            do not do.

    Returns:
        The table.

    Raises:
        InputError: The file or a column is missing or malformed, a number lies outside its range, a direction is
            missing or stands twice, the steps are unequal or the sphere not covered, the gains disagree at the
            azimuths that are the same direction, or the antenna would radiate more than 1.5 times its power.
    """
    table = read_table(path)
    azimuth, elevation, gain = (_in_range(table, name) for name in COLUMNS)
    rows, low, high = _axis(table, "elevation_deg", elevation)
    if (low, high) != (-90.0, 90.0):
        raise InputError(
            f"{path}: elevation_deg runs from {low:g} to {high:g}, must run from -90 to 90; add the directions "
            "that are missing (principal cuts alone do not do)"
        )
    columns, first, last = _axis(table, "azimuth_deg", azimuth)
    count = columns.max() + 1
    closed = abs(last - first - 360) < 1e-6
    step = (last - first) / (count - 1)
    if not closed and abs(last - first + step - 360) > _UNEVEN * step:
        raise InputError(
            f"{path}: azimuth_deg runs from {first:g} to {last:g} in steps of {step:g}, must cover a full turn, as "
            "-180 to 180 or 0 to 360; add the directions that are missing (principal cuts alone do not do)"
        )
    gains = np.full((rows.max() + 1, count), np.nan)
    gains[rows, columns] = gain
    _refuse_gaps(table, rows, columns, gains)
    if closed:
        apart = np.abs(gains[:, 0] - gains[:, -1])
        if apart.max() > SEAM_TOLERANCE_DB:
            worst = np.flatnonzero((rows == apart.argmax()) & (columns == count - 1))[0]
            raise InputError(
                f"{table.cell(int(worst), 'gain_dbi')}: {gain[worst]:g} differs from the gain at azimuth "
                f"{first:g}, {gains[apart.argmax(), 0]:g}, which is the same direction; correct one"
            )
        gains = gains[:, :-1]
    found = GainTable(first, gains)
    if found.efficiency > LARGEST_EFFICIENCY:
        raise InputError(
            f"{path}: an antenna with these gains would radiate {found.efficiency:.3g} times the power it takes, "
            f"must be at most {LARGEST_EFFICIENCY:g}; give absolute gains [dBi], not levels relative to another"
        )
    return found


def _in_range(table: SourceTable, name: str) -> NDArray[np.float64]:
    values = table.numbers(name)
    low, high = RANGES[name]
    if (wrong := (values < low) | (values > high)).any():
        first = int(np.flatnonzero(wrong)[0])
        remedy = "write a null as a low gain, such as -60" if values[first] < low else "check the unit"
        raise InputError(
            f"{table.cell(first, name)}: {values[first]:g} must be {low:g} to {high:g} ({wrong.sum()} of "
            f"{len(table)} rows); {remedy if name == 'gain_dbi' else 'give degrees'}"
        )
    return values


def _axis(
    table: SourceTable, name: str, values: NDArray[np.float64]
) -> tuple[NDArray[np.int64], float, float]:
    """Place of every row on an axis of equal steps [rows], and its ends [deg]."""
    found = np.unique(values)
    if len(found) < 2:
        raise InputError(
            f"{table.source}: column {name!r} holds {found[0]:g} alone; give a grid over all directions "
            "(principal cuts alone do not do)"
        )
    steps = np.diff(found)
    step = float(np.median(steps))
    odd = np.flatnonzero(np.abs(steps - step) > _UNEVEN * step)
    if len(odd):
        at = int(np.flatnonzero(values == found[odd[0] + 1])[0])
        raise InputError(
            f"{table.cell(at, name)}: {found[odd[0] + 1]:g} follows {found[odd[0]]:g} where the other steps are "
            f"{step:g}; give equal steps"
        )
    if step > LARGEST_STEP_DEG * (1 + _UNEVEN):
        raise InputError(
            f"{table.source}: {name} goes in steps of {step:g}, must be at most {LARGEST_STEP_DEG:g}; give a finer grid"
        )
    return np.round((values - found[0]) / step).astype(np.int64), float(found[0]), float(found[-1])


def _refuse_gaps(
    table: SourceTable, rows: NDArray[np.int64], columns: NDArray[np.int64], gains: NDArray[np.float64]
) -> None:
    """Refuse directions that stand twice or not at all."""
    place = rows * gains.shape[1] + columns
    order = np.argsort(place, kind="stable")
    twice = np.flatnonzero(np.diff(place[order]) == 0)
    if len(twice):
        first, second = order[twice[0]], order[twice[0] + 1]
        raise InputError(
            f"{table.source}, row {table.row[second]}: the same direction as row {table.row[first]} "
            f"({len(twice)} in all); remove one"
        )
    missing = np.argwhere(np.isnan(gains))
    if len(missing):
        row, column = missing[0]
        axes = (table.numbers(name) for name in ("azimuth_deg", "elevation_deg"))
        azimuth, elevation = (
            axis[np.flatnonzero(index == at)[0]]
            for axis, index, at in zip(axes, (columns, rows), (column, row), strict=True)
        )
        raise InputError(
            f"{table.source}: no row for azimuth_deg = {azimuth:g}, elevation_deg = {elevation:g} "
            f"({len(missing)} of {gains.size} directions); add it (principal cuts alone do not do)"
        )
