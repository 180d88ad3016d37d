"""The scene in 3-D before a run: the faces of each material, and both ends of the links.

Lengths are scaled so that the scene fits into a sphere of `RADIUS` around the origin: the camera of the page sees from
0.1 to 1000 units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes import read_scene, read_triangles
from calibray.support.lazy_imports import library
from calibray.window.folder import StudyFolder
from calibray.window.plan import opened

RADIUS: Final = 10.0


@dataclass(frozen=True, eq=False)
class Solid:
    """A scene in 3-D, scaled.

    Attributes:
        meshes: Corners of the faces by material [F, 3, 3].
        tx: Transmitters [n, 3].
        rx: Receivers [n, 3].
    """

    meshes: dict[str, NDArray[np.float64]]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]

    def stl(self, material: str) -> bytes:
        """The faces of a material as an STL file."""
        corners = self.meshes[material]
        trimesh = library("trimesh", "scenes")
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        return trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False).export(file_type="stl")


def solid(folder: StudyFolder, scene: str | None) -> Solid | None:
    """The scene of a study, or a chosen one as long as there is no study; None without either.

    Raises:
        InputError: The scene or the links cannot be read.
    """
    source, study = opened(folder, scene)
    if source is None:
        return None
    frequency = 1e9 if study is None else study.scene.frequency
    read = read_scene(source, frequency)
    triangles = read_triangles(read)
    low, high = triangles.vertex.min(axis=0), triangles.vertex.max(axis=0)
    centre, scale = (low + high) / 2, 2 * RADIUS / max(float(np.linalg.norm(high - low)), 1e-6)
    names, corners = list(read.materials), (triangles.corners - centre) * scale
    meshes = {
        names[number]: corners[triangles.material == number] for number in np.unique(triangles.material)
    }
    links = None if study is None else study.measurements()
    tx, rx = (np.zeros((0, 3)),) * 2 if links is None else (links.tx, links.rx)
    return Solid(meshes, *((np.unique(ends, axis=0) - centre) * scale for ends in (tx, rx)))
