"""Triangle meshes of a scene: joined, and written as PLY and XML files for Mitsuba, byte for byte alike.

Mitsuba and Sionna RT find neighbouring faces by the vertices that they share, within one mesh; where two meshes meet
there is no wedge, and so no diffraction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from calibray.support.output_files import replacing

Place = Callable[[NDArray[np.int64]], NDArray[np.float64]]
"""Where corners lie."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; faces that share an edge share its vertices.

    Attributes:
        vertices: Positions [V, 3], [m].
        faces: Vertex indices of every triangle, counter-clockwise seen from outside [F, 3].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class MeshObject:
    """One object of a scene file.

    Attributes:
        name: Name of the object, unlike that of any material.
        material: Name of its material.
        mesh: Its surface.
    """

    name: str
    material: str
    mesh: Mesh


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several, the vertices of different parts kept apart.

    Args:
        meshes: At least one mesh.

    Returns:
        All faces in the order given, over the used vertices only.
    """
    parts = list(meshes)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)])
    used, inverse = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], inverse.reshape(faces.shape))


def welded(triangles: NDArray[np.int64], scale: float, place: Place | None = None) -> Mesh:
    """A mesh of triangles whose corners are whole multiples of a length: equal corners become one vertex.

    Args:
        triangles: Corners of every triangle, counter-clockwise seen from outside [F, 3, 3], [scale].
        scale: The length [m].
        place: Where corners lie, if not at these multiples: [n, 3], [scale] -> [n, 3], [m].

    Returns:
        The mesh; triangles with two equal corners are left out.

    Example:
        >>> welded(np.array([[[0, 0, 0], [5, 0, 0], [0, 5, 0]], [[5, 0, 0], [5, 5, 0], [0, 5, 0]]]), 0.001).faces
        array([[0, 2, 1],
               [2, 3, 1]])
    """
    vertices, faces = np.unique(np.reshape(triangles, (-1, 3)), axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    corners = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    where = vertices.astype(np.float64) * scale if place is None else place(vertices)
    return joined([Mesh(where, faces[corners])])


def ply_bytes(mesh: Mesh) -> bytes:
    """The mesh as a binary little-endian PLY file.

    Args:
        mesh: The mesh; its vertices are rounded to 32-bit floats.

    Returns:
        The content of the file.
    """
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"] = 3
    faces["vertices"] = mesh.faces
    return header.encode("ascii") + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


def scene_xml(
    objects: Sequence[MeshObject],
    materials: Mapping[str, Mapping[str, float | str]],
    comment: str | None = None,
) -> str:
    """The Mitsuba XML of a scene whose meshes lie in `meshes/NAME.ply`.

    Args:
        objects: The objects of the scene.
        materials: Constants by material name. A `type` names a material of ITU-R P.2040, which then gives
            permittivity and conductivity.
        comment: Text of a comment at its beginning.

    Returns:
        The text of the file.
    """
    lines = ['<scene version="2.1.0">']
    if comment is not None:
        # A comment may hold no double hyphen.
        lines.append(f"    <!-- {escape(comment).replace('--', '- -')} -->")
    for name, constants in materials.items():
        kind = "itu-radio-material" if "type" in constants else "radio-material"
        lines.append(f'    <bsdf type="{kind}" id={quoteattr(f"mat-{name}")}>')
        for key, value in constants.items():
            tag, text = ("string", value) if isinstance(value, str) else ("float", f"{value:.6g}")
            lines.append(f'        <{tag} name="{key}" value={quoteattr(text)}/>')
        lines.append("    </bsdf>")
    for item in objects:
        lines += [
            f'    <shape type="ply" id={quoteattr(f"mesh-{item.name}")}>',
            f'        <string name="filename" value={quoteattr(f"meshes/{item.name}.ply")}/>',
            '        <boolean name="face_normals" value="true"/>',
            f'        <ref id={quoteattr(f"mat-{item.material}")} name="bsdf"/>',
            "    </shape>",
        ]
    return "\n".join([*lines, "</scene>", ""])


def write_scene(
    folder: Path,
    objects: Sequence[MeshObject],
    materials: Mapping[str, Mapping[str, float | str]],
    comment: str | None = None,
) -> Path:
    """Write `scene.xml` and `meshes/NAME.ply` of every object.

    Args:
        folder: Where to write; made if it does not exist.
        objects: The objects of the scene.
        materials: Constants of the materials by name, as `scene_xml` takes them.
        comment: Text of a comment at its beginning.

    Returns:
        Path of the XML file.
    """
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    for item in objects:
        with replacing(folder / "meshes" / f"{item.name}.ply") as partial:
            partial.write_bytes(ply_bytes(item.mesh))
    path = folder / "scene.xml"
    with replacing(path) as partial:
        partial.write_bytes(scene_xml(objects, materials, comment).encode("utf-8"))
    return path
