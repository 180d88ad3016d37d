"""Mesh files, checked before a ray tracer sees them.

Mitsuba does not look whether the corners of a PLY file's faces exist: one beyond the last vertex ends the process, or
takes the face's reflections away in silence. What OBJ files say wrong it finds itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.support.messages import shortened

HEADER: Final = 65_536
"""The bytes beyond which the header of a PLY file is not searched for its end."""

_TYPES: Final = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_FORMATS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS: Final = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Element:
    """A table of a PLY file: its rows, and its columns with their types; the corners of a face are four columns."""

    name: str
    count: int
    columns: tuple[tuple[str, str], ...]
    varies: bool = False


def check_ply(path: Path) -> None:
    """Refuse a PLY mesh with a face that has no three corners among its vertices, or a vertex that is not finite.

    Args:
        path: The file.

    Raises:
        InputError: The mesh is malformed, cut short, empty, or has such a face or vertex.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"mesh {path}: cannot be read ({error.strerror}); check the file") from None
    order, elements, body = _header(path, content)
    tables = (
        _text_tables(path, elements, body) if order == "" else _binary_tables(path, order, elements, body)
    )
    _check(path, tables.get("vertex"), tables.get("face"))


def _check(path: Path, vertices: NDArray[np.void] | None, faces: NDArray[np.void] | None) -> None:
    """Refuse vertices that are not finite and faces that have no three corners among them."""
    if vertices is None or faces is None or not len(vertices) or not len(faces):
        raise _malformed(path, "has no vertices or no faces")
    if missing := [axis for axis in "xyz" if axis not in _names(vertices.dtype)]:
        raise _malformed(path, f"its vertices have no {missing[0]}")
    if "corners" not in _names(faces.dtype):
        raise _malformed(path, "its faces name no corners")
    for axis in "xyz":
        if (wrong := ~np.isfinite(vertices[axis].astype(np.float64))).any():
            row = int(np.flatnonzero(wrong)[0])
            raise _malformed(path, f"{axis} of vertex {row} is {vertices[axis][row]}, must be finite")
    corners = np.stack([faces[f"corner {k}"] for k in range(3)], axis=1).astype(np.float64)
    if (wrong := (corners < 0) | (corners >= len(vertices)) | (corners != np.floor(corners))).any():
        row, place = (int(index[0]) for index in np.nonzero(wrong))
        raise _malformed(
            path, f"face {row} names vertex {corners[row, place]:g}, must be 0 to {len(vertices) - 1}"
        )


def _malformed(path: Path, fault: str) -> InputError:
    return InputError(f"mesh {path}: {fault}; export it again, as triangles")


def _header(path: Path, content: bytes) -> tuple[str, list[_Element], bytes]:
    """Byte order (none for text), the elements in their order, and what follows the header."""
    end = content.find(b"end_header", 0, HEADER)
    if not content.startswith(b"ply") or end < 0:
        raise _malformed(path, "is no PLY file, or its header has no end")
    stop = content.find(b"\n", end)
    order, elements = None, list[_Element]()
    for line in content[:end].decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", kind, _] if kind in _FORMATS:
                order = _FORMATS[kind]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 19:
                elements.append(_Element(name, int(count), ()))
            case ["property", "list", size, kind, name] if elements and {size, kind} <= set(_TYPES):
                elements[-1] = _with_list(elements[-1], size, kind, name)
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1] = _with_columns(elements[-1], [(name, _TYPES[kind])])
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise _malformed(path, f"cannot read its header's line {shortened(line)!r}")
    if order is None:
        raise _malformed(path, "its header names no format")
    return order, elements, content[stop + 1 :] if stop >= 0 else b""


def _with_columns(element: _Element, columns: list[tuple[str, str]]) -> _Element:
    return _Element(element.name, element.count, (*element.columns, *columns), element.varies)


def _with_list(element: _Element, size: str, kind: str, name: str) -> _Element:
    """A list that is no face's corners may be of any length: its table cannot be passed over."""
    if element.name != "face" or name not in _CORNERS:
        return _Element(element.name, element.count, element.columns, varies=True)
    corners = [(f"corner {k}", _TYPES[kind]) for k in range(3)]
    return _with_columns(element, [("corners", _TYPES[size]), *corners])


def _row_type(path: Path, element: _Element, order: str) -> np.dtype:
    names = [name for name, _ in element.columns]
    if element.varies or not names or len(set(names)) != len(names):
        raise _malformed(path, f"the properties of its {shortened(element.name)} cannot be read")
    return np.dtype([(name, f"{order}{kind}") for name, kind in element.columns])


def _names(row: np.dtype) -> tuple[str, ...]:
    return row.names or ()


def _needed(elements: list[_Element]) -> list[_Element]:
    """The elements up to the last that matters."""
    last = max((k for k, element in enumerate(elements) if element.name in ("vertex", "face")), default=-1)
    return elements[: last + 1]


def _binary_tables(path: Path, order: str, elements: list[_Element], body: bytes) -> dict[str, NDArray]:
    tables, place = {}, 0
    for element in _needed(elements):
        row = _row_type(path, element, order)
        if len(body) - place < element.count * row.itemsize:
            raise _malformed(
                path, f"is cut short, or has a face of more than three corners in {element.name}"
            )
        tables[element.name] = np.frombuffer(body, row, element.count, place)
        place += element.count * row.itemsize
        _check_triangles(path, tables[element.name])
    return tables


def _text_tables(path: Path, elements: list[_Element], body: bytes) -> dict[str, NDArray]:
    words, tables, place = body.split(), {}, 0
    for element in _needed(elements):
        row = _row_type(path, element, "")
        numbers = element.count * len(_names(row))
        if len(words) - place < numbers:
            raise _malformed(
                path, f"is cut short, or has a face of other than three corners in {element.name}"
            )
        try:
            values = np.array(words[place : place + numbers], dtype=np.bytes_).astype(np.float64)
        except ValueError:
            raise _malformed(path, f"its {shortened(element.name)} holds what is no number") from None
        table = np.empty(element.count, dtype=[(name, np.float64) for name in _names(row)])
        for column, name in enumerate(_names(row)):
            table[name] = values[column :: len(_names(row))]
        tables[element.name] = table
        place += numbers
        _check_triangles(path, tables[element.name])
    return tables


def _check_triangles(path: Path, table: NDArray) -> None:
    if "corners" in _names(table.dtype) and (wrong := table["corners"] != 3).any():
        row = int(np.flatnonzero(wrong)[0])
        raise _malformed(path, f"face {row} has {table['corners'][row]:g} corners, must have 3")
