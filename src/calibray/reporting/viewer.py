"""Data for the report's 3-D viewer: the scene and the strongest paths of every link, packed as text.

Positions are rounded to a grid over the scene with 65,536 points in each direction; in a scene 2 km wide, the grid
points are 3 cm apart.
"""

from __future__ import annotations

from base64 import b64encode
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines import Ledger, fingerprint
from calibray.engines.ledger.database import key
from calibray.engines.rays.export import Export
from calibray.errors import InputError
from calibray.fields import path_gains
from calibray.paths import Paths, take
from calibray.reporting.link_survey import Survey
from calibray.result.files import changed_files, has_links
from calibray.result.record import Record
from calibray.scenes import Triangles
from calibray.study import Setup
from calibray.support.progress import Progress

PER_LINK: Final = 12
"""Maximum number of paths shown per link."""

INTERACTIONS: Final = 400_000
"""Maximum total number of interactions shown; if there are more, fewer paths per link are shown."""

TRIANGLES: Final = 250_000
"""Maximum number of triangles drawn; if there are more, the largest triangles are drawn."""

STEPS: Final = np.iinfo(np.uint16).max


@dataclass(frozen=True, eq=False)
class Rays:
    """Paths to be drawn.

    Attributes:
        paths: The strongest paths of every link, in descending order of power.
        vertex: Interaction points of the paths [I, 3], [m].
        gain_db: Power gain of each path [P], [dB], with the exported materials and without nuisances.
        per_link: Maximum number of paths per link.
        traced: Number of traced paths.
        links_by_material: For each material, the number of links with at least one traced path that interacts with it.
    """

    paths: Paths
    vertex: NDArray[np.float32] | NDArray[np.float64]
    gain_db: NDArray[np.float64]
    per_link: int
    traced: int
    links_by_material: dict[str, int]


def with_stored_paths(result: Record, ledger: Path) -> Record:
    """Add paths from the ledger to a result: those of the call at the calibrated or, failing that, the initial values.

    The result is unchanged if its engine returns no rays, if the study can no longer be opened, or if the ledger
    contains no call with the study's scene and links.
    """
    if not result.study.engine.exports_rays or result.paths is not None or not ledger.is_file():
        return result
    with suppress(InputError):
        setup = Setup.open(result.study)
        calibrated = np.array([result.parameters[name] for name in setup.parameters.names])
        with closing(Ledger(ledger)) as store:
            for values in (calibrated, setup.parameters.start):
                entry = store.find(fingerprint(setup), key(values), len(setup.links))
                if entry is not None and not entry.failure:
                    materials = setup.parameters.materials(values, setup.scene.materials)
                    study = replace(setup, scene=replace(setup.scene, materials=materials))
                    return replace(result, paths=Export.of(study, entry.rays).paths)
    return result


def rays(result: Record, progress: Progress | None = None) -> Rays:
    """Find the strongest paths of every link; paths missing from the result are read from the cache or traced.

    Raises:
        InputError: The scene or the links of the study can no longer be used or have changed.
        EngineError: The ray tracer failed.
    """
    paths = result.paths
    if paths is None:
        setup = Setup.open(result.study)
        if changed := changed_files(result, setup.files):
            raise InputError(f"{', '.join(changed[:5])} changed since the calibration")
        if not has_links(result, setup.links):
            raise InputError(f"the links in {setup.links.source} changed since the calibration")
        paths = setup.trace(progress=progress)
    return strongest(paths, result)


def strongest(paths: Paths, result: Record) -> Rays:
    """Select the strongest paths of every link with the exported materials."""
    gain = path_gains(paths, result.scene_materials).reshape(paths.num_paths, -1)
    # As for path loss, power is summed over receive ports and averaged over transmit ports.
    power = (np.abs(gain) ** 2).sum(axis=1) / paths.tx_field.shape[1]
    gain_db = 10 * np.log10(np.maximum(power, 1e-40))
    order = np.lexsort((-gain_db, paths.link))
    link = paths.link[order]
    # Rank of every path within its link; the strongest path has rank 0.
    rank = np.arange(len(link)) - np.searchsorted(link, link)
    # Total number of interactions if each link keeps only its 1, 2, ... strongest paths.
    interactions = np.cumsum(
        np.bincount(rank[rank < PER_LINK], np.diff(paths.first)[order][rank < PER_LINK], PER_LINK)
    )
    per_link = int(np.clip(np.searchsorted(interactions, INTERACTIONS, side="right"), 1, PER_LINK))
    chosen = order[rank < per_link]
    # A link counts once for a material, however many of its paths interact with the material.
    link_and_material = np.stack([np.repeat(paths.link, np.diff(paths.first)), paths.material], axis=1)
    links = np.bincount(np.unique(link_and_material, axis=0)[:, 1], minlength=len(paths.materials))
    shown = take(paths, chosen)
    return Rays(
        shown,
        shown.vertex,
        gain_db[chosen],
        per_link,
        paths.num_paths,
        dict(zip(paths.materials, links.tolist(), strict=True)),
    )


@dataclass(frozen=True)
class Grid:
    """A grid to which positions are rounded, given by its lower corner [3] and its spacing in all directions [m]."""

    low: NDArray[np.float64]
    step: float

    @classmethod
    def over(cls, *points: NDArray[np.float64]) -> Grid:
        """Make the smallest grid that contains all points [n, 3], [m]."""
        positions = np.concatenate([part.reshape(-1, 3) for part in points])
        low, high = positions.min(axis=0), positions.max(axis=0)
        return cls(low, float(max((high - low).max(), 1.0) / STEPS))

    def steps(self, points: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Convert positions to whole numbers of grid steps [n, 3]."""
        return np.clip(np.rint((points - self.low) / self.step), 0, STEPS).astype(np.uint16)


def packed(
    survey: Survey, triangles: Triangles | None, rays: Rays | None, materials: list[str]
) -> dict[str, Any]:
    """Pack the data for the viewer; arrays become little-endian integers in base64.

    `materials` lists the materials in the order of the scene; triangles and rays are None if not available.
    """
    points = [survey.tx, survey.rx]
    if triangles is not None and len(triangles.face):
        points.append(triangles.vertex)
    if rays is not None:
        points.append(rays.vertex.astype(float))
    grid = Grid.over(*points)
    return {
        "low": grid.low.tolist(),
        "step": grid.step,
        "tx": _text(grid.steps(survey.tx)),
        "rx": _text(grid.steps(survey.rx)),
        "mesh": None if triangles is None else _mesh(triangles, grid, materials),
        "paths": None if rays is None else _paths(rays, grid),
    }


def _mesh(triangles: Triangles, grid: Grid, materials: list[str]) -> dict[str, Any]:
    """Order the triangles by material, with those of the ground first; vertices at the same grid point are merged."""
    area = np.linalg.norm(triangles.normal, axis=1)
    kept = np.sort(np.argsort(-area, kind="stable")[:TRIANGLES])
    part = np.where(triangles.ground[kept], 0, 1 + triangles.material[kept])
    order = kept[np.argsort(part, kind="stable")]
    corners = grid.steps(triangles.vertex)[triangles.face[order]].reshape(-1, 3)
    vertex, index = np.unique(corners, axis=0, return_inverse=True)
    sizes = np.bincount(part, minlength=1 + len(materials))
    return {
        "vertex": _text(vertex),
        "face": _text(index.astype(np.uint32)),
        "parts": [
            {"name": name, "count": int(size), "ground": not number}
            for number, (name, size) in enumerate(zip(["ground", *materials], sizes, strict=True))
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
        # Loss in hundredths of a decibel.
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
