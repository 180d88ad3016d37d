"""Makes scenes from OpenStreetMap extracts, vector files, height models and floor plans.

Each name is imported on first use, because each type of source needs different libraries.
"""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray.scenes.authoring.extrusion import Windows as Windows
    from calibray.scenes.authoring.floor_plan import Segment as Segment
    from calibray.scenes.authoring.floor_plan import read_plan as read_plan
    from calibray.scenes.authoring.floor_plan_scene import LIDS as LIDS
    from calibray.scenes.authoring.floor_plan_scene import WALL_THICKNESS as WALL_THICKNESS
    from calibray.scenes.authoring.floor_plan_scene import make_plan_scene as make_plan_scene
    from calibray.scenes.authoring.footprints import FootprintColumns as FootprintColumns
    from calibray.scenes.authoring.footprints import Footprints as Footprints
    from calibray.scenes.authoring.footprints import HeightRule as HeightRule
    from calibray.scenes.authoring.footprints import HeightSource as HeightSource
    from calibray.scenes.authoring.footprints import clean_footprints as clean_footprints
    from calibray.scenes.authoring.footprints import read_footprints as read_footprints
    from calibray.scenes.authoring.footprints import read_openstreetmap as read_openstreetmap
    from calibray.scenes.authoring.made_scene import SCENE_FILES as SCENE_FILES
    from calibray.scenes.authoring.made_scene import MadeScene as MadeScene
    from calibray.scenes.authoring.made_scene import Palette as Palette
    from calibray.scenes.authoring.made_scene import SurfaceMaterial as SurfaceMaterial
    from calibray.scenes.authoring.made_scene import make_scene as make_scene
    from calibray.scenes.authoring.made_scene import material_name as material_name
    from calibray.scenes.authoring.terrain import Terrain as Terrain
    from calibray.scenes.authoring.terrain import lower_origin as lower_origin
    from calibray.scenes.authoring.terrain import read_terrain as read_terrain
    from calibray.scenes.authoring.trees import TREES_FILE as TREES_FILE
    from calibray.scenes.authoring.trees import Trees as Trees
    from calibray.scenes.authoring.trees import read_trees as read_trees
    from calibray.scenes.authoring.wall_faces import merge_faces as merge_faces

__all__, __getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "extrusion": "Windows",
        "floor_plan": "Segment read_plan",
        "floor_plan_scene": "LIDS WALL_THICKNESS make_plan_scene",
        "footprints": "FootprintColumns Footprints HeightRule HeightSource clean_footprints read_footprints "
        "read_openstreetmap",
        "made_scene": "SCENE_FILES MadeScene Palette SurfaceMaterial make_scene material_name",
        "terrain": "Terrain lower_origin read_terrain",
        "trees": "TREES_FILE Trees read_trees",
        "wall_faces": "merge_faces",
    },
)
