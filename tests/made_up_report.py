"""Synthetic reports of any size: links and buildings on a grid of streets, paths from a formula, no tracing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

import shown
from calibray.calibration.result import Result
from calibray.paths import Kind, Paths
from calibray.reporting.link_survey import survey
from calibray.reporting.page import PageData
from calibray.reporting.viewer import strongest
from calibray.scenes import Scene, Triangles
from changed import changed

BLOCK = 40.0
"""Distance between streets [m]."""

_FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
     [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]]
)  # fmt: skip


def made_up(
    links: int, buildings: int, paths: int = 20, names: tuple[str, str] = ("brick", "concrete"),
    groups: tuple[str, ...] = ("north", "south"), seed: int = 0,
) -> tuple[Result, PageData]:  # fmt: skip
    """Make a calibration and the data of its report.

    Args:
        links: Number of links.
        buildings: Number of buildings, each a box.
        paths: Paths of a link.
        names: Names of two materials.
        groups: Names of the groups.
        seed: Seed of the random numbers.

    Returns:
        The calibration, and its links, scene and paths.
    """
    random = np.random.default_rng(seed)
    triangles = _town(buildings, random)
    side = BLOCK * np.sqrt(buildings)
    street = np.round(random.uniform(0, side, links) / BLOCK) * BLOCK
    rx = np.stack([street, random.uniform(0, side, links), np.full(links, 1.5)], axis=1)
    mast = np.array([[0.3, 0.3, 25.0], [0.7, 0.6, 30.0]]) * [side, side, 1]
    tx = mast[np.arange(links) % 2]
    distance = np.linalg.norm(rx - tx, axis=1)
    measured = 40 + 30 * np.log10(distance) + random.normal(0, 4, links)
    after = measured + random.normal(0, 3, links)
    after[::50] = np.inf
    table = pd.DataFrame({
        "row": np.arange(2, links + 2), "measured_db": measured, "before_db": after + 3, "after_db": after,
        "log_distance_db": 40 + 30 * np.log10(distance), "has_path": np.isfinite(after),
        "held_out": rx[:, 0] > 0.7 * side, "retrace_gap_db": np.nan, "predicted_db": after, "scene_db": after - 1.0,
        **{f"{end}_{axis}": at[:, k] for end, at in (("tx", tx), ("rx", rx)) for k, axis in enumerate("xyz")},
        "group": np.array(groups, dtype=object)[np.arange(links) % len(groups)],
    })  # fmt: skip
    result = replace(shown.result(), links=table)
    materials = dict(zip(names, list(result.materials.values())[:2], strict=True))
    result = changed(result, materials={**result.materials, **materials})
    traced = _paths(tx, rx, paths, {**result.materials}, random)
    result = replace(result, paths=traced)
    scene = Scene("made up", result.study.path, materials, (), "<scene/>")
    return result, PageData(survey(result), scene, triangles, strongest(traced, result))


def _town(buildings: int, random: np.random.Generator) -> Triangles:
    side = int(np.ceil(np.sqrt(buildings)))
    place = np.stack(np.divmod(np.arange(buildings), side), axis=1) * BLOCK + BLOCK / 2
    half, height = random.uniform(8, 16, (buildings, 2)), random.uniform(6, 40, buildings)
    turn = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    foot = place[:, None] + turn * half[:, None]
    low = np.concatenate([foot, np.zeros((buildings, 4, 1))], axis=2)
    high = np.concatenate([foot, np.repeat(height, 4).reshape(buildings, 4, 1)], axis=2)
    vertex = np.concatenate([low, high], axis=1).reshape(-1, 3)
    face = (_FACES + 8 * np.arange(buildings)[:, None, None]).reshape(-1, 3)
    edge = side * BLOCK
    sheet = np.array([[0, 0, 0], [edge, 0, 0], [edge, edge, 0], [0, edge, 0]], dtype=float)
    face = np.concatenate([face, np.array([[0, 1, 2], [0, 2, 3]]) + len(vertex)])
    ground = np.arange(len(face)) >= len(face) - 2
    return Triangles(np.concatenate([vertex, sheet]), face, np.where(ground, 1, 0), ground)


def _paths(
    tx: np.ndarray, rx: np.ndarray, per_link: int, materials: dict, random: np.random.Generator
) -> Paths:
    """Paths of one to three reflections, at points between the ends of every link that has a path."""
    link = np.repeat(np.flatnonzero(np.arange(len(rx)) % 50 != 0), per_link)
    depth = random.integers(1, 4, len(link))
    first = np.concatenate([[0], np.cumsum(depth)])
    owner, count = np.repeat(np.arange(len(link)), depth), int(first[-1])
    share = (np.arange(count) - first[owner] + 1) / (depth[owner] + 1)
    ends = tx[link][owner], rx[link][owner]
    vertex = ends[0] + share[:, None] * (ends[1] - ends[0]) + random.normal(0, 15, (count, 3))
    vertex[:, 2] = np.abs(vertex[:, 2])
    length = np.linalg.norm(rx - tx, axis=1)[link] * random.uniform(1, 2, len(link))
    unturned = np.tile([1.0, 0.0], (count, 1))
    return Paths(
        frequency=3.5e9,
        materials=materials,
        tx_position=tx,
        rx_position=rx,
        link=link.astype(np.int32),
        delay=length / 299_792_458,
        spreading=1 / length,
        departure=np.ones((len(link), 2)),
        arrival=np.ones((len(link), 2)),
        tx_field=np.ones((len(link), 1, 2), dtype=complex),
        rx_field=np.ones((len(link), 1, 2), dtype=complex),
        first=first.astype(np.int64),
        kind=np.full(count, Kind.SPECULAR, dtype=np.uint8),
        material=random.integers(0, 2, count).astype(np.int32),
        cos_incidence=random.uniform(0.2, 0.9, count),
        rotation=unturned,
        vertex=vertex.astype(np.float32),
    )
