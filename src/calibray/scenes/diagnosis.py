"""Diagnosis: what is wrong with a scene before an hour of tracing shows it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calibray.errors import InputError
from calibray.extras import library
from calibray.materials import ITU_MATERIALS
from calibray.progress import Progress
from calibray.scenes.meshes import Mesh
from calibray.scenes.scene import find_scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Severity = Literal["error", "warning", "note"]

LARGEST: Final = 50_000.0
"""An extent [m] beyond which a scene is hardly in metres about a local origin."""

_SAME: Final = 0.001  # [m], corners nearer than this are one place
_FLAT: Final = 1e-10  # [m^2], area of a face that has none


@dataclass(frozen=True)
class Finding:
    """One thing that a scene suffers from.

    Attributes:
        severity: "error" if Sionna RT or Calibray will refuse the scene, "warning" if results suffer, else "note".
        place: The object or the material that it is about; the scene itself if empty.
        problem: What is wrong.
        remedy: What to do about it.
    """

    severity: Severity
    place: str
    problem: str
    remedy: str


@dataclass(frozen=True)
class ObjectHealth:
    """One mesh of a scene, counted.

    Attributes:
        name: Its name.
        material: Its material.
        vertices: Number of vertices.
        faces: Number of triangles.
        open_edges: Edges of one face alone, even when corners at one place are taken for one.
        unwelded_edges: Edges that two faces have in common by place but not by vertex: no wedge is found there.
        crowded_edges: Edges that more than two faces share: no wedge is found there either.
        flipped_faces: Faces whose normals point inward, or differently from those of the faces beside them.
        empty_faces: Faces without area.
        repeated_faces: Faces with the corners of another one.
    """

    name: str
    material: str
    vertices: int
    faces: int
    open_edges: int
    unwelded_edges: int
    crowded_edges: int
    flipped_faces: int
    empty_faces: int
    repeated_faces: int


@dataclass(frozen=True)
class Diagnosis:
    """What a scene is like.

    Attributes:
        source: What was examined.
        bounds: West, south, bottom, east, north and top [6], in the scene's unit.
        objects: Its meshes, counted.
        findings: What is wrong, the worst first.
    """

    source: str
    bounds: tuple[float, ...]
    objects: tuple[ObjectHealth, ...]
    findings: tuple[Finding, ...]

    @property
    def faces(self) -> int:
        """Number of triangles of all meshes."""
        return sum(item.faces for item in self.objects)


def diagnose(source: str | Path, progress: Progress | None = None) -> Diagnosis:
    """Examine a scene.

    Args:
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        progress: Called with ("examining", meshes done, meshes in all).

    Returns:
        What it is like.

    Raises:
        InputError: It does not exist, is no scene, or a mesh of it is missing or cannot be read.
    """
    path, root = find_scene(source)
    examined: list[ObjectHealth] = []
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for name, material, mesh in read_meshes(path, root):
        examined.append(health(name, material, mesh))
        low, high = np.minimum(low, mesh.vertices.min(axis=0)), np.maximum(high, mesh.vertices.max(axis=0))
        if progress is not None:
            progress("examining", len(examined), len(root.findall("shape")))
    objects, bounds = tuple(examined), (*low.tolist(), *high.tolist())
    findings = [*_material_findings(root, objects), *_scale_findings(bounds)]
    for item in objects:
        findings += _object_findings(item)
    order = ("error", "warning", "note")
    return Diagnosis(
        str(source), bounds, objects, tuple(sorted(findings, key=lambda one: order.index(one.severity)))
    )


def read_meshes(path: Path, root: ElementTree.Element) -> Iterator[tuple[str, str, Mesh]]:
    """Read the meshes of a scene, PLY and OBJ files, one after the other.

    Args:
        path: Its XML file.
        root: The element `scene`.

    Yields:
        Object, material and mesh, turned over where the file says so; shapes without a file are passed by.

    Raises:
        InputError: A mesh is missing or cannot be read, or there is none.
    """
    trimesh = library("trimesh", "scenes")
    found = 0
    for shape in root.findall("shape"):
        name = (shape.get("id") or "?").removeprefix("mesh-")
        filename = shape.find("string[@name='filename']")
        if filename is None:
            continue
        file = path.parent / filename.get("value", "")
        if not file.is_file():
            raise InputError(
                f"{path}: mesh {file} of {name!r} does not exist; copy the meshes folder beside the scene"
            )
        try:
            loaded = trimesh.load_mesh(file, process=False, maintain_order=True)
            mesh = Mesh(np.asarray(loaded.vertices, dtype=float), np.asarray(loaded.faces, dtype=np.int64))
        except Exception as error:  # whatever trimesh's readers raise on a broken file
            raise InputError(
                f"{path}: mesh {file} of {name!r} cannot be read ({error}); export it again"
            ) from None
        if not len(mesh.faces):
            raise InputError(
                f"{path}: mesh {file} of {name!r} has no face; remove the object, or export it again"
            )
        reference = shape.find("ref")
        nested = shape.find("bsdf")
        material = next((part.get("id", "") for part in (reference, nested) if part is not None), "")
        turned = shape.find("boolean[@name='flip_normals']")
        if turned is not None and turned.get("value") == "true":
            mesh = Mesh(mesh.vertices, mesh.faces[:, ::-1])
        found += 1
        yield name, material.removeprefix("mat-"), mesh
    if not found:
        raise InputError(f"{path}: the scene has no mesh; export the scene with its meshes")


def health(name: str, material: str, mesh: Mesh) -> ObjectHealth:
    """Count what is wrong with a mesh.

    Args:
        name: Its object.
        material: Its material.
        mesh: The mesh.

    Returns:
        The counts.
    """
    _, place = np.unique(np.rint(mesh.vertices / _SAME).astype(np.int64), axis=0, return_inverse=True)
    by_place = place.reshape(-1)[mesh.faces]
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    twice_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    empty = (twice_area / 2 < _FLAT) | (by_place == np.roll(by_place, 1, axis=1)).any(axis=1)
    _, repeats = np.unique(np.sort(by_place[~empty], axis=1), axis=0, return_counts=True)
    _, uses = _edge_uses(mesh.faces[~empty])
    _, uses_by_place = _edge_uses(by_place[~empty])
    open_by_place = int((uses_by_place == 1).sum())
    return ObjectHealth(
        name=name,
        material=material,
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        open_edges=open_by_place,
        unwelded_edges=max(0, (int((uses == 1).sum()) - open_by_place) // 2),
        crowded_edges=int((uses_by_place > 2).sum()),
        flipped_faces=_flipped(mesh.vertices, mesh.faces[~empty], by_place[~empty]),
        empty_faces=int(empty.sum()),
        repeated_faces=int((repeats - 1).sum()),
    )


def _edge_uses(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges without direction [E, 2] and how many faces each has [E]."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


def _flipped(vertices: NDArray[np.float64], faces: NDArray[np.int64], by_place: NDArray[np.int64]) -> int:
    """Faces that look the wrong way.

    Faces are turned alike along the edges that two of them share; then each connected piece has one right way: its
    signed volume about a point below its middle is positive, and a level sheet looks up.
    """
    if not len(faces):
        return 0
    turn, piece = _turned(by_place)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    base = np.full((piece.max() + 1, 3), np.inf)
    np.minimum.at(base, piece, np.minimum(np.minimum(a, b), c))
    middle = np.zeros_like(base)
    np.add.at(middle, piece, (a + b + c) / 3)
    base[:, :2] = (middle / np.bincount(piece)[:, None])[:, :2]
    normal = np.cross(b - a, c - a) * turn[:, None]
    volume = np.bincount(piece, (normal * (a - base[piece])).sum(axis=1) / 6)
    area = np.bincount(piece, np.linalg.norm(normal, axis=1) / 2)
    upward = np.bincount(piece, normal[:, 2])
    sheet = np.abs(volume) < 1e-3 * area**1.5
    # An upright sheet has no right way: either is as good.
    right = np.where(sheet, np.sign(np.where(np.abs(upward) < 1e-3 * area, 0, upward)), np.sign(volume))
    wrong = turn * right[piece] < 0
    undecided = right[piece] == 0
    odd = np.minimum(np.bincount(piece, turn > 0), np.bincount(piece, turn < 0))
    return int(wrong.sum() + odd[np.unique(piece[undecided])].sum())


def _turned(faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """+1 or -1 for every face so that neighbours look the same way [F], and the connected piece of each [F]."""
    count = len(faces)
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    face = np.repeat(np.arange(count), 3)
    _, edge, uses = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    order = np.argsort(edge, kind="stable")
    pairs = order[uses[edge[order]] == 2].reshape(-1, 2)
    one, other = face[pairs].T
    same_way = (directed[pairs[:, 0]] == directed[pairs[:, 1]][:, ::-1]).all(axis=1)
    # Every face stands twice, as it is and turned over; agreeing ones are linked.
    links = np.concatenate(
        [
            np.column_stack([one, np.where(same_way, other, other + count)]),
            np.column_stack([one + count, np.where(same_way, other + count, other)]),
        ]
    )
    graph = coo_array((np.ones(len(links)), links.T), shape=(2 * count, 2 * count))
    _, side = connected_components(graph, directed=False)
    pieces = coo_array((np.ones(len(one)), (one, other)), shape=(count, count))
    _, piece = connected_components(pieces, directed=False)
    first = np.full(piece.max() + 1, count)
    np.minimum.at(first, piece, np.arange(count))
    return np.where(side[:count] == side[first[piece]], 1.0, -1.0), piece


def _object_findings(item: ObjectHealth) -> list[Finding]:
    share = f"of {item.faces} faces" if item.faces else ""
    faults: Sequence[tuple[int, Severity, str, str]] = (
        (
            item.unwelded_edges, "warning",
            "edges at which faces meet without sharing vertices: no diffraction there",
            "merge vertices by distance (Blender: M, By Distance) and export again without splitting normals",
        ),
        (
            item.crowded_edges, "note",
            "edges that more than two faces share: no diffraction there",
            "remove inner walls, or part the bodies that touch",
        ),
        (
            item.flipped_faces, "warning",
            f"{share} with the normal turned inward or against their neighbours'",
            "recalculate normals outside (Blender: Shift-N)",
        ),
        (item.empty_faces, "warning", f"{share} without area", "dissolve degenerate faces, and export again"),
        (
            item.repeated_faces, "warning",
            f"{share} that lie on another one: waves pass the wall twice",
            "remove the copies",
        ),
    )  # fmt: skip
    return [
        Finding(severity, item.name, f"{count} {problem}", remedy)
        for count, severity, problem, remedy in faults
        if count
    ]


def _material_findings(root: ElementTree.Element, objects: Sequence[ObjectHealth]) -> list[Finding]:
    known = {name for table in ITU_MATERIALS.values() for name in table}
    findings = []
    for bsdf in [*root.findall("bsdf"), *root.findall("shape/bsdf")]:
        identifier = bsdf.get("id") or bsdf.get("name")
        if not identifier:
            findings.append(
                Finding(
                    "error", "", f"a BSDF of type {bsdf.get('type')!r} has no id", "give it one: mat-NAME"
                )
            )
        elif bsdf.get("type") != "itu-radio-material" and identifier.removeprefix("mat-") in known:
            findings.append(
                Finding(
                    "error",
                    identifier,
                    "has a name of ITU-R P.2040's, which Sionna RT refuses",
                    f"name it mat-itu_{identifier.removeprefix('mat-')} for ITU's constants, or otherwise",
                )  # fmt: skip
            )
    defined = {
        (bsdf.get("id") or bsdf.get("name") or "").removeprefix("mat-")
        for bsdf in [*root.findall("bsdf"), *root.findall("shape/bsdf")]
    }
    for item in objects:
        if item.material not in defined:
            findings.append(
                Finding(
                    "error",
                    item.name,
                    f"refers to no material of the scene ({item.material!r})",
                    "give it one",
                )
            )
        if item.name in defined:
            findings.append(
                Finding(
                    "error",
                    item.name,
                    "is called like a material, which Sionna RT refuses",
                    "rename the object",
                )
            )
    return findings


def _scale_findings(bounds: Sequence[float]) -> list[Finding]:
    low, high = np.array(bounds[:3]), np.array(bounds[3:])
    extent = high - low
    across, centre = float(extent[:2].max()), float(np.abs((low + high) / 2)[:2].max())
    size = f"{extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g}"
    if across < 1 and np.abs([*low[:2], *high[:2]]).max() <= 180:
        return [
            Finding(
                "error",
                "",
                f"the scene is {size} large, as if in degrees of longitude and latitude",
                "project it to metres (calibray scene does)",
            )  # fmt: skip
        ]
    findings = []
    if across > LARGEST:
        findings.append(
            Finding(
                "error",
                "",
                f"the scene is {size} m large, as if in millimetres",
                "scale it by 0.001 to metres",
            )
        )
    elif centre > 100 * max(across, 1000.0):
        findings.append(
            Finding(
                "error",
                "",
                f"the scene lies {centre:.0f} m from its origin, where single precision is coarse",
                "move the origin into the scene (calibray scene does)",
            )  # fmt: skip
        )
    if 0 < extent[2] < 0.005 * across and extent[2] < 1:
        findings.append(
            Finding(
                "note",
                "",
                f"the scene is {size} m large, flat as a sheet",
                "check that heights were exported",
            )
        )
    return findings


def draw_positions(
    source: str | Path, tx: ArrayLike, rx: ArrayLike, inside: Mapping[str, ArrayLike] | None = None
) -> Figure:
    """Draw antennas over the scene seen from above.

    Args:
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        tx: Transmitters [n, 3], [m].
        rx: Receivers [m, 3], [m].
        inside: Further positions to mark, by what they are: [k, 3], [m].

    Returns:
        The figure; its `savefig` writes PNG, SVG or PDF.

    Raises:
        InputError: The scene cannot be read.
    """
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    path, root = find_scene(source)
    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    meshes = [mesh for _, _, mesh in read_meshes(path, root)]
    whole = np.ptp(np.concatenate([mesh.vertices[:, :2] for mesh in meshes]), axis=0)
    for mesh in meshes:
        if not _is_ground(mesh, whole):
            seen = mesh.vertices[mesh.faces][:, :, :2]
            # Walls are lines when seen from above.
            axes.add_collection(PolyCollection(seen, facecolor="0.85", edgecolor="0.45", linewidth=0.4))
    marks = {"receivers": (rx, "o", "tab:blue", 12), "transmitters": (tx, "^", "tab:red", 50)}
    for what, places in (inside or {}).items():
        marks[what] = (places, "x", "tab:orange", 30)
    for what, (places, marker, color, size) in marks.items():
        points = np.asarray(places, dtype=float).reshape(-1, 3)
        if len(points):
            axes.scatter(
                points[:, 0], points[:, 1], size, color, marker, label=f"{len(points)} {what}", zorder=3
            )
    axes.autoscale_view()
    axes.legend(loc="upper right")
    axes.set_title(path.name)
    return figure


def _is_ground(mesh: Mesh, whole: NDArray[np.float64]) -> bool:
    """Whether a mesh is a sheet under the whole scene, which would hide everything in a drawing."""
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    normal = np.cross(sides[:, 0], sides[:, 1])
    level = np.abs(normal[:, 2]) > 0.5 * np.linalg.norm(normal, axis=1)
    wide = (np.ptp(mesh.vertices[:, :2], axis=0) > 0.8 * whole).all()
    seen, extent = np.abs(normal[:, 2]).sum() / 2, float(np.prod(whole))
    return bool(level.all() and wide and seen > 0.5 * extent)
