"""Mesh files: those that Mitsuba would crash on or trace wrongly are refused, sound ones are read in every encoding."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import calibray as cb
from calibray.errors import InputError
from calibray.scenes import Mesh, read_mesh, read_scene, read_triangles
from calibray.scenes.meshes import ply_bytes
from calibray.scenes.obstruction import obstruction
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from small_scenes import write_scene

FLOOR = {"floor": [[(-9.0, -9.0, 0.0), (9.0, -9.0, 0.0), (9.0, 9.0, 0.0), (-9.0, 9.0, 0.0)]]}
HEADER = """ply
format {} 1.0
element vertex {}
property float x
property float y
property float z
element face {}
property list uchar int vertex_indices
end_header
"""
CORNERS = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
FACES = [[0, 1, 2], [0, 2, 3]]
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
ENCODINGS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def encode(
    encoding: str = "ascii",
    corners: np.ndarray = CORNERS,
    faces: list[list[int]] = FACES,
    header: str = HEADER,
    stored: str = "f4",
    index: str = "",
) -> bytes:
    """A PLY file, its faces with any number of corners."""
    head = header.format(encoding, len(corners), len(faces)).encode()
    if encoding == "ascii":
        rows = [*corners.tolist(), *([len(face), *face] for face in faces)]
        return head + "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    order = ENCODINGS[encoding]
    count, index = (index, index) if index else ("u1", "i4")
    packed = [
        np.array(len(face), f"{order}{count}").tobytes() + np.array(face, f"{order}{index}").tobytes()
        for face in faces
    ]
    return head + corners.astype(f"{order}{stored}").tobytes() + b"".join(packed)


def read(folder: Path, content: bytes, kind: str = "ply") -> Mesh:
    file = folder / f"floor.{kind}"
    file.write_bytes(content)
    return read_mesh(file, kind)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_sound_meshes_are_read_and_reflect(tmp_path: Path, encoding: str) -> None:
    mesh = read(tmp_path, encode(encoding))
    np.testing.assert_array_equal(mesh.vertices, CORNERS)
    np.testing.assert_array_equal(mesh.faces, FACES)
    file = write_scene(tmp_path, FLOOR)
    (tmp_path / "meshes" / "floor.ply").write_bytes(encode(encoding))
    links = SimpleNamespace(tx=np.array([[0.0, 0, 3]]), rx=np.array([[4.0, 0, 2]]))
    assert cb.trace(file, links, frequency=2e9, max_depth=1, samples=20_000).num_paths == 2


def test_written_meshes_are_read_again(tmp_path: Path) -> None:
    mesh = read(tmp_path, ply_bytes(Mesh(CORNERS, np.array(FACES))))
    np.testing.assert_array_equal(mesh.vertices, CORNERS)
    np.testing.assert_array_equal(mesh.faces, FACES)


@pytest.mark.parametrize(
    "header",
    [
        HEADER.replace("\n", "\r\n"),
        HEADER.replace("float", "double"),
        HEADER.replace("vertex_indices", "vertex_index").replace("int", "uint"),
        HEADER.replace("element vertex", "comment made by hand\nobj_info none\nelement vertex"),
        HEADER.replace("end_header", "element edge 0\nproperty int a\nend_header"),
    ],
)
def test_headers_written_in_other_ways_are_read(tmp_path: Path, header: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, encode(header=header)).faces, FACES)


def test_further_columns_are_ignored(tmp_path: Path) -> None:
    header = HEADER.replace("property float z\n", "property float z\nproperty float red\n")
    coloured = np.hstack([CORNERS, np.ones((4, 1))])
    for encoding in ENCODINGS:
        np.testing.assert_array_equal(
            read(tmp_path, encode(encoding, coloured, header=header)).vertices, CORNERS
        )


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("corners", "faces", "message"),
    [
        (
            CORNERS,
            [[0, 1, 2], [0, 2, 4]],
            r"face 1 refers to vertex 4, but must refer to vertices from 0 to 3",
        ),
        (
            CORNERS,
            [[0, 1, 99_999_999], [0, 2, 3]],
            r"face 0 refers to vertex 1e\+08, but must refer to vertices from 0 to 3",
        ),
        (
            CORNERS,
            [[0, 1, 2], [0, -1, 3]],
            r"face 1 (refers to vertex -1, but must refer|is '3 0 -1 3', but must be the number 3)",
        ),
        (
            CORNERS,
            [[0, 1, 2, 3]],
            "face 0 (has 4 corners, but must have|is '4 0 1 2 3', but must be the number) 3",
        ),
        (CORNERS, [[0, 1, 2], [0, 2]], r"unexpected length|face 1 is '2 0 2', but must be the number 3"),
        (np.where(CORNERS == 9, np.nan, CORNERS), FACES, r"x of vertex 1 is nan, but must be finite"),
        (np.where(CORNERS == 9, np.inf, CORNERS), FACES, r"x of vertex 1 is inf, but must be finite"),
        (CORNERS, [], "has no vertices or no faces"),
        (CORNERS[:0], [], "has no vertices or no faces"),
    ],
)
def test_malformed_meshes_are_refused(
    tmp_path: Path, encoding: str, corners: np.ndarray, faces: list[list[int]], message: str
) -> None:
    """Sionna RT ends the process at the first, and loses the reflection of the second without a message."""
    with pytest.raises(InputError, match=rf"mesh .*floor\.ply: .*({message}).*; export it again") as refusal:
        read(tmp_path, encode(encoding, corners, faces))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_type_of_a_ply_file_is_read_and_reflects(tmp_path: Path, encoding: str) -> None:
    """Sionna RT itself loses the reflections of a mesh with integer coordinates, which are legal."""
    corners = np.array([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]])
    files = {}
    for vertex, code in PLY_TYPES.items():
        header = HEADER.replace("float", vertex).replace(
            "property", f"property {vertex} quality\nproperty", 1
        )
        with_quality = np.hstack([np.ones((4, 1), dtype=int), corners])
        files[f"vertex-{vertex}"] = encode(encoding, with_quality, header=header, stored=code)
    for index, code in PLY_TYPES.items():
        if code[0] != "f":
            header = HEADER.replace("uchar int", f"{index} {index}")
            files[f"index-{index}"] = encode(encoding, corners, header=header, index=code)
    tile = [[(0, 0, 0), (9, 0, 0), (9, 9, 0), (0, 9, 0)]]
    scene = write_scene(tmp_path, {name: tile for name in files})
    for name, content in files.items():
        file = tmp_path / "meshes" / f"{name}.ply"
        file.write_bytes(content)
        np.testing.assert_array_equal(read_mesh(file, "ply").vertices, corners, name)
    # The tracer compares bounds and area with what Mitsuba holds.
    links = SimpleNamespace(tx=np.array([[1.0, 1, 3]]), rx=np.array([[5.0, 4, 2]]))
    cb.trace(scene, links, frequency=2e9, max_depth=1, samples=20_000)
    # Alone in a scene, so that no other mesh reflects instead.
    alone = write_scene(tmp_path / "alone", {"tile": tile})
    (tmp_path / "alone" / "meshes" / "tile.ply").write_bytes(files["vertex-int"])
    assert cb.trace(alone, links, frequency=2e9, max_depth=1, samples=20_000).num_paths == 2


def test_a_surface_that_mitsuba_holds_differently_is_refused(tmp_path: Path) -> None:
    scene = read_scene(write_scene(tmp_path, FLOOR), 2e9)
    larger = {"floor": [[(-9.0, -9.0, 0.0), (9.0, -9.0, 0.0), (9.0, 9.1, 0.0), (-9.0, 9.1, 0.0)]]}
    write_scene(tmp_path, larger)
    with pytest.raises(InputError, match=r"surface of material 'stone' in Mitsuba differs .*325\.8 m.*324 m"):
        Tracer(scene, 2e9, TraceSettings(), Antenna(), Antenna())


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_meshes_cut_or_changed_anywhere_are_refused_or_sound(tmp_path: Path, encoding: str) -> None:
    whole, random = encode(encoding), np.random.default_rng(3)
    body = whole.index(b"end_header") + 11
    for cut in random.integers(len(whole) - 4, size=40):
        with pytest.raises(InputError, match=r"floor\.ply"):
            read(tmp_path, whole[:cut])
    for position in random.integers(body if encoding == "ascii" else len(whole), size=100):
        changed = bytearray(whole)
        changed[position] ^= 1 << int(random.integers(8))
        try:
            mesh = read(tmp_path, bytes(changed))
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            assert mesh.faces.shape == (2, 3)
            assert np.isfinite(mesh.vertices[mesh.faces]).all()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"ply", b"plx"),
        (b"end_header", b"end_of_it"),
        (b"format ascii 1.0\n", b""),
        (b"ascii", b"morse"),
        (b"vertex 4", b"vertex 9999999999999999"),
        (b"vertex 4", b"vertex -4"),
        (b"vertex 4", b"vertex 3"),
        (b"vertex 4", b"vertex " + b"9" * 5000),
        (b"face 2", b"face 3"),
        (b"float x", b"float w"),
        (b"float x", b"float y"),
        (b"list uchar int vertex_indices", b"list uchar int holes"),
        (b"list uchar int vertex_indices", b"int a"),
        (b"9.0", b"nine"),
        (b"9.0", b"\xff\xfe"),
        (b"\n3 0 1 2", b"\n3 0 1.5 2"),
        (b"\n3 0 1 2", b"\n3 0 4294967297 2"),
        (b"\n3 0 1 2", b"\n3 0 1 two"),
    ],
    ids=lambda text: text.decode(errors="replace")[:30],
)
def test_malformed_text_is_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    content = encode().replace(old, new, 1)
    assert content != encode()
    with pytest.raises(InputError, match=r"floor\.ply: .*; export it again") as refusal:
        read(tmp_path, content)
    assert len(str(refusal.value)) < 600


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_header_that_declares_more_than_the_file_holds_allocates_nothing(
    tmp_path: Path, encoding: str
) -> None:
    for old, new in (("vertex 4", "vertex 4000000000"), ("face 2", "face 1000000000000")):
        content = encode(encoding).replace(old.encode(), new.encode(), 1)
        with pytest.raises(InputError, match=r"floor\.ply"):
            read(tmp_path, content)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n",
            r"line 3: 'v 0 nan 0': a vertex must be three finite numbers",
        ),
        ("v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2: 'v 1 0': a vertex must be"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
            "line 4: 'f 1 2 4': a face must refer to at least three of the 3 vertices",
        ),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "line 4: .*a face must refer to at least three"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2.5 3\n", "line 4: .*a face must refer to at least three"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1//1 -2//1\n", "line 4: .*a face must refer to at least three"),
        ("v 0 0 0\n", "has no faces"),
    ],
)
def test_a_malformed_obj_mesh_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=rf"floor\.obj: {message}"):
        read(tmp_path, text.encode(), "obj")


def test_an_obj_mesh_is_read_with_polygons_and_indices_from_the_end(tmp_path: Path) -> None:
    mesh = read(tmp_path, b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1/1 -3/2/2 3 -1\nf 2 3 1/1/1\n", "obj")
    np.testing.assert_array_equal(
        mesh.vertices[mesh.faces][:2, :, :2], [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]
    )
    # Vertex 2 with and without texture and normal is two vertices, as in Mitsuba: no wedge is found there.
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 2, 0]]


def test_objects_that_became_unreadable_are_left_out_and_named(tmp_path: Path) -> None:
    wall = [[(0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 0.0, 9.0), (0.0, 0.0, 9.0)]]
    scene = read_scene(write_scene(tmp_path, {**FLOOR, "wall": wall}), 2e9)
    (tmp_path / "meshes" / "wall.ply").write_text("ply\nnonsense")
    triangles = read_triangles(scene)
    assert triangles.left_out == ("wall",)
    assert triangles.ground.tolist() == [True, True]


def test_triangles_are_those_of_the_placed_shapes(tmp_path: Path) -> None:
    """A wall that its shape moves, scales from millimetres or gives as a rectangle obstructs like a plain mesh."""
    wall = [[(0.0, -9.0, 0.0), (0.0, 9.0, 0.0), (0.0, 9.0, 9.0), (0.0, -9.0, 9.0)]]
    file = write_scene(tmp_path, {**FLOOR, "wall": wall})
    text = file.read_text()
    moved = '<transform name="to_world"><translate x="3"/></transform></shape></scene>'
    rectangle = (
        '<shape type="rectangle" id="mesh-screen"><transform name="to_world"><rotate y="1" angle="90"/>'
        '<translate x="-5" z="2"/></transform><ref id="mat-stone" name="bsdf"/></shape></scene>'
    )
    file.write_text(text.replace("</shape></scene>", moved).replace("</scene>", rectangle))
    triangles = read_triangles(read_scene(file, 2e9))
    assert triangles.left_out == ()
    tx = np.array([[-8.0, 0.0, 2.0], [2.0, 0.0, 2.0], [-2.0, 0.0, 2.0]])
    rx = np.array([[-2.0, 0.0, 2.0], [4.0, 0.0, 2.0], [2.0, 0.0, 2.0]])
    assert obstruction(triangles, tx, rx).walls.tolist() == [1, 1, 0]
