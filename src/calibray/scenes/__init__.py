"""Scenes: the geometry and the materials that a tracer is given."""

from calibray.scenes.export import export_scene
from calibray.scenes.scene import Scene, SceneObject, check_material_name, read_scene

__all__ = ["Scene", "SceneObject", "check_material_name", "export_scene", "read_scene"]
