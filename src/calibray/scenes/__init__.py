"""Scenes: the geometry and materials that a ray tracer reads.

This package reads and writes scenes. Its subpackage `scenes.checks` finds faults in scenes and positions, and
`scenes.authoring` makes scenes from maps and floor plans. Both subpackages import from this package, but not from each
other.
"""

from calibray.scenes.buildings import building_numbers as building_numbers
from calibray.scenes.meshes import Mesh as Mesh
from calibray.scenes.meshes import MeshObject as MeshObject
from calibray.scenes.meshes import join_meshes as join_meshes
from calibray.scenes.meshes import ply_bytes as ply_bytes
from calibray.scenes.meshes import read_mesh as read_mesh
from calibray.scenes.scene import Scene as Scene
from calibray.scenes.scene import check_material_name as check_material_name
from calibray.scenes.scene import export_scene as export_scene
from calibray.scenes.scene import has_copied_meshes as has_copied_meshes
from calibray.scenes.scene import read_scene as read_scene
from calibray.scenes.scene import xml_with_copied_meshes as xml_with_copied_meshes
from calibray.scenes.scene_file import read_frame as read_frame
from calibray.scenes.scene_file import write_scene as write_scene
from calibray.scenes.shapes import COARSE as COARSE
from calibray.scenes.shapes import SurfaceSize as SurfaceSize
from calibray.scenes.triangles import Triangles as Triangles
from calibray.scenes.triangles import ground_heights as ground_heights
from calibray.scenes.triangles import read_meshes as read_meshes
from calibray.scenes.triangles import read_triangles as read_triangles
