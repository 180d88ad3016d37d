"""Scenes of buildings and ground, made from footprints.

By default roofs and walls have separate materials. Sionna RT finds wedges within one mesh only, so eaves diffract only
if roofs and walls share a material (`Palette(roof=None)`). The upright edges of walls always diffract.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.scenes.authoring.extrusion import (
    ROOF,
    UNDERSIDE,
    WALL,
    WINDOW,
    Shell,
    Windows,
    extrude,
    split_overlaps,
)
from calibray.scenes.authoring.footprints import Footprints
from calibray.scenes.authoring.made_scene import SCENE_FILES, MadeScene, Palette, extent, write_made_scene
from calibray.scenes.authoring.terrain import Terrain, make_level_ground
from calibray.scenes.authoring.trees import TREES_FILE, Trees
from calibray.scenes.authoring.wall_alignment import align
from calibray.scenes.meshes import WIDEST, MeshObject, weld
from calibray.support.lazy_imports import library
from calibray.support.output_files import check_outputs

SINK: Final = 0.5
"""Depth to which buildings on sloping ground extend below the lowest ground under their walls [m]."""


def make_scene(
    footprints: Footprints,
    folder: str | Path,
    frame: Frame | None = None,
    terrain: Terrain | None = None,
    palette: Palette | None = None,
    windows: Windows | None = None,
    margin: float = 50.0,
    ground: bool = True,
    per_building: bool = False,
    overwrite: bool = False,
    trees: Trees | None = None,
) -> MadeScene:
    """Make a scene of buildings and ground.

    Args:
        footprints: The buildings.
        folder: Folder for `scene.xml`, `scene.json` and the meshes.
        frame: Position of the scene on the globe, which the files store.
        terrain: The ground; by default it is level, z = 0, and extends `margin` beyond the buildings. On a terrain, the
            heights of a building are measured from the lowest ground under its walls.
        palette: The materials.
        windows: How walls are divided into wall and window; None for walls without windows.
        margin: Distance by which level ground extends beyond the buildings [m].
        ground: Whether to make ground; without it, buildings are closed at the bottom.
        per_building: One mesh per building and material, named `BUILDING-MATERIAL`, instead of one per material.
            Calibray can then give some buildings a separate material. Tracing many meshes takes longer.
        overwrite: Replace files that Calibray did not write.
        trees: Trees; those over the ground are written next to the scene as `TREES_FILE`, which needs a frame.

    Raises:
        InputError: There is no building, the margin is out of range, the folder cannot be written, or a file there must
            not be replaced.
    """
    folder = check_outputs(folder, (*SCENE_FILES, TREES_FILE), overwrite=overwrite)
    palette = palette or Palette()
    if not len(footprints):
        raise InputError("there is no building to make a scene from; check the file and its columns")
    if not 0 <= margin <= WIDEST:
        raise InputError(f"margin = {margin!r}: must be 0 to {WIDEST:g} m")
    base = _base_heights(footprints, terrain)
    cells, overlapping = split_overlaps(footprints, base + footprints.bottom, base + footprints.top)
    shell = extrude(cells, windows, base if ground else None)
    objects = _objects(shell, palette, footprints.name if per_building else None)
    if ground:
        sheet = terrain or make_level_ground(footprints.bounds + margin * np.array([-1, -1, 1, 1]))
        objects.append(MeshObject("ground-surface", palette.ground.name, sheet.mesh()))
    if trees is not None:
        trees = trees.within(footprints.bounds + margin * np.array([-1, -1, 1, 1]))
    counts = {
        "buildings": len(footprints),
        **(trees.counts if trees is not None else {}),
        **footprints.repairs,
        **({"sharing ground with another, cut": overlapping} if overlapping else {}),
        **(terrain.repairs if terrain is not None else {}),
    }
    guessed = {source: names for source, names in footprints.guessed().items() if names}
    materials = [palette.wall, palette.window, palette.roof or palette.wall, palette.ground]
    scene = MadeScene(folder / SCENE_FILES[0], frame, *extent(objects), counts, guessed)
    write_made_scene(scene, objects, materials, overwrite)
    # The trees of a scene that this one replaces are no longer here.
    (folder / TREES_FILE).unlink(missing_ok=True)
    if trees is not None and frame is not None and len(trees):
        trees.write(folder, frame)
    return scene


def _base_heights(footprints: Footprints, terrain: Terrain | None) -> NDArray[np.float64]:
    """Height from which each building rises [n], [m]: below the lowest ground under its walls."""
    if terrain is None:
        return np.zeros(len(footprints))
    shapely = library("shapely", "scenes")
    step = float(min(np.diff(terrain.x).min(), np.diff(terrain.y).min())) / 2
    corners, building = shapely.get_coordinates(
        shapely.segmentize(footprints.polygon, step), return_index=True
    )
    lowest = np.full(len(footprints), np.inf)
    np.minimum.at(lowest, building, terrain.heights(*corners.T))
    return np.floor((lowest - SINK) * 100) / 100


def _objects(shell: Shell, palette: Palette, buildings: Sequence[str] | None) -> list[MeshObject]:
    """One mesh per material, or per building and material; no mesh has the name of a material."""
    roof = (palette.roof or palette.wall).name
    names = {WALL: palette.wall.name, WINDOW: palette.window.name, ROOF: roof, UNDERSIDE: roof}
    material = np.array([names[kind] for kind in range(len(names))])[shell.kind]
    position = align(shell.corners).positions
    if buildings is None:
        return [
            MeshObject(f"all-{name}", name, weld(shell.corners[material == name], position))
            for name in sorted(set(material))
        ]
    order = np.lexsort((material, shell.owner))
    ends = np.flatnonzero((np.diff(shell.owner[order]) != 0) | (material[order][1:] != material[order][:-1]))
    return [
        MeshObject(
            f"{buildings[int(shell.owner[rows[0]])]}-{material[rows[0]]}",
            str(material[rows[0]]),
            weld(shell.corners[rows], position),
        )
        for rows in np.split(order, ends + 1)
    ]
