"""Scenes: reading the materials and objects of a Mitsuba XML file, and rewriting the file for the tracer.

In the file for the tracer, each surface material is a plain Sionna `radio-material` with explicit constants and a name
that Calibray chooses. All constants are therefore in one place (`Material`), and a study that gives the constants can
use frequencies outside the range of an ITU law (NVlabs/sionna-rt#71, #72). The chosen names also avoid conflicts with
Sionna's naming rules: an ITU name needs the prefix `itu_`, and an object must not have the name of a material.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from glob import escape
from pathlib import Path
from shutil import copyfile
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import (
    BOUNDS,
    DEFAULT_REVISION,
    ITU_MATERIALS,
    SCALAR_CONSTANTS,
    ItuLaw,
    Material,
    frequency_independent_law,
    itu_law,
    itu_material,
    law_with_stated,
)
from calibray.scenes.scene_file import (
    MESHES,
    frame_comment,
    keep_traced_elements,
    parse,
    plain_name,
    read_frame,
    scene_path,
    unique_names,
)
from calibray.scenes.shapes import SurfaceSize, local_origin, read_surface, write_local_shape
from calibray.support.messages import did_you_mean, shortened
from calibray.support.output_files import check_outputs, replacing, write_text
from calibray.tables import hertz

DEFAULT_THICKNESS: Final = 0.1
"""Sionna RT's default thickness of a material [m]."""

TRACED: Final = "mat-calibray-"
"""Prefix of material ids in the scene for the tracer, followed by the index in `Scene.materials`."""

ITU_NAMES: Final = frozenset(name for table in ITU_MATERIALS.values() for name in table)
"""Names of the materials in all revisions of ITU-R P.2040; Sionna RT reserves these names."""

_MATERIAL_FIELDS: Final = frozenset(entry.name for entry in fields(Material))
_BULK_FIELDS: Final = frozenset({"relative_permittivity", "conductivity"})


@dataclass(frozen=True)
class SceneObject:
    """A mesh of a scene: its id without the prefix `mesh-`, and the name of its material."""

    name: str
    material: str


@dataclass(frozen=True)
class Scene:
    """A scene as read from its file.

    Attributes:
        source: The scene as the user named it: a path or `sionna:NAME`.
        path: The XML file.
        materials: The materials that objects use, by name, with their constants at `frequency`.
        objects: The meshes, in file order.
        xml: XML of the scene for the tracer; the id of material k of `materials` is `mat-calibray-k`.
        laws: Frequency law of each material: the law of ITU-R P.2040 for an ITU material, otherwise a constant law.
        sizes: Bounds and size of each object.
        frequency: The frequency for which the scene was read [Hz]; None if the constants are valid at all frequencies.
    """

    source: str
    path: Path
    materials: dict[str, Material]
    objects: tuple[SceneObject, ...]
    xml: str
    laws: dict[str, ItuLaw] = field(default_factory=dict)
    sizes: tuple[SurfaceSize, ...] = ()
    frequency: float | None = None

    @property
    def local_origin(self) -> NDArray[np.float64]:
        """Origin of the frame in which the scene is traced [3], [m]; zero if the scene is near (0, 0, 0)."""
        return local_origin(self.sizes)

    def check_frequency(self, frequency: float) -> None:
        """Refuse a frequency [Hz] at which the constants are not valid.

        Raises:
            InputError: The scene was read for a different frequency, and its constants depend on frequency.
        """
        if self.frequency is not None and frequency != self.frequency:
            raise InputError(
                f"scene {self.source}: its constants are valid only at {hertz(self.frequency)}; read it at "
                f"{hertz(frequency)} with read_scene"
            )


def read_scene(
    source: str | Path,
    frequency: float,
    overrides: Mapping[str, Material | Mapping[str, object]] | None = None,
    split: Mapping[str, str] | None = None,
) -> Scene:
    """Read a Mitsuba XML scene and the constants of its materials.

    Args:
        source: Path of the XML file, or `sionna:NAME` for a scene bundled with Sionna RT.
        frequency: Carrier frequency [Hz], at which ITU materials are evaluated.
        overrides: Constants, by material name, that replace the constants in the file: a `Material`, or a mapping of
            its fields. The mapping can also contain `itu`, an ITU-R P.2040 material, and `revision`, which applies to
            `itu` or to the ITU material in the file.
        split: Separate materials for certain objects: a mapping from the name of each new material to a pattern of
            object names, in which `*` matches any text. If the material name ends in `*`, each object gets its own
            material, with `*` replaced by the object's name.

    Raises:
        InputError: The file does not exist or is not a Mitsuba scene, or a mesh is missing or malformed. A material has
            no radio constants, or an override is for a material that is not in the scene. A pattern matches no object,
            or matches objects with different materials. The frequency is outside the range of an ITU law.
    """
    overrides, split = dict(overrides or {}), dict(split or {})
    path = scene_path(str(source))
    root = parse(path, str(source))
    keep_traced_elements(root, path)
    definitions = _definitions(root, path)
    objects: list[SceneObject] = []
    materials: dict[str, Material] = {}
    laws: dict[str, ItuLaw] = {}
    index: dict[str, int] = {}
    originals: dict[str, str] = {}  # material in the file, by name of the material that the objects get
    sizes: list[SurfaceSize] = []
    for shape in root.findall("shape"):
        sizes.append(SurfaceSize.of(read_surface(shape, path)))
        object_name = (shape.get("id") or "").removeprefix("mesh-")
        original = _file_material_name(shape, definitions, path)
        name = _split_name(object_name, split, definitions) or original
        if originals.setdefault(name, original) != original:
            raise InputError(
                f"[objects] {name}: its objects have the materials {originals[name]!r} and {original!r}; "
                "use a separate entry for each material"
            )
        if name not in materials:
            constants = _merge(overrides.get(original), overrides.get(name) if name != original else None)
            materials[name], laws[name] = _material(
                name, original, definitions.get(original), constants, frequency, path
            )
        for child in [*shape.findall("ref"), *shape.findall("bsdf")]:
            shape.remove(child)
        reference = {"id": f"{TRACED}{index.setdefault(name, len(index))}", "name": "bsdf"}
        ElementTree.SubElement(shape, "ref", reference)
        objects.append(SceneObject(object_name, name))
    if not objects:
        raise InputError(f"{path}: the scene has no <shape>; export the scene with its meshes")
    object_names = [entry.name for entry in objects]
    for name, pattern in split.items():
        if not any(_matches(object_name, pattern) for object_name in object_names):
            raise InputError(
                f"[objects] {name} = {pattern!r}: matches no object; {did_you_mean(pattern, object_names)}"
            )
    for name in overrides:
        check_material_name(name, {**materials, **dict.fromkeys(originals.values())}, f"[materials] {name}")
    for bsdf in root.findall("bsdf"):
        root.remove(bsdf)
    for number, material in enumerate(materials.values()):
        root.insert(number, material_element(f"{TRACED}{number}", material))
    xml = ElementTree.tostring(root, encoding="unicode")
    valid_at = frequency if any(law.b or law.d for law in laws.values()) else None
    return Scene(str(source), path, materials, tuple(objects), xml, laws, tuple(sizes), valid_at)


def has_copied_meshes(scene: Scene) -> bool:
    """Whether the tracer reads copies of meshes, because of a local frame or a shape that the tracer would misread."""
    return bool(scene.local_origin.any()) or any(size.misread for size in scene.sizes)


def xml_with_copied_meshes(scene: Scene, folder: Path) -> str:
    """Write copies of the meshes in the local frame to a folder, and make the XML with which the tracer loads them.

    Raises:
        InputError: A mesh cannot be copied.
    """
    origin = scene.local_origin
    root = ElementTree.fromstring(scene.xml)
    for number, (shape, size) in enumerate(zip(root.findall("shape"), scene.sizes, strict=True)):
        if origin.any() or size.misread:
            write_local_shape(shape, scene.path, origin, folder / f"{number}.ply")
    return ElementTree.tostring(root, encoding="unicode")


def check_material_name(name: str, materials: Mapping[str, object], location: str) -> None:
    """Refuse a material that is not in a scene; `location` states where the user named the material.

    Raises:
        InputError: The material is not in the scene; the message suggests a similar name.
    """
    if name not in materials:
        raise InputError(f"{location}: the scene has no material {name!r}; {did_you_mean(name, materials)}")


def is_itu_name(name: str) -> bool:
    """Whether Sionna RT reserves a name, with or without the prefix `itu_`, for an ITU-R P.2040 material."""
    return name in ITU_NAMES or name.startswith(("itu_", "itu-"))


def _definitions(root: ElementTree.Element, path: Path) -> dict[str, ElementTree.Element]:
    """The materials that a scene defines, by name."""
    definitions: dict[str, ElementTree.Element] = {}
    for bsdf in [*root.findall("bsdf"), *root.findall("shape/bsdf")]:
        name = _material_name(bsdf)
        first = definitions.setdefault(name, bsdf)
        if ElementTree.canonicalize(ElementTree.tostring(first), strip_text=True) != ElementTree.canonicalize(
            ElementTree.tostring(bsdf), strip_text=True
        ):
            raise InputError(
                f"{path}: material {shortened(repr(name))} is defined twice, with different constants; "
                "rename one of them"
            )
    return definitions


def _material_name(bsdf: ElementTree.Element) -> str:
    return (bsdf.get("id") or bsdf.get("name") or "").removeprefix("mat-")


def _file_material_name(
    shape: ElementTree.Element, definitions: Mapping[str, ElementTree.Element], path: Path
) -> str:
    """The name of the material that the file assigns to an object."""
    nested = shape.find("bsdf")
    if nested is not None:
        return _material_name(nested)
    references = [reference.get("id", "").removeprefix("mat-") for reference in shape.findall("ref")]
    material = next((reference for reference in references if reference in definitions), None)
    if material is None:
        raise InputError(
            f"{path}: shape {shape.get('id') or '?'!r} refers to no <bsdf> of the scene; give it a material"
        )
    return material


def _matches(object_name: str, pattern: str) -> bool:
    # Only `*` is a wildcard, because object names may contain brackets and question marks.
    return fnmatchcase(object_name, escape(pattern).replace("[*]", "*"))


def _split_name(
    object_name: str, split: Mapping[str, str], definitions: Mapping[str, ElementTree.Element]
) -> str | None:
    """Name of an object's separate material, from the first pattern that matches; None if no pattern matches."""
    name = next((name for name, pattern in split.items() if _matches(object_name, pattern)), None)
    if name is None:
        return None
    name = name[:-1] + object_name if name.endswith("*") else name
    if name in definitions:
        raise InputError(
            f"[objects] {name}: the scene already has a material with this name; choose another name"
        )
    return name


def _merge(
    base: Material | Mapping[str, object] | None, specific: Material | Mapping[str, object] | None
) -> Material | Mapping[str, object] | None:
    """Merge the constants of a material with the constants given for some of its objects, which take precedence."""
    if specific is None or isinstance(specific, Material) or base is None:
        return base if specific is None else specific
    if isinstance(base, Material):
        base = {name: getattr(base, name) for name in _MATERIAL_FIELDS}
    return {**base, **specific}


def _material(
    name: str,
    original: str,
    bsdf: ElementTree.Element | None,
    override: Material | Mapping[str, object] | None,
    frequency: float,
    path: Path,
) -> tuple[Material, ItuLaw]:
    """The constants of a material and their frequency law; the override takes precedence over the file."""
    if isinstance(override, Material):
        return override, frequency_independent_law(override)
    constants = {key: value for key, value in (override or {}).items() if value is not None}
    itu, revision = constants.pop("itu", None), constants.pop("revision", DEFAULT_REVISION)
    unknown = set(constants) - _MATERIAL_FIELDS
    if unknown:
        raise InputError(
            f"[materials] {name}: unknown key {sorted(unknown)[0]!r}; known: {sorted(_MATERIAL_FIELDS)}"
        )
    bulk_given = set(constants) >= _BULK_FIELDS
    try:
        if itu is not None:
            base = itu_material(str(itu), frequency, DEFAULT_THICKNESS, revision=str(revision))
            material = replace(base, **{**_slab(bsdf), **constants})
        elif bulk_given:
            material = Material(**{"thickness": DEFAULT_THICKNESS, **_slab(bsdf), **constants})
        else:
            material = replace(_file_material(original, bsdf, frequency, str(revision)), **constants)
    except InputError as error:
        raise InputError(f"{path}: material {name!r}: {error}") from None
    itu = _itu_type(original, bsdf) if itu is None else itu
    if itu is None or bulk_given:
        return material, frequency_independent_law(material)
    return material, law_with_stated(itu_law(str(itu), frequency, str(revision)), material, constants)


def _file_material(name: str, bsdf: ElementTree.Element | None, frequency: float, revision: str) -> Material:
    kind = bsdf.get("type") if bsdf is not None else None
    itu_type = _itu_type(name, bsdf)
    if itu_type is not None:
        return replace(itu_material(itu_type, frequency, DEFAULT_THICKNESS, revision), **_slab(bsdf))
    if kind == "radio-material":
        return replace(Material(1.0, 0.0, DEFAULT_THICKNESS), **_floats(bsdf))
    raise InputError(
        f"its BSDF of type {kind!r} has no radio constants; give relative_permittivity and conductivity (or itu) "
        f"in [materials], or name it mat-itu_..."
    )


def _itu_type(name: str, bsdf: ElementTree.Element | None) -> str | None:
    """The ITU name that Sionna derives from a BSDF: the BSDF's `type` string, or its name without the prefix `itu_`."""
    has_itu_name = name.startswith(("itu_", "itu-"))
    declared = None if bsdf is None else bsdf.find("string[@name='type']")
    if (
        bsdf is not None
        and declared is not None
        and (has_itu_name or bsdf.get("type") == "itu-radio-material")
    ):
        return declared.get("value")
    return name[4:] if has_itu_name else None


def _floats(bsdf: ElementTree.Element | None) -> dict[str, float]:
    """The numbers in a BSDF that are fields of a material."""
    constants = {}
    for element in [] if bsdf is None else bsdf.findall("float"):
        name, value = element.get("name", ""), element.get("value")
        if name in _MATERIAL_FIELDS:
            try:
                constants[name] = float(value or "")
            except ValueError:
                raise InputError(f"{name} = {value!r}: must be {BOUNDS[name]}") from None
    return constants


def _slab(bsdf: ElementTree.Element | None) -> dict[str, float]:
    """The numbers in a BSDF that describe the slab and its surface, but not the bulk medium."""
    return {key: value for key, value in _floats(bsdf).items() if key not in _BULK_FIELDS}


def material_element(identifier: str, material: Material) -> ElementTree.Element:
    """Make the BSDF of a material, with the constants that a Sionna scene file can contain."""
    bsdf = ElementTree.Element("bsdf", {"type": "radio-material", "id": identifier})
    for name in SCALAR_CONSTANTS:
        ElementTree.SubElement(bsdf, "float", {"name": name, "value": repr(getattr(material, name))})
    return bsdf


def export_scene(
    scene: Scene,
    materials: Mapping[str, Material],
    target: Path,
    copy_meshes: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a scene file with new constants in the same frame; the file refers to the original meshes or to copies.

    Materials and objects are given names that Sionna RT accepts (`exported_names`). Sionna scene files support only the
    Lambertian scattering pattern; set other patterns after loading the scene.

    Args:
        scene: The scene as it was read.
        materials: Constants by material name.
        target: File to write.
        copy_meshes: Whether to copy the meshes to a folder next to the file, so that the scene is self-contained.
        overwrite: Whether copies may replace files that Calibray did not write; the scene's own meshes are never
            replaced.

    Raises:
        InputError: A material of the scene has no constants, or a copy would replace a protected file.
        OSError: A file cannot be written.
    """
    missing = [name for name in scene.materials if name not in materials]
    if missing:
        raise InputError(
            f"{scene.path}: there are no constants for the material {missing[0]!r}; give constants for all materials"
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
    if scene.path.is_file() and (frame := read_frame(scene.path)) is not None:
        root.insert(0, ElementTree.Comment(frame_comment(frame)))
    ElementTree.indent(root)
    write_text(target, ElementTree.tostring(root, encoding="unicode") + "\n")


def exported_names(names: Iterable[str]) -> dict[str, str]:
    """Choose unique material names, made up of letters, digits, `_` and `-`, for an exported scene.

    Sionna RT refuses a plain `radio-material` with an ITU name, so an ITU name becomes `calibrated-NAME`. Mitsuba
    misreads names with dots, quotes or line breaks.

    Example:
        >>> exported_names(["stone", "concrete", "brick.old", "brick old"])
        {'stone': 'stone', 'concrete': 'calibrated-concrete', 'brick.old': 'brick_old', 'brick old': 'brick_old-2'}
    """
    listed = list(names)
    plain = (f"calibrated-{name}" if is_itu_name(plain_name(name)) else name for name in listed)
    return dict(zip(listed, unique_names(plain, set(), "material"), strict=True))


def _copy(mesh: Path, folder: Path, copies: dict[str, Path], overwrite: bool) -> Path:
    """Copy a mesh; copies of meshes from different folders that have the same name are numbered."""
    stem, number = plain_name(mesh.stem), 1
    name = f"{stem}{mesh.suffix}"
    while copies.setdefault(name, mesh) != mesh:
        number += 1
        name = f"{stem}-{number}{mesh.suffix}"
    if folder.is_symlink():
        raise InputError(f"{folder}: is a symbolic link; remove it, or export to another folder")
    if (folder / name).exists() and (folder / name).samefile(mesh):
        return mesh
    check_outputs(folder, [name], [mesh], overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / name) as partial:
        copyfile(mesh, partial)
    return folder / name
