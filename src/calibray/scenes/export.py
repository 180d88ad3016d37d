"""A scene exported with other constants, for Sionna RT or any other reader of Mitsuba scenes."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from shutil import copyfile

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes.scene import TRACED, Scene, is_itu_name, material_element
from calibray.scenes.scene_file import MESHES
from calibray.support.output_files import check_outputs, replacing, write_text


def export_scene(
    scene: Scene,
    materials: Mapping[str, Material],
    target: Path,
    copy_meshes: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a scene file with other constants; it refers to the original meshes or to copies.

    Sionna RT refuses a plain `radio-material` with an ITU name, so such a material becomes `calibrated-NAME`. Sionna's
    scene files support the Lambertian scattering pattern only; set another pattern after loading the scene.

    Args:
        scene: The scene as it was read.
        materials: Constants by material name.
        target: File to write.
        copy_meshes: Whether to copy the meshes next to the file, so that the folder is complete.
        overwrite: Let copies replace files that Calibray did not write; meshes of the scene are never replaced.

    Raises:
        InputError: A material of the scene is missing, or a copy would replace a protected file.
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
    exported = {f"{TRACED}{index}": exported_id(name) for index, name in enumerate(scene.materials)}
    copies: dict[str, Path] = {}
    for shape in root.findall("shape"):
        for reference in shape.findall("ref"):
            reference.set("id", exported[reference.get("id", "")])
        filename = shape.find("string[@name='filename']")
        if filename is not None:
            mesh = (scene.path.parent / filename.get("value", "")).resolve()
            if copy_meshes:
                mesh = _copy(mesh, target.parent.resolve() / MESHES, copies, overwrite)
            filename.set("value", os.path.relpath(mesh, target.parent.resolve()))
    for index, (name, material) in enumerate(materials.items()):
        root.insert(index, material_element(exported_id(name), material))
    ElementTree.indent(root)
    write_text(target, ElementTree.tostring(root, encoding="unicode") + "\n")


def exported_id(name: str) -> str:
    """The id of a material in an exported scene.

    Args:
        name: The material's name.

    Returns:
        `mat-NAME`, so that Sionna RT calls the material NAME; `mat-calibrated-NAME` for an ITU name.
    """
    return f"mat-calibrated-{name}" if is_itu_name(name) else f"mat-{name}"


def _copy(mesh: Path, folder: Path, copies: dict[str, Path], overwrite: bool) -> Path:
    """Copy a mesh; meshes of the same name from different folders get numbers."""
    name, number = mesh.name, 1
    while copies.setdefault(name, mesh) != mesh:
        number += 1
        name = f"{mesh.stem}-{number}{mesh.suffix}"
    if folder.is_symlink():
        raise InputError(f"{folder}: is a link; remove it, or export into another folder")
    if (folder / name).exists() and (folder / name).samefile(mesh):
        return mesh
    check_outputs(folder, [name], [mesh], overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / name) as partial:
        copyfile(mesh, partial)
    return folder / name
