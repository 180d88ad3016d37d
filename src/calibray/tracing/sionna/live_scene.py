"""A Sionna RT scene in memory, as in a notebook: converted to plain data, and assigned calibrated materials."""

# Mitsuba defines its types when its variant is chosen, so its stubs declare them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from sionna.rt.antenna_pattern import antenna_pattern_registry

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes import Mesh, MeshObject
from calibray.support.messages import did_you_mean
from calibray.tracing.settings import PATTERNS, POLARIZATIONS, Antenna
from calibray.tracing.sionna.scene import scattering_pattern
from calibray.tracing.sionna.solver import SCALAR_CONSTANTS

DIRECTIONS: Final = 64
"""Number of directions in which a pattern is compared with the known ones."""


@dataclass(frozen=True, eq=False)
class LiveScene:
    """What a scene in memory states.

    Attributes:
        frequency: Carrier frequency [Hz].
        objects: The meshes; surfaces that are not connected are separate objects, because Sionna merges objects.
        materials: The materials that objects use, by name.
        antennas: Transmit and receive antenna.
        tx: Positions by name of the transmitters [3], [m].
        rx: Positions by name of the receivers [3], [m].
        tx_power_dbm: Transmitted power by name of the transmitters [dBm].
    """

    frequency: float
    objects: tuple[MeshObject, ...]
    materials: dict[str, Material]
    antennas: tuple[Antenna, Antenna]
    tx: dict[str, NDArray[np.float64]]
    rx: dict[str, NDArray[np.float64]]
    tx_power_dbm: dict[str, float]

    @classmethod
    def of(cls, scene: object) -> LiveScene:
        """Read a scene with its transmitters, receivers and arrays.

        Raises:
            InputError: It is not a scene of Sionna RT, or has a property that a study cannot state.
        """
        live = _checked(scene)
        if not (live.transmitters and live.receivers and live.tx_array and live.rx_array):
            raise InputError(
                "the scene has no transmitter, receiver or antenna array; add them, and set scene.tx_array and "
                "scene.rx_array"
            )
        return cls(
            _number(live.frequency),
            tuple(part for item in live.objects.values() for part in _objects(item)),
            {item.radio_material.name: _material(item.radio_material) for item in live.objects.values()},
            (_antenna("tx", live.tx_array, live.transmitters), _antenna("rx", live.rx_array, live.receivers)),
            {name: _vector(device.position) for name, device in live.transmitters.items()},
            {name: _vector(device.position) for name, device in live.receivers.items()},
            {name: _number(device.power_dbm) for name, device in live.transmitters.items()},
        )


def apply_materials(scene: object, materials: Mapping[str, Material]) -> None:
    """Set the constants of a scene's materials by name.

    Raises:
        InputError: It is not a scene of Sionna RT, or lacks a material; nothing is set then.
    """
    live = _checked(scene)
    for name in materials:
        if name not in live.radio_materials:
            raise InputError(
                f"the scene has no material {name!r}; {did_you_mean(name, live.radio_materials)}. Give objects with "
                "materials of their own in the study ([objects]) these materials in the scene"
            )
    for name, material in materials.items():
        target = live.radio_materials[name]
        for constant in SCALAR_CONSTANTS:
            setattr(target, constant, getattr(material, constant))
        target.scattering_pattern = scattering_pattern(material)


def _checked(scene: object) -> Any:
    if not isinstance(scene, rt.Scene):
        raise InputError(
            f"scene is a {type(scene).__name__}; must be a scene of sionna.rt, as load_scene gives"
        )
    return scene


def _objects(item: Any) -> Iterator[MeshObject]:
    """The connected surfaces of an object."""
    values = mi.traverse(item.mi_mesh)
    vertex = np.array(values["vertex_positions"], dtype=float).reshape(-1, 3)
    face = np.array(values["faces"], dtype=np.int64).reshape(-1, 3)
    position, welded = np.unique(vertex, axis=0, return_inverse=True)
    face = welded.reshape(-1)[face]
    ends = face[:, [0, 1, 1, 2]].reshape(-1, 2).T
    links = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(len(position),) * 2)
    count, part = connected_components(links, directed=False)
    # Names become file names, and differ from those of materials.
    name = re.sub(r"[^A-Za-z0-9_-]", "_", item.name)
    for number in np.unique(part[face[:, 0]]).tolist():
        used, faces = np.unique(face[part[face[:, 0]] == number], return_inverse=True)
        suffix = f"-{number}" if count > 1 else ""
        yield MeshObject(
            f"object-{name}{suffix}", item.radio_material.name, Mesh(position[used], faces.reshape(-1, 3))
        )


def _material(material: Any) -> Material:
    if not isinstance(material, rt.RadioMaterial):
        raise InputError(
            f"material {material.name!r} is a {type(material).__name__}; a study needs a RadioMaterial, with constants"
        )
    pattern = material.scattering_pattern
    lobes = {
        name: float(getattr(pattern, name))
        for name in ("alpha_r", "alpha_i", "lambda_")
        if hasattr(pattern, name)
    }
    kind = type(pattern).__name__.removesuffix("Pattern").lower()
    constants = {name: _number(getattr(material, name)) for name in SCALAR_CONSTANTS}
    return Material(**constants, scattering_pattern=kind, **lobes)


def _antenna(end: str, array: Any, devices: Mapping[str, Any]) -> Antenna:
    """The antenna of all devices of one end."""
    if array.array_size != 1:
        raise InputError(
            f"scene.{end}_array has {array.array_size} elements; a measured value belongs to one antenna: set an array "
            "of one element with its pattern"
        )
    orientation = np.array([_vector(device.orientation) for device in devices.values()])
    if np.ptp(orientation, axis=0).max() > 1e-6:
        raise InputError(
            f"the devices at the end {end} have different orientations; a study has one antenna per end: calibrate "
            "devices of one orientation at a time"
        )
    azimuth, cosine = np.random.default_rng(0).uniform(
        [[-np.pi], [-0.999]], [[np.pi], [0.999]], (2, DIRECTIONS)
    )
    sampled = _fields(array.antenna_pattern.patterns, np.arccos(cosine), azimuth)
    for pattern, polarization in product(PATTERNS, POLARIZATIONS):
        make: Any = antenna_pattern_registry.get(pattern)
        known = _fields(make(polarization=polarization).patterns, np.arccos(cosine), azimuth)
        if known.shape == sampled.shape and np.allclose(known, sampled, atol=1e-5):
            yaw, pitch, roll = orientation[0].tolist()
            return Antenna(pattern, polarization, (yaw, pitch, roll))
    raise InputError(
        f"scene.{end}_array has a pattern of its own; a study knows {', '.join(PATTERNS)} with polarization "
        f"{', '.join(POLARIZATIONS)}: give its gain as a table (antennas.{end}.pattern) in a study file"
    )


def _fields(
    patterns: Any, zenith: NDArray[np.float64], azimuth: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Fields of an antenna's ports along theta and phi [ports, 2, n]."""
    fields = [pattern(mi.Float(zenith), mi.Float(azimuth)) for pattern in patterns]
    dr.eval(fields)
    return np.array([[np.array(part.real) + 1j * np.array(part.imag) for part in pair] for pair in fields])


def _number(value: Any) -> float:
    return float(np.array(value).item())


def _vector(value: Any) -> NDArray[np.float64]:
    return np.array(value, dtype=float).reshape(3)
