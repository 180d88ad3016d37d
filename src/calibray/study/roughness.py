"""Rough surfaces: the effect of the materials' roughness heights on the paths of a study."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.constants import speed_of_light

from calibray.parameters import Parameters
from calibray.parameters.laws import ROUGHNESS
from calibray.paths import Kind, Paths

if TYPE_CHECKING:
    from calibray.fields import Effects


def roughness_effects(stated: Mapping[str, float], parameters: Parameters, paths: Paths) -> Effects:
    """The loss of specular reflections on rough surfaces; none if no material is rough.

    Args:
        stated: Standard deviation of the surface heights by material, where it is stated [mm].
        parameters: The study's parameters.
        paths: The paths.
    """
    names = [parameters.names[index] for index in parameters.of_effects]
    number = {
        name.removesuffix(f".{ROUGHNESS}"): index
        for index, name in enumerate(names)
        if name.endswith(f".{ROUGHNESS}")
    }
    rough = [name for name in paths.materials if stated.get(name) or name in number]
    if not rough:
        return ()
    # JAX is slow to import, and every study file that is read imports this module.
    from calibray.fields import RoughSurfaces

    path = np.repeat(np.arange(paths.num_paths), np.diff(paths.first))
    specular = paths.kind == Kind.SPECULAR
    known = list(paths.materials)
    square = [
        np.bincount(
            path, (specular & (paths.material == known.index(name))) * paths.cos_incidence**2, paths.num_paths
        )
        for name in rough
    ]
    per_mm = 8 * (np.pi * 1e-3 * paths.frequency / speed_of_light) ** 2
    heights = np.array([stated.get(name, 0.0) for name in rough])
    exponent = np.asarray(per_mm * np.stack(square, axis=1), dtype=np.float64)
    return (RoughSurfaces(exponent, heights, tuple(map(number.get, rough))),)
