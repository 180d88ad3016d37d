"""Scenes: a Mitsuba XML file read into materials and objects, and written again in the form that the tracer takes.

Every surface material becomes one of Sionna's plain `radio-material`s with constants and a name of our own choosing.
That keeps the constants in one place (`Material`), lets a frequency lie outside an ITU table when the study gives the
constants itself (NVlabs/sionna-rt#71, #72), and steps around Sionna's rules on names (an ITU name needs the prefix
`itu_`, an object may not be called like a material).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from calibray.errors import InputError
from calibray.materials import (
    BOUNDS,
    DEFAULT_REVISION,
    ItuLaw,
    Material,
    itu_law,
    itu_material,
)
from calibray.parameters.laws import frequency_independent_law
from calibray.scenes.scene_file import check_files, check_shape, parse, scene_path
from calibray.support.messages import did_you_mean

DEFAULT_THICKNESS: Final = 0.1
"""Sionna's default for a material without one [m]."""

TRACED: Final = "mat-calibray-"
"""What the ids of materials begin with in a scene for the tracer; their place in `Scene.materials` follows."""

_MATERIAL_FIELDS: Final = frozenset(entry.name for entry in fields(Material))


@dataclass(frozen=True)
class SceneObject:
    """One mesh of a scene.

    Attributes:
        name: Its id without the prefix `mesh-`.
        material: Name of its material.
    """

    name: str
    material: str


@dataclass(frozen=True)
class Scene:
    """A scene as read from its file.

    Attributes:
        source: What the user named: a path or `sionna:NAME`.
        path: The XML file [path].
        materials: The materials that some object uses, by name, at the frequency the scene was read for.
        objects: The meshes, in the file's order.
        xml: The scene for the tracer; material k of `materials` is the BSDF `calibray-k`.
        laws: How the constants of each material follow the frequency: ITU-R's law where ITU-R gives them, else not.
    """

    source: str
    path: Path
    materials: dict[str, Material]
    objects: tuple[SceneObject, ...]
    xml: str
    laws: dict[str, ItuLaw] = field(default_factory=dict)


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
        overrides: Constants in place of the file's, by material name: a `Material`, or a mapping with any of its
            fields, or with `itu` (and `revision`) naming an ITU-R P.2040 material.
        split: Materials to be made for some objects, by name: a pattern of the objects' names, with `*` for any
            text. A name that ends in `*` makes one material for every object, `*` replaced by the object's name.

    Returns:
        The scene.

    Raises:
        InputError: The file does not exist or is no Mitsuba scene, a mesh is missing, a material has no radio
            constants, an override names no material of the scene, a pattern matches no object or objects of
            different materials, or a frequency lies outside an ITU range.
    """
    overrides, split = dict(overrides or {}), dict(split or {})
    path = scene_path(str(source))
    root = parse(path, str(source))
    definitions = _bsdf_definitions(root)
    objects: list[SceneObject] = []
    materials: dict[str, Material] = {}
    laws: dict[str, ItuLaw] = {}
    origin: dict[str, str] = {}
    order: dict[str, int] = {}
    for shape in root.findall("shape"):
        check_shape(shape, path)
        original, name = _materials_of(shape, definitions, split, path)
        if origin.setdefault(name, original) != original:
            raise InputError(
                f"[objects] {name}: its objects have the materials {origin[name]!r} and {original!r}; "
                "name one material for each"
            )
        if name not in materials:
            constants = _merged(overrides.get(original), overrides.get(name) if name != original else None)
            bsdf = definitions.get(original)
            materials[name] = _material(name, original, bsdf, constants, frequency, path)
            laws[name] = _law(materials[name], original, bsdf, constants, frequency)
        _refer(shape, f"{TRACED}{order.setdefault(name, len(order))}")
        objects.append(SceneObject(_object_name(shape), name))
    if not objects:
        raise InputError(f"{path}: the scene has no <shape>; export the scene with its meshes")
    for name, pattern in split.items():
        if not any(fnmatchcase(entry.name, pattern) for entry in objects):
            known = [entry.name for entry in objects]
            raise InputError(
                f"[objects] {name} = {pattern!r}: matches no object; {did_you_mean(pattern, known)}"
            )
    for name in overrides:
        check_material_name(name, {**materials, **dict.fromkeys(origin.values())}, f"[materials] {name}")
    for bsdf in root.findall("bsdf"):
        root.remove(bsdf)
    check_files(root, path)
    for index, material in enumerate(materials.values()):
        root.insert(index, material_element(f"{TRACED}{index}", material))
    xml = ElementTree.tostring(root, encoding="unicode")
    return Scene(str(source), path, materials, tuple(objects), xml, laws)


def check_material_name(name: str, materials: Mapping[str, object], place: str) -> None:
    """Refuse a material that a scene lacks.

    Args:
        name: The name to look for.
        materials: The scene's materials by name.
        place: Where the name stands, for the message.

    Raises:
        InputError: There is no such material; the message offers the nearest name.
    """
    if name in materials:
        return
    raise InputError(f"{place}: the scene has no material {name!r}; {did_you_mean(name, materials)}")


def _bsdf_definitions(root: ElementTree.Element) -> dict[str, ElementTree.Element]:
    found = [*root.findall("bsdf"), *root.findall("shape/bsdf")]
    return {_material_name(bsdf): bsdf for bsdf in found}


def _material_name(bsdf: ElementTree.Element) -> str:
    return (bsdf.get("id") or bsdf.get("name") or "").removeprefix("mat-")


def _shape_material(
    shape: ElementTree.Element, definitions: dict[str, ElementTree.Element], path: Path
) -> str:
    name = shape.get("id") or "?"
    nested = shape.find("bsdf")
    if nested is not None:
        return _material_name(nested)
    references = [ref.get("id", "").removeprefix("mat-") for ref in shape.findall("ref")]
    material = next((reference for reference in references if reference in definitions), None)
    if material is None:
        raise InputError(f"{path}: shape {name!r} refers to no <bsdf> of the scene; give it a material")
    return material


def _object_name(shape: ElementTree.Element) -> str:
    return (shape.get("id") or "").removeprefix("mesh-")


def _materials_of(
    shape: ElementTree.Element,
    definitions: dict[str, ElementTree.Element],
    split: Mapping[str, str],
    path: Path,
) -> tuple[str, str]:
    """Material of an object in the file, and the one it gets: the first of `split` that matches, else the same."""
    original, name = _shape_material(shape, definitions, path), _object_name(shape)
    own = next((own for own, pattern in split.items() if fnmatchcase(name, pattern)), None)
    if own is None:
        return original, original
    own = own[:-1] + name if own.endswith("*") else own
    if own in definitions:
        raise InputError(
            f"[objects] {own}: the scene has a material of that name already; choose another name"
        )
    return original, own


def _merged(
    base: Material | Mapping[str, object] | None, more: Material | Mapping[str, object] | None
) -> Material | Mapping[str, object] | None:
    """The constants given for a material, those for some of its objects put over those for all."""
    if more is None or isinstance(more, Material) or base is None:
        return base if more is None else more
    if isinstance(base, Material):
        return {**{name: getattr(base, name) for name in _MATERIAL_FIELDS}, **more}
    return {**base, **more}


def _material(
    name: str,
    original: str,
    bsdf: ElementTree.Element | None,
    override: Material | Mapping[str, object] | None,
    frequency: float,
    path: Path,
) -> Material:
    """The constants of one material: the override's where it gives them, else the file's."""
    if isinstance(override, Material):
        return override
    given = {key: value for key, value in (override or {}).items() if value is not None}
    itu, revision = given.pop("itu", None), given.pop("revision", DEFAULT_REVISION)
    unknown = set(given) - _MATERIAL_FIELDS
    if unknown:
        raise InputError(
            f"[materials] {name}: unknown key {sorted(unknown)[0]!r}; known: {sorted(_MATERIAL_FIELDS)}"
        )
    try:
        if itu is not None:
            base = itu_material(str(itu), frequency, DEFAULT_THICKNESS, revision=str(revision))
            return replace(base, **{**_slab(bsdf), **given})
        if {"relative_permittivity", "conductivity"} <= set(given):
            return Material(**{"thickness": DEFAULT_THICKNESS, **_slab(bsdf), **given})
        return replace(_file_material(original, bsdf, frequency), **given)
    except InputError as error:
        raise InputError(f"{path}: material {name!r}: {error}") from None


def _law(
    material: Material,
    original: str,
    bsdf: ElementTree.Element | None,
    override: Material | Mapping[str, object] | None,
    frequency: float,
) -> ItuLaw:
    """How a material's constants follow the frequency: those given as numbers do not."""
    steady = frequency_independent_law(material)
    if isinstance(override, Material):
        return steady
    given = {key: value for key, value in (override or {}).items() if value is not None}
    itu, revision = given.get("itu", _itu_type(original, bsdf)), given.get("revision", DEFAULT_REVISION)
    if itu is None or {"relative_permittivity", "conductivity"} <= set(given):
        return steady
    law = itu_law(str(itu), frequency, str(revision))
    if "relative_permittivity" in given:
        law = law._replace(a=steady.a, b=0.0)
    return law._replace(c=steady.c, d=0.0) if "conductivity" in given else law


def _file_material(name: str, bsdf: ElementTree.Element | None, frequency: float) -> Material:
    kind = bsdf.get("type") if bsdf is not None else None
    itu_type = _itu_type(name, bsdf)
    if itu_type is not None:
        base = itu_material(itu_type, frequency, _floats(bsdf).get("thickness", DEFAULT_THICKNESS))
        return replace(base, **_slab(bsdf))
    if kind == "radio-material":
        return replace(Material(1.0, 0.0, DEFAULT_THICKNESS), **_floats(bsdf))
    raise InputError(
        f"its BSDF of type {kind!r} has no radio constants; give relative_permittivity and conductivity (or itu) "
        f"in [materials], or name it mat-itu_..."
    )


def _itu_type(name: str, bsdf: ElementTree.Element | None) -> str | None:
    """The ITU name that Sionna reads from a BSDF: its `type` string, or its own name after `itu_`."""
    named = name.startswith(("itu_", "itu-"))
    declared = None if bsdf is None else bsdf.find("string[@name='type']")
    if bsdf is not None and declared is not None and (named or bsdf.get("type") == "itu-radio-material"):
        return declared.get("value")
    return name[4:] if named else None


def _floats(bsdf: ElementTree.Element | None) -> dict[str, float]:
    if bsdf is None:
        return {}
    found = {}
    for element in bsdf.findall("float"):
        name, value = element.get("name", ""), element.get("value")
        if name in _MATERIAL_FIELDS:
            try:
                found[name] = float(value or "")
            except ValueError:
                raise InputError(f"{name} = {value!r}: must be {BOUNDS[name]}") from None
    return found


def _slab(bsdf: ElementTree.Element | None) -> dict[str, float]:
    constants = _floats(bsdf)
    return {key: constants[key] for key in constants if key not in ("relative_permittivity", "conductivity")}


def _refer(shape: ElementTree.Element, identifier: str) -> None:
    for child in [*shape.findall("ref"), *shape.findall("bsdf")]:
        shape.remove(child)
    ElementTree.SubElement(shape, "ref", {"id": identifier, "name": "bsdf"})


def material_element(identifier: str, material: Material) -> ElementTree.Element:
    """The BSDF of a material: the constants that Sionna's scene files know.

    Args:
        identifier: Its id.
        material: The constants.

    Returns:
        The XML element.
    """
    bsdf = ElementTree.Element("bsdf", {"type": "radio-material", "id": identifier})
    for name in (
        "relative_permittivity",
        "conductivity",
        "thickness",
        "scattering_coefficient",
        "xpd_coefficient",
    ):
        ElementTree.SubElement(bsdf, "float", {"name": name, "value": repr(getattr(material, name))})
    return bsdf
