"""Scenes of a few triangles, written as Mitsuba XML with PLY meshes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

CONCRETE = (
    '<bsdf type="radio-material" id="mat-stone"><float name="relative_permittivity" value="5.0"/>'
    '<float name="conductivity" value="0.05"/><float name="thickness" value="0.2"/></bsdf>'
)
Corner = tuple[float, float, float]


def write_scene(
    folder: Path,
    quads: Mapping[str, Sequence[Sequence[Corner]]],
    bsdf: str = CONCRETE,
    material: str = "mat-stone",
) -> Path:
    """Write a scene.

    Args:
        folder: Folder to write into.
        quads: Meshes by name, each of some quadrilaterals with four corners [m]; corners that are equal are shared.
        bsdf: The XML of the materials.
        material: Id of the BSDF that all meshes refer to.

    Returns:
        The XML file.
    """
    shapes = ""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    for name, faces in quads.items():
        (folder / "meshes" / f"{name}.ply").write_text(ply(faces))
        shapes += (
            f'<shape type="ply" id="mesh-{name}"><string name="filename" value="meshes/{name}.ply"/>'
            f'<ref id="{material}" name="bsdf"/></shape>'
        )
    file = folder / "scene.xml"
    file.write_text(f'<scene version="2.1.0">{bsdf}{shapes}</scene>')
    return file


def ply(quads: Sequence[Sequence[Corner]]) -> str:
    """Quadrilaterals as the text of a PLY mesh of triangles."""
    vertices = list(dict.fromkeys(corner for quad in quads for corner in quad))
    triangles = []
    for quad in quads:
        a, b, c, d = (vertices.index(corner) for corner in quad)
        triangles += [f"3 {a} {b} {c}", f"3 {a} {c} {d}"]
    header = [
        "ply", "format ascii 1.0", f"element vertex {len(vertices)}", "property float x", "property float y",
        "property float z", f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return "\n".join([*header, *(" ".join(map(str, vertex)) for vertex in vertices), *triangles, ""])


def block(low: Corner, high: Corner) -> list[list[Corner]]:
    """The six faces of a box, outward normals."""
    (x, y, z), (u, v, w) = low, high
    return [
        [(x, y, z), (x, v, z), (u, v, z), (u, y, z)],
        [(x, y, w), (u, y, w), (u, v, w), (x, v, w)],
        [(x, y, z), (u, y, z), (u, y, w), (x, y, w)],
        [(x, v, z), (x, v, w), (u, v, w), (u, v, z)],
        [(x, y, z), (x, y, w), (x, v, w), (x, v, z)],
        [(u, y, z), (u, v, z), (u, v, w), (u, y, w)],
    ]
