"""Scenes: the geometry and materials that a ray tracer reads.

This package reads and writes scenes; `scenes.checks` finds faults in a scene and in positions, and `scenes.authoring`
makes scenes from maps and floor plans. Both import from here, and not from each other.
"""

from calibray.scenes.buildings import building_numbers
from calibray.scenes.export import export_scene
from calibray.scenes.meshes import Mesh, MeshObject, join_meshes, ply_bytes, read_mesh
from calibray.scenes.scene import (
    Scene,
    check_material_name,
    has_copied_meshes,
    read_scene,
    xml_with_copied_meshes,
)
from calibray.scenes.scene_file import read_frame, write_scene
from calibray.scenes.shapes import COARSE, SurfaceSize
from calibray.scenes.triangles import Triangles, ground_heights, read_meshes, read_triangles

__all__ = [
    "COARSE",
    "Mesh",
    "MeshObject",
    "Scene",
    "SurfaceSize",
    "Triangles",
    "building_numbers",
    "check_material_name",
    "export_scene",
    "ground_heights",
    "has_copied_meshes",
    "join_meshes",
    "ply_bytes",
    "read_frame",
    "read_mesh",
    "read_meshes",
    "read_scene",
    "read_triangles",
    "write_scene",
    "xml_with_copied_meshes",
]
