"""One set of Dr.Jit's kernels for the scenes of all tests; compiling them takes most of the time of a small trace."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from calibray.scenes import read_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from small_scenes import CONCRETE, write_scene

COUNT = 63
"""Number of materials, more than all scenes have together that a test holds in memory; making them takes 1 s."""


def last_of_many(folder: Path) -> tuple[Any, Any]:
    """Make a scene of `COUNT` materials in a folder; return the shape and the material with the largest numbers.

    Dr.Jit numbers shapes and materials, and its kernels contain the largest number in memory. While these two are
    kept, kernels are the same for all scenes with fewer shapes and materials, and for scenes next to others.
    """
    names = [f"mat-{number}" for number in range(COUNT)]
    bsdf = "".join(CONCRETE.replace("mat-stone", name) for name in names)
    square = [[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)]]
    # A mesh for each material: Sionna would merge those of one material.
    file = write_scene(folder, dict.fromkeys(names, square), bsdf, "{}")
    file.write_text(file.read_text().format(*names))
    tracer = Tracer(read_scene(file, 3.5e9), 3.5e9, TraceSettings(), Antenna(), Antenna())
    tracer.solver.set_materials({})
    shapes = tracer.solver.mitsuba_scene.shapes()
    return _last(shapes, mi.ShapePtr), _last((shape.bsdf() for shape in shapes), mi.BSDFPtr)


def _last(objects: Iterable[Any], pointer: Callable[[Any], Any]) -> Any:
    return max(objects, key=lambda item: np.array(dr.reinterpret_array(mi.UInt, pointer(item))).item())
