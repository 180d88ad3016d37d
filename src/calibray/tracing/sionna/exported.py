"""An exported scene compared with the calibrated one, after plain Sionna RT has loaded it."""

# Mitsuba defines its types when its variant is chosen, so its stubs declare them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import sionna.rt as rt

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes import read_scene
from calibray.scenes.export import exported_names
from calibray.support.messages import first_line, shortened
from calibray.tracing.protocol import Links
from calibray.tracing.sionna.scene import surfaces_agree, surfaces_by_material
from calibray.tracing.sionna.solver import SCALAR_CONSTANTS
from calibray.tracing.sionna.tracer import Tracer

LARGEST_DIFFERENCE_DB: Final = 0.01
"""Largest difference of path loss at which two traces of one scene agree [dB]: constants are rounded in the file."""

SAMPLES: Final = 20_000
"""Number of rays of the comparison; both scenes use the same rays."""

_LOG: Final = logging.getLogger(__name__)


def verify_export(tracer: Tracer, materials: Mapping[str, Material], target: Path, links: Links) -> None:
    """Load an exported scene into plain Sionna RT; compare materials, surfaces and the path loss of some links.

    `tracer` has the scene as it was read. The comparison uses fewer rays than its settings state.

    Raises:
        InputError: Sionna RT cannot load the exported scene, or it is another one.
    """
    scene, names = tracer.scene, exported_names(materials)
    try:
        loaded = rt.load_scene(str(target))
    except Exception as error:  # Mitsuba and Sionna raise whatever they run into
        raise InputError(_failed(target, f"Sionna RT cannot load it ({first_line(error)})")) from None
    for name in scene.materials:
        held: Any = loaded.radio_materials.get(names[name])
        if held is None:
            raise InputError(_failed(target, f"Sionna RT has no material {shortened(repr(names[name]))}"))
        for constant in SCALAR_CONSTANTS:
            expected, value = (
                getattr(materials[name], constant),
                float(np.array(getattr(held, constant)).item()),
            )
            if not np.isclose(value, expected, rtol=1e-5, atol=1e-12):
                fault = f"{constant} of {shortened(repr(names[name]))} is {value:g} in Sionna RT, not {expected:g}"
                raise InputError(_failed(target, fault))
    by_material = surfaces_by_material(loaded.mi_scene, lambda material: str(material.name))
    for name in scene.materials:
        stored = [
            size for size, item in zip(scene.sizes, scene.objects, strict=True) if item.material == name
        ]
        if not surfaces_agree(by_material.get(names[name], []), stored, np.zeros(3)):
            fault = f"Sionna RT contains another surface of material {shortened(repr(names[name]))}"
            raise InputError(_failed(target, fault))
    if scene.local_origin.any():
        _LOG.warning(
            "%s lies far from its origin: plain Sionna RT computes in single precision there and may lose paths; "
            "move the origin into the scene", target,
        )  # fmt: skip
    settings = tracer.settings
    few_rays = replace(
        settings, samples=SAMPLES, max_depth=min(settings.max_depth, 2), diffuse_reflection=False
    )
    # Scene files hold the Lambertian pattern only, so the constants are given again.
    constants = {name: materials[name] for name in scene.materials}
    written = read_scene(target, tracer.frequency, {names[name]: item for name, item in constants.items()})
    antennas = tracer.solver.tx_antenna, tracer.solver.rx_antenna
    exported = Tracer(written, tracer.frequency, few_rays, *antennas)
    power = []
    for solution in (tracer.with_settings(few_rays).solve(links, constants), exported.solve(links, {})):
        gains = (np.abs(solution.gain) ** 2).sum(axis=(1, 2))
        power.append(np.bincount(solution.link, gains, len(links.tx)))
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = np.abs(10 * np.log10(power[0] / power[1]))
    difference = np.where((power[0] == 0) & (power[1] == 0), 0.0, difference)
    if not (difference <= LARGEST_DIFFERENCE_DB).all():
        fault = f"path loss differs by {np.nanmax(difference):.2f} dB from the calibrated scene"
        raise InputError(_failed(target, fault))


def _failed(target: Path, fault: str) -> str:
    return (
        f"{target}: was written, but is not the calibrated scene: {fault}; rename materials, objects and mesh files "
        "with unusual characters, and export again"
    )
