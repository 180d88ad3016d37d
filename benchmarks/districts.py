"""Districts drawn from seeds: streets, buildings, materials, carriers and links that are not in the package.

Seeds 100 to 109 are for development (the odd ones were previously used for judging). Buildings are boxes with windows,
so that the position of an interaction determines its building.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd

from calibray import engines, fields
from calibray.fitting.problem import Problem
from calibray.materials import Material, itu_material
from calibray.paths import Paths
from calibray.scenarios import demo_study_path
from calibray.scenes import Mesh, MeshObject, join_meshes, write_scene
from calibray.study import Setup, Study
from coastal_district import Building, building_meshes, district

DEVELOPMENT = tuple(f"district-{seed}" for seed in (100, 101, 102, 103, 104, 105, 106, 107, 108, 109))
"""Districts for development."""

JUDGING = tuple(f"district-{seed}" for seed in (153, 155, 159, 161, 163))
"""Districts for judging, on which the default of `noise.constants_spread` was also chosen: a new version needs other
seeds. (151 and 157 draw a carrier for which P.2040 gives no constants.)"""

DEMO = "demo"
NEAR_M = 0.1
"""Largest distance of an interaction from the footprint of its building [m]."""


@dataclass(frozen=True)
class District:
    """A traced district.

    Attributes:
        name: Its name.
        problem: The problem of its links.
        footprints: Corners of every building, counter-clockwise [n, 2], [m].
    """

    name: str
    problem: Problem
    footprints: tuple[np.ndarray, ...]

    @property
    def paths(self) -> Paths:
        """Its paths."""
        return cast(engines.Replay, self.problem.engine).paths

    def path_loss(self, truth: np.ndarray) -> np.ndarray:
        """Path loss of every link with the same materials everywhere [L], [dB]."""
        return self.problem.engine.path_loss(truth[None])[0]

    def path_loss_apart(self, truth: np.ndarray, spread: float, random: np.random.Generator) -> np.ndarray:
        """Path loss of every link if every building has its own wall constants [L], [dB].

        Args:
            truth: The means over the buildings.
            spread: Standard deviation of a building's factor.
            random: Generator of random numbers.
        """
        paths = self.paths
        buildings, parameters = len(self.footprints), self.problem.parameters
        own = np.clip(
            truth * np.exp(spread * random.standard_normal((buildings, len(truth)))),
            parameters.lower,
            parameters.upper,
        )
        known = list(paths.materials.items())
        material, table, place = paths.material.copy(), dict(paths.materials), self._building(paths)
        for building in np.unique(place[place >= 0]):
            here = parameters.materials(own[building], paths.materials)
            for index, (name, _) in enumerate(known):
                mine = (place == building) & (paths.material == index)
                if mine.any():
                    material[mine] = len(table)
                    table[f"{name} of {building}"] = here[name]
        ground = parameters.materials(truth, paths.materials)
        table.update({name: ground[name] for name, _ in known})
        section = self.problem.setup.study
        return fields.path_loss(
            replace(paths, material=material, materials=table), None, section.objective.combining,
            section.scene.bandwidth,
        )  # fmt: skip

    def _building(self, paths: Paths) -> np.ndarray:
        """Building of every interaction, -1 for the ground [I]."""
        found = np.full(paths.num_interactions, -1)
        point = np.asarray(paths.vertex, dtype=float)
        for number, corners in enumerate(self.footprints):
            edge = np.roll(corners, -1, axis=0) - corners
            normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
            depth = np.einsum("pek,ek->pe", point[:, None, :2] - corners, normal).min(axis=1)
            found[(depth > -NEAR_M) & (point[:, 2] > NEAR_M)] = number
        return found


@dataclass(frozen=True)
class Streets:
    """A grid of streets around blocks, centred on the origin.

    Attributes:
        blocks: Number of blocks along x and y [2].
        pitch: Distance from street to street along x and y [2], [m].
        width: Width of a street [m].
    """

    blocks: np.ndarray
    pitch: np.ndarray
    width: float

    @property
    def extent(self) -> np.ndarray:
        """Total size along x and y [2], [m]."""
        return self.blocks * self.pitch + self.width


def named(words: str, judging: tuple[str, ...] = JUDGING) -> list[str]:
    """Names of districts from names and groups (all, development, judging), separated by commas."""
    groups = {"all": (DEMO, *DEVELOPMENT, *judging), "development": DEVELOPMENT, "judging": judging}
    return [name for word in words.split(",") for name in groups.get(word, (word,))]


def make(name: str, folder: Path, missing: float = 0.0) -> District:
    """Make a district and trace it; the package's cache keeps its paths.

    Args:
        name: "demo", "district-SEED" with 20 to 200 links, or "district-SEED:LINKS".
        folder: Folder for the scene and its links.
        missing: Share of the buildings that are missing in the scene; the links are those of the complete district.
    """
    if name == DEMO:
        setup = Study.load(demo_study_path()).opened()
        footprints = tuple(building.footprint for building in district())
    else:
        # Each process has its own folder, because another process may be writing the same district.
        seed, _, links = name.removeprefix("district-").partition(":")
        setup, footprints = _drawn(
            int(seed),
            folder / f"{name.replace(':', '-')}-{missing:g}-{os.getpid()}",
            missing,
            int(links or 0),
        )
    return District(name, Problem.of(setup, engines.make(setup, "replay")), footprints)


def _drawn(seed: int, folder: Path, missing: float, links: int) -> tuple[Setup, tuple[np.ndarray, ...]]:
    random = np.random.default_rng([seed, 77])
    blocks, width = random.integers(2, 5, 2), random.uniform(14, 30)
    block = random.uniform(50, 130, 2)
    streets = Streets(blocks, block + width, width)
    buildings = []
    for column in range(blocks[0]):
        for row in range(blocks[1]):
            south_west = np.array([column, row]) * streets.pitch + width - streets.extent / 2
            buildings += _block(south_west, block, random, len(buildings))
    frequency = float(random.choice([0.9e9, 2.1e9, 3.5e9, 6e9, 10e9, 28e9]))
    wall, earth = str(random.choice(["concrete", "brick", "marble"])), float(random.uniform(0.3, 3.0))
    materials = {
        "walls": _constants(itu_material(wall, frequency, float(random.uniform(0.1, 0.4)))),
        "windows": _constants(itu_material("glass", frequency, float(random.uniform(0.005, 0.03)))),
        "ground": {
            "relative_permittivity": 4.0,
            "conductivity": float(random.uniform(0.005, 0.1)),
            "thickness": earth,
        },
    }
    write_scene(folder / "scene", _objects(buildings, streets), materials)
    bounds = {
        "walls.relative_permittivity": {"bounds": [1.5, 12.0]},
        "windows.relative_permittivity": {"bounds": [1.5, 10.0]},
        "ground.relative_permittivity": {"bounds": [1.5, 20.0]},
    }
    if random.random() < 0.5:
        bounds["walls.conductivity"] = {"bounds": [1e-3, 3.0], "scale": "log"}
    count = links or round(float(np.exp(random.uniform(np.log(20), np.log(200)))))
    table = _links(4 * count, streets, random)
    table.to_csv(folder / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene/scene.xml", "frequency": frequency},
        "links": {
            "file": "links.csv", "tx": ["tx_x", "tx_y", "tx_z"], "rx": ["rx_x", "rx_y", "rx_z"], "value": "loss_db"
        },
        "antennas": {end: {"pattern": "dipole", "polarization": "V"} for end in ("tx", "rx")},
        "trace": {"max_depth": 4, "samples": 300_000},
        "parameters": bounds,
    }  # fmt: skip
    setup = Study.from_content(content, folder / "study.toml").opened()
    # The first of the planned receivers that have a path.
    reached = np.setdiff1d(np.arange(len(table)), setup.trace().links_without_path)[:count]
    table.iloc[reached].to_csv(folder / "links.csv", index=False)
    if missing:
        count = max(1, round(missing * len(buildings)))
        lost = np.random.default_rng([seed, 78]).permutation(len(buildings))[:count]
        buildings = [each for number, each in enumerate(buildings) if number not in lost]
        write_scene(folder / "scene", _objects(buildings, streets), materials)
    setup = Study.from_content(content, folder / "study.toml").opened()
    return setup, tuple(each.footprint for each in buildings)


def _objects(buildings: list[Building], streets: Streets) -> list[MeshObject]:
    structures, windows = zip(*(building_meshes(each) for each in buildings), strict=True)
    x, y = streets.extent / 2 + 20
    ground = Mesh(
        np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    return [
        MeshObject("structures", "walls", join_meshes(structures)),
        MeshObject("panes", "windows", join_meshes(windows)),
        MeshObject("plane", "ground", ground),
    ]


def _block(corner: np.ndarray, size: np.ndarray, random: np.random.Generator, first: int) -> list[Building]:
    """The buildings of a block, one per lot."""
    lots = random.integers(1, 3, 2)
    found = []
    for column in range(lots[0]):
        for row in range(lots[1]):
            low = corner + size * np.array([column, row]) / lots + random.uniform(0, 4, 2)
            high = corner + size * np.array([column + 1, row + 1]) / lots - random.uniform(0, 4, 2)
            low, high = np.round(low * 64) / 64, np.round(high * 64) / 64
            footprint = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
            height = float(np.round(random.uniform(8, 50) * 64) / 64)
            found.append(
                Building(f"b{first + len(found):03d}", footprint, height, float(random.uniform(0.2, 0.6)))
            )
    return found


def _links(count: int, streets: Streets, random: np.random.Generator) -> pd.DataFrame:
    stations = np.column_stack([_in_streets(3, streets, random)[0], random.uniform(3, 20, 3)])
    stations = stations[: random.integers(1, 4)]
    place, street = _in_streets(count, streets, random)
    near = np.linalg.norm(place[:, None] - stations[None, :, :2], axis=2)
    tx = stations[near.argmin(axis=1)]
    table = np.column_stack([tx, place, np.full(count, 1.5)]).round(2)
    links = pd.DataFrame(table, columns=["tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"])
    return links.assign(loss_db=100.0, street=street)


def _in_streets(count: int, streets: Streets, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places in the streets [count, 2], [m], and the names of these streets [count]."""
    blocks, pitch, extent = streets.blocks, streets.pitch, streets.extent
    along = random.random(count) < 0.5
    line = np.where(along, random.integers(0, blocks[0] + 1, count), random.integers(0, blocks[1] + 1, count))
    across = line * np.where(along, pitch[0], pitch[1]) + streets.width * random.uniform(0.15, 0.85, count)
    other = random.uniform(0, 1, count) * np.where(along, extent[1], extent[0])
    found = np.where(along[:, None], np.stack([across, other], 1), np.stack([other, across], 1))
    names = np.array([f"{'x' if north else 'y'}{number}" for north, number in zip(along, line, strict=True)])
    return found - extent / 2, names


def _constants(material: Material) -> dict[str, float]:
    return {name: getattr(material, name) for name in ("relative_permittivity", "conductivity", "thickness")}
