"""Measured antenna patterns: the gain of an antenna on a grid of directions, from a CSV file or an MSI file.

Between grid points, the gain is interpolated bilinearly in decibels, including across the ends of the azimuth axis. In
decibels, main lobes are nearly parabolic (as in 3GPP TR 38.901, Table 7.3-1), so the error is smallest where the
antenna radiates most. Nulls that are narrower than the grid spacing become shallower.

Planning tools export a horizontal and a vertical cut in the text format of MSI Planet (`TwoCuts`). Attenuations are
relative to the gain in the file's header. Horizontal angles are measured clockwise from the main direction, as seen
from above. Vertical angles are measured downwards from the horizon in front of the antenna, through the nadir to the
back of the antenna.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.measurements import SourceTable, read_table
from calibray.support.messages import shortened

TWO_CUT_SUFFIXES: Final = (".msi", ".pln", ".ant")
DIPOLE_GAIN_DBI: Final = 2.15
"""Gain of a half-wave dipole, the reference of dBd [dBi]."""
CUT_RANGES: Final = {"GAIN": (-30.0, 60.0), "angle": (-180.0, 360.0), "attenuation": (-0.5, 100.0)}
"""Ranges of gain [dBi], angles [deg] and attenuations [dB]; rounded attenuations can be slightly negative."""
LARGEST_STEP_DEG: Final = 15.0
_NUMBER: Final = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, eq=False)
class TwoCuts:
    """Two cuts of an antenna's gain through its main direction.

    Attributes:
        gain_dbi: Reference gain of the attenuations [dBi].
        horizontal_db: Attenuation [360], [dB], at whole degrees, clockwise from the main direction.
        vertical_db: Attenuation [360], [dB], at whole degrees, downwards from the horizon in front of the antenna.
    """

    gain_dbi: float
    horizontal_db: NDArray[np.float64]
    vertical_db: NDArray[np.float64]

    @property
    def downtilt_deg(self) -> float:
        """Angle of the main lobe below the horizon [deg]: mean of the forward angles with minimum attenuation."""
        angle = (np.arange(360) + 180) % 360 - 180
        front = np.abs(angle) < 90
        return float(angle[front & (self.vertical_db == self.vertical_db[front].min())].mean())

    def gain(self, azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> NDArray[np.float64]:
        """Gain [...], [dBi], in any direction of the antenna's frame; azimuths are counter-clockwise from the x axis.

        Between the cuts, the gain is interpolated by horizontal projection, which preserves both cuts exactly (Gil et
        al., "A 3D interpolation method for base-station-antenna radiation patterns", IEEE Antennas and Propagation
        Magazine 43, 2001).
        """
        azimuth = (np.asarray(azimuth_deg, dtype=float) + 180.0) % 360.0 - 180.0
        down = -np.asarray(elevation_deg, dtype=float)
        horizontal, back = self._at(self.horizontal_db, -azimuth), np.abs(azimuth) / 180.0
        # Both cuts contain the attenuation in front of the antenna and behind it; the differences below avoid counting
        # this attenuation twice.
        front_db = self._at(self.vertical_db, down) - self.horizontal_db[0]
        back_db = self._at(self.vertical_db, 180.0 - down) - self.horizontal_db[180]
        return self.gain_dbi - (horizontal + (1 - back) * front_db + back * back_db)

    def _at(self, cut_db: NDArray[np.float64], angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(angle_deg, np.arange(360.0), cut_db, period=360.0)


def read_two_cuts(path: str | Path) -> TwoCuts:
    """Read an MSI file (also .pln, .ant): header lines, then the cuts HORIZONTAL and VERTICAL.

    Each cut states its number of lines. Each line has an angle [deg] and an attenuation [dB]; the lines, in any order,
    cover a full turn in steps of at most 15 degrees. Blanks, tabs and semicolons are separators; decimal commas are
    accepted. According to the format, GAIN is in dBd unless its line contains dBi.

    Raises:
        InputError: The file cannot be read, lacks the gain or a cut, or has a malformed line; the message states the
            line number.
    """
    try:
        lines = Path(path).read_text(encoding="latin-1").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}); check the file") from None
    gain: float | None = None
    cuts: dict[str, NDArray[np.float64]] = {}
    number = 0
    while number < len(lines):
        words = re.split(r"[\s;]+", lines[number].strip())
        key = words[0].upper().rstrip(":=")
        place = f"{path}, line {number + 1}"
        if key == "GAIN":
            gain = _gain_dbi(place, words[1:])
        elif key in ("HORIZONTAL", "VERTICAL"):
            if key in cuts:
                raise InputError(f"{place}: {key} is given twice; remove one")
            count = _count(place, key, words[1:])
            cuts[key] = _cut(path, number + 1, lines[number + 1 : number + 1 + count], count, key)
            number += count
        elif words[0] and _NUMBER.fullmatch(words[0]):
            raise InputError(
                f"{place}: {shortened(lines[number])!r} belongs to no cut; correct the cut's number of lines"
            )
        number += 1
    for key in ("HORIZONTAL", "VERTICAL"):
        if key not in cuts:
            raise InputError(f"{path}: no line {key} with its number of angles; export both cuts")
    if gain is None:
        raise InputError(f"{path}: no line GAIN; add the antenna's gain, such as 'GAIN 17.5 dBi'")
    return TwoCuts(gain, cuts["HORIZONTAL"], cuts["VERTICAL"])


def _gain_dbi(place: str, words: list[str]) -> float:
    text = " ".join(words)
    joined = re.fullmatch(rf"({_NUMBER.pattern})\s*[(\[]?(dbi|dbd)?[)\]]?(?:\s.*)?", text, re.IGNORECASE)
    if joined is None:
        raise InputError(f"{place}: GAIN {shortened(text)!r}: must be a number, such as 'GAIN 17.5 dBi'")
    value = float(joined.group(1).replace(",", "."))
    # A unit next to the number, with or without brackets, takes precedence over a unit in a comment.
    unit = (joined.groups()[-1] or ("dbi" if "dbi" in text.lower() else "dbd")).lower()
    return _cut_in_range(place, "GAIN", value if unit == "dbi" else value + DIPOLE_GAIN_DBI)


def _count(place: str, key: str, words: list[str]) -> int:
    if not words or not words[0].isdecimal() or len(words[0]) > 4 or not 24 <= int(words[0]) <= 7201:
        raise InputError(
            f"{place}: {key} {shortened(' '.join(words))!r}: must be followed by the number of its lines, 24 to 7201"
        )
    return int(words[0])


def _cut(path: str | Path, first: int, lines: list[str], count: int, key: str) -> NDArray[np.float64]:
    """Attenuation at whole degrees [360], [dB]; `first` is the number of lines that precede `lines` in the file."""
    if len(lines) < count:
        raise InputError(
            f"{path}: {key} states {count} lines, but the file ends after {len(lines)}; export it again"
        )
    pairs = np.empty((count, 2))
    for index, line in enumerate(lines):
        place, words = (
            f"{path}, line {first + index + 1}",
            [w for w in re.split(r"[\s;]+", line.strip()) if w],
        )
        if len(words) < 2 or not all(_NUMBER.fullmatch(word) for word in words[:2]):
            raise InputError(
                f"{place}: {shortened(line)!r}: must be an angle [deg] and an attenuation [dB]; {key} states {count} "
                "lines"
            )
        angle, attenuation = (float(word.replace(",", ".")) for word in words[:2])
        pairs[index] = _cut_in_range(place, "angle", angle), _cut_in_range(place, "attenuation", attenuation)
    # The file may state a direction at both ends of a full turn; the first value is used.
    angle, order = np.unique(np.round(pairs[:, 0] % 360.0, 6), return_index=True)
    largest = float(np.diff([*angle, angle[0] + 360.0]).max())
    if largest > LARGEST_STEP_DEG:
        raise InputError(
            f"{path}: {key} has a gap of {largest:g} degrees without a value, but gaps must be at most "
            f"{LARGEST_STEP_DEG:g}; export a full turn"
        )
    return np.interp(np.arange(360.0), angle, pairs[order, 1], period=360.0)


def _cut_in_range(place: str, name: str, value: float) -> float:
    low, high = CUT_RANGES[name]
    if not low <= value <= high:
        remedy: Any = (
            "attenuations are positive and relative to the gain"
            if name == "attenuation"
            else "check the unit"
        )
        raise InputError(f"{place}: {name} {value:g} must be {low:g} to {high:g}; {remedy}")
    return value


COLUMNS: Final = ("azimuth_deg", "elevation_deg", "gain_dbi")
RANGES: Final = {"azimuth_deg": (-180.0, 360.0), "elevation_deg": (-90.0, 90.0), "gain_dbi": (-200.0, 60.0)}
LARGEST_EFFICIENCY: Final = 1.5
"""Maximum ratio of radiated to accepted power up to which values are accepted as absolute gains [1]."""
SEAM_TOLERANCE_DB: Final = 0.1
"""Maximum difference between the gains at the first azimuth and at the same direction a full turn later [dB]."""
_STEP_TOLERANCE: Final = 0.01
"""Maximum relative difference between a step and the median step."""


@dataclass(frozen=True, eq=False)
class GainTable:
    """The gain of an antenna on a regular grid over all directions.

    Attributes:
        first_azimuth_deg: Azimuth of the first column [deg], from the antenna's x axis towards its y axis.
        gain_dbi: Gain [elevations, azimuths], [dBi]. Elevations run from -90 to 90 degrees in equal steps, including
            the ends. Azimuths run in equal steps around a full turn, excluding the end of the turn.

    Example:
        >>> GainTable(-180.0, np.zeros((181, 360))).efficiency
        1.0
    """

    first_azimuth_deg: float
    gain_dbi: NDArray[np.float64]

    @property
    def steps_deg(self) -> tuple[float, float]:
        """Step sizes in elevation and azimuth [deg]."""
        elevations, azimuths = self.gain_dbi.shape
        return 180.0 / (elevations - 1), 360.0 / azimuths

    @property
    def efficiency(self) -> float:
        """Ratio of radiated to accepted power [1], which is the mean gain over the sphere; 1 for a lossless antenna."""
        step = np.radians(self.steps_deg[0])
        elevation = np.radians(np.linspace(-90, 90, len(self.gain_dbi)))
        # Integrals of cos(elevation) times the hat functions of linear interpolation, so that a gain of 0 dBi gives 1.
        weight = 2 * np.cos(elevation) * (1 - np.cos(step)) / step
        weight[[0, -1]] = 1 - np.sin(step) / step
        return round(float(weight @ (10 ** (self.gain_dbi / 10)).mean(axis=1)) / 2, 12)

    def gain(self, azimuth_deg: ArrayLike, elevation_deg: ArrayLike, xp: Any = np) -> Any:
        """Interpolate the gain [...], [dBi], at azimuths and elevations [...], [deg]; elevations are from -90 to 90.

        `xp` is the array library: NumPy, or `jax.numpy` within a JAX function.
        """
        elevation_step, azimuth_step = self.steps_deg
        rows, columns = self.gain_dbi.shape
        gain_dbi = xp.asarray(self.gain_dbi)
        row = (xp.asarray(elevation_deg, dtype=float) + 90) / elevation_step
        column = ((xp.asarray(azimuth_deg, dtype=float) - self.first_azimuth_deg) / azimuth_step) % columns
        i = xp.clip(row.astype(int), 0, rows - 2)
        # For negative numbers very close to 0, the remainder rounds to `columns`, the end of the last interval.
        j = xp.minimum(column.astype(int), columns - 1)
        next_j = (j + 1) % columns
        u, v = row - i, column - j
        low = (1 - v) * gain_dbi[i, j] + v * gain_dbi[i, next_j]
        high = (1 - v) * gain_dbi[i + 1, j] + v * gain_dbi[i + 1, next_j]
        return (1 - u) * low + u * high

    def digest(self) -> str:
        """Fingerprint of the gains, independent of the layout of the file."""
        content = np.array([self.first_azimuth_deg, *self.gain_dbi.shape, *self.gain_dbi.ravel()])
        return hashlib.sha256(content.astype("<f8").tobytes()).hexdigest()


def is_gain_file(pattern: str) -> bool:
    """Whether a pattern is the name of a gain file, which ends in ".csv", ".msi", ".pln" or ".ant"."""
    return pattern.lower().endswith((".csv", *TWO_CUT_SUFFIXES))


def read_gain_table(path: str | Path) -> GainTable:
    """Read the gain of an antenna from a CSV file of all directions, or from an MSI file of two cuts (`read_two_cuts`).

    The CSV file has the columns azimuth_deg, elevation_deg and gain_dbi, with one row per direction in any order.
    Azimuths cover a full turn (-180 to 180 or 0 to 360, with or without the end), and elevations -90 to 90, both in
    equal steps of at most 15 degrees. Every pair of azimuth and elevation has a row. Principal cuts alone are not
    sufficient.

    Raises:
        InputError: The file or a column is missing or malformed, a number is out of range, a direction is missing or
            given twice, the steps are unequal, the sphere is not covered, the gains of one direction at both ends of
            the azimuth axis differ, or the antenna would radiate more than 1.5 times its accepted power.
    """
    if str(path).lower().endswith(TWO_CUT_SUFFIXES):
        cuts = read_two_cuts(path)
        return GainTable(-180.0, cuts.gain(*np.meshgrid(np.arange(-180.0, 180.0), np.arange(-90.0, 91.0))))
    table = read_table(path)
    azimuth, elevation, gain = (_in_range(table, name) for name in COLUMNS)
    row, low, high = _axis(table, "elevation_deg", elevation)
    if (low, high) != (-90.0, 90.0):
        raise InputError(
            f"{path}: elevation_deg runs from {low:g} to {high:g}, but must run from -90 to 90; add the "
            "missing directions (principal cuts alone are not enough)"
        )
    column, first, last = _axis(table, "azimuth_deg", azimuth)
    count = column.max() + 1
    closed = abs(last - first - 360) < 1e-6
    step = (last - first) / (count - 1)
    if not closed and abs(last - first + step - 360) > _STEP_TOLERANCE * step:
        raise InputError(
            f"{path}: azimuth_deg runs from {first:g} to {last:g} in steps of {step:g}, but must cover a full "
            "turn, such as -180 to 180 or 0 to 360; add the missing directions (principal cuts alone are not enough)"
        )
    gains = np.full((row.max() + 1, count), np.nan)
    gains[row, column] = gain
    _refuse_repeats(table, row * count + column)
    _refuse_gaps(table, row, column, gains)
    if closed:
        difference = np.abs(gains[:, 0] - gains[:, -1])
        if difference.max() > SEAM_TOLERANCE_DB:
            worst = difference.argmax()
            line = int(np.flatnonzero((row == worst) & (column == count - 1))[0])
            raise InputError(
                f"{table.cell(line, 'gain_dbi')}: {gain[line]:g} differs from the gain at azimuth "
                f"{first:g}, {gains[worst, 0]:g}, which is the same direction; correct one of the two"
            )
        gains = gains[:, :-1]
    gain_table = GainTable(first, gains)
    if gain_table.efficiency > LARGEST_EFFICIENCY:
        raise InputError(
            f"{path}: an antenna with these gains would radiate {gain_table.efficiency:.3g} times the power that it "
            f"accepts, but the factor must be at most {LARGEST_EFFICIENCY:g}; give absolute gains [dBi], "
            "not relative levels"
        )
    return gain_table


def _in_range(table: SourceTable, name: str) -> NDArray[np.float64]:
    values = table.numbers(name)
    low, high = RANGES[name]
    wrong = np.flatnonzero((values < low) | (values > high))
    if len(wrong):
        value = values[wrong[0]]
        remedy = "write a null as a low gain, such as -60" if value < low else "check the unit"
        raise InputError(
            f"{table.cell(int(wrong[0]), name)}: {value:g} must be {low:g} to {high:g} ({len(wrong)} of "
            f"{len(table)} rows); {remedy if name == 'gain_dbi' else 'give degrees'}"
        )
    return values


def _axis(
    table: SourceTable, name: str, values: NDArray[np.float64]
) -> tuple[NDArray[np.int64], float, float]:
    """Index of every row on an axis with equal steps [rows], and the ends of the axis [deg]."""
    axis = np.unique(values)
    if len(axis) < 2:
        raise InputError(
            f"{table.source}: column {name!r} contains only {axis[0]:g}; give a grid over all directions "
            "(principal cuts alone are not enough)"
        )
    steps = np.diff(axis)
    step = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - step) > _STEP_TOLERANCE * step)
    if len(uneven):
        before, after = axis[uneven[0]], axis[uneven[0] + 1]
        line = int(np.flatnonzero(values == after)[0])
        raise InputError(
            f"{table.cell(line, name)}: {after:g} follows {before:g} where the other steps are "
            f"{step:g}; give equal steps"
        )
    if step > LARGEST_STEP_DEG * (1 + _STEP_TOLERANCE):
        raise InputError(
            f"{table.source}: {name} has steps of {step:g}, but steps must be at most {LARGEST_STEP_DEG:g}; give a "
            "finer grid"
        )
    return np.round((values - axis[0]) / step).astype(np.int64), float(axis[0]), float(axis[-1])


def _refuse_repeats(table: SourceTable, cell: NDArray[np.int64]) -> None:
    """Raise an error if two rows have the same grid cell; `cell` [rows] is the cell of each row."""
    order = np.argsort(cell, kind="stable")
    repeats = np.flatnonzero(np.diff(cell[order]) == 0)
    if len(repeats):
        first, second = order[repeats[0]], order[repeats[0] + 1]
        raise InputError(
            f"{table.source}, row {table.row[second]}: has the same direction as row {table.row[first]} "
            f"(repeated directions: {len(repeats)}); remove one of the two"
        )


def _refuse_gaps(
    table: SourceTable, row: NDArray[np.int64], column: NDArray[np.int64], gains: NDArray[np.float64]
) -> None:
    """Raise an error if a grid cell has no row."""
    missing = np.argwhere(np.isnan(gains))
    if len(missing):
        elevation = table.numbers("elevation_deg")[row == missing[0, 0]][0]
        azimuth = table.numbers("azimuth_deg")[column == missing[0, 1]][0]
        raise InputError(
            f"{table.source}: no row for azimuth_deg = {azimuth:g}, elevation_deg = {elevation:g} "
            f"({len(missing)} of {gains.size} directions); add it (principal cuts alone are not enough)"
        )
