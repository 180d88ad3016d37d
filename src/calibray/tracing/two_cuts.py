"""Antenna patterns in the form of planning tools: a horizontal and a vertical cut, in MSI Planet's text format.

Attenuations are relative to the gain of the header. Horizontal angles are clockwise from the main direction as seen
from above; vertical angles are downwards from the horizon in front of the antenna, via the ground to its back.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.support.messages import shortened

TWO_CUT_SUFFIXES: Final = (".msi", ".pln", ".ant")
DIPOLE_GAIN_DBI: Final = 2.15
"""Gain of a half-wave dipole, the reference of dBd [dBi]."""
RANGES: Final = {"GAIN": (-30.0, 60.0), "angle": (-180.0, 360.0), "attenuation": (-0.5, 100.0)}
"""Ranges of the gain [dBi], of angles [deg] and of attenuations [dB]; rounded cuts slightly exceed their gain."""
LARGEST_STEP_DEG: Final = 15.0
_NUMBER: Final = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, eq=False)
class TwoCuts:
    """Two cuts of an antenna's gain through its main direction.

    Attributes:
        gain_dbi: Gain to which attenuations refer [dBi].
        horizontal_db: Attenuation at whole degrees clockwise from the main direction [360], [dB].
        vertical_db: Attenuation at whole degrees downwards from the horizon in front [360], [dB].
    """

    gain_dbi: float
    horizontal_db: NDArray[np.float64]
    vertical_db: NDArray[np.float64]

    def gain(self, azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> NDArray[np.float64]:
        """Gain in any direction of the antenna's frame [...], [dBi]; azimuths counter-clockwise from the x axis.

        Between the cuts, the gain is interpolated by horizontal projection, which keeps both cuts exactly (Gil et al.,
        "A 3D interpolation method for base-station-antenna radiation patterns", IEEE Antennas and Propagation Magazine
        43, 2001).
        """
        azimuth = (np.asarray(azimuth_deg, dtype=float) + 180.0) % 360.0 - 180.0
        down = -np.asarray(elevation_deg, dtype=float)
        horizontal, back = self._at(self.horizontal_db, -azimuth), np.abs(azimuth) / 180.0
        front_db = self._at(self.vertical_db, down) - self.horizontal_db[0]
        back_db = self._at(self.vertical_db, 180.0 - down) - self.horizontal_db[180]
        return self.gain_dbi - (horizontal + (1 - back) * front_db + back * back_db)

    def _at(self, cut_db: NDArray[np.float64], angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(angle_deg, np.arange(360.0), cut_db, period=360.0)


def read_two_cuts(path: str | Path) -> TwoCuts:
    """Read an MSI file (also .pln, .ant): header lines, then the cuts HORIZONTAL and VERTICAL.

    Each cut states its number of lines, each with an angle [deg] and an attenuation [dB], in any order, around a full
    turn in steps of at most 15 degrees. Blanks, tabs or semicolons are separators; decimal commas are accepted. GAIN is
    in dBd unless its line contains dBi, as the format defines.

    Raises:
        InputError: The file cannot be read, lacks the gain or a cut, or a line is malformed; the message names the
            line.
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
            raise InputError(f"{path}: no line {key} with the number of its angles; export both cuts")
    if gain is None:
        raise InputError(f"{path}: no line GAIN; add the antenna's gain, as 'GAIN 17.5 dBi'")
    return TwoCuts(gain, cuts["HORIZONTAL"], cuts["VERTICAL"])


def _gain_dbi(place: str, words: list[str]) -> float:
    joined = re.fullmatch(rf"({_NUMBER.pattern})\s*(dbi|dbd)?(?:\s.*)?", " ".join(words), re.IGNORECASE)
    if joined is None:
        raise InputError(
            f"{place}: GAIN {shortened(' '.join(words))!r}: must be a number, as 'GAIN 17.5 dBi'"
        )
    value = float(joined.group(1).replace(",", "."))
    unit = (joined.groups()[-1] or "dbd").lower()
    return _in_range(place, "GAIN", value if unit == "dbi" else value + DIPOLE_GAIN_DBI)


def _count(place: str, key: str, words: list[str]) -> int:
    if not words or not words[0].isdecimal() or len(words[0]) > 4 or not 24 <= int(words[0]) <= 7201:
        raise InputError(
            f"{place}: {key} {shortened(' '.join(words))!r}: must be followed by the number of its lines, 24 to 7201"
        )
    return int(words[0])


def _cut(path: str | Path, first: int, lines: list[str], count: int, key: str) -> NDArray[np.float64]:
    """Attenuation at whole degrees [360], [dB]; `first` is the number of lines before these."""
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
        pairs[index] = _in_range(place, "angle", angle), _in_range(place, "attenuation", attenuation)
    angle, order = np.unique(np.round(pairs[:, 0] % 360.0, 6), return_index=True)
    largest = float(np.diff([*angle, angle[0] + 360.0]).max())
    if largest > LARGEST_STEP_DEG:
        raise InputError(
            f"{path}: {key} leaves {largest:g} degrees without a value, must be at most {LARGEST_STEP_DEG:g}; export a "
            "full turn"
        )
    return np.interp(np.arange(360.0), angle, pairs[order, 1], period=360.0)


def _in_range(place: str, name: str, value: float) -> float:
    low, high = RANGES[name]
    if not low <= value <= high:
        remedy: Any = (
            "attenuations are positive, below the gain" if name == "attenuation" else "check the unit"
        )
        raise InputError(f"{place}: {name} {value:g} must be {low:g} to {high:g}; {remedy}")
    return value
