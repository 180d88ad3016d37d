"""Worlds in which a district's study differs from the truth in one respect.

The study of a world is calibrated unchanged. Its measurements are the path loss of the paths of the true world, with
the true materials, plus noise. The study and the true world are traced once per district; each truth takes one replay.

    python benchmarks/misfit_worlds.py --districts district-100     # the size of each world
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import calibray as cb
import districts
from calibray import engines, fields
from calibray.fitting.problem import Problem
from calibray.paths import Paths, take
from calibray.paths.interactions import Kind
from calibray.paths.program import concatenate
from calibray.study import Study
from calibray.tables import Column, Table, numbers, render
from districts import District

NOTHING = "nothing more"
RICHER = "depth 5, diffraction, refraction"
SCATTERING = "scattering 0.4 on walls"
MISSING = "15 % of buildings missing in the study"
POSITIONS = "positions off by 3 m"
TREES = "trees, 8 dB on a quarter of the links"
AZIMUTH = "azimuth off by 20 degrees"
THICKNESS = "thickness wrong by 50 %"

WORLDS = (NOTHING, RICHER, SCATTERING, MISSING, POSITIONS, TREES, AZIMUTH, THICKNESS)

NOISE_DB = 3.0
SCATTERED = 0.4
MISSING_SHARE = 0.15
POSITION_M = 3.0
TREES_DB, TREES_SHARE, GROVES = 8.0, 0.25, 3
AZIMUTH_DEG = 20.0
FACTOR = 1.5
DIFFUSE_TRACE = {"max_depth": 2, "samples": 30_000, "diffuse_reflection": True}

JUDGING = tuple(f"district-{seed}" for seed in range(200, 224) if seed not in (201, 206, 208, 209))
"""Twenty districts not used for development. (The others draw a carrier for which P.2040 has no constants.)"""


@dataclass(frozen=True, eq=False)
class World:
    """A district's study and the true world.

    Attributes:
        name: What differs; one of `WORLDS`.
        district: The district as the study describes it.
        truth: The paths of the true world.
        further_db: Additional loss in the true world [L], [dB].
    """

    name: str
    district: District
    truth: Paths
    further_db: np.ndarray

    def planted(self, seed: int) -> Planted:
        """Draw a truth within the bounds, and noise.

        Args:
            seed: Seed of the repetition.
        """
        problem, objective = self.district.problem, self.district.problem.objective
        parameters, section = problem.parameters, problem.setup.study
        random = np.random.default_rng([seed, len(objective.measured), WORLDS.index(self.name)])
        point = random.uniform(*parameters.search_bounds)
        materials = parameters.materials(parameters.from_search(point), self.truth.materials)
        if self.name == SCATTERING:
            materials["walls"] = replace(materials["walls"], scattering_coefficient=SCATTERED)
        for name in sorted({each.material for each in parameters}) if self.name == THICKNESS else ():
            factor = FACTOR if random.random() < 0.5 else 1 / FACTOR
            materials[name] = replace(materials[name], thickness=materials[name].thickness * factor)
        loss = fields.path_loss(self.truth, materials, section.objective.combining, section.scene.bandwidth)
        loss_db = loss + self.further_db
        reached = np.isfinite(loss_db) & (objective.weight > 0)
        measured = np.where(reached, loss_db, 0.0) + NOISE_DB * random.standard_normal(len(loss_db))
        objective = replace(objective, measured=measured, weight=np.where(reached, objective.weight, 0.0))
        return Planted(replace(problem, objective=objective), point, loss_db)


@dataclass(frozen=True, eq=False)
class Planted:
    """A calibration problem with a known truth.

    Attributes:
        problem: The problem; links without a path in the study or in the true world have weight 0.
        truth: The true parameters in the search space [d].
        loss_db: True path loss without noise [L], [dB].
    """

    problem: Problem
    truth: np.ndarray
    loss_db: np.ndarray


def make(name: str, folder: Path, worlds: tuple[str, ...] = WORLDS) -> dict[str, World]:
    """Make a district and its worlds; the package's cache keeps their paths.

    Args:
        name: "district-SEED".
        folder: Folder for scenes and links.
        worlds: The worlds.
    """
    full = districts.make(name, folder)
    return {world: _world(world, full, folder) for world in worlds}


def named(words: str) -> list[str]:
    """Names of districts from names and groups, separated by commas."""
    return districts.named(words, JUDGING)


def _world(name: str, full: District, folder: Path) -> World:
    setup = full.problem.setup
    random = np.random.default_rng([len(setup.links), WORLDS.index(name)])
    study, truth, further_db = full, full.paths, np.zeros(len(setup.links))
    if name == RICHER:
        truth = _opened(full, {"trace": {"max_depth": 5, "diffraction": True, "refraction": True}}).trace()
    elif name == SCATTERING:
        walls = replace(setup.scene.materials["walls"], scattering_coefficient=SCATTERED)
        scattered = _opened(full, {"trace": DIFFUSE_TRACE}).trace({"walls": walls})
        diffuse = np.logical_or.reduceat(
            np.append(scattered.kind == Kind.DIFFUSE, False), scattered.first[:-1]
        )
        diffuse &= np.diff(scattered.first) > 0  # the line of sight has no interaction
        truth = concatenate([truth, take(scattered, np.flatnonzero(diffuse))])
    elif name == MISSING:
        study = districts.make(full.name, folder, MISSING_SHARE)
    elif name == POSITIONS:
        study = _changed(full, _moved(full, random), {})
    elif name == TREES:
        further_db = np.where(_in_groves(setup.links.rx[:, :2], random), TREES_DB, 0.0)
    elif name == AZIMUTH:
        azimuth, true_azimuth = _sectors(full, random)
        columns = {"azimuth": azimuth, "true_azimuth": true_azimuth}
        truth = _changed(full, columns, _sector_study("true_azimuth")).paths
        study = _changed(full, columns, _sector_study("azimuth"))
    return World(name, study, truth, further_db)


def _opened(district: District, sections: dict[str, Any]) -> cb.Setup:
    study = district.problem.setup.study
    content = study.content()
    for section, keys in sections.items():
        content[section] = {**content.get(section, {}), **keys}
    return Study.from_content(content, study.path).opened()


def _changed(district: District, columns: dict[str, np.ndarray], sections: dict[str, Any]) -> District:
    """The district with changed columns of its links and changed sections of its study."""
    file = district.problem.setup.study.path.parent / f"links-{'-'.join(columns)}.csv"
    district.problem.setup.links.frame.assign(**columns).to_csv(file, index=False)
    links = {"file": file.name, **sections.get("links", {})}
    setup = _opened(district, {**sections, "links": links})
    return replace(district, problem=Problem.of(setup, engines.make(setup, "replay")))


def _moved(district: District, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Positions of the receivers with an error in a random direction, outside buildings."""
    true = district.problem.setup.links.rx[:, :2]
    stated = true.copy()
    for link in range(len(true)):
        for _ in range(20):
            angle = random.uniform(0, 2 * np.pi)
            moved = true[link] + POSITION_M * np.array([np.cos(angle), np.sin(angle)])
            if not any(_inside(moved, corners) for corners in district.footprints):
                stated[link] = moved
                break
    return {"rx_x": stated[:, 0].round(3), "rx_y": stated[:, 1].round(3)}


def _inside(point: np.ndarray, corners: np.ndarray) -> bool:
    return bool(((corners.min(axis=0) - 0.1 < point) & (point < corners.max(axis=0) + 0.1)).all())


def _in_groves(place: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Mask of the quarter of the receivers nearest to a few random receivers, the groves [L]."""
    centre = place[random.choice(len(place), GROVES, replace=False)]
    distance = np.linalg.norm(place[:, None] - centre, axis=2).min(axis=1)
    return distance.argsort().argsort() < round(TREES_SHARE * len(place))


def _sectors(district: District, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Stated and true azimuth of every link's transmitter [L], [deg]: towards its receivers, and turned to one side."""
    links = district.problem.setup.links
    stated, error = np.zeros(len(links)), np.zeros(len(links))
    for tx in np.unique(links.tx, axis=0):
        mine = (links.tx == tx).all(axis=1)
        away = (links.rx - tx)[mine, :2]
        unit = away / np.linalg.norm(away, axis=1)[:, None]
        stated[mine] = np.degrees(np.arctan2(*unit.mean(axis=0)[::-1])).round(1)
        error[mine] = AZIMUTH_DEG if random.random() < 0.5 else -AZIMUTH_DEG
    return stated, stated + error


def _sector_study(azimuth: str) -> dict[str, Any]:
    return {
        "antennas": {"tx": {"pattern": "tr38901", "polarization": "V"}},
        "links": {"tx_antenna": {"azimuth_deg": azimuth, "azimuth_from": "east"}},
    }


def main() -> None:
    """Print the size of every world, and the difference of its path loss from that of the study's paths."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--districts", default="district-100")
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in named(given.districts):
            for world in make(name, Path(folder)).values():
                planted = world.planted(0)
                known = planted.problem.modelled(planted.truth[None])[0]
                gap = (planted.loss_db - known)[planted.problem.objective.weight > 0]
                size = (len(known), len(gap), world.truth.num_paths)
                gaps = (np.median(gap), np.sqrt(np.mean(gap**2)))
                rows.append((name, world.name, *map(str, size), *(f"{each:.2f}" for each in gaps)))
    columns = (
        Column("district"), Column("world"), numbers("links"), numbers("with paths"), numbers("true paths"),
        numbers("median gap", "dB"), numbers("RMS gap", "dB"),
    )  # fmt: skip
    print(render(Table("Worlds", columns, tuple(rows))))


if __name__ == "__main__":
    main()
