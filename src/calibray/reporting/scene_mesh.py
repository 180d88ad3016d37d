"""The scene and its paths packed for the viewer of the report: whole numbers on a grid, as text.

Positions are steps of a grid over the scene, 65,536 in each direction: 3 cm in a scene of 2 km.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.reporting.link_survey import Survey
from calibray.reporting.rays import Rays
from calibray.scenes import Triangles

STEPS: Final = 65_535
TRIANGLES: Final = 250_000
"""Triangles that are drawn; of more, the largest are."""


@dataclass(frozen=True)
class Grid:
    """A grid that positions are rounded to.

    Attributes:
        low: Its corner [3], [m].
        step: Its spacing [m], the same in all directions.
    """

    low: NDArray[np.float64]
    step: float

    @classmethod
    def over(cls, *points: NDArray[np.float64]) -> Grid:
        """The grid over some positions [n, 3], [m]."""
        every = np.concatenate([part.reshape(-1, 3) for part in points])
        low, high = every.min(axis=0), every.max(axis=0)
        return cls(low, float(max((high - low).max(), 1.0) / STEPS))

    def steps(self, points: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Positions as whole numbers of steps [n, 3]."""
        return np.clip(np.rint((points - self.low) / self.step), 0, STEPS).astype(np.uint16)


def packed(
    survey: Survey, triangles: Triangles | None, rays: Rays | None, materials: list[str]
) -> dict[str, Any]:
    """What the viewer draws.

    Args:
        survey: The links.
        triangles: The scene; None where it cannot be read.
        rays: The paths; None where there are none.
        materials: Names of the scene's materials, in its order.

    Returns:
        Plain values, arrays as base64 of little-endian whole numbers.
    """
    near = [survey.tx, survey.rx]
    if triangles is not None and len(triangles.face):
        near.append(triangles.vertex)
    if rays is not None:
        near.append(rays.vertex.astype(float))
    grid = Grid.over(*near)
    return {
        "low": grid.low.tolist(),
        "step": grid.step,
        "tx": _text(grid.steps(survey.tx)),
        "rx": _text(grid.steps(survey.rx)),
        "mesh": None if triangles is None else _mesh(triangles, grid, materials),
        "paths": None if rays is None else _paths(rays, grid),
    }


def _mesh(triangles: Triangles, grid: Grid, materials: list[str]) -> dict[str, Any]:
    """The triangles, ordered by ground and material, over vertices that are no nearer than a step."""
    area = np.linalg.norm(triangles.normal, axis=1)
    kept = np.sort(np.argsort(-area, kind="stable")[:TRIANGLES])
    part = np.where(triangles.ground[kept], 0, 1 + triangles.material[kept])
    order = kept[np.argsort(part, kind="stable")]
    grids = grid.steps(triangles.vertex)[triangles.face[order]].reshape(-1, 3)
    vertex, index = np.unique(grids, axis=0, return_inverse=True)
    sizes = np.bincount(part, minlength=1 + len(materials))
    return {
        "vertex": _text(vertex),
        "face": _text(index.astype(np.uint32)),
        "parts": [
            {"name": name, "count": int(size), "ground": not place}
            for place, (name, size) in enumerate(zip(["ground", *materials], sizes, strict=True))
            if size
        ],
        "drawn": len(kept),
        "all": len(triangles.face),
        "left_out": len(triangles.left_out),
    }


def _paths(rays: Rays, grid: Grid) -> dict[str, Any]:
    paths = rays.paths
    counts = np.bincount(paths.link, minlength=paths.num_links)
    return {
        "count": _text(counts.astype(np.uint8)),
        "depth": _text(np.diff(paths.first).astype(np.uint8)),
        # Hundredths of a decibel below 0 dB.
        "loss": _text(np.clip(np.rint(-100 * rays.gain_db), 0, STEPS).astype(np.uint16)),
        "kind": _text(paths.kind.astype(np.uint8)),
        "material": _text(paths.material.astype(np.uint16)),
        "materials": list(paths.materials),
        "vertex": _text(grid.steps(rays.vertex.astype(float))),
        "per_link": rays.per_link,
        "traced": rays.traced,
    }


def _text(values: NDArray[np.integer]) -> str:
    return b64encode(np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<")).tobytes()).decode()
