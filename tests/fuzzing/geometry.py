"""Attacks on scenes: their XML, their meshes, and the files of antennas' gains."""

from __future__ import annotations

import functools
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from random import Random
from types import SimpleNamespace

import numpy as np
import trimesh

from calibray.fields import path_loss
from calibray.scenes import Mesh, read_mesh
from calibray.study import Study
from calibray.tracing.gain_table import read_gain_table
from fuzzing import world
from fuzzing.mutations import NUMBERS, TEXTS, damage
from fuzzing.outcome import Case
from fuzzing.world import OWN, World

TRACED = 0.3
"""Share of the scenes that are traced where they can be read."""
_NAMES = ("scene.xml", "meshes", "mesh ", "[objects]", "[materials]", "material", "scene", "trace", "shape")


def _traced(study: Path, whole: bool) -> Callable[[], list[float]]:
    """Open a study and trace it, each time anew."""

    def act() -> list[float]:
        setup = Study.load(study).opened()
        if not whole:
            return [len(setup.scene.objects)]
        return np.asarray(path_loss(setup.tracer.trace(setup.links))).tolist()

    return act


def _inserted(element: str, where: str, text: str) -> str:
    """A scene with an element before the first end of another one."""
    return text.replace(where, element + where, 1)


DOCUMENTS: tuple[Callable[[str], str], ...] = (
    lambda t: (
        '<?xml version="1.0"?><!DOCTYPE s [<!ENTITY a "b"><!ENTITY b "&a;&a;">]>'
        + t.replace("mat-roof", "&b;")
    ),
    lambda t: '<!DOCTYPE s [<!ENTITY a SYSTEM "file:///etc/passwd">]>' + t.replace("walls", "&a;", 1),
    lambda t: (
        "<!DOCTYPE s ["
        + '<!ENTITY a0 "'
        + "x" * 50
        + '">'
        + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 20}">' for k in range(1, 9))
        + "]>"
        + t.replace("mat-roof", "&a8;")
    ),
    lambda t: '<?xml version="1.0" encoding="utf-16"?>' + t,
    lambda t: '<?xml version="1.0" encoding="x-none"?>' + t,
    lambda t: '<?xml version="1.1"?>' + t,
    lambda t: "<scene>" * 5000 + "</scene>" * 5000,
    lambda t: t.replace("<shape", "<group>" * 300 + "<shape", 1).replace(
        "</shape>", "</shape>" + "</group>" * 300, 1
    ),
    lambda t: t.replace("<scene ", '<scene xmlns="http://x.y/z" '),
    lambda t: t.replace("<scene ", '<m:scene xmlns:m="http://x.y/z" ').replace("</scene>", "</m:scene>"),
    lambda t: t.replace("</scene>", '<include filename="scene.xml"/></scene>'),
    lambda t: t.replace("</scene>", '<default name="f" value="x"/></scene>').replace("house.ply", "$f"),
    lambda t: t.replace("</scene>", '<path value="/etc"/></scene>'),
    lambda t: t.replace(
        "</scene>", '<sensor type="perspective"><float name="fov" value="x"/></sensor></scene>'
    ),
    lambda t: t.replace("</scene>", '<integrator type="nothing"/></scene>'),
    lambda t: t.replace(
        "</scene>", '<emitter type="envmap"><string name="filename" value="no.exr"/></emitter></scene>'
    ),
    lambda t: t.replace(
        "</scene>", '<shape type="sphere" id="mesh-s"><ref id="mat-walls" name="bsdf"/></shape></scene>'
    ),
    lambda t: t.replace(
        "</scene>", '<shape type="shapegroup" id="mesh-s"><ref id="mat-walls" name="bsdf"/></shape></scene>'
    ),
    lambda t: t.replace(
        "</scene>", '<shape type="cube" id="mesh-c"><ref id="mat-walls" name="bsdf"/></shape></scene>'
    ),
    lambda t: t.replace(
        "</scene>",
        '<shape type="serialized" id="mesh-c"><string name="filename" value="links.csv"/>'
        '<ref id="mat-walls" name="bsdf"/></shape></scene>',
    ),
    lambda t: t.replace("</scene>", t[t.index("<shape") :]),
    lambda t: t.replace("mesh-shed", "mesh-house"),
    lambda t: t.replace("meshes/shed.ply", "../../../../etc/passwd"),
    lambda t: t.replace("meshes/shed.ply", "/dev/zero"),
    lambda t: t.replace("meshes/shed.ply", "x" * 5000 + ".ply"),
    lambda t: t.replace("mesh-shed", "mesh-" + "x" * 50_000),
    lambda t: t.replace("mesh-shed", "mesh-shed/../a b&quot;&#10;"),
    lambda t: t.replace("radio-material", "twosided", 1),
    lambda t: t.replace('<scale x="80" y="80"/>', '<scale x="nan" y="80"/>'),
    lambda t: t.replace('<scale x="80" y="80"/>', '<scale value="0"/>'),
    lambda t: t.replace('<scale x="80" y="80"/>', '<matrix value="1 2 3"/>'),
    lambda t: t.replace('<scale x="80" y="80"/>', '<scale x="1e38" y="1e38"/>'),
    lambda t: t.replace('<scale x="80" y="80"/>', '<lookat origin="0,0,0" target="0,0,0" up="0,0,0"/>'),
    lambda t: t.replace(
        "</bsdf>",
        '<texture type="bitmap" name="t"><string name="filename" value="no.png"/></texture></bsdf>',
        1,
    ),
    lambda t: t.replace('"wood"', '"wood\0"'),
    *(
        functools.partial(_inserted, f'<{tag} type="{kind}">{body}</{tag}>', where)
        for tag, kind in (
            ("texture", "bitmap"),
            ("texture", "x"),
            ("emitter", "area"),
            ("medium", "homogeneous"),
            ("volume", "gridvolume"),
            ("sensor", "thinlens"),
            ("shape", "merge"),
            ("spectrum", "x"),
        )
        for body in ("", '<string name="filename" value="links.csv"/>', '<ref id="mat-walls"/>')
        for where in ("</scene>", "</shape>", "</bsdf>")
    ),
)
_TAGS = (
    "shape",
    "bsdf",
    "float",
    "string",
    "transform",
    "ref",
    "boolean",
    "integer",
    "emitter",
    "scene",
    "x",
    "rgb",
    "medium",
)


def scene(rng: Random, found: World, folder: Path) -> Case:
    """A scene file with elements, attributes or bytes changed."""
    study = found.copy(folder)
    file = study.with_name("scene.xml")
    text = file.read_text()
    match rng.randrange(4):
        case 0:
            place = rng.randrange(len(DOCUMENTS))
            changed, note = DOCUMENTS[place](text).encode(), f"document {place}"
        case 1:
            changed, note = damage(rng, text.encode()), "bytes"
        case _:
            root = ElementTree.fromstring(text)
            note = " ".join(_edit(rng, root) for _ in range(rng.choice((1, 1, 2))))
            changed = ElementTree.tostring(root)
    file.write_bytes(changed)
    return Case("scene", note, _traced(study, rng.random() < TRACED), names=_NAMES, own=OWN)


def _edit(rng: Random, root: ElementTree.Element) -> str:
    parents = [each for each in root.iter() if len(each)]
    parent = rng.choice(parents)
    child = rng.choice(list(parent))
    match rng.randrange(6):
        case 0:
            parent.remove(child)
            return f"remove {child.tag}"
        case 1:
            parent.append(child)
            return f"repeat {child.tag}"
        case 2:
            # Not into itself: such a tree has no end.
            rng.choice([each for each in parents if each not in set(child.iter())]).append(child)
            return f"move {child.tag}"
        case 3:
            child.tag = rng.choice(_TAGS)
            return f"tag {child.tag}"
        case _:
            key = rng.choice((*child.attrib, "id", "name", "type", "value"))
            value = rng.choice(
                (*TEXTS, *map(str, NUMBERS[:12]), "obj", "ply", "sphere", "cube", "nan", "disk", "0, 0")
            )
            # What no XML can hold is another attack's.
            child.set(key, re.sub("[\0-\x08]", "?", value)[:2000])
            return f"{child.tag}.{key} = {value[:40]!r}"


MOVES = ((10, -20, 0), (10_000, 0, 0), (0, 700_000, 300), (690_000, 5_330_000, 500))
"""Offsets of a moved study [m]."""


def moved(rng: Random, found: World, folder: Path) -> Case:
    """The whole study moved, its meshes stored with any type of PLY: the right path loss comes out."""
    study = found.copy(folder)
    offset = [part + rng.choice((0, 1, 37)) for part in rng.choice(MOVES)]
    for name in ("house.ply", "shed.ply"):
        file = folder / "meshes" / name
        file.write_bytes(_typed_ply(read_mesh(file, "ply"), offset, rng))
    roof = (
        np.loadtxt((folder / "meshes" / "roof.obj").read_text().splitlines()[:4], usecols=(1, 2, 3)) + offset
    )
    rows = [f"v {x} {y} {z}" for x, y, z in roof.tolist()]
    (folder / "meshes" / "roof.obj").write_text("\n".join([*rows, "f 1 2 3", "f 1 3 4", ""]))
    scene_file = folder / "scene.xml"
    x, y, z = offset
    move = f'<scale x="80" y="80"/><translate x="{x}" y="{y}" z="{z}"/>'
    scene_file.write_text(scene_file.read_text().replace('<scale x="80" y="80"/>', move))

    def act() -> list[float]:
        setup = Study.load(study).opened()
        links = SimpleNamespace(tx=setup.links.tx + offset, rx=setup.links.rx + offset)
        difference = np.asarray(path_loss(setup.tracer.trace(links))) - found.right["path_loss"]
        return np.round(difference, 3).tolist()

    return Case("moved", str(offset), act, expected=[0.0] * len(found.right["path_loss"]), own=OWN)


def _typed_ply(mesh: Mesh, offset: list[int], rng: Random) -> bytes:
    """A moved mesh of whole coordinates as PLY, with a type that holds them."""
    vertices = mesh.vertices + offset
    largest = np.abs(vertices).max()
    types = {"double": "f8", "int": "i4", "float": "f4", "short": "i2"}
    fitting = [name for name, most in zip(types, (1e9, 2e9, 8000, 32767), strict=True) if largest <= most]
    name, order = rng.choice(fitting), rng.choice("<>")
    encoding = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = (
        f"ply\nformat {encoding} 1.0\nelement vertex {len(vertices)}\n"
        + "".join(f"property {name} {axis}\n" for axis in "xyz")
        + f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", f"{order}i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    return header.encode() + vertices.astype(f"{order}{types[name]}").tobytes() + faces.tobytes()


def mesh(rng: Random, found: World, folder: Path) -> Case:
    """A mesh with numbers, words or bytes changed."""
    study = found.copy(folder)
    name = rng.choice(("house.ply", "shed.ply", "roof.obj"))
    file = folder / "meshes" / name
    if name == "shed.ply" and rng.random() < 0.7:
        trimesh.load(file, process=False).export(file, encoding="binary_little_endian")
    raw, bad = file.read_bytes(), False
    if rng.random() < 0.5:
        raw, note = damage(rng, raw), "bytes"
    else:
        raw, note, bad = _wrong(rng, raw, name) if b"\0" not in raw else _header(rng, raw)
    file.write_bytes(raw)
    whole = rng.random() < TRACED or bad
    if name.endswith("ply") and not whole:
        return Case("mesh", f"{name} {note}", lambda: read_mesh(file, "ply").faces, bad, names=(name,))
    return Case("mesh", f"{name} {note}", _traced(study, whole), bad, names=(name, *_NAMES), own=OWN)


def _wrong(rng: Random, raw: bytes, name: str) -> tuple[bytes, str, bool]:
    """A text mesh with one number changed, and whether it is none any more."""
    lines = raw.decode().splitlines()
    first = lines.index("end_header") + 1 if name.endswith("ply") else 0
    row = rng.randrange(first, len(lines))
    words = lines[row].split()
    value = rng.choice(
        ("nan", "inf", "-1", "999", "1e30", "x", "", "1.5", "2147483648", "-2147483649", "1e400", "0")
    )
    face = words[0] in ("f", "3") and len(words) == 4
    words[rng.randrange(1 if face or name.endswith("obj") else 0, len(words))] = value
    lines[row] = " ".join(words)
    # Mitsuba takes an OBJ's vertices backwards where they are negative, as the format says.
    bad = value in ("nan", "inf", "x", "") or (
        face and value in ("999", "1e30", "2147483648", "1.5", "-2147483649", "1e400")
    )
    return "\n".join([*lines, ""]).encode(), f"line {row + 1}: {value!r}", bad and name.endswith("ply")


def _header(rng: Random, raw: bytes) -> tuple[bytes, str, bool]:
    """A binary mesh whose header says something else, or with a vertex or corner that is none."""
    end = raw.index(b"end_header\n") + 11
    head, body = raw[:end].decode(), bytearray(raw[end:])
    vertices, faces = (int(each) for each in re.findall(r"element \w+ (\d+)", head))
    match rng.randrange(4):
        case 0:
            body[-4:] = int(rng.choice((-1, vertices, 10**9))).to_bytes(4, "little", signed=True)
            return head.encode() + body, "corner", True
        case 1:
            place = 4 * rng.randrange(3 * vertices)
            body[place : place + 4] = np.float32(rng.choice((math.nan, math.inf))).tobytes()
            return head.encode() + body, "vertex", "property uchar red" not in head and place < 12
        case 2:
            return head.encode() + body[: -rng.randrange(1, len(body))], "cut short", True
        case _:
            old, new = rng.choice(
                (
                    (f"face {faces}", f"face {10 ** rng.choice((1, 9, 15))}"),
                    (f"vertex {vertices}", f"vertex {vertices - 1}"),
                    (f"vertex {vertices}", f"vertex {10 ** rng.choice((2, 9, 15))}"),
                    ("little", "big"),
                    ("float x", "double x"),
                    ("uchar int", "uchar short"),
                    ("float z", "float y"),
                    ("end_header", "end"),
                    ("uchar int", "int int"),
                )
            )
            return (
                head.replace(old, new).encode() + body,
                f"{old!r} to {new!r}",
                old != new and "face 1" not in old,
            )


def antenna(rng: Random, found: World, folder: Path) -> Case:
    """A file of gains with cells, rows or bytes changed."""
    file = folder / "horn.csv"
    lines, bad = world.horn().splitlines(), False
    row = rng.randrange(1, len(lines))
    match rng.randrange(5):
        case 0 | 1:
            cells = lines[row].split(",")
            value = rng.choice(
                ("", "nan", "x", "1e999", "-inf", "500", "-1e9", "0x1", "1e5", "200", '"', "\0", "12.5")
            )
            cells[rng.randrange(3)] = value
            lines[row], bad, note = ",".join(cells), value != "12.5", f"row {row}: {value!r}"
        case 2:
            del lines[row]
            bad, note = True, f"without row {row}"
        case 3:
            lines.append(lines[row])
            bad, note = True, f"row {row} twice"
        case _:
            file.write_bytes(damage(rng, "\n".join(lines).encode()))
            return Case("antenna", "bytes", lambda: read_gain_table(file).gain_dbi, names=("horn.csv",))
    file.write_text("\n".join(lines))
    return Case("antenna", note, lambda: read_gain_table(file).gain_dbi, bad, names=("horn.csv",))
