"""Paths of Sionna RT in memory, as returned by its `PathSolver`.

Vertices and interactions are [D, R, T, P] with synthetic arrays, otherwise [D, R, Ra, T, Ta, P] for the antennas of the
arrays. Gains `a` are real and imaginary part [R, Ra, T, Ta, P].
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.polylines import Polyline, rows_of
from calibray.engines.rays.table import TYPES
from calibray.errors import InputError
from calibray.measurements import SourceTable

SOURCE: Final = "the paths of Sionna RT"


def is_sionna_paths(value: object) -> bool:
    """Whether a value is Sionna's `Paths`."""
    return type(value).__module__.startswith("sionna.rt") and hasattr(value, "interactions")


def read_sionna_paths(paths: Any) -> SourceTable:
    """Read paths between antennas with one position each.

    Powers are summed over the ports of a receiver and averaged over those of a transmitter.

    Raises:
        InputError: An array has antennas at several positions, or there is no path.
    """
    for array in (paths.tx_array, paths.rx_array):
        if array.array_size != 1:
            raise InputError(
                f"{SOURCE}: an array has {array.array_size} antennas, whose paths are summed; trace with one antenna "
                f"each"
            )
    return rows_of(_paths(paths), SOURCE)


def _paths(paths: Any) -> Iterator[Polyline]:
    real, imaginary = (np.array(part, dtype=float) for part in paths.a)
    power = (real**2 + imaginary**2).sum(axis=1).mean(axis=2)  # [R, T, P]
    shape = power.shape
    kinds, vertices = np.array(paths.interactions), np.array(paths.vertices, dtype=float)
    if not paths.synthetic_array:  # ports at one place have the same paths
        kinds, vertices = kinds[:, :, 0, :, 0], vertices[:, :, 0, :, 0]
    delay = np.array(paths.tau, dtype=float)
    delay = delay if delay.shape == shape else delay[:, 0, :, 0]
    sources, targets = (
        _positions(ends, count) for ends, count in ((paths.sources, shape[1]), (paths.targets, shape[0]))
    )
    names = {int(kind): name for name, kind in TYPES.items()}
    for rx, tx, path in np.argwhere((power > 0) & (delay >= 0)).tolist():
        kind = [int(code) for code in kinds[:, rx, tx, path] if code]
        inner = vertices[: len(kind), rx, tx, path]
        points = np.vstack([sources[tx], inner, targets[rx]])
        yield Polyline(
            points, [names[code] for code in kind], 10 * np.log10(power[rx, tx, path]), delay[rx, tx, path]
        )


def _positions(ends: Any, count: int) -> NDArray[np.float64]:
    """Positions of the ends [count, 3]; ports at one position are listed one after the other."""
    positions = np.array(ends, dtype=float).T
    return positions[:: len(positions) // count]
