"""Scenes that Calibray makes: their materials, and one folder with `scene.xml`, its meshes and the assumptions."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements.column_names import without_accents
from calibray.scenes.meshes import MeshObject
from calibray.scenes.scene import ITU_NAMES, is_itu_name
from calibray.scenes.scene_file import write_scene
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_outputs, write_text

SCENE_FILES: Final = ("scene.xml", "scene.json")
"""What is written next to the meshes."""

THICKEST: Final = 100.0
"""Largest thickness of a material of a new scene [m]."""

_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


@dataclass(frozen=True)
class SurfaceMaterial:
    """A material of a new scene, with the constants of ITU-R P.2040.

    Attributes:
        name: Name of the material; not a name of ITU-R P.2040, because Sionna RT reserves these.
        itu: Material of ITU-R P.2040 that gives the constants.
        thickness: Thickness of the slab [m].

    Raises:
        InputError: The name is an ITU name or has characters other than letters, digits, `_` and `-`; there is no such
            ITU material; or the thickness is not greater than 0 and at most `THICKEST`.
    """

    name: str
    itu: str
    thickness: float

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise InputError(f"material {self.name!r}: must be letters, digits, '_' and '-', a letter first")
        if is_itu_name(self.name):
            suggestion = f"{self.name.removeprefix('itu_').removeprefix('itu-')}_wall"
            raise InputError(
                f"material {self.name!r}: is a name of ITU-R P.2040, which Sionna RT reserves; name it "
                f"{suggestion!r}, for example"
            )
        if self.itu not in ITU_NAMES:
            raise InputError(
                f"material {self.name}: ITU-R P.2040 has no {self.itu!r}; {did_you_mean(self.itu, sorted(ITU_NAMES))}"
            )
        if not 0 < self.thickness <= THICKEST:
            raise InputError(
                f"material {self.name}: thickness = {self.thickness!r} must be greater than 0 and at most "
                f"{THICKEST:g} m"
            )

    def constants(self) -> dict[str, float | str]:
        """The constants in the form of a scene file."""
        return {"type": self.itu, "thickness": self.thickness}


def material_name(kind: str) -> str:
    """The name of a material for a type of wall, whose name may have any characters.

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
        wall: Walls.
        window: Windows.
        roof: Roofs and undersides; None for the walls' material, which makes eaves diffract.
        ground: The ground.
    """

    wall: SurfaceMaterial = SurfaceMaterial("walls", "concrete", 0.3)
    window: SurfaceMaterial = SurfaceMaterial("windows", "glass", 0.02)
    roof: SurfaceMaterial | None = SurfaceMaterial("roofs", "concrete", 0.3)
    ground: SurfaceMaterial = SurfaceMaterial("ground", "concrete", 1.0)


@dataclass(frozen=True)
class MadeScene:
    """A scene that Calibray made.

    Attributes:
        path: Its XML file.
        frame: Position on the globe; None if unknown.
        bounds: West, south, bottom, east, north and top [6], [m].
        triangles: Number of triangles by material.
        counts: Number of objects used, repaired or left out, by kind.
        guessed: The buildings whose height is assumed, by the source of the assumption.
        walls: How the lines of a floor plan were used.
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
    """Bounds of objects, in the order of `MadeScene.bounds`, and their number of triangles by material."""
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
    """Write a scene and the assumptions made; with `overwrite`, replace files that Calibray did not write.

    Other materials and repeated ones are ignored.

    Raises:
        InputError: Two different materials, or a material and a mesh, have the same name; or a file must not be
            replaced.
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
