"""Reads scenes loaded in plain Sionna RT, sets their materials, and verifies exported scenes."""

# Mitsuba defines its types only when a variant is chosen, so its stubs declare these types as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportIndexIssue=false

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
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
from calibray.materials import SCALAR_CONSTANTS, Material
from calibray.scenes import Mesh, MeshObject, read_scene
from calibray.scenes.scene import exported_names
from calibray.scenes.scene_file import unique_names
from calibray.scenes.shapes import COARSE, TOO_COARSE
from calibray.support.messages import did_you_mean, first_line, shortened
from calibray.tables import hertz
from calibray.tracing.protocol import Links
from calibray.tracing.settings import PATTERNS, POLARIZATIONS, Antenna
from calibray.tracing.sionna.scene import scattering_pattern, surfaces_agree, surfaces_by_material
from calibray.tracing.sionna.tracer import Tracer

_LOG: Final = logging.getLogger(__name__)

DIRECTIONS: Final = 64
"""Number of directions in which a pattern is compared with the known patterns."""


def materials_of_shapes(numbers: Iterable[int]) -> dict[int, str]:
    """Material name of each shape, by the shape's number in Mitsuba; shapes of deleted scenes are left out."""
    shapes = {number: dr.reinterpret_array(mi.ShapePtr, mi.UInt32(number))[0] for number in numbers}
    return {number: shape.bsdf().id() for number, shape in shapes.items() if shape is not None}


@dataclass(frozen=True, eq=False)
class LiveScene:
    """The content of a scene in memory.

    Attributes:
        frequency: Carrier frequency [Hz].
        objects: One mesh for each connected surface, because Sionna merges the scene's original objects.
        materials: The materials that objects use, by name.
        antennas: Transmit and receive antenna.
        tx: Position [3], [m], of each transmitter, by name.
        rx: Position [3], [m], of each receiver, by name.
        tx_power_dbm: Transmit power [dBm] of each transmitter, by name.
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
            InputError: The object is not a Sionna RT scene, or the scene has a property that a study cannot
                describe.
        """
        live = _checked(scene)
        if not (live.transmitters and live.receivers and live.tx_array and live.rx_array):
            raise InputError(
                "the scene lacks a transmitter, a receiver or an antenna array; add what is missing, and set "
                "scene.tx_array and scene.rx_array"
            )
        # Mitsuba loads objects in parallel, so their order in the scene varies between processes.
        items = [item for _, item in sorted(live.objects.items())]
        parts = [part for item in items for part in _objects(item)]
        # The names of objects become file names.
        names = unique_names(part.name for part in parts)
        objects = tuple(replace(part, name=name) for part, name in zip(parts, names, strict=True))
        _check_precision(objects)
        return cls(
            _number(live.frequency),
            objects,
            {item.radio_material.name: _material(item.radio_material) for item in items},
            (_antenna("tx", live.tx_array, live.transmitters), _antenna("rx", live.rx_array, live.receivers)),
            {name: _vector(device.position) for name, device in live.transmitters.items()},
            {name: _vector(device.position) for name, device in live.receivers.items()},
            {name: _number(device.power_dbm) for name, device in live.transmitters.items()},
        )


def apply_materials(scene: object, materials: Mapping[str, Material], frequency: float | None = None) -> None:
    """Set the constants of a scene's materials by name.

    The constants are valid only at the carrier frequency `frequency` [Hz]; if the scene has a different carrier
    frequency, a warning is given. After this call, setting `scene.frequency` does not replace the constants of ITU
    materials.

    Raises:
        InputError: The object is not a Sionna RT scene, or the scene lacks a material; in both cases, nothing is set.
    """
    live = _checked(scene)
    for name in materials:
        if name not in live.radio_materials:
            raise InputError(
                f"the scene has no material {name!r}; {did_you_mean(name, live.radio_materials)}. If the study "
                "creates materials for objects ([objects]), assign these materials to the objects in the scene as well"
            )
    for name, material in materials.items():
        target = live.radio_materials[name]
        target.frequency_update_callback = None
        for constant in SCALAR_CONSTANTS:
            setattr(target, constant, getattr(material, constant))
        target.scattering_pattern = scattering_pattern(material)
    if frequency is not None and not np.isclose(carrier := _number(live.frequency), frequency, rtol=1e-6):
        _LOG.warning(
            "scene.frequency is %s, but the calibrated constants are for %s; set scene.frequency = %r",
            hertz(carrier), hertz(frequency), frequency,
        )  # fmt: skip


def _checked(scene: object) -> Any:
    if not isinstance(scene, rt.Scene):
        raise InputError(
            f"scene is a {type(scene).__name__}; it must be a sionna.rt scene, as returned by load_scene"
        )
    return scene


def _objects(item: Any) -> Iterator[MeshObject]:
    """The connected surfaces of an object; the names of the surfaces differ from the names of materials."""
    values = mi.traverse(item.mi_mesh)
    vertex = np.array(values["vertex_positions"], dtype=float).reshape(-1, 3)
    face = np.array(values["faces"], dtype=np.int64).reshape(-1, 3)
    # Faces are connected by equal positions, because files may repeat a corner for each face.
    position, welded = np.unique(vertex, axis=0, return_inverse=True)
    face = welded.reshape(-1)[face]
    ends = face[:, [0, 1, 1, 2]].reshape(-1, 2).T
    links = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(len(position),) * 2)
    count, part = connected_components(links, directed=False)
    for number in np.unique(part[face[:, 0]]).tolist():
        used, faces = np.unique(face[part[face[:, 0]] == number], return_inverse=True)
        suffix = f"-{number}" if count > 1 else ""
        yield MeshObject(
            f"object-{item.name}{suffix}",
            item.radio_material.name,
            Mesh(position[used], faces.reshape(-1, 3)),
        )


def _check_precision(objects: Iterable[MeshObject]) -> None:
    """Refuse a scene, or give a warning, if single precision noticeably rounds coordinates far from the origin."""
    furthest = max((float(np.abs(item.mesh.vertices).max()) for item in objects), default=0.0)
    step = float(np.spacing(np.float32(furthest)))
    where = f"the scene reaches {furthest:.0f} m from its origin"
    fault = f"{where}, where Sionna RT stores coordinates in steps of {step:g} m"
    if step > TOO_COARSE:
        raise InputError(
            f"{fault}; move the origin into the scene and load it again, or write a study file for its scene file"
        )
    if step > COARSE:
        _LOG.warning("%s: path loss may be off by hundredths of a dB; move the origin into the scene", fault)


def _material(material: Any) -> Material:
    if not isinstance(material, rt.RadioMaterial):
        raise InputError(
            f"material {material.name!r} is a {type(material).__name__}; a study requires a RadioMaterial with "
            "constants"
        )
    pattern = material.scattering_pattern
    lobes = {
        name: _number(getattr(pattern, name))
        for name in ("alpha_r", "alpha_i", "lambda_")
        if hasattr(pattern, name)
    }
    kind = type(pattern).__name__.removesuffix("Pattern").lower()
    constants = {name: _number(getattr(material, name)) for name in SCALAR_CONSTANTS}
    return Material(**constants, scattering_pattern=kind, **lobes)


def _antenna(end: str, array: Any, devices: Mapping[str, Any]) -> Antenna:
    """The antenna of all devices at one end."""
    if array.array_size != 1:
        raise InputError(
            f"scene.{end}_array has {array.array_size} elements; a measured value belongs to one antenna: set an array "
            "of one element with the pattern of this antenna"
        )
    if np.any(np.array(array.normalized_positions)):
        raise InputError(
            f"the element of scene.{end}_array is not at the position of the device; move the devices to the positions "
            "of their elements, and set an array with the element at its centre"
        )
    orientation = np.array([_vector(device.orientation) for device in devices.values()])
    if np.ptp(orientation, axis=0).max() > 1e-6:
        raise InputError(
            f"the devices at the end {end} have different orientations; a study has one antenna per end: calibrate "
            "devices of one orientation at a time"
        )
    # Directions are uniform over the sphere, except for the poles, where azimuths are undefined.
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
        f"scene.{end}_array has an unknown pattern; a study supports {', '.join(PATTERNS)} with polarization "
        f"{', '.join(POLARIZATIONS)}; give the gain as a table (antennas.{end}.pattern) in a study file"
    )


def _fields(
    patterns: Any, zenith: NDArray[np.float64], azimuth: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Fields [ports, 2, n] of an antenna's ports along theta and phi."""
    fields = [pattern(mi.Float(zenith), mi.Float(azimuth)) for pattern in patterns]
    dr.eval(fields)
    return np.array([[np.array(part.real) + 1j * np.array(part.imag) for part in pair] for pair in fields])


def _number(value: Any) -> float:
    return float(np.array(value).item())


def _vector(value: Any) -> NDArray[np.float64]:
    return np.array(value, dtype=float).reshape(3)


LARGEST_DIFFERENCE_DB: Final = 0.01
"""Maximum difference in path loss between traces that count as equal [dB]; the constants in the file are rounded."""

SAMPLES: Final = 20_000
"""Number of rays for the comparison; both scenes use the same rays."""


def verify_export(tracer: Tracer, materials: Mapping[str, Material], target: Path, links: Links) -> None:
    """Load an exported scene into plain Sionna RT, and compare materials, surfaces and the path loss of `links`.

    `tracer` contains the original scene. The comparison uses few rays, at most two interactions and no diffuse
    reflection.

    Raises:
        InputError: Sionna RT cannot load the exported scene, or the exported scene differs from the original scene.
    """
    scene, names = tracer.scene, exported_names(materials)
    try:
        loaded = rt.load_scene(str(target))
    except Exception as error:  # Mitsuba and Sionna raise errors of many types
        raise InputError(_failed(target, f"Sionna RT cannot load it ({first_line(error)})")) from None
    for name in scene.materials:
        held: Any = loaded.radio_materials.get(names[name])
        if held is None:
            raise InputError(_failed(target, f"Sionna RT has no material {shortened(repr(names[name]))}"))
        for constant in SCALAR_CONSTANTS:
            expected, value = getattr(materials[name], constant), _number(getattr(held, constant))
            if not np.isclose(value, expected, rtol=1e-5, atol=1e-12):
                fault = f"{constant} of {shortened(repr(names[name]))} is {value:g} in Sionna RT, not {expected:g}"
                raise InputError(_failed(target, fault))
    by_material = surfaces_by_material(loaded.mi_scene, lambda material: str(material.name))
    for name in scene.materials:
        stored = [
            size for size, item in zip(scene.sizes, scene.objects, strict=True) if item.material == name
        ]
        if not surfaces_agree(by_material.get(names[name], []), stored, np.zeros(3)):
            fault = f"Sionna RT contains a different surface of material {shortened(repr(names[name]))}"
            raise InputError(_failed(target, fault))
    if scene.local_origin.any():
        _LOG.warning(
            "%s lies far from its origin: plain Sionna RT computes in single precision and may lose paths there; "
            "move the origin into the scene", target,
        )  # fmt: skip
    settings = tracer.settings
    few_rays = replace(
        settings, samples=SAMPLES, max_depth=min(settings.max_depth, 2), diffuse_reflection=False
    )
    # Scene files contain only Lambertian patterns, so the materials are passed explicitly.
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
        f"{target}: was written, but differs from the calibrated scene: {fault}; rename materials, objects and mesh "
        "files with unusual characters, and export again"
    )
