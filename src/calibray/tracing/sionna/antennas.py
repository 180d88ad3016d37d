"""Antenna patterns as functions for Sionna's own field stage."""

# Mitsuba makes its types when its variant is chosen: its stubs know them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from sionna.rt.antenna_pattern import PolarizedAntennaPattern, antenna_pattern_registry

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
        # Sionna does not say what it registers.
        make: Any = antenna_pattern_registry.get(antenna.pattern)
        return make(polarization=antenna.polarization).patterns
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
