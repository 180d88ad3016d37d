"""Paths of Remcom Wireless InSite, from its text files `*.paths.*.p2m`.

Lines that begin with # are comments. The first line is the number of receivers. For each receiver, its number and its
number of paths follow and, if there are any paths, a line of sums. A path has a line of nine numbers (number, number of
interactions, received power [dBm], phase [deg], time of arrival [s], four angles [deg]), a line such as Tx-R-D-Rx, and
a line for each point.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from calibray.engines.rays.polylines import Polyline, rows_of
from calibray.errors import InputError
from calibray.measurements import SourceTable
from calibray.support.messages import shortened

TYPES: Final = {"R": "reflection", "D": "diffraction", "DS": "diffuse", "T": "transmission"}
"""Interactions by their letters; foliage (F, X) is not a surface with a material."""


def read_insite(file: Path, tx_power_dbm: float | None) -> SourceTable:
    """Read the paths of one transmitter.

    Raises:
        InputError: The transmitted power is missing, the file is malformed, or a path crosses foliage.
    """
    if tx_power_dbm is None:
        raise InputError(
            f"{file}: states received power in dBm; give tx_power_dbm, the transmitted power of the project"
        )
    lines = [
        (number, line.strip())
        for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    rest = iter(lines)
    try:
        return rows_of(_paths(file, rest, tx_power_dbm), str(file))
    except StopIteration:
        raise InputError(
            f"{file}: ends within a path; export it again, or check that it is a paths file"
        ) from None


def _paths(file: Path, rest: Iterator[tuple[int, str]], tx_power_dbm: float) -> list[Polyline]:
    paths = []
    (receivers,) = _numbers(file, next(rest), 1)
    for _ in range(int(receivers)):
        _, count = _numbers(file, next(rest), 2)
        if count:
            next(rest)
        for _ in range(int(count)):
            _, depth, power, _, delay, *_ = _numbers(file, next(rest), 9)
            number, text = next(rest)
            names = text.split("-")[1:-1]
            if unknown := [name for name in names if name not in TYPES]:
                raise InputError(
                    f"{file}, line {number}: {shortened(text)!r} has the interaction {shortened(unknown[0])!r}; "
                    f"Calibray knows {', '.join(TYPES)}, so export without foliage"
                )
            points = np.array([_numbers(file, next(rest), 3) for _ in range(int(depth) + 2)])
            paths.append(Polyline(points, [TYPES[name] for name in names], power - tx_power_dbm, delay))
    return paths


def _numbers(file: Path, line: tuple[int, str], count: int) -> list[float]:
    number, text = line
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(
            f"{file}, line {number}: {shortened(text)!r}, must be {count} numbers; this is not a paths file of "
            f"Wireless InSite (project.paths.t001_01.r002.p2m)"
        )
    return values
