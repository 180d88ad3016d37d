"""Makes scenes from footprints, and writes scene files with materials and a record of assumptions.

By default, roofs and walls have separate materials. Sionna RT finds wedges only within one mesh, so eaves diffract only
if roofs and walls share a material (`Palette(roof=None)`). The vertical edges of walls always diffract.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements.column_names import without_accents
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
from calibray.scenes.authoring.terrain import Terrain, make_level_ground
from calibray.scenes.authoring.trees import TREES_FILE, Trees
from calibray.scenes.authoring.wall_alignment import align
from calibray.scenes.meshes import WIDEST, MeshObject, weld
from calibray.scenes.scene import ITU_NAMES, is_itu_name
from calibray.scenes.scene_file import write_scene
from calibray.support.lazy_imports import library
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_outputs, write_text

SCENE_FILES: Final = ("scene.xml", "scene.json")
"""Files written next to the folder of meshes."""

THICKEST: Final = 100.0
"""Maximum thickness of a material in a new scene [m]."""

_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


@dataclass(frozen=True)
class SurfaceMaterial:
    """A material of a new scene, with constants from ITU-R P.2040.

    Attributes:
        name: Name of the material; ITU-R P.2040 names are not allowed, because Sionna RT reserves them.
        itu: ITU-R P.2040 material from which the constants are taken.
        thickness: Thickness of the slab [m].

    Raises:
        InputError: The name is an ITU name or contains characters other than letters, digits, `_` and `-`. The ITU
            material does not exist. The thickness is not positive or exceeds `THICKEST`.
    """

    name: str
    itu: str
    thickness: float

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InputError(
                f"material {self.name!r}: must consist of letters, digits, '_' and '-' and begin with a letter"
            )
        if is_itu_name(self.name):
            suggestion = f"{self.name.removeprefix('itu_').removeprefix('itu-')}_wall"
            raise InputError(
                f"material {self.name!r}: is an ITU-R P.2040 name, which Sionna RT reserves; name it "
                f"{suggestion!r}, for example"
            )
        if self.itu not in ITU_NAMES:
            raise InputError(
                f"material {self.name}: ITU-R P.2040 has no {self.itu!r}; {did_you_mean(self.itu, sorted(ITU_NAMES))}"
            )
        if not 0 < self.thickness <= THICKEST:
            raise InputError(
                f"material {self.name}: thickness = {self.thickness!r}: must be greater than 0 and at most "
                f"{THICKEST:g} m"
            )

    def constants(self) -> dict[str, float | str]:
        """The constants in the form in which a scene file states them."""
        return {"type": self.itu, "thickness": self.thickness}


def material_name(kind: str) -> str:
    """Make a material name from the name of a wall type, which can contain any characters.

    Example:
        >>> material_name("tür 2"), material_name("brick"), material_name("2 x drywall")
        ('tur_2', 'brick_wall', 'wall_2_x_drywall')
    """
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", without_accents(kind)).strip("_-")
    name = name if _NAME.fullmatch(name) else f"wall_{name}".rstrip("_")
    return f"{name}_wall" if is_itu_name(name) else name


@dataclass(frozen=True)
class Palette:
    """The materials of buildings and ground.

    Attributes:
        wall: Material of walls.
        window: Material of windows.
        roof: Material of roofs and undersides. If None, roofs and undersides have the material of the walls, so eaves
            diffract.
        ground: Material of the ground.
    """

    wall: SurfaceMaterial = SurfaceMaterial("walls", "concrete", 0.3)
    window: SurfaceMaterial = SurfaceMaterial("windows", "glass", 0.02)
    roof: SurfaceMaterial | None = SurfaceMaterial("roofs", "concrete", 0.3)
    ground: SurfaceMaterial = SurfaceMaterial("ground", "concrete", 1.0)


@dataclass(frozen=True)
class MadeScene:
    """A scene that Calibray made.

    Attributes:
        path: The XML file.
        frame: Geographic frame of the scene; None if unknown.
        bounds: West, south, bottom, east, north and top [6], [m].
        triangles: Number of triangles by material.
        counts: Number of objects that were used, repaired or left out, by category.
        guessed: Names of the buildings with an assumed height, grouped by the source of the assumption.
        walls: Sentences that state how the lines of a floor plan were used.
    """

    path: Path
    frame: Frame | None
    bounds: tuple[float, ...]
    triangles: Mapping[str, int]
    counts: Mapping[str, int]
    guessed: Mapping[str, Sequence[str]] = field(default_factory=dict)
    walls: Sequence[str] = ()

    def record(self) -> dict[str, object]:
        """The content of `scene.json`."""
        return {
            "frame": None if self.frame is None else self.frame.record(),
            "bounds": list(self.bounds),
            "triangles": dict(self.triangles),
            "counts": dict(self.counts),
            "guessed": {source: list(names) for source, names in self.guessed.items()},
            **({"walls": list(self.walls)} if self.walls else {}),
        }


def extent(objects: Sequence[MeshObject]) -> tuple[tuple[float, ...], dict[str, int]]:
    """Bounds of objects, in the order of `MadeScene.bounds`, and the number of triangles of each material."""
    triangles = dict.fromkeys(sorted({item.material for item in objects}), 0)
    for item in objects:
        triangles[item.material] += len(item.mesh.faces)
    corners = np.array([[item.mesh.vertices.min(axis=0), item.mesh.vertices.max(axis=0)] for item in objects])
    return (*corners[:, 0].min(axis=0).tolist(), *corners[:, 1].max(axis=0).tolist()), triangles


def write_made_scene(
    scene: MadeScene,
    objects: Sequence[MeshObject],
    materials: Sequence[SurfaceMaterial],
    overwrite: bool = False,
) -> None:
    """Write a scene and its assumptions; with `overwrite`, replace files that Calibray did not write.

    Unused and repeated materials are ignored.

    Raises:
        InputError: Two different materials have the same name, a material and a mesh have the same name, or a file must
            not be replaced.
    """
    constants: dict[str, Mapping[str, float | str]] = {}
    for material in materials:
        if constants.setdefault(material.name, material.constants()) != material.constants():
            raise InputError(
                f"material {material.name!r}: is given twice with different constants; use another name"
            )
    if clash := sorted({item.name for item in objects} & set(constants)):
        raise InputError(
            f"material {clash[0]!r}: a mesh has the same name, which Sionna RT refuses; use another name"
        )
    folder = scene.path.parent
    check_outputs(folder, SCENE_FILES, overwrite=overwrite)
    used = {name: values for name, values in constants.items() if name in scene.triangles}
    write_scene(folder, objects, used, scene.frame, overwrite)
    write_text(folder / "scene.json", json.dumps(scene.record(), indent=2) + "\n")


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
    """Make a scene with buildings and ground.

    Args:
        footprints: The buildings.
        folder: Folder for `scene.xml`, `scene.json` and the meshes.
        frame: Geographic frame of the scene, which is stored in the files.
        terrain: The ground; by default, the ground is level at z = 0 and extends `margin` beyond the buildings. With
            terrain, the heights of a building and of its parts are measured from the lowest ground under the building's
            walls.
        palette: The materials.
        windows: Division of walls into strips of wall and window; None for walls without windows.
        margin: Distance by which level ground extends beyond the buildings [m].
        ground: Whether the scene includes ground; without ground, buildings are closed at the bottom.
        per_building: Whether to make one mesh per building and material, named `BUILDING-MATERIAL`, instead of one mesh
            per material. With separate meshes, a study can assign separate materials to individual buildings. Tracing
            many meshes takes longer.
        overwrite: Whether to replace files that Calibray did not write.
        trees: The trees. If `frame` is given, trees within `margin` of the buildings are written to `TREES_FILE` next
            to the scene.

    Raises:
        InputError: There is no building, the margin is out of range, the folder cannot be written to, or a file in it
            must not be replaced.
    """
    folder = check_outputs(folder, (*SCENE_FILES, TREES_FILE), overwrite=overwrite)
    palette = palette or Palette()
    if not len(footprints):
        raise InputError("there is no building to make a scene from; check the file and its columns")
    if not 0 <= margin <= WIDEST:
        raise InputError(f"margin = {margin!r}: must be 0 to {WIDEST:g} m")
    level = _ground_heights(footprints, terrain)
    base = level if terrain is None else level - SINK
    bottom = np.where(footprints.bottom > 0, level + footprints.bottom, base)
    cells, overlapping = split_overlaps(footprints, bottom, level + footprints.top)
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
    # Remove the trees of an older scene that this scene replaces.
    (folder / TREES_FILE).unlink(missing_ok=True)
    if trees is not None and frame is not None and len(trees):
        trees.write(folder, frame)
    return scene


def _ground_heights(footprints: Footprints, terrain: Terrain | None) -> NDArray[np.float64]:
    """Lowest ground under the walls of each building [n], [m]; the building's heights are measured from this level."""
    if terrain is None:
        return np.zeros(len(footprints))
    shapely = library("shapely", "scenes")
    step = float(min(np.diff(terrain.x).min(), np.diff(terrain.y).min())) / 2
    corners, building = shapely.get_coordinates(
        shapely.segmentize(footprints.polygon, step), return_index=True
    )
    lowest = np.full(len(footprints), np.inf)
    np.minimum.at(lowest, building, terrain.heights(*corners.T))
    # Parts are measured from the same ground as the whole building, so one part can stand on another.
    parts, wholes = np.flatnonzero(footprints.part), np.flatnonzero(~footprints.part)
    inside = shapely.point_on_surface(footprints.polygon[parts])
    part, whole = shapely.STRtree(footprints.polygon[wholes]).query(inside, predicate="within")
    np.minimum.at(lowest, parts[part], lowest[wholes[whole]])
    return np.floor(lowest * 100) / 100


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
