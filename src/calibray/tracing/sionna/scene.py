"""Scenes, materials and antenna patterns in the form that Sionna RT takes."""

# Mitsuba defines its types when its variant is chosen, so its stubs declare them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from sionna.rt.antenna_pattern import PolarizedAntennaPattern, antenna_pattern_registry
from sionna.rt.radio_materials import scattering_pattern_registry
from sionna.rt.scene import load_scene_from_string

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes import Scene
from calibray.tracing.gain_table import GainTable, read_gain_table
from calibray.tracing.settings import Antenna
from calibray.tracing.sionna.arrays import aligned


def load_scene(scene: Scene) -> rt.Scene:
    """Load a scene into Sionna RT; its mesh files are found relative to the scene file.

    Raises:
        InputError: Sionna cannot load it.
    """
    resolver = mi.file_resolver()
    try:
        search = mi.FileResolver(resolver)
        search.append(str(scene.path.parent.resolve()))
        mi.set_file_resolver(search)
        return load_scene_from_string(scene.xml)
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(
            f"{scene.path}: Sionna RT cannot load the scene: {' '.join(str(error).split())}"
        ) from None
    finally:
        mi.set_file_resolver(resolver)


def shape_ids(mitsuba_scene: Any) -> dict[int, Any]:
    """Mitsuba's shapes by the ids with which path buffers refer to them."""
    return {
        int(np.array(dr.reinterpret_array(mi.UInt, mi.ShapePtr(shape))).item()): shape
        for shape in mitsuba_scene.shapes()
    }


def scattering_pattern(material: Material) -> rt.ScatteringPattern:
    """Make a material's scattering pattern, its exponents rounded to integers as Sionna requires."""
    constants = {
        "lambertian": {},
        "directive": {"alpha_r": round(material.alpha_r)},
        "backscattering": {
            "alpha_r": round(material.alpha_r),
            "alpha_i": round(material.alpha_i),
            "lambda_": material.lambda_,
        },
    }[material.scattering_pattern]
    # Sionna's registries are not typed.
    make: Any = scattering_pattern_registry.get(material.scattering_pattern)
    return make(**constants)


def antenna_patterns(antenna: Antenna) -> list:
    """Make an antenna's pattern functions of zenith and azimuth [rad] for Sionna's field stage, one per port."""
    if antenna.gain_file is None:
        make: Any = antenna_pattern_registry.get(antenna.pattern)
        return make(polarization=antenna.polarization).patterns
    pattern = tabulated_pattern(read_gain_table(antenna.gain_file))
    return PolarizedAntennaPattern(v_pattern=pattern, polarization=antenna.polarization).patterns


def tabulated_pattern(table: GainTable) -> Callable[[mi.Float, mi.Float], mi.Complex2f]:
    """Make a function of zenith and azimuth [rad] that gives the field amplitude, interpolated as `GainTable.gain`."""
    (rows, columns), (elevation_step, azimuth_step) = table.gain_dbi.shape, np.radians(table.steps_deg)
    first_azimuth = np.radians(table.first_azimuth_deg)
    gain = mi.Float(aligned(table.gain_dbi.ravel(), np.float32))

    def pattern(zenith: mi.Float, azimuth: mi.Float) -> mi.Complex2f:
        row = dr.clip((np.pi - zenith) / elevation_step, 0, rows - 1)
        column = (azimuth - first_azimuth) / azimuth_step
        column = dr.clip(column - dr.floor(column / columns) * columns, 0, columns)
        i, j = dr.minimum(mi.UInt(row), rows - 2), dr.minimum(mi.UInt(column), columns - 1)
        # The column after the last one is the first: the azimuth closes on itself.
        next_j = dr.select(j == columns - 1, 0, j + 1)
        u, v = row - mi.Float(i), column - mi.Float(j)
        low, high = (
            dr.lerp(dr.gather(mi.Float, gain, start + j), dr.gather(mi.Float, gain, start + next_j), v)
            for start in (i * columns, (i + 1) * columns)
        )
        return mi.Complex2f(dr.power(10.0, dr.lerp(low, high, u) / 20), 0)

    return pattern
