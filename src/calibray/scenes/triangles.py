"""The triangles of a scene, for drawing."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.scene import TRACED, Scene

LEVEL: Final = 0.5
"""Cosine of the tilt [1] up to which a face counts as lying, as a roof or the ground does."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """The meshes of a scene, joined.

    Attributes:
        vertex: Positions [V, 3], [m].
        face: Indices of every triangle's vertices [F, 3].
        material: Place of every triangle's material in `Scene.materials` [F].
        ground: Whether a triangle belongs to a sheet under the whole scene, as terrain is [F].
        left_out: Names of the objects that could not be read.
    """

    vertex: NDArray[np.float64]
    face: NDArray[np.int64]
    material: NDArray[np.int64]
    ground: NDArray[np.bool_]
    left_out: tuple[str, ...] = ()

    @property
    def corners(self) -> NDArray[np.float64]:
        """Positions of every triangle's corners [F, 3, 3], [m]."""
        return self.vertex[self.face]

    @property
    def normal(self) -> NDArray[np.float64]:
        """Normals, as long as the triangles are large [F, 3], [m^2]."""
        corners = self.corners
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def read_triangles(scene: Scene) -> Triangles:
    """Read the meshes of a scene.

    Args:
        scene: The scene.

    Returns:
        Its triangles; an object that is no mesh file, or is moved by a transform, is left out and named.
    """
    vertices, faces, materials, objects, left_out = [np.zeros((0, 3))], [], [], [], []
    count = 0
    for number, (name, material, mesh) in enumerate(_meshes(scene)):
        if mesh is None:
            left_out.append(name)
            continue
        vertices.append(mesh[0])
        faces.append(mesh[1] + count)
        materials.append(np.full(len(mesh[1]), material))
        objects.append(np.full(len(mesh[1]), number))
        count += len(mesh[0])
    empty = np.zeros(0, dtype=np.int64)
    joined = Triangles(
        np.concatenate(vertices),
        np.concatenate([empty.reshape(0, 3), *faces]),
        np.concatenate([empty, *materials]),
        np.zeros(sum(map(len, faces)), dtype=bool),
        tuple(left_out),
    )
    return _with_ground(joined, np.concatenate([empty, *objects]))


def _meshes(
    scene: Scene,
) -> Iterator[tuple[str, int, tuple[NDArray[np.float64], NDArray[np.int64]] | None]]:
    """Name, material and mesh of every object; no mesh where there is none to be drawn."""
    import trimesh

    for shape in ElementTree.fromstring(scene.xml).findall("shape"):
        name = (shape.get("id") or "?").removeprefix("mesh-")
        reference = shape.find("ref")
        material = int(("0" if reference is None else reference.get("id", "")).removeprefix(TRACED))
        filename = shape.find("string[@name='filename']")
        mesh = None
        if filename is not None and shape.find("transform") is None:
            try:
                read = trimesh.load_mesh(scene.path.parent / filename.get("value", ""), process=False)
                mesh = np.asarray(read.vertices, dtype=float), np.asarray(read.faces, dtype=np.int64)
            # Whatever the reader raises on a file that it cannot read: the report says that it is left out.
            except Exception:
                mesh = None
        yield name, material, mesh


def _with_ground(triangles: Triangles, owner: NDArray[np.int64]) -> Triangles:
    """Objects that lie flat under most of the scene are its ground."""
    ground = triangles.ground.copy()
    if not len(triangles.face):
        return triangles
    corners, normal = triangles.corners, triangles.normal
    area = np.linalg.norm(normal, axis=1)
    lying = np.abs(normal[:, 2]) > LEVEL * area
    whole = np.ptp(triangles.vertex[:, :2], axis=0)
    for number in np.unique(owner):
        own = owner == number
        extent = np.ptp(corners[own][:, :, :2].reshape(-1, 2), axis=0)
        if (extent > LEVEL * whole).all() and area[own & lying].sum() > 0.95 * area[own].sum():
            ground |= own
    return Triangles(triangles.vertex, triangles.face, triangles.material, ground, triangles.left_out)
