"""The file of a scene: found, parsed, and its shapes and the files it names checked before a ray tracer sees them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np

from calibray.errors import InputError
from calibray.scenes.checks.obj import check_obj
from calibray.scenes.checks.ply import check_ply
from calibray.support.messages import shortened
from calibray.support.output_files import exists

BUNDLED_PREFIX: Final = "sionna:"

SHAPES: Final = ("cube", "obj", "ply", "rectangle", "serialized")
"""The types of shapes that are triangle meshes, which alone Sionna RT takes."""

MAX_DEPTH: Final = 64
"""How deep the elements of a scene file may lie in each other."""


def scene_path(source: str) -> Path:
    """Find the file of a scene.

    Args:
        source: Path of the XML file, or `sionna:NAME` for a scene bundled with Sionna RT.

    Returns:
        The XML file.

    Raises:
        InputError: There is no such file or bundled scene, or Sionna RT is not installed.
    """
    if source.startswith(BUNDLED_PREFIX):
        name = source.removeprefix(BUNDLED_PREFIX)
        spec = find_spec("sionna")
        if spec is None or not spec.submodule_search_locations:
            raise InputError(f"scene {source!r}: sionna-rt is not installed; pip install sionna-rt")
        folder = Path(next(iter(spec.submodule_search_locations))) / "rt" / "scenes"
        path = folder / name / f"{name}.xml"
        if not exists(path):
            known = sorted(
                entry.name for entry in folder.iterdir() if (entry / f"{entry.name}.xml").is_file()
            )
            raise InputError(f"scene {source!r}: Sionna RT bundles no such scene; it has {', '.join(known)}")
        return path
    path = Path(source)
    if not exists(path):
        raise InputError(
            f"scene file {shortened(source, 300)}: does not exist; check the path (or name a bundled one, "
            "sionna:munich)"
        )
    return path


def content(path: Path) -> bytes:
    """The bytes of a scene's file; read once for as long as it stays the same.

    Args:
        path: The file.

    Returns:
        Its bytes.

    Raises:
        OSError: The file cannot be read.
    """
    status = path.stat()
    return _content(path, status.st_mtime_ns, status.st_size, status.st_ino)


@lru_cache(maxsize=4)
def _content(path: Path, *_: int) -> bytes:
    return path.read_bytes()


def parse(path: Path, source: str) -> ElementTree.Element:
    """Read the XML of a scene.

    Args:
        path: The file.
        source: What the user named, for messages.

    Returns:
        The root element.

    Raises:
        InputError: The file cannot be read, is not well-formed, lies too deep in itself, or is no scene.
    """
    try:
        root = ElementTree.fromstring(content(path), ElementTree.XMLParser(target=_Builder()))
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
            f"scene file {source}: the root element is <{root.tag}>, a Mitsuba scene has <scene>"
        )
    return root


def find_scene(source: str | Path) -> tuple[Path, ElementTree.Element]:
    """Find a scene's file and read its XML.

    Args:
        source: Path of the XML file, or `sionna:NAME` for a scene bundled with Sionna RT.

    Returns:
        The file, and its root element.

    Raises:
        InputError: The file does not exist or is no Mitsuba scene.
    """
    path = scene_path(str(source))
    return path, parse(path, str(source))


class _Builder(ElementTree.TreeBuilder):
    """Elements as ElementTree makes them, but not so deep in each other that nothing could walk them."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InputError(f"elements lie more than {MAX_DEPTH} deep in each other; export the scene again")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def check_shape(shape: ElementTree.Element, path: Path) -> None:
    """Refuse a shape that is no triangle mesh, or whose mesh is missing or malformed.

    Args:
        shape: The element.
        path: The scene's file.

    Raises:
        InputError: It is such a shape.
    """
    kind, name = shape.get("type", ""), shape.get("id")
    if kind not in SHAPES:
        raise InputError(
            f"{path}: shape {name!r} is a {shortened(kind)!r}, must be one of {', '.join(SHAPES)}; "
            "export it as a triangle mesh"
        )
    _check_transform(shape, path)
    filename = shape.find("string[@name='filename']")
    if filename is None:
        if kind in ("obj", "ply", "serialized"):
            raise InputError(f"{path}: shape {name!r} names no file; give it a filename")
        return
    mesh = path.parent / filename.get("value", "")
    if not exists(mesh):
        raise InputError(
            f"{path}: mesh {shortened(filename.get('value', ''), 200)!r} of shape {name!r} does not exist in "
            f"{path.parent}; copy the meshes folder beside the scene"
        )
    if kind == "ply":
        check_ply(mesh)
    if kind == "obj":
        check_obj(mesh)


def _check_transform(shape: ElementTree.Element, path: Path) -> None:
    """Refuse a transform that makes a shape flat or sends it nowhere: rays would pass as if it were not there."""
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
                f"{path}: <{step.tag}> of shape {shape.get('id')!r} is {shortened(' '.join(words))!r}, must be finite "
                "numbers that leave the shape its width; export the scene again"
            )


def check_files(root: ElementTree.Element, path: Path) -> None:
    """Refuse textures and the like without their files, and scenes in several files.

    Args:
        root: The scene, without the materials of the file, which are replaced.
        path: The scene's file.

    Raises:
        InputError: It is such a scene.
    """
    if root.find(".//include") is not None:
        raise InputError(f"{path}: <include> is not supported; export the scene into one file")
    for element in root.iter():
        filename = element.find("string[@name='filename']")
        if (
            element.tag != "shape"
            and filename is not None
            and not exists(path.parent / filename.get("value", ""))
        ):
            raise InputError(
                f"{path}: file {shortened(filename.get('value', ''), 200)!r} of a {element.tag} does not exist; copy "
                f"it beside the scene, or remove the {element.tag}, which radio waves do not see"
            )
