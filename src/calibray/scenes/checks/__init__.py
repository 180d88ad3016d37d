"""Checks of scenes: faults of their files and meshes, and positions that do not match them."""

from calibray.scenes.checks.positions import SceneSurfaces, building_outlines, count_crossings, move_outside
from calibray.scenes.checks.scene_check import Finding, SceneCheck, check_scene

__all__ = [
    "Finding",
    "SceneCheck",
    "SceneSurfaces",
    "building_outlines",
    "check_scene",
    "count_crossings",
    "move_outside",
]
