"""Intervals where the scene is wrong: thicknesses that are off by half, which the study takes as known to some extent.

    python benchmarks/misfit.py --repetitions 6 --districts demo,district-100,district-102,district-104,district-106

Each repetition draws a truth from the bounds, adds 3 dB of noise, and calibrates the study with its constants taken as
exact (`noise.constants_spread = 0`), as known to 15 % and to 30 %. In the second world the thickness of every
calibrated material is 1.5 times, or 1 / 1.5 times, that of the scene.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import districts
from calibray import fields
from calibray.fitting.search import search
from calibray.optimizers import LeastSquares
from calibray.tables import Column, Table, numbers
from calibray.tables.text import render
from calibray.uncertainty.assessment import certainty
from calibray.uncertainty.credible_sets import credible
from districts import District

NOISE_DB = 3.0
LEVEL = 0.9
FACTOR = 1.5
SPREADS = (0.0, 0.15, 0.3)
WORLDS = ("as the scene says", "thickness off by half")


class Value(NamedTuple):
    """One parameter of one repetition: its world and spread, its verdict, whether its set contains the truth."""

    world: str
    spread: float
    verdict: str
    inside: bool


def repetition(district: District, world: str, seed: int) -> list[Value]:
    """Calibrate one truth with every spread."""
    problem, paths = district.problem, district.paths
    parameters, study = problem.parameters, problem.setup.study
    lower, upper = parameters.search_bounds
    random = np.random.default_rng([seed, len(paths.link)])
    point = random.uniform(lower, upper)
    materials = parameters.materials(parameters.from_search(point), paths.materials)
    for name in {parameter.material for parameter in parameters} if world == WORLDS[1] else ():
        factor = FACTOR if random.random() < 0.5 else 1 / FACTOR
        materials[name] = replace(materials[name], thickness=materials[name].thickness * factor)
    loss = fields.path_loss(paths, materials, study.objective.combining, study.scene.bandwidth)
    measured = loss + NOISE_DB * random.standard_normal(len(loss))
    planted = replace(problem, objective=replace(problem.objective, measured=measured))
    trail = search(planted, LeastSquares(lower, upper, starts=48, seed=seed))
    values = []
    for spread in SPREADS:
        noise = study.noise.model_copy(update={"constants_spread": spread})
        setup = replace(problem.setup, study=study.model_copy(update={"noise": noise}))
        assessed = certainty(replace(planted, setup=setup), trail)
        if assessed.posterior is None:
            raise RuntimeError(f"{district.name}: no draws; {assessed.remarks}")
        means = assessed.posterior.means
        for k, interval in enumerate(assessed.intervals.values()):
            pieces = credible(means.point[:, k], means.weight, lower[k], upper[k], LEVEL)
            inside = any(low <= point[k] <= high for low, high in pieces)
            values.append(Value(world, spread, str(interval.verdict), inside))
    return values


def table(values: list[Value]) -> Table:
    """Coverage by world and spread."""
    columns = (
        Column("truth"), numbers("constants known to"), numbers("values"), numbers("in 90 % set"),
        numbers("identified or weakly"), numbers("in 90 % set"),
        numbers("ambiguous or at bound"), numbers("in 90 % set"),
    )  # fmt: skip
    rows = []
    for world in WORLDS:
        for spread in SPREADS:
            mine = [value for value in values if (value.world, value.spread) == (world, spread)]
            identified = [value for value in mine if value.verdict in ("identified", "weakly identified")]
            partly = [value for value in mine if value.verdict in ("ambiguous", "at bound")]
            rows.append((
                world, f"{spread:.0%}".replace("%", " %"), str(len(mine)), _share(mine), str(len(identified)),
                _share(identified), str(len(partly)), _share(partly),
            ))  # fmt: skip
    return Table("Intervals and constants that the scene fixes", columns, tuple(rows))


def _share(values: list[Value]) -> str:
    return f"{np.mean([value.inside for value in values]):.2f}" if values else "-"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=6)
    parser.add_argument("--districts", default="development", help="names, or development or judging")
    given = parser.parse_args()
    groups = {"development": districts.DEVELOPMENT, "judging": districts.JUDGING}
    names = groups.get(given.districts, tuple(given.districts.split(",")))
    values: list[Value] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            district = districts.make(name, Path(folder))
            for seed in range(given.repetitions):
                for world in WORLDS:
                    values += repetition(district, world, seed)
                print(f"{name}: {seed + 1} of {given.repetitions}", end="\r", file=sys.stderr)
    print(render(table(values)))


if __name__ == "__main__":
    main()
