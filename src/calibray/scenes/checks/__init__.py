"""Checks of scenes, which find faults in scene files and meshes, and positions that do not match a scene."""

from calibray.scenes.checks.positions import SceneSurfaces as SceneSurfaces
from calibray.scenes.checks.positions import building_outlines as building_outlines
from calibray.scenes.checks.positions import count_crossings as count_crossings
from calibray.scenes.checks.positions import move_outside as move_outside
from calibray.scenes.checks.scene_check import Finding as Finding
from calibray.scenes.checks.scene_check import SceneCheck as SceneCheck
from calibray.scenes.checks.scene_check import check_scene as check_scene
from calibray.scenes.checks.scene_check import scale_findings as scale_findings
