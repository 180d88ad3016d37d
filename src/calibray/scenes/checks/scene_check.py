"""Detection of faults in a scene's materials, names, units and meshes before a long trace."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calibray.scenes.meshes import MILLIMETRE, WIDEST, MeshObject
from calibray.scenes.scene import ITU_NAMES
from calibray.scenes.scene_file import find_scene
from calibray.scenes.shapes import COARSE, TOO_COARSE, read_surface
from calibray.scenes.triangles import read_meshes, vertical_crossings
from calibray.support.messages import counted
from calibray.support.progress import Progress

Severity = Literal["error", "warning", "note"]

_FLAT: Final = 1e-10  # area below which the area of a face counts as zero [m^2]

CLOSE: Final = 0.01
"""Distance below which Sionna RT confuses parallel faces [m]. At 10 m from the origin, Sionna RT found two reflections
from sheets 1 mm apart and no path through walls 0.1 to 5 mm apart. At this distance from the origin, a gap of 10 mm was
sufficient; at 900 m, a gap of 100 mm was necessary."""

_PARALLEL: Final = 0.999  # minimum cosine of the angle between the normals of faces that count as parallel


@dataclass(frozen=True)
class Finding:
    """A fault in a scene, or in positions within a scene.

    Attributes:
        severity: "error" if Sionna RT or Calibray refuses the scene, "warning" if results may be wrong, otherwise
            "note".
        subject: The object, material or file with the fault; empty for the scene itself.
        problem: Description of the fault.
        remedy: How to correct the fault.
    """

    severity: Severity
    subject: str
    problem: str
    remedy: str


@dataclass(frozen=True)
class MeshFaults:
    """Size and faults of one mesh of a scene.

    Attributes:
        name: Name of the object.
        material: Name of the object's material.
        vertices: Number of vertices.
        faces: Number of triangles.
        open_edges: Number of edges that belong to only one face, even after vertices at the same position are merged.
        unwelded_edges: Number of edges at which two faces meet without sharing vertices, so that no wedge is found.
        crowded_edges: Number of edges shared by more than two faces, so that no wedge is found.
        flipped_faces: Number of faces whose normals point inward, or opposite to the normals of their neighbours.
        empty_faces: Number of faces with zero area.
        repeated_faces: Number of faces with the same corners as another face.
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
class SceneCheck:
    """The result of checking a scene.

    Attributes:
        source: The scene that was checked.
        bounds: West, south, bottom, east, north and top [6], in the scene's unit.
        objects: The meshes of the scene and their faults.
        findings: The faults, most severe first.
    """

    source: str
    bounds: tuple[float, ...]
    objects: tuple[MeshFaults, ...]
    findings: tuple[Finding, ...]

    @property
    def faces(self) -> int:
        """Total number of triangles in all meshes."""
        return sum(item.faces for item in self.objects)


def check_scene(source: str | Path, progress: Progress | None = None) -> SceneCheck:
    """Examine the size, meshes and faults of a scene: a Mitsuba XML file, or `sionna:NAME`.

    `progress` is called with ("examining", meshes done, total number of meshes).

    Raises:
        InputError: The scene does not exist or is not a Mitsuba scene, or a mesh is missing or cannot be read.
    """
    path, root = find_scene(source)
    checked: list[MeshFaults] = []
    coarse: list[Finding] = []
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for item in read_meshes(source):
        checked.append(count_faults(item))
        if item.mesh.step > COARSE:
            problem = f"its file stores coordinates in steps of {item.mesh.step:g} m, because it is far from the origin"
            severity: Severity = "error" if item.mesh.step > TOO_COARSE else "warning"
            coarse.append(Finding(severity, item.name, problem, "export it with coordinates of type double"))
        low = np.minimum(low, item.mesh.vertices.min(axis=0))
        high = np.maximum(high, item.mesh.vertices.max(axis=0))
        if progress is not None:
            progress("examining", len(checked), len(root.findall("shape")))
    findings = [*_material_findings(root, checked), *scale_findings(low, high), *coarse]
    for item in checked:
        findings += _mesh_findings(item)
    if not any(finding.severity == "error" for finding in findings):
        findings += _overlap_findings(root, path)
    order = ("error", "warning", "note")
    findings.sort(key=lambda finding: order.index(finding.severity))
    return SceneCheck(str(source), (*low.tolist(), *high.tolist()), tuple(checked), tuple(findings))


def _mesh_findings(item: MeshFaults) -> list[Finding]:
    faults: Sequence[tuple[int, Severity, str, str]] = (
        (
            item.unwelded_edges,
            "warning",
            f"{counted(item.unwelded_edges, 'edge')} at which faces meet without sharing vertices, where Sionna RT "
            "finds no diffraction",
            "merge vertices by distance (Blender: M, By Distance) and export again without splitting normals",
        ),
        (
            item.crowded_edges,
            "note",
            f"{counted(item.crowded_edges, 'edge')} shared by more than two faces, where Sionna RT finds no "
            "diffraction",
            "remove inner walls, or separate bodies that touch",
        ),
        (
            item.flipped_faces,
            "note",
            f"{item.flipped_faces} of {item.faces} faces with normals that point inward or opposite to the normals of "
            "adjacent faces; Sionna RT accepts such normals, but other programs may not",
            "recalculate normals to point outside (Blender: Shift-N)",
        ),
        (
            item.empty_faces,
            "warning",
            f"{item.empty_faces} of {item.faces} faces with zero area",
            "dissolve degenerate faces, and export again",
        ),
        (
            item.repeated_faces,
            "warning",
            f"{item.repeated_faces} of {item.faces} faces coincide with another face: paths through these faces may be "
            "lost, and reflections may be counted twice",
            "remove the duplicates",
        ),
    )
    return [
        Finding(severity, item.name, problem, remedy) for count, severity, problem, remedy in faults if count
    ]


def _material_findings(root: ElementTree.Element, objects: Sequence[MeshFaults]) -> Iterator[Finding]:
    defined = set()
    for bsdf in [*root.findall("bsdf"), *root.findall("shape/bsdf")]:
        identifier = bsdf.get("id") or bsdf.get("name") or ""
        name = identifier.removeprefix("mat-")
        defined.add(name)
        if not identifier:
            problem = f"a BSDF of type {bsdf.get('type')!r} has no id"
            yield Finding("error", "", problem, "give it the id mat-NAME")
        elif bsdf.get("type") != "itu-radio-material" and name in ITU_NAMES:
            remedy = f"name it mat-itu_{name} to use the ITU constants, or choose another name"
            yield Finding("error", identifier, "has an ITU-R P.2040 name, which Sionna RT refuses", remedy)
    for name, count in Counter(shape.get("id") for shape in root.findall("shape")).items():
        if name is not None and count > 1:
            yield Finding(
                "error", name, f"is the id of {count} objects, which Sionna RT refuses", "make the ids unique"
            )
    for item in objects:
        if item.material not in defined:
            problem = f"refers to a material that the scene does not contain ({item.material!r})"
            yield Finding("error", item.name, problem, "give it a material")
        if item.name in defined:
            problem = "has the name of a material, which Sionna RT refuses"
            yield Finding("error", item.name, problem, "rename the object")


def scale_findings(low: NDArray[np.float64], high: NDArray[np.float64]) -> Iterator[Finding]:
    """Faults in the unit and the heights of a scene, given the lower and upper corners [3] of its bounds."""
    extent = high - low
    width = float(extent[:2].max())
    size = f"{extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g}"
    if width < 1 and np.abs([*low[:2], *high[:2]]).max() <= 180:
        problem = f"the scene measures {size}, as if in degrees of longitude and latitude"
        yield Finding("error", "", problem, "project it to metres, as calibray scene does")
        return
    if width > WIDEST:
        problem = f"the scene measures {size} m, as if in millimetres"
        yield Finding("error", "", problem, "scale it by 0.001 to metres")
    if 0 < extent[2] < 0.005 * width and extent[2] < 1:
        problem = f"the scene measures {size} m and is almost flat"
        yield Finding("note", "", problem, "check that heights were exported")


def _overlap_findings(root: ElementTree.Element, path: Path) -> Iterator[Finding]:
    """Report exposed faces that nearly coincide with a parallel face, and name one pair of objects as an example."""
    shapes = root.findall("shape")
    meshes = [read_surface(shape, path) for shape in shapes]
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    owner = np.repeat(np.arange(len(shapes)), [len(mesh.faces) for mesh in meshes])
    references = [(shape.find("ref"), shape.find("bsdf")) for shape in shapes]
    names = [next((part.get("id") for part in parts if part is not None), None) for parts in references]
    cover = find_covers(corners)
    covered = np.flatnonzero(cover >= 0)
    if not len(covered):
        return
    pairs = np.column_stack([owner[covered], owner[cover[covered]]])
    differs = np.array([names[one] != names[other] for one, other in pairs.tolist()])
    one, other = (shapes[number].get("id") for number in pairs[np.argmax(differs)].tolist())
    material = (
        f", {differs.sum()} of them to a face of a different material, so a ray may hit either face"
        if differs.any()
        else ""
    )
    problem = (
        f"{counted(len(covered), 'face')} closer than {CLOSE:g} m to a parallel face (such as faces of {one!r} and "
        f"{other!r}){material}: reflections may be counted twice, and paths through the faces may be lost"
    )
    severity: Severity = "warning" if differs.any() else "note"
    yield Finding(severity, "", problem, "remove one of the faces, or move them apart by 0.1 m")


def find_covers(corners: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each face, index [F] of a parallel face that is closer than `CLOSE` to its centroid; -1 if there is none.

    `corners` [F, 3, 3] are the corners of the faces [m]. The index is also -1 for faces that rays cannot reach from
    outside, such as walls between touching buildings and floors of buildings on the ground. A side of a face is in the
    open if a straight line from it crosses an even number of faces.
    """
    cover = np.full(len(corners), -1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 2 * _FLAT, length, np.inf)
    steepest = np.abs(normal).argmax(axis=1)
    for axis in range(3):
        # Faces are projected along the axis closest to their normal, which gives the largest projected area.
        turn = [(axis + 1) % 3, (axis + 2) % 3, axis]
        members = np.flatnonzero(steepest == axis)
        centroid = corners[members].mean(axis=1)[:, turn]
        order = np.argsort(centroid[:, 0], kind="stable")
        members, centroid = members[order], centroid[order]
        found = np.full(len(members), -1)
        above, below = np.zeros(len(members), dtype=int), np.zeros(len(members), dtype=int)
        for face, point, height in vertical_crossings(corners[:, :, turn], centroid):
            gap = height - centroid[point, 2]
            own = members[point]
            cosine = np.abs((normal[face] * normal[own]).sum(axis=1))
            # The distance between the faces is the gap along this axis times the component of the normal along the
            # axis.
            near = (cosine > _PARALLEL) & (np.abs(gap * normal[own, axis]) < CLOSE) & (face != own)
            found[point[near]] = face[near]
            np.add.at(above, point, gap > CLOSE)
            np.add.at(below, point, gap < -CLOSE)
        # A side with an even number of surfaces beyond it is outside all closed bodies.
        # Nothing below the ground is in the open.
        is_open = (above % 2 == 0) | ((below % 2 == 0) & (axis != 2))
        cover[members[is_open]] = found[is_open]
    return cover


def count_faults(item: MeshObject) -> MeshFaults:
    """Count the faults in a mesh."""
    mesh = item.mesh
    _, position = np.unique(np.rint(mesh.vertices / MILLIMETRE).astype(np.int64), axis=0, return_inverse=True)
    by_position = position.reshape(-1)[mesh.faces]
    sides = mesh.vertices[mesh.faces[:, 1:]] - mesh.vertices[mesh.faces[:, :1]]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    empty = (area < _FLAT) | (by_position == np.roll(by_position, 1, axis=1)).any(axis=1)
    _, repeats = np.unique(np.sort(by_position[~empty], axis=1), axis=0, return_counts=True)
    _, _, uses = _edges(mesh.faces[~empty])
    _, _, uses_by_position = _edges(by_position[~empty])
    open_edges = int((uses_by_position == 1).sum())
    return MeshFaults(
        name=item.name,
        material=item.material,
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        open_edges=open_edges,
        # An unwelded edge counts as two open edges, one for each face.
        unwelded_edges=max(0, (int((uses == 1).sum()) - open_edges) // 2),
        crowded_edges=int((uses_by_position > 2).sum()),
        flipped_faces=_count_flipped(mesh.vertices, mesh.faces[~empty], by_position[~empty]),
        empty_faces=int(empty.sum()),
        repeated_faces=int((repeats - 1).sum()),
    )


def _edges(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The directed sides of all faces [3 F, 2], the edge of each side [3 F], and the number of sides per edge [E]."""
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, edge, uses = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    return sides, edge.reshape(-1), uses


def _count_flipped(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], by_position: NDArray[np.int64]
) -> int:
    """Count the faces with wrong normals.

    First, the faces of each connected component are oriented consistently. The correct orientation is known for two
    types of component. A component that is closed, or open only at its bottom, must have a positive signed volume. A
    horizontal sheet must have an upward normal. For any other component, such as a wall, either side may be outside,
    and the faces whose orientation differs from that of the majority are counted.
    """
    if not len(faces):
        return 0
    orientation, piece = _orient(by_position)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    base = np.full((piece.max() + 1, 3), np.inf)
    np.minimum.at(base, piece, np.minimum(np.minimum(a, b), c))
    normal = np.cross(b - a, c - a) * orientation[:, None]
    # Divergence theorem: positive if the normals of a closed body point outwards. Positions are relative to the lower
    # bounds of the component, which avoids cancellation of large coordinates.
    volume = np.bincount(piece, (normal * (a - base[piece])).sum(axis=1) / 6)
    area = np.bincount(piece, np.linalg.norm(normal, axis=1) / 2)
    # Twice the signed area in plan; for a level sheet, more than its total area.
    upward = np.bincount(piece, normal[:, 2])
    is_sheet = np.abs(volume) < 1e-3 * area**1.5
    is_level = np.abs(upward) > area
    is_closed = np.bincount(piece, _open_above(vertices, faces, by_position, base[piece, 2])) == 0
    right = np.where(
        is_sheet & is_level, np.sign(upward), np.where(is_closed & ~is_sheet, np.sign(volume), 0.0)
    )
    wrong = orientation * right[piece] < 0
    # If neither side is known to be outside, the minority of faces counts as flipped.
    minority = np.minimum(np.bincount(piece, orientation > 0), np.bincount(piece, orientation < 0))
    return int(wrong.sum() + minority[np.unique(piece[right[piece] == 0])].sum())


def _open_above(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    by_position: NDArray[np.int64],
    lowest: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Number [F] of open edges of each face that lie above `lowest`, the bottom of its connected component."""
    _, edge, uses = _edges(by_position)
    is_open = (uses == 1)[edge].reshape(-1, 3)
    height = vertices[faces][:, :, 2]
    above = np.maximum(height, np.roll(height, -1, axis=1)) > lowest[:, None] + 2 * MILLIMETRE
    return (is_open & above).sum(axis=1)


def _orient(faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sign [F], +1 or -1, that orients each face consistently with its neighbours, and index [F] of its component."""
    count = len(faces)
    sides, edge, uses = _edges(faces)
    order = np.argsort(edge, kind="stable")
    pairs = order[uses[edge[order]] == 2].reshape(-1, 2)
    one, other = pairs.T // 3
    same = (sides[pairs[:, 0]] == sides[pairs[:, 1]][:, ::-1]).all(axis=1)
    # The graph has two nodes for each face: f is the face as given, and count + f is the face reversed. The edges of
    # the graph join consistent orientations of neighbours, so all orientations in one component are consistent.
    links = np.concatenate(
        [
            np.column_stack([one, np.where(same, other, other + count)]),
            np.column_stack([one + count, np.where(same, other + count, other)]),
        ]
    )
    graph = coo_array((np.ones(len(links)), links.T), shape=(2 * count, 2 * count))
    _, side = connected_components(graph, directed=False)
    pieces = coo_array((np.ones(len(one)), (one, other)), shape=(count, count))
    _, piece = connected_components(pieces, directed=False)
    first = np.full(piece.max() + 1, count)
    np.minimum.at(first, piece, np.arange(count))
    return np.where(side[:count] == side[first[piece]], 1.0, -1.0), piece
