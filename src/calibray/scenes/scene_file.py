"""The XML file of a scene: finding, parsing, checking and writing the file that a ray tracer reads."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape, quoteattr, unescape

import numpy as np

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.scenes.meshes import Mesh, MeshObject, ply_bytes, read_mesh
from calibray.support.messages import shortened
from calibray.support.output_files import check_outputs, exists, write_bytes, write_text

BUNDLED_PREFIX: Final = "sionna:"

SHAPES: Final = ("cube", "obj", "ply", "rectangle")
"""Types of shapes that consist of triangles. Mitsuba's compressed `serialized` meshes are refused, because their size
is known only after decompression."""

MESHES: Final = "meshes"
"""Folder for meshes, next to the scene file."""

MAX_DEPTH: Final = 64
"""Maximum nesting depth of elements in a scene file."""

_NOT_RADIO: Final = frozenset(
    (
        "default",
        "emitter",
        "film",
        "integrator",
        "medium",
        "phase",
        "sampler",
        "sensor",
        "spectrum",
        "texture",
    )
)
"""Elements of Mitsuba scenes that have no effect on radio waves."""

_PROPERTIES: Final[Mapping[str, tuple[str, ...]]] = {
    "boolean": tuple(
        ["face_normals", "flip_normals", "flip_tex_coords", "faceNormals", "flipNormals", "flipTexCoords"]
    ),
    "integer": ("shape_index", "shapeIndex"),
    "string": ("filename",),
    "transform": ("to_world", "toWorld"),
}
"""Names of shape properties, by type of element, as spelled in Mitsuba 3 and in earlier versions."""

_FRAME_COMMENT: Final = "calibray frame "


def plain_name(name: str) -> str:
    """Convert a name to a plain name for files and objects, with only letters, digits, `_` and `-`."""
    return re.sub(r"[^0-9A-Za-z_-]+", "_", name)


def unique_names(names: Iterable[str], taken: Collection[str] = (), kind: str = "_") -> list[str]:
    """Make names plain and unique: a repeated name becomes `NAME-2`, and a name in `taken` becomes `NAME-KIND`.

    Example:
        >>> unique_names(["Town hall", "Town/hall", '"><x'])
        ['Town_hall', 'Town_hall-2', '_x']
    """
    unique: list[str] = []
    used, numbers = set(taken), Counter[str]()
    for name in names:
        plain = plain_name(name)[:80] or kind
        candidate = f"{plain}-{kind}" if plain in taken else plain
        while candidate in used:
            numbers[plain] += 1
            candidate = f"{plain}-{numbers[plain] + 1}"
        used.add(candidate)
        unique.append(candidate)
    return unique


def scene_path(source: str) -> Path:
    """Find the XML file of a scene, given the path or, for a scene bundled with Sionna RT, `sionna:NAME`.

    Raises:
        InputError: There is no such file or bundled scene, or Sionna RT is not installed.
    """
    if source.startswith(BUNDLED_PREFIX):
        name = source.removeprefix(BUNDLED_PREFIX)
        spec = find_spec("sionna")
        if spec is None or not spec.submodule_search_locations:
            raise InputError(
                f"scene {source!r}: sionna-rt is not installed; install it with: pip install sionna-rt"
            )
        folder = Path(next(iter(spec.submodule_search_locations))) / "rt" / "scenes"
        path = folder / name / f"{name}.xml"
        if not exists(path):
            bundled = sorted(
                entry.name for entry in folder.iterdir() if (entry / f"{entry.name}.xml").is_file()
            )
            raise InputError(
                f"scene {shortened(source, 300)!r}: is not bundled with Sionna RT; choose one of {', '.join(bundled)}"
            )
        return path
    path = Path(source)
    if not exists(path):
        raise InputError(
            f"scene file {shortened(source, 300)}: does not exist; check the path (or give a bundled scene, such as "
            "sionna:munich)"
        )
    return path


def read_content(path: Path) -> bytes:
    """Read the bytes of a scene file; an unchanged file is read only once.

    Raises:
        OSError: The file cannot be read.
    """
    status = path.stat()
    return _content(path, status.st_mtime_ns, status.st_size, status.st_ino)


@lru_cache(maxsize=4)
def _content(path: Path, *_: int) -> bytes:
    return path.read_bytes()


def parse(path: Path, source: str) -> ElementTree.Element:
    """Parse the XML of a scene; `source` is the scene as the user named it.

    Raises:
        InputError: The file cannot be read, is not well-formed, is nested too deeply, or is not a Mitsuba scene.
    """
    try:
        root = ElementTree.fromstring(read_content(path), ElementTree.XMLParser(target=_ShallowTree()))
    except InputError as error:
        raise InputError(f"scene file {source}: {error}") from None
    except OSError as error:
        raise InputError(f"scene file {source}: cannot be read ({error.strerror}); check the file") from None
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(
            f"scene file {source}: is not well-formed XML ({error}); export it again, as UTF-8"
        ) from None
    if root.tag != "scene":
        raise InputError(
            f"scene file {source}: the root element is <{root.tag}>, but must be <scene>; give a Mitsuba scene"
        )
    return root


def find_scene(source: str | Path) -> tuple[Path, ElementTree.Element]:
    """Find the file of a scene, parse its XML, and return the path of the file and the root element.

    Raises:
        InputError: The file does not exist or is not a Mitsuba scene.
    """
    path = scene_path(str(source))
    return path, parse(path, str(source))


class _ShallowTree(ElementTree.TreeBuilder):
    """A tree builder that refuses deep nesting, because it would overflow the stack in recursive code."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InputError(f"elements are nested more than {MAX_DEPTH} deep; export the scene again")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def shape_mesh(shape: ElementTree.Element, path: Path) -> Mesh | None:
    """Read the mesh of a shape without applying its transform, and refuse a shape that cannot be traced.

    The result is None for a rectangle or a cube, because these shapes have no file.

    Raises:
        InputError: The shape is not a triangle mesh or has a degenerate transform, or its mesh is missing or malformed.
    """
    kind, name = shape.get("type", ""), shape.get("id")
    if kind not in SHAPES:
        raise InputError(
            f"{path}: shape {name!r} is a {shortened(kind)!r}, but must be one of {', '.join(SHAPES)}; "
            "export it as a PLY mesh of triangles"
        )
    _check_transform(shape, path)
    named = shape.find("string[@name='filename']")
    if named is None:
        if kind in ("obj", "ply"):
            raise InputError(f"{path}: shape {name!r} has no filename; add one")
        return None
    filename = named.get("value", "")
    mesh = path.parent / filename
    if not exists(mesh):
        raise InputError(
            f"{path}: mesh {shortened(filename, 200)!r} of shape {name!r} does not exist in {path.parent}; copy the "
            "meshes folder next to the scene"
        )
    return read_mesh(mesh, kind)


def _check_transform(shape: ElementTree.Element, path: Path) -> None:
    """Refuse a transform that flattens a shape or moves it to infinity, because rays would miss the shape."""
    for step in shape.findall("transform/*"):
        words = [value for key, value in step.attrib.items() if key in ("x", "y", "z", "value", "angle")]
        try:
            numbers = np.array([float(word) for text in words for word in re.split(r"[,\s]+", text.strip())])
        except ValueError:
            numbers = np.array([np.nan])
        flat = step.tag == "scale" and not numbers.all()
        if step.tag == "matrix" and len(numbers) in (9, 16):
            with np.errstate(all="ignore"):
                flat = np.linalg.det(numbers.reshape(int(np.sqrt(len(numbers))), -1)) == 0
        if flat or not np.isfinite(numbers).all():
            raise InputError(
                f"{path}: <{step.tag}> of shape {shape.get('id')!r} is {shortened(' '.join(words))!r}, but must be "
                "finite numbers that do not flatten the shape; export the scene again"
            )


def keep_traced_elements(root: ElementTree.Element, path: Path) -> None:
    """Reduce a scene to the elements that a trace needs, so that Mitsuba reads no other elements.

    Mitsuba would also load textures, emitters and sensors. These elements have no effect on radio waves, but can crash
    the process if they are malformed.

    Raises:
        InputError: The scene includes another file, or contains an element, a property or a parameter that Calibray
            does not support.
    """
    if root.find(".//include") is not None:
        raise InputError(f"{path}: <include> is not supported; export the scene into one file")
    _drop(root)
    for element in root:
        if element.tag not in ("bsdf", "shape"):
            raise InputError(_unknown(element, "the scene", path))
    for shape in root.findall("shape"):
        owner = f"shape {shortened(repr(shape.get('id')))}"
        _drop(shape)
        for child in shape:
            if child.get("name", "") not in _PROPERTIES.get(child.tag, ()) and child.tag not in (
                "bsdf",
                "ref",
            ):
                raise InputError(_unknown(child, owner, path))
        for element in shape.iter():
            for key, value in element.attrib.items():
                if "$" in value:
                    raise InputError(
                        f"{path}: {key} = {shortened(repr(value))} in {owner} is a parameter of the scene, which "
                        "Calibray does not substitute; write its value instead"
                    )


def _drop(element: ElementTree.Element) -> None:
    for child in list(element):
        if child.tag in _NOT_RADIO:
            element.remove(child)


def _unknown(element: ElementTree.Element, owner: str, path: Path) -> str:
    name = "" if element.get("name") is None else f" name={shortened(repr(element.get('name')))}"
    return (
        f"{path}: <{shortened(element.tag)}{name}> in {owner} is not an element of a radio scene; remove it, or export "
        "the scene again"
    )


def write_scene(
    folder: Path,
    objects: Sequence[MeshObject],
    materials: Mapping[str, Mapping[str, float | str]],
    frame: Frame | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a new scene: `scene.xml`, and `meshes/NAME.ply` for each object.

    A material whose `type` is an ITU-R P.2040 material has the permittivity and conductivity of that ITU material. The
    frame is stored in a comment, which `read_frame` reads. With `overwrite`, even files that Calibray did not write are
    replaced.

    Returns the path of the XML file.

    Raises:
        InputError: The folder cannot be written to, or a file in it must not be replaced. In case of an error, no
            file is written.
    """
    meshes = {f"{item.name}.ply": item.mesh for item in objects}
    check_outputs(folder, ["scene.xml"], overwrite=overwrite)
    # Meshes in another folder must not be replaced through a symbolic link.
    if (folder / MESHES).is_symlink():
        raise InputError(
            f"output folder {folder}: {folder / MESHES} is a symbolic link; remove it, or choose another folder"
        )
    check_outputs(folder / MESHES, list(meshes), overwrite=overwrite)
    (folder / MESHES).mkdir(parents=True, exist_ok=True)
    for name, mesh in meshes.items():
        write_bytes(folder / MESHES / name, ply_bytes(mesh))
    write_text(folder / "scene.xml", _scene_xml(objects, materials, frame))
    return folder / "scene.xml"


def _scene_xml(
    objects: Sequence[MeshObject], materials: Mapping[str, Mapping[str, float | str]], frame: Frame | None
) -> str:
    lines = ['<scene version="2.1.0">']
    if frame is not None:
        lines.append(f"    <!--{frame_comment(frame)}-->")
    for name, constants in materials.items():
        kind = "itu-radio-material" if "type" in constants else "radio-material"
        lines.append(f'    <bsdf type="{kind}" id={quoteattr(f"mat-{name}")}>')
        for key, value in constants.items():
            tag, text = ("string", value) if isinstance(value, str) else ("float", f"{value:.6g}")
            lines.append(f'        <{tag} name="{key}" value={quoteattr(text)}/>')
        lines.append("    </bsdf>")
    for item in objects:
        lines += [
            f'    <shape type="ply" id={quoteattr(f"mesh-{item.name}")}>',
            f'        <string name="filename" value={quoteattr(f"{MESHES}/{item.name}.ply")}/>',
            '        <boolean name="face_normals" value="true"/>',
            f'        <ref id={quoteattr(f"mat-{item.material}")} name="bsdf"/>',
            "    </shape>",
        ]
    return "\n".join([*lines, "</scene>", ""])


def frame_comment(frame: Frame) -> str:
    """The text of the XML comment that states a frame."""
    # XML comments must not contain a double hyphen.
    return " " + escape(f"{_FRAME_COMMENT}{frame}").replace("--", "- -") + " "


def read_frame(source: str | Path) -> Frame | None:
    """Read the geographic frame of a scene; None if the scene file states no frame.

    Raises:
        InputError: The scene does not exist, or its file states an invalid frame.
    """
    path = scene_path(str(source))
    head = read_content(path)[:8192].decode("utf-8", "replace")
    comment = re.search(f"<!-- {_FRAME_COMMENT}(.*?) -->", head, re.DOTALL)
    if comment is None:
        return None
    text = unescape(comment[1]).replace("- -", "--")
    try:
        return Frame.from_record(json.loads(text))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: its frame {text!r} is not JSON ({error}); make the scene again") from None
