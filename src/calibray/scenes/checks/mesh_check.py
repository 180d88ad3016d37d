"""Health of a mesh: edges without a neighbour, faces that look the wrong way, lie twice or have no area."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calibray.scenes.meshes import Mesh

_SAME: Final = 0.001  # [m], corners nearer than this are one place
_FLAT: Final = 1e-10  # [m^2], area of a face that has none


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

    Faces are turned alike along the edges that two of them share. A connected piece that is closed, or open at its
    bottom alone, has one right way then: its volume is positive; and a level sheet looks up. Of any other piece, such
    as a wall, it is not known which side is outside, and the faces that look unlike most are counted.
    """
    if not len(faces):
        return 0
    turn, piece = _turned(by_place)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    base = np.full((piece.max() + 1, 3), np.inf)
    np.minimum.at(base, piece, np.minimum(np.minimum(a, b), c))
    normal = np.cross(b - a, c - a) * turn[:, None]
    volume = np.bincount(piece, (normal * (a - base[piece])).sum(axis=1) / 6)
    area = np.bincount(piece, np.linalg.norm(normal, axis=1) / 2)
    upward = np.bincount(piece, normal[:, 2])
    is_sheet = np.abs(volume) < 1e-3 * area**1.5
    is_level = np.abs(upward) > area
    lowest = base[:, 2]
    is_closed = np.bincount(piece, _open_above(vertices, faces, by_place, lowest[piece])) == 0
    right = np.where(
        is_sheet & is_level, np.sign(upward), np.where(is_closed & ~is_sheet, np.sign(volume), 0.0)
    )
    wrong = turn * right[piece] < 0
    undecided = right[piece] == 0
    odd = np.minimum(np.bincount(piece, turn > 0), np.bincount(piece, turn < 0))
    return int(wrong.sum() + odd[np.unique(piece[undecided])].sum())


def _open_above(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    by_place: NDArray[np.int64],
    lowest: NDArray[np.float64],
) -> NDArray[np.int64]:
    """How many edges of every face have no other face and do not lie at the bottom of its piece [F]."""
    edges = by_place[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, edge, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    is_open = (uses == 1)[edge.reshape(-1)].reshape(-1, 3)
    height = vertices[faces][:, :, 2]
    above = np.maximum(height, np.roll(height, -1, axis=1)) > lowest[:, None] + 2 * _SAME
    return (is_open & above).sum(axis=1)


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
