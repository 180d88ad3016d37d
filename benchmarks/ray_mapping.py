"""Ray mapping on foreign engines: calls until the engine's own optimum is reached to 0.01 dB.

    python benchmarks/ray_mapping.py --first 3000 --districts 20 --seeds 3 --out rays.jsonl

The engine is the replay of a district with antennas, constants and physics of its own; it answers with the power of
every path. The study knows neither. Truths are drawn evenly within the bounds, errors have 3 dB. The excess of a call
is the RMSE of its candidate on the engine, minus that of the engine's optimum. A call counts as the first one whose
excess is at most 0.01 dB.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

import districts
from calibray.engines import Replay
from calibray.engines.rays.compile import RaySetting, compile_rays, powers, rays_of
from calibray.engines.rays.export import Export
from calibray.engines.rays.table import RayTable
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.fitting.ray_mapping import map_rays
from calibray.fitting.ray_model import HALF_SPACE
from calibray.fitting.search import least_squares
from calibray.materials import Material, itu_material
from calibray.paths import Paths
from calibray.study import Study
from calibray.tracing.settings import Antenna

NOISE_DB: Final = 3.0
REACHED_DB: Final = 0.01

SAME: Final = (Antenna("dipole", "V"), Antenna("dipole", "V"))
OTHER: Final = (Antenna("tr38901", "V", (0.7, 0.1, 0.0)), Antenna("iso", "V"))
TURNED: Final = (Antenna("tr38901", "H", (0.7, 0.1, 0.0)), Antenna("hw_dipole", "H"))


def changed(material: Material, **factors: float) -> Material:
    """A material with constants multiplied by factors."""
    return replace(material, **{name: getattr(material, name) * factor for name, factor in factors.items()})


ENGINES: Final[dict[str, tuple[Any, Any]]] = {
    "same physics": (OTHER, lambda m, _: m),
    "half-spaces": (OTHER, lambda m, _: replace(m, thickness=HALF_SPACE)),
    "thicker": (OTHER, lambda m, _: changed(m, thickness=1.6, conductivity=3.0)),
    "polarization": (TURNED, lambda m, _: changed(m, thickness=1.6, conductivity=3.0)),
    "scattering": (SAME, lambda m, _: replace(changed(m, thickness=0.8), scattering_coefficient=0.4)),
    "conductivity": (OTHER, lambda m, _: changed(m, conductivity=10.0)),
    "ITU law": (
        OTHER,
        lambda m, f: replace(m, conductivity=itu_material("concrete", f).conductivity, thickness=0.25),
    ),
}
"""Antennas, and materials from the study's at a carrier [Hz]."""


class Foreign:
    """An engine that answers with rays."""

    def __init__(self, problem: Problem, paths: Paths, name: str) -> None:
        antennas, materials = ENGINES[name]
        setup = problem.setup
        table = rays_of(paths)
        setting = RaySetting(setup.scene, setup.radio.frequency, antennas, setup.links)
        self.setting = RaySetting.of(setup)
        self.table: RayTable = table
        bare = compile_rays(replace(table, power=None), setting)
        self.paths = replace(
            bare, materials={key: materials(m, paths.frequency) for key, m in bare.materials.items()}
        )
        self.replay = Replay(self.paths, problem.parameters)
        self.parameters = problem.parameters

    def rays(self, candidate: np.ndarray) -> Export:
        """The answer to one candidate."""
        paths = replace(self.paths, materials=self.parameters.materials(candidate, self.paths.materials))
        return Export.of_table(replace(self.table, power=powers(paths)), self.setting)


def repetition(district: districts.District, name: str, seed: int) -> dict[str, Any]:
    """One planted truth on one engine."""
    started, random = time.process_time(), np.random.default_rng([seed, 30])
    known = district.problem
    content = {key: value for key, value in known.setup.study.content().items() if key != "antennas"}
    setup = Study.from_content(content, known.setup.study.path).opened()
    foreign = Foreign(replace(known, setup=setup), district.paths, name)
    parameters = foreign.parameters
    truth = parameters.from_search(random.uniform(*parameters.search_bounds))
    loss = foreign.replay.path_loss(truth[None])[0]
    measured = loss + NOISE_DB * random.standard_normal(len(loss))
    problem = replace(
        known,
        setup=setup,
        engine=foreign.replay,
        objective=replace(district.problem.objective, measured=measured),
    )
    optimum = least_squares(problem, 256, parameters.to_search(truth)[None]).best.y
    mapped = map_rays(problem, foreign.rays, seed=seed, most_calls=6)
    points = parameters.to_search(np.array([call.candidate for call in mapped.calls]))
    excess = problem.squares(points).value - optimum
    return {
        "district": district.name, "engine": name, "seed": seed, "paths": foreign.paths.num_paths,
        "calls": next((k + 1 for k, value in enumerate(excess.tolist()) if value <= REACHED_DB), 99),
        "made": len(excess), "excess_db": excess.tolist(), "misfit_db": mapped.understanding.misfit_db,
        "gap_db": mapped.gap_db, "understood": mapped.understood, "seconds": time.process_time() - started,
    }  # fmt: skip


def main() -> None:
    """Run the repetitions and print the quantiles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--districts", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--engines", default=",".join(ENGINES))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.first, options.first + options.districts):
            try:
                district = districts.make(f"district-{number}", Path(folder))
            except InputError as error:  # some draw a carrier for which P.2040 has no constants
                print(f"district-{number} left out: {error}", flush=True)
                continue
            for name in options.engines.split(","):
                for seed in range(options.seeds):
                    rows.append(repetition(district, name, seed))
                    print(json.dumps(rows[-1]), flush=True)
                    if options.out is not None:
                        with options.out.open("a") as file:
                            file.write(json.dumps(rows[-1]) + "\n")
    for name in options.engines.split(","):
        mine = [row for row in rows if row["engine"] == name]
        calls = np.array([row["calls"] for row in mine])
        print(
            f"{name:14} calls median {np.median(calls):g}, 90th percentile {np.quantile(calls, 0.9):g}; understood "
            f"{np.mean([row['understood'] for row in mine]):.0%}; last excess "
            f"{max(row['excess_db'][-1] for row in mine):.4f} dB at most"
        )


if __name__ == "__main__":
    main()
