"""A scene exported with other constants, for Sionna RT or any other reader of Mitsuba scenes."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path
from shutil import copyfile

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes.scene import TRACED, Scene, is_itu_name, material_element
from calibray.scenes.scene_file import MESHES, plain_name, unique_names
from calibray.support.output_files import check_outputs, replacing, write_text


def export_scene(
    scene: Scene,
    materials: Mapping[str, Material],
    target: Path,
    copy_meshes: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a scene file with other constants; it refers to the original meshes or to copies.

    Materials and objects get names that Sionna RT accepts (`exported_names`). Sionna's scene files support the
    Lambertian scattering pattern only; set another pattern after loading the scene.

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
    names = exported_names(materials)
    exported = {f"{TRACED}{index}": f"mat-{names[name]}" for index, name in enumerate(scene.materials)}
    object_names = unique_names(
        (item.name or "object" for item in scene.objects), set(names.values()), "object"
    )
    copies: dict[str, Path] = {}
    for shape, name in zip(root.findall("shape"), object_names, strict=True):
        shape.set("id", f"mesh-{name}")
        for reference in shape.findall("ref"):
            reference.set("id", exported[reference.get("id", "")])
        filename = shape.find("string[@name='filename']")
        if filename is not None:
            mesh = (scene.path.parent / filename.get("value", "")).resolve()
            if copy_meshes:
                mesh = _copy(mesh, target.parent.resolve() / MESHES, copies, overwrite)
            filename.set("value", os.path.relpath(mesh, target.parent.resolve()))
    for index, (name, material) in enumerate(materials.items()):
        root.insert(index, material_element(f"mat-{names[name]}", material))
    ElementTree.indent(root)
    write_text(target, ElementTree.tostring(root, encoding="unicode") + "\n")


def exported_names(names: Iterable[str]) -> dict[str, str]:
    """The names of materials in an exported scene: letters, digits, `_` and `-`, and no name twice.

    Sionna RT refuses a plain `radio-material` with an ITU name, so this name becomes `calibrated-NAME`. Mitsuba
    misreads names with dots, quotes or line breaks.

    Example:
        >>> exported_names(["stone", "concrete", "brick.old", "brick old"])
        {'stone': 'stone', 'concrete': 'calibrated-concrete', 'brick.old': 'brick_old', 'brick old': 'brick_old-2'}
    """
    listed = list(names)
    plain = (f"calibrated-{name}" if is_itu_name(plain_name(name)) else name for name in listed)
    return dict(zip(listed, unique_names(plain, set(), "material"), strict=True))


def _copy(mesh: Path, folder: Path, copies: dict[str, Path], overwrite: bool) -> Path:
    """Copy a mesh; meshes of the same name from different folders get numbers."""
    stem, number = plain_name(mesh.stem), 1
    name = f"{stem}{mesh.suffix}"
    while copies.setdefault(name, mesh) != mesh:
        number += 1
        name = f"{stem}-{number}{mesh.suffix}"
    if folder.is_symlink():
        raise InputError(f"{folder}: is a link; remove it, or export into another folder")
    if (folder / name).exists() and (folder / name).samefile(mesh):
        return mesh
    check_outputs(folder, [name], [mesh], overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / name) as partial:
        copyfile(mesh, partial)
    return folder / name
