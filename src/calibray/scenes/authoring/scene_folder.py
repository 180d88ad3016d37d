"""Scenes made of footprints, ground and floor plans: one folder with `scene.xml`, its meshes and what was assumed.

Roofs and walls are materials of their own by default. Sionna RT finds wedges within one mesh alone, so the eaves
diffract only if roofs and walls share a material (`Palette(roof=None)`); the upright edges of walls always do.
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
from calibray.materials import ITU_MATERIALS
from calibray.scenes.authoring.building_parts import take_apart
from calibray.scenes.authoring.extrusion import (
    MILLIMETRE,
    ROOF,
    UNDERSIDE,
    WALL,
    WINDOW,
    Shell,
    Windows,
    extrude,
)
from calibray.scenes.authoring.footprints import Footprints
from calibray.scenes.authoring.terrain import Terrain, level_ground
from calibray.scenes.authoring.wall_alignment import align
from calibray.scenes.meshes import MeshObject, welded, write_scene
from calibray.support.extras import library
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_folder, write_text

SINK: Final = 0.5
"""How deep buildings on sloping ground go below the lowest point of it under their walls [m]."""

_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_COMMENT: Final = "calibray frame "


@dataclass(frozen=True)
class SurfaceMaterial:
    """A material of a scene to be made: its constants are ITU-R P.2040's.

    Attributes:
        name: What the material is called; no name of ITU-R P.2040's, which Sionna RT keeps for itself.
        itu: Which material of ITU-R P.2040 gives its constants.
        thickness: Thickness of the slab [m].

    Raises:
        InputError: The name is an ITU name or holds other characters than letters, digits, `_` and `-`, there is no
            such ITU material, or the thickness is not greater than 0.
    """

    name: str
    itu: str
    thickness: float

    def __post_init__(self) -> None:
        known = sorted({name for table in ITU_MATERIALS.values() for name in table})
        if not _NAME.fullmatch(self.name):
            raise InputError(f"material {self.name!r}: must be letters, digits, '_' and '-', a letter first")
        if self.name in known or self.name.startswith(("itu_", "itu-")):
            raise InputError(
                f"material {self.name!r}: is a name of ITU-R P.2040's, which Sionna RT keeps for itself; "
                f"name it {self.name.removeprefix('itu_').removeprefix('itu-') + '_wall'!r}, say"
            )
        if self.itu not in known:
            raise InputError(
                f"material {self.name}: ITU-R P.2040 has no {self.itu!r}; {did_you_mean(self.itu, known)}"
            )
        if not (np.isfinite(self.thickness) and self.thickness > 0):
            raise InputError(f"material {self.name}: thickness = {self.thickness!r} must be greater than 0 m")

    def constants(self) -> dict[str, float | str]:
        """The constants as a scene file takes them."""
        return {"type": self.itu, "thickness": self.thickness}


@dataclass(frozen=True)
class Palette:
    """What the surfaces of buildings and ground are made of.

    Attributes:
        wall: Walls.
        window: Windows.
        roof: Roofs, and undersides; None for the walls' material, whose eaves then diffract.
        ground: The ground.
    """

    wall: SurfaceMaterial = SurfaceMaterial("walls", "concrete", 0.3)
    window: SurfaceMaterial = SurfaceMaterial("windows", "glass", 0.02)
    roof: SurfaceMaterial | None = SurfaceMaterial("roofs", "concrete", 0.3)
    ground: SurfaceMaterial = SurfaceMaterial("ground", "concrete", 1.0)

    def of(self, kind: int) -> SurfaceMaterial:
        """The material of a kind of surface of `extrusion`."""
        return {
            WALL: self.wall,
            WINDOW: self.window,
            ROOF: self.roof or self.wall,
            UNDERSIDE: self.roof or self.wall,
        }[kind]


@dataclass(frozen=True)
class Made:
    """A scene that was made.

    Attributes:
        path: Its XML file.
        frame: Where it lies on the globe; None if that is not known.
        bounds: West, south, bottom, east, north and top [6], [m].
        triangles: Number of triangles by material.
        counts: What there is in it, and what was repaired or left out.
        guessed: The buildings whose height is a guess, by what it was guessed from.
    """

    path: Path
    frame: Frame | None
    bounds: tuple[float, ...]
    triangles: Mapping[str, int]
    counts: Mapping[str, int]
    guessed: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def record(self) -> dict[str, object]:
        """What was made and assumed, as JSON takes it."""
        return {
            "frame": None if self.frame is None else self.frame.record(),
            "bounds": list(self.bounds),
            "triangles": dict(self.triangles),
            "counts": dict(self.counts),
            "guessed": {source: list(names) for source, names in self.guessed.items()},
        }


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
) -> Made:
    """Make a scene of buildings and ground.

    Args:
        footprints: The buildings.
        folder: Where to write `scene.xml`, `scene.json` and the meshes.
        frame: Where the scene lies on the globe; kept in the files.
        terrain: The ground; without one it is level, z = 0, and reaches `margin` beyond the buildings. On a terrain
            a building's heights count from the lowest point of the ground under its walls.
        palette: What the surfaces are made of.
        windows: How walls are divided into wall and window; None for walls alone.
        margin: How far level ground reaches beyond the buildings [m].
        ground: Whether to make any; without it buildings are closed below.
        per_building: One mesh a building and material, named `BUILDING-MATERIAL`, in place of one a material.
            Calibray can then give some buildings a material of their own; tracing many meshes takes longer.

    Returns:
        What was made.

    Raises:
        InputError: There is no building, or the folder cannot be written.
    """
    folder, palette = check_folder(folder), palette or Palette()
    if not len(footprints):
        raise InputError("there is no building to make a scene of; check the file and its columns")
    base = _bases(footprints, terrain)
    cells, cut = take_apart(footprints, base + footprints.bottom, base + footprints.top)
    shell = extrude(cells, windows, base if ground else None)
    objects = _objects(shell, palette, footprints.name if per_building else None)
    if ground:
        sheet = terrain or level_ground(footprints.bounds + margin * np.array([-1, -1, 1, 1]))
        objects.append(MeshObject("ground-surface", palette.ground.name, sheet.mesh()))
    used = [palette.wall, palette.window, *([palette.roof] if palette.roof else []), palette.ground]
    return finish(
        folder,
        objects,
        used,
        frame,
        {
            "buildings": len(footprints),
            **footprints.repairs,
            **({"sharing ground with another, cut": cut} if cut else {}),
            **(terrain.repairs if terrain is not None else {}),
        },
        {source: names for source, names in footprints.guessed().items() if names},
    )


def finish(
    folder: Path,
    objects: Sequence[MeshObject],
    materials: Sequence[SurfaceMaterial],
    frame: Frame | None,
    counts: Mapping[str, int],
    guessed: Mapping[str, Sequence[str]],
) -> Made:
    """Write a scene and what was assumed.

    Args:
        folder: Where to write.
        objects: Its meshes.
        materials: Their materials, and perhaps more; of one name there is one.
        frame: Where it lies on the globe, if that is known.
        counts: What there is in it.
        guessed: The buildings whose height is a guess.

    Returns:
        What was made.

    Raises:
        InputError: Two different materials, or a material and a mesh, have one name.
    """
    used = {item.material for item in objects}
    constants: dict[str, Mapping[str, float | str]] = {}
    for material in materials:
        if constants.setdefault(material.name, material.constants()) != material.constants():
            raise InputError(
                f"material {material.name!r}: is given twice with other constants; use another name"
            )
    if clash := sorted({item.name for item in objects} & set(constants)):
        raise InputError(
            f"material {clash[0]!r}: a mesh has the same name, which Sionna RT refuses; use another"
        )
    triangles = dict.fromkeys(sorted(used), 0)
    for item in objects:
        triangles[item.material] += len(item.mesh.faces)
    corners = np.array([[item.mesh.vertices.min(axis=0), item.mesh.vertices.max(axis=0)] for item in objects])
    bounds = [*corners[:, 0].min(axis=0).tolist(), *corners[:, 1].max(axis=0).tolist()]
    path = write_scene(
        folder,
        objects,
        {name: values for name, values in constants.items() if name in used},
        None if frame is None else f"{_COMMENT}{frame}",
    )
    made = Made(path, frame, tuple(bounds), triangles, counts, guessed)
    write_text(folder / "scene.json", json.dumps(made.record(), indent=2) + "\n")
    return made


def read_frame(path: str | Path) -> Frame | None:
    """Where a scene lies on the globe, as its file says.

    Args:
        path: The XML file of a scene that Calibray made.

    Returns:
        The frame, or None if the file does not say.

    Raises:
        InputError: What the file says is no frame.
    """
    with Path(path).open(encoding="utf-8") as lines:
        head = lines.read(8192)
    found = re.search(f"<!-- {_COMMENT}(.*?) -->", head, re.DOTALL)
    if found is None:
        return None
    text = found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&").replace("- -", "--")
    try:
        return Frame.from_record(json.loads(text))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: its frame {text!r} is not JSON ({error}); make the scene again") from None


def _bases(footprints: Footprints, terrain: Terrain | None) -> NDArray[np.float64]:
    """Height of the ground that every building stands on [n], [m]: the lowest under its walls."""
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
    """One mesh a material, or a building and material, its name unlike that of any material."""
    names = [palette.of(kind).name for kind in range(4)]
    material = np.array(names)[shell.kind]
    place = align(shell.corners).placed
    if buildings is None:
        return [
            MeshObject(f"all-{name}", name, welded(shell.corners[material == name], MILLIMETRE, place))
            for name in sorted(set(material))
        ]
    order = np.lexsort((material, shell.owner))
    groups = np.flatnonzero(
        (np.diff(shell.owner[order]) != 0) | (material[order][1:] != material[order][:-1])
    )
    return [
        MeshObject(
            f"{buildings[int(shell.owner[rows[0]])]}-{material[rows[0]]}",
            str(material[rows[0]]),
            welded(shell.corners[rows], MILLIMETRE, place),
        )
        for rows in np.split(order, groups + 1)
    ]
