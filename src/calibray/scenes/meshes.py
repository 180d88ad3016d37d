"""Triangle meshes: joining, welding, reading PLY and OBJ files, and writing PLY files.

Sionna RT finds wedges only between faces that share vertices within one mesh. Where two meshes meet, there is no wedge
and therefore no diffraction.

Mitsuba does not validate mesh files. If a vertex index is out of range, the process crashes, or reflections are lost
without a message. Rays never hit faces with NaN vertices. `read_mesh` refuses such files. Integer coordinates are
valid, but with them Mitsuba loses all reflections from the mesh. The tracer therefore reads a floating-point copy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.support.messages import first_line, shortened

MILLIMETRE: Final = 0.001
"""Unit of integer corner coordinates [m]."""

WIDEST: Final = 50_000.0
"""Maximum extent of a new scene [m]; a wider scene is probably not in metres, or not near a local origin."""

LARGEST_COORDINATE: Final = 1e9
"""Maximum coordinate of a vertex or an antenna [m]; the same limit applies to positions in path files."""

SMALL: Final = 4096
"""Maximum size [bytes] of a PLY file, such as the file of one building, whose mesh is cached within a process. A run
reads its scene up to five times. Reading a scene of 2,367 buildings takes 2.8 s the first time and 0.8 s after that."""

_HEADER: Final = re.compile(
    rb"ply\r?\n(?:(?:comment|obj_info)\b.*\n)*"
    rb"format (?:ascii|binary_little_endian|binary_big_endian) 1\.0\r?\n"
    rb"(?:(?:comment|obj_info|element|property)\b.*\n)*end_header\r?\n"
)
_COMMENT: Final = re.compile(rb"^(?:comment|obj_info)\b.*\n", re.MULTILINE)
_INDEX_PROPERTIES: Final = ("vertex_indices", "vertex_index")
_TEXT_FACE: Final = re.compile(r"\s*3(\s+\d{1,9}){3}(\s.*)?")  # a face row of a text PLY file


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; adjacent faces share the vertices of their common edge.

    Attributes:
        vertices: Positions [V, 3], [m].
        faces: Vertex indices of each triangle [F, 3], counter-clockwise when seen from outside.
        step: Spacing of floating-point numbers at the largest coordinate in the file [m]; 0 if it is negligible.
        misread: Whether the tracer must read a PLY copy instead, because the file stores integer coordinates, Mitsuba
            would shear the shape, or the shape is a rectangle, which is not a mesh in Mitsuba.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    step: float = 0.0
    misread: bool = False


@dataclass(frozen=True)
class MeshObject:
    """One object of a scene file.

    Attributes:
        name: Name of the object, which differs from the names of all materials.
        material: Name of the object's material.
        mesh: Surface of the object.
    """

    name: str
    material: str
    mesh: Mesh


def join_meshes(meshes: Iterable[Mesh]) -> Mesh:
    """Join one or more meshes; vertices of different meshes are not merged, and unused vertices are dropped."""
    parts = list(meshes)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)])
    used, inverse = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], inverse.reshape(faces.shape))


def weld(
    triangles: NDArray[np.int64], position: Callable[[NDArray[np.int64]], NDArray[np.float64]] | None = None
) -> Mesh:
    """Make a mesh from triangles with integer corners [F, 3, 3]; equal corners become one vertex.

    Triangles are counter-clockwise when seen from outside; triangles with two equal corners are dropped. Corners are in
    units of `MILLIMETRE`, unless `position` converts corners [n, 3] to positions [n, 3], [m].

    Example:
        >>> weld(np.array([[[0, 0, 0], [5, 0, 0], [0, 5, 0]], [[5, 0, 0], [5, 5, 0], [0, 5, 0]]])).faces
        array([[0, 2, 1],
               [2, 3, 1]])
    """
    corners, faces = np.unique(np.reshape(triangles, (-1, 3)), axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    vertices = corners.astype(np.float64) * MILLIMETRE if position is None else position(corners)
    return join_meshes([Mesh(vertices, faces[distinct])])


def read_mesh(file: Path, kind: str) -> Mesh:
    """Read a mesh file of kind "ply" or "obj", and refuse a file that would crash Mitsuba or be traced wrongly.

    Polygons of an OBJ file are split into triangles.

    Raises:
        InputError: The file cannot be read, is damaged or has no face, or a vertex is not finite. A face refers to a
            vertex that does not exist or, in a PLY file, is not a triangle.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InputError(f"mesh {file}: cannot be read ({error.strerror}); check the file") from None
    try:
        if kind == "obj":
            return _read_obj(content)
        return _read_ply(content) if len(content) > SMALL else _read_small_ply(content)
    except InputError as error:
        fault = str(error)
    except Exception as error:  # trimesh's parser may raise any exception
        fault = f"cannot be read as PLY ({first_line(error)})"
    raise InputError(f"mesh {file}: {fault}; export it again, as triangles")


@lru_cache(maxsize=10_000)
def _read_small_ply(content: bytes) -> Mesh:
    mesh = _read_ply(content)
    for array in (mesh.vertices, mesh.faces):
        array.flags.writeable = False
    return mesh


def _read_ply(content: bytes) -> Mesh:
    from trimesh.exchange.ply import load_ply

    # trimesh accepts almost any line as a header line, and expects comments in UTF-8.
    header = _HEADER.match(content)
    if header is None:
        raise InputError("is not a PLY file, or its header is damaged")
    body = content[header.end() :]
    # Before it allocates memory, trimesh refuses a binary file whose size differs from the size declared in its header.
    with np.errstate(all="ignore"):
        loaded = load_ply(
            BytesIO(_COMMENT.sub(b"", header[0]) + body), fix_texture=False, skip_materials=True
        )
    elements = loaded["metadata"]["_ply_raw"]
    vertex, face = (elements.get(name, {"length": 0}) for name in ("vertex", "face"))
    if not vertex["length"] or not face["length"]:
        raise InputError("has no vertices or no faces")
    stored = [np.dtype(vertex["properties"][axis]) for axis in "xyz"]
    name = next((name for name in _INDEX_PROPERTIES if name in face["properties"]), None)
    if name is None:
        raise InputError("its faces have no list vertex_indices")
    if isinstance(face["data"], dict):
        _check_text_faces(body.decode(), elements)
        corners = face["data"][name]
    else:
        # trimesh assumes that all faces have as many corners as the first one.
        counts, corners = face["data"][name]["f0"], face["data"][name]["f1"]
        if (other := np.flatnonzero(counts != 3)).size:
            raise InputError(f"face {other[0]} has {counts[other[0]]} corners, but must have 3")
    vertices = np.stack(
        [np.asarray(vertex["data"][axis], dtype=np.float64).ravel() for axis in "xyz"], axis=1
    )
    if len(vertices) != vertex["length"] or corners.shape != (face["length"], 3):
        raise InputError("is truncated, or has a face that does not have three corners")
    _check_range(vertices)
    if (wrong := (corners < 0) | (corners >= len(vertices)) | (corners != np.floor(corners))).any():
        row, corner = np.argwhere(wrong)[0]
        raise InputError(
            f"face {row} refers to vertex {corners[row, corner]:g}, but must refer to vertices from 0 to "
            f"{len(vertices) - 1}"
        )
    misread = any(kind.kind != "f" for kind in stored)
    # The spacing is large enough to matter only in single precision.
    is_single = any(kind == np.dtype(np.float32).newbyteorder(kind.byteorder) for kind in stored)
    step = float(np.spacing(np.float32(np.abs(vertices).max()))) if is_single else 0.0
    return Mesh(vertices, corners.astype(np.int64), step, misread)


def _check_range(vertices: NDArray[np.float64]) -> None:
    """Refuse vertices that are not finite, or are so far from the origin that areas overflow in single precision."""
    if (wrong := ~(np.abs(vertices) <= LARGEST_COORDINATE)).any():
        row, axis = np.argwhere(wrong)[0]
        raise InputError(
            f"{'xyz'[axis]} of vertex {row} is {vertices[row, axis]:g}, but must be finite and at most "
            f"{LARGEST_COORDINATE:g} m"
        )


def _check_text_faces(text: str, elements: dict[str, dict[str, Any]]) -> None:
    """Refuse face rows of a text PLY file that trimesh would truncate, round or drop without a message."""
    lengths = {name: element["length"] for name, element in elements.items()}
    first = sum(lengths[name] for name in takewhile(lambda name: name != "face", lengths))
    for index, line in enumerate(text.splitlines()[first : first + lengths["face"]]):
        if not _TEXT_FACE.fullmatch(line):
            raise InputError(
                f"face {index} is {shortened(line)!r}, but must be the number 3 and three vertex indices"
            )


def _read_obj(content: bytes) -> Mesh:
    """Read vertices and faces; as in Mitsuba, corners with different textures or normals are different vertices."""
    # trimesh is not used here: it drops faces that it cannot read, interprets index 0 as the first vertex, and misreads
    # faces whose corners are written in different forms (1/1/1 and 1).
    positions: list[list[float]] = []
    vertices: dict[tuple[int, str], int] = {}
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(content.decode("utf-8", errors="replace").splitlines(), start=1):
        keyword, *words = line.split() or [""]
        if keyword == "v":
            positions.append([_number(word) for word in words[:3]])
            if len(words) < 3 or not np.isfinite(positions[-1]).all():
                raise InputError(
                    f"line {number}: {shortened(line.strip())!r}: a vertex must be three finite numbers"
                )
        elif keyword == "f":
            parts = [word.partition("/") for word in words]
            indices = [_obj_index(_number(index), len(positions)) for index, _, _ in parts]
            if len(indices) < 3 or None in indices:
                raise InputError(
                    f"line {number}: {shortened(line.strip())!r}: a face must refer to at least three of the "
                    f"{len(positions)} vertices before it"
                )
            first, *rest = (
                vertices.setdefault((index, attributes), len(vertices))
                for index, (_, _, attributes) in zip(indices, parts, strict=True)
                if index is not None
            )
            # A polygon becomes a fan of triangles around its first corner.
            faces += [(first, second, third) for second, third in pairwise(rest)]
    if not faces:
        raise InputError("has no faces")
    mesh = Mesh(np.array([positions[index] for index, _ in vertices]), np.array(faces, dtype=np.int64))
    _check_range(mesh.vertices)
    return mesh


def _obj_index(number: float, count: int) -> int | None:
    """Convert a vertex number, counted from 1 or backwards from -1, to an index; None if there is no such vertex."""
    index = number - 1 if number > 0 else number + count
    return int(index) if 0 <= index < count and index == np.floor(index) else None


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")


def ply_bytes(mesh: Mesh) -> bytes:
    """Encode a mesh as a binary little-endian PLY file; equal meshes give equal bytes.

    Vertices are stored as 32-bit floats, or as 64-bit floats if rounding to 32 bits could move them by more than about
    0.1 mm.
    """
    # Single precision halves the file size; beyond 4 km, the spacing of its numbers is 0.5 mm or more.
    is_coarse = np.spacing(np.float32(np.abs(mesh.vertices).max(initial=0.0))) > 3e-4
    name, stored = ("double", "<f8") if is_coarse else ("float", "<f4")
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty {name} x\nproperty {name} y\nproperty {name} z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"] = 3
    faces["vertices"] = mesh.faces
    return header.encode("ascii") + mesh.vertices.astype(stored).tobytes() + faces.tobytes()
