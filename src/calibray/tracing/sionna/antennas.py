"""Antenna patterns as Sionna RT evaluates them, and the Jones vectors of paths that leave or arrive."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from sionna.rt.antenna_pattern import (
    PolarizedAntennaPattern,
    antenna_pattern_registry,
    antenna_pattern_to_world_implicit,
)
from sionna.rt.utils import rotation_matrix

from calibray.tracing.gain_table import GainTable, read_gain_table
from calibray.tracing.settings import Antenna
from calibray.tracing.sionna.arrays import aligned


def patterns_of(antenna: Antenna) -> list:
    """Pattern functions of zenith and azimuth [rad].

    Args:
        antenna: The antenna.

    Returns:
        One function per port.
    """
    if antenna.gain_file is None:
        return antenna_pattern_registry.get(antenna.pattern)(polarization=antenna.polarization).patterns
    pattern = tabulated(read_gain_table(antenna.gain_file))
    return PolarizedAntennaPattern(v_pattern=pattern, polarization=antenna.polarization).patterns


def tabulated(table: GainTable) -> Callable[[mi.Float, mi.Float], mi.Complex2f]:
    """`GainTable.gain` as a pattern function of Sionna: the field's amplitude.

    Args:
        table: Gains on a grid of directions.

    Returns:
        The function of zenith and azimuth [rad].
    """
    (rows, columns), (rise, turn) = table.gain_dbi.shape, np.radians(table.steps_deg)
    first = np.radians(table.first_azimuth_deg)
    gain = mi.Float(aligned(table.gain_dbi.ravel(), np.float32))

    def pattern(zenith: mi.Float, azimuth: mi.Float) -> mi.Complex2f:
        row = dr.clip((np.pi - zenith) / rise, 0, rows - 1)
        column = (azimuth - first) / turn
        column = dr.clip(column - dr.floor(column / columns) * columns, 0, columns)
        i, j = dr.minimum(mi.UInt(row), rows - 2), dr.minimum(mi.UInt(column), columns - 1)
        k = dr.select(j == columns - 1, 0, j + 1)
        u, v = row - mi.Float(i), column - mi.Float(j)
        low, high = (
            dr.lerp(dr.gather(mi.Float, gain, at + j), dr.gather(mi.Float, gain, at + k), v)
            for at in (i * columns, (i + 1) * columns)
        )
        return mi.Complex2f(dr.power(10.0, dr.lerp(low, high, u) / 20), 0)

    return pattern


def jones_vectors(antenna: Antenna, patterns: list, direction: np.ndarray, way: str) -> np.ndarray:
    """Jones vectors of an antenna in the basis (theta, phi) of the wave.

    Args:
        antenna: The antenna.
        patterns: Its pattern functions.
        direction: Directions, seen from the antenna [P, 3].
        way: "out" for waves that leave, "in" for waves that arrive.

    Returns:
        The vectors by port [P, ports, 2], complex.
    """
    if not len(direction):
        return np.zeros((0, antenna.ports, 2), dtype=complex)
    to_world = rotation_matrix(mi.Point3f(*antenna.orientation))
    look = mi.Vector3f(*(aligned(axis, np.float32) for axis in direction.T))
    fields = [antenna_pattern_to_world_implicit(pattern, to_world, look, way) for pattern in patterns]
    parts = np.array([np.array(field, dtype=float) for field in fields])  # [ports, (re, re, im, im), P]
    return np.moveaxis(parts[:, :2] + 1j * parts[:, 2:], 2, 0)


def turned(field: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Jones vectors in a frame that is rotated against theirs.

    Args:
        field: The vectors [P, ports, 2].
        rotation: (cos, sin) of the rotation [P, 2].

    Returns:
        The vectors [P, ports, 2].
    """
    cos, sin = rotation[:, None, 0], rotation[:, None, 1]
    return np.stack(
        [cos * field[..., 0] + sin * field[..., 1], cos * field[..., 1] - sin * field[..., 0]], axis=-1
    )
