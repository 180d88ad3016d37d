"""Outlines of buildings seen from above, for drawing."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from calibray.scenes.triangles import LEVEL, Triangles


def footprints(
    triangles: Triangles, west: float, south: float, east: float, north: float
) -> list[NDArray[np.float64]]:
    """Outlines of all that lies, whole or in part, within an area given by its bounds [m], the ground apart.

    They are closed lines, the first corner not repeated, each [n, 2], [m].
    """
    normal = triangles.normal
    area = np.linalg.norm(normal, axis=1)
    corners = triangles.corners
    low, high = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    least, most = np.array([west, south]), np.array([east, north])
    # Faces around the area too: half a roof has another outline.
    around = (most - least) / 2
    inside = (high > least - around).all(axis=1) & (low < most + around).all(axis=1)
    lying = (np.abs(normal[:, 2]) > LEVEL * area) & (area > 0)
    chosen = np.flatnonzero(lying & inside & ~triangles.ground)
    turned = normal[chosen, 2] < 0
    face = np.where(turned[:, None, None], corners[chosen][:, ::-1], corners[chosen])
    _, index = np.unique(face.reshape(-1, 3).round(3), axis=0, return_inverse=True)
    point = dict(zip(index.reshape(-1).tolist(), face.reshape(-1, 3)[:, :2].tolist(), strict=True))
    lines = (np.array([point[each] for each in loop]) for loop in _loops(index.reshape(-1, 3).tolist()))
    return [each for each in lines if (each.max(axis=0) > least).all() and (each.min(axis=0) < most).all()]


def _loops(faces: list[list[int]]) -> list[list[int]]:
    """Closed lines around faces that share edges; an edge that two faces share is inside."""
    edges = {
        edge for face in faces for edge in zip(face, face[1:] + face[:1], strict=True) if edge[0] != edge[1]
    }
    following: dict[int, list[int]] = defaultdict(list)
    for start, end in edges:
        if (end, start) not in edges:
            following[start].append(end)
    loops = []
    for start in list(following):
        while following[start]:
            loop = [start]
            while following[loop[-1]]:
                loop.append(following[loop[-1]].pop())
                if loop[-1] == start:
                    break
            if len(loop) > 3:
                loops.append(loop[:-1] if loop[-1] == start else loop)
    return loops
