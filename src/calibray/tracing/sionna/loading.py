"""Scenes and materials as Sionna RT takes them."""

# Mitsuba makes its types when its variant is chosen: its stubs know them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from sionna.rt.radio_materials import scattering_pattern_registry
from sionna.rt.scene import load_scene_from_string

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes import Scene


def load(scene: Scene) -> rt.Scene:
    """Load a scene.

    Args:
        scene: The scene; its meshes are found from its file.

    Returns:
        Sionna's scene.

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


def mitsuba_scene(scene: rt.Scene) -> Any:
    """The scene that Mitsuba holds; neither Sionna nor Mitsuba says of which type it is.

    Args:
        scene: Sionna's scene.

    Returns:
        Mitsuba's.
    """
    return scene.mi_scene


def shape_materials(scene: rt.Scene) -> dict[int, int]:
    """Materials of the shapes.

    Args:
        scene: Sionna's scene.

    Returns:
        Material index by the id under which Dr.Jit knows a shape.
    """
    return {
        int(np.array(dr.reinterpret_array(mi.UInt, mi.ShapePtr(shape))).item()): int(
            shape.bsdf().name.split("-")[-1]
        )
        for shape in mitsuba_scene(scene).shapes()
    }


def scattering_pattern(material: Material) -> rt.ScatteringPattern:
    """A material's scattering pattern, its exponents rounded to the whole numbers that Sionna takes.

    Args:
        material: The material.

    Returns:
        Sionna's pattern.
    """
    constants = {
        "lambertian": {},
        "directive": {"alpha_r": round(material.alpha_r)},
        "backscattering": {
            "alpha_r": round(material.alpha_r),
            "alpha_i": round(material.alpha_i),
            "lambda_": material.lambda_,
        },
    }[material.scattering_pattern]
    # Sionna does not say what it registers.
    make: Any = scattering_pattern_registry.get(material.scattering_pattern)
    return make(**constants)
