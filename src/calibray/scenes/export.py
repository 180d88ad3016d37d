"""A scene written with other constants, for Sionna RT or whatever else reads Mitsuba scenes."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from shutil import copyfile
from typing import Final

from calibray.errors import InputError
from calibray.materials import ITU_MATERIALS, Material
from calibray.scenes.scene import TRACED, Scene, material_element
from calibray.support.output_files import check_replaceable, replacing, write_text

MESHES: Final = "meshes"
"""The folder that copies of meshes are put into, beside the scene file."""


def export_scene(
    scene: Scene,
    materials: Mapping[str, Material],
    target: Path,
    copy_meshes: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a scene file with other constants; it refers to the meshes of the original, or to copies.

    Sionna RT refuses a plain `radio-material` under an ITU name, so such a material becomes `calibrated-NAME`. Its
    scene files know no scattering pattern but the Lambertian one; another has to be set by who loads the scene.

    Args:
        scene: The scene as it was read.
        materials: Constants by material name.
        target: File to write.
        copy_meshes: Whether the meshes are copied beside the file, so that the folder can be given away.
        overwrite: Let copies replace files that Calibray did not write; meshes of the scene are never replaced.

    Raises:
        InputError: A material of the scene is missing, or a copy must not take a file's place.
        OSError: A file cannot be written.
    """
    missing = [name for name in scene.materials if name not in materials]
    if missing:
        raise InputError(
            f"{scene.path}: there are no constants for the material {missing[0]!r}; export all of them"
        )
    root = ElementTree.fromstring(scene.xml)
    for bsdf in root.findall("bsdf"):
        root.remove(bsdf)
    written = {f"{TRACED}{index}": exported_id(name) for index, name in enumerate(scene.materials)}
    copies: dict[str, Path] = {}
    for shape in root.findall("shape"):
        for reference in shape.findall("ref"):
            reference.set("id", written[reference.get("id", "")])
        filename = shape.find("string[@name='filename']")
        if filename is not None:
            mesh = (scene.path.parent / filename.get("value", "")).resolve()
            if copy_meshes:
                mesh = _copied(mesh, target.parent.resolve() / MESHES, copies, overwrite)
            filename.set("value", os.path.relpath(mesh, target.parent.resolve()))
    for index, (name, material) in enumerate(materials.items()):
        root.insert(index, material_element(exported_id(name), material))
    ElementTree.indent(root)
    write_text(target, ElementTree.tostring(root, encoding="unicode") + "\n")


def exported_id(name: str) -> str:
    """The id under which a material is written.

    Args:
        name: Its name.

    Returns:
        `mat-` and its name, which Sionna RT calls it by.
    """
    return f"mat-calibrated-{name}" if _is_itu_name(name) else f"mat-{name}"


def _copied(mesh: Path, folder: Path, copies: dict[str, Path], overwrite: bool) -> Path:
    """A copy of a mesh; meshes of one name from different folders get numbers."""
    name, number = mesh.name, 1
    while copies.setdefault(name, mesh) != mesh:
        number += 1
        name = f"{mesh.stem}-{number}{mesh.suffix}"
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / name).exists() and (folder / name).samefile(mesh):
        return mesh
    check_replaceable(folder / name, [mesh], overwrite)
    with replacing(folder / name) as partial:
        copyfile(mesh, partial)
    return folder / name


def _is_itu_name(name: str) -> bool:
    names = {known for table in ITU_MATERIALS.values() for known in table}
    return name in names or name.startswith(("itu_", "itu-"))
