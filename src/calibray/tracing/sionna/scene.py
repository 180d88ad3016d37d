"""Scenes, materials and antenna patterns in the form that Sionna RT requires."""

# Mitsuba defines its types only when a variant is chosen, so its stubs declare these types as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

import logging
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from numpy.typing import NDArray
from sionna.rt import antenna_pattern
from sionna.rt.antenna_pattern import PolarizedAntennaPattern, antenna_pattern_registry
from sionna.rt.radio_materials import scattering_pattern_registry
from sionna.rt.scene import load_scene_from_string

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes import COARSE, Mesh, Scene, SurfaceSize, has_copied_meshes, xml_with_copied_meshes
from calibray.tracing.antennas import array_factor
from calibray.tracing.gain_table import GainTable, read_gain_table
from calibray.tracing.settings import Antenna
from calibray.tracing.sionna.buffers import aligned

_LOG: Final = logging.getLogger(__name__)


def load_scene(scene: Scene) -> rt.Scene:
    """Load a scene, in its local frame, into Sionna RT; paths of mesh files are relative to the scene file.

    Raises:
        InputError: Sionna cannot load the scene, or its surfaces differ from the surfaces in the files.
    """
    if has_copied_meshes(scene):
        with _temporary_folder(scene.path) as folder:
            loaded = _load(xml_with_copied_meshes(scene, Path(folder)), scene.path)
    else:
        loaded = _load(scene.xml, scene.path)
    _check_surfaces(loaded.mi_scene, scene)
    step = max((size.step for size in scene.sizes), default=0.0)
    if step > COARSE:
        _LOG.warning(
            "%s stores coordinates in steps of %g m, because it is far from the origin: path loss may be off by "
            "hundredths of a dB; export meshes with coordinates of type double", scene.path, step,
        )  # fmt: skip
    return loaded


def _temporary_folder(path: Path) -> TemporaryDirectory[str]:
    try:
        return TemporaryDirectory(prefix="calibray-")
    except OSError as error:
        raise InputError(
            f"{path}: its meshes must be copied for the tracer, but there is no folder for temporary files "
            f"({error.strerror}); set TMPDIR to a writable folder"
        ) from None


def _load(xml: str, path: Path) -> rt.Scene:
    # Mitsuba looks for relative names in the working directory first, where another scene may have meshes of the same
    # names. Absolute names ensure that Mitsuba reads the files that the fingerprint of a trace covers.
    root, folder = ElementTree.fromstring(xml), path.parent.resolve()
    for filename in root.iterfind(".//string[@name='filename']"):
        filename.set("value", str(folder / filename.get("value", "")))
    try:
        return load_scene_from_string(ElementTree.tostring(root, encoding="unicode"))
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"{path}: Sionna RT cannot load the scene: {' '.join(str(error).split())}") from None


def _check_surfaces(mitsuba_scene: Any, scene: Scene) -> None:
    """Raise an error if the bounds or areas of surfaces in Mitsuba's memory differ from those in the files.

    Mitsuba reads mesh files itself; if it misread a data type or a file layout, reflections would be lost without a
    message. Mitsuba merges the objects of a material into one mesh, so the comparison is by material.

    Raises:
        InputError: A surface differs.
    """
    # The names of Sionna's materials end with the index of the material (`Scene.xml`).
    held = surfaces_by_material(mitsuba_scene, lambda material: int(material.name.split("-")[-1]))
    for number, material in enumerate(scene.materials):
        stored = [
            size for size, item in zip(scene.sizes, scene.objects, strict=True) if item.material == material
        ]
        traced = held.get(number, [])
        if not surfaces_agree(traced, stored, scene.local_origin):
            raise InputError(
                f"{scene.path}: the surface of material {material!r} in Mitsuba differs from that in the mesh files "
                f"({sum(size.area for size in traced):.6g} m^2 instead of {sum(size.area for size in stored):.6g} "
                "m^2); export the meshes again, as binary PLY with coordinates of type float"
            )


def surfaces_by_material(mitsuba_scene: Any, key: Callable[[Any], Any]) -> dict[Any, list[SurfaceSize]]:
    """Measure the shapes in Mitsuba's memory, grouped by a key of their materials."""
    held: dict[Any, list[SurfaceSize]] = {}
    for shape in mitsuba_scene.shapes():
        held.setdefault(key(shape.bsdf()), []).append(_size(shape))
    return held


def _size(shape: Any) -> SurfaceSize:
    """Measure a Mitsuba shape."""
    values = mi.traverse(shape)
    if "vertex_positions" not in values:
        # A rectangle returns its bounds and area in single precision.
        bounds, area = shape.bbox(), float(np.array(shape.surface_area()).item())
        return SurfaceSize(tuple(np.array(bounds.min)), tuple(np.array(bounds.max)), area, 0.0)
    vertex = np.array(values["vertex_positions"], dtype=float).reshape(-1, 3)
    return SurfaceSize.of(Mesh(vertex, np.array(values["faces"], dtype=np.int64).reshape(-1, 3)))


def surfaces_agree(traced: list[SurfaceSize], stored: list[SurfaceSize], origin: NDArray[np.float64]) -> bool:
    """Whether a surface in the local frame agrees, to within single precision, with objects in the scene frame."""
    if not traced:
        return False
    low, high = np.min([size.low for size in stored], axis=0), np.max([size.high for size in stored], axis=0)
    bounds = np.array([low, high]) - origin
    # A vertex is rounded when it is stored and again when it is transformed.
    rounding = 4 * float(np.spacing(np.float32(np.abs(bounds).max())))
    area = sum(size.area for size in stored)
    area_rounding = 1e-5 * area + rounding * sum(size.sides for size in stored)
    traced_bounds = [
        np.min([size.low for size in traced], axis=0),
        np.max([size.high for size in traced], axis=0),
    ]
    return bool(
        np.abs(traced_bounds - bounds).max() <= rounding
        and abs(sum(size.area for size in traced) - area) <= area_rounding
    )


def shape_ids(mitsuba_scene: Any) -> dict[int, Any]:
    """Mitsuba's shapes, by the ids that path buffers use for the shapes."""
    return {
        int(np.array(dr.reinterpret_array(mi.UInt, mi.ShapePtr(shape))).item()): shape
        for shape in mitsuba_scene.shapes()
    }


def scattering_pattern(material: Material) -> rt.ScatteringPattern:
    """Make a material's scattering pattern, with its exponents rounded to integers as Sionna requires."""
    constants = {
        "lambertian": {},
        "directive": {"alpha_r": round(material.alpha_r)},
        "backscattering": {
            "alpha_r": round(material.alpha_r),
            "alpha_i": round(material.alpha_i),
            "lambda_": material.lambda_,
        },
    }[material.scattering_pattern]
    # Sionna's registries have no type annotations.
    make: Any = scattering_pattern_registry.get(material.scattering_pattern)
    return make(**constants)


def antenna_patterns(antenna: Antenna) -> list:
    """Make an antenna's patterns for Sionna's field stage: one function of zenith and azimuth [rad] per port."""
    if antenna.gain_file is None and not antenna.is_array:
        make: Any = antenna_pattern_registry.get(antenna.pattern)
        return make(polarization=antenna.polarization).patterns
    if antenna.gain_file is None:
        pattern = getattr(antenna_pattern, f"v_{antenna.pattern}_pattern")
    else:
        pattern = tabulated_pattern(read_gain_table(antenna.gain_file))
    if antenna.is_array:
        pattern = _array_pattern(antenna, pattern)
    return PolarizedAntennaPattern(v_pattern=pattern, polarization=antenna.polarization).patterns


def _array_pattern(
    antenna: Antenna, element: Callable[[mi.Float, mi.Float], mi.Complex2f]
) -> Callable[[mi.Float, mi.Float], mi.Complex2f]:
    return lambda zenith, azimuth: element(zenith, azimuth) * array_factor(antenna, zenith, azimuth, xp=dr)


def tabulated_pattern(table: GainTable) -> Callable[[mi.Float, mi.Float], mi.Complex2f]:
    """Make a function that interpolates the field amplitude at zenith and azimuth [rad], as `GainTable.gain` does."""
    (rows, columns), (elevation_step, azimuth_step) = table.gain_dbi.shape, np.radians(table.steps_deg)
    first_azimuth = np.radians(table.first_azimuth_deg)
    gain = mi.Float(aligned(table.gain_dbi.ravel(), np.float32))

    def pattern(zenith: mi.Float, azimuth: mi.Float) -> mi.Complex2f:
        row = dr.clip((np.pi - zenith) / elevation_step, 0, rows - 1)
        column = (azimuth - first_azimuth) / azimuth_step
        column = dr.clip(column - dr.floor(column / columns) * columns, 0, columns)
        i, j = dr.minimum(mi.UInt(row), rows - 2), dr.minimum(mi.UInt(column), columns - 1)
        # The first column follows the last one, because the azimuth is periodic.
        next_j = dr.select(j == columns - 1, 0, j + 1)
        u, v = row - mi.Float(i), column - mi.Float(j)
        low, high = (
            dr.lerp(dr.gather(mi.Float, gain, start + j), dr.gather(mi.Float, gain, start + next_j), v)
            for start in (i * columns, (i + 1) * columns)
        )
        return mi.Complex2f(dr.power(10.0, dr.lerp(low, high, u) / 20), 0)

    return pattern
