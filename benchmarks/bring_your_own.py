"""How often the example town's planted materials lie in their 95 % intervals, over seeds of its log.

    python benchmarks/bring_your_own.py [--seeds 40] [--first 0] [--keep-faint] [--biased]

Every seed is another walk through the town of `examples/bring_your_own`: other errors of position, other fading.
Positions are drawn from some for each stop, so that all are traced once and no program is compiled twice; what is
chosen, fitted and profiled is what `calibray run` does. --keep-faint fits all averages that were heard, --biased leaves
the logarithm of their means as it is.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest

EXAMPLES = Path(__file__).parents[1] / "examples" / "bring_your_own"
sys.path.insert(0, str(EXAMPLES))

import make_town as town  # noqa: E402

from calibray import engines  # noqa: E402
from calibray.calibration.certainty import certainty  # noqa: E402
from calibray.calibration.heard import heard  # noqa: E402
from calibray.calibration.methods import choose  # noqa: E402
from calibray.calibration.problem import Problem  # noqa: E402
from calibray.calibration.search import search  # noqa: E402
from calibray.measurements import Averaging, Measurements, Preparation  # noqa: E402
from calibray.measurements.preparation import prepare  # noqa: E402
from calibray.measurements.tables import SourceTable  # noqa: E402
from calibray.scenes.making import make_scene  # noqa: E402
from calibray.scenes.openstreetmap import read_openstreetmap  # noqa: E402
from calibray.study import Setup  # noqa: E402
from calibray.study.draft import draft  # noqa: E402

CHOICES = 4  # recorded positions to draw from for each stop
PLANTED = {
    f"{name}.relative_permittivity": each["relative_permittivity"]
    for name, each in (("walls", town.WALLS), ("ground", town.GROUND))
}


def opened(folder: Path) -> tuple[Problem, list, np.ndarray]:
    """The town's problem over all positions that may be recorded, the amplitudes at its stops, and the positions."""
    found, frame = read_openstreetmap(EXAMPLES / "town.osm", town.FRAME)
    scene = make_scene(found, folder, frame).path
    places, gains = town.stopped(scene)
    rng = np.random.default_rng(2026)
    shape = (len(town.PHONE_DB), len(places), CHOICES)
    recorded = np.zeros((*shape, 3)) + places[:, None]
    recorded[..., :2] += rng.normal(0.0, town.GPS_ERROR, (*shape, 2))
    drafted = draft(
        str(scene), EXAMPLES / "rsrp.csv", folder / "study.toml", EXAMPLES / "cells.csv", town.FREQUENCY
    )
    masts = np.repeat(list(town.MASTS.values()), recorded.size // 3, axis=0)
    group = [
        f"{cell} {phone}"
        for cell in town.MASTS
        for phone in town.PHONE_DB
        for _ in range(recorded[0].size // 3)
    ]
    links = Measurements(
        tx=masts,
        rx=np.tile(recorded.reshape(-1, 3), (len(town.MASTS), 1)),
        path_loss_db=np.full(len(masts), -town.FLOOR_DBM),
        group=np.array(group),
        limit_db=np.full(len(masts), -town.FLOOR_DBM),
    )
    setup = Setup.open(drafted.study, links=links)
    return Problem.of(setup, engines.make(setup)), gains, recorded


def walked(problem: Problem, gains: list, recorded: np.ndarray, seed: int, biased: bool) -> Problem:
    """The problem of one walk: only the positions drawn and heard count."""
    rng = np.random.default_rng(seed)
    number = np.arange(len(problem.setup.links)).reshape(len(town.MASTS), *recorded.shape[:3])
    rows = []
    for stop in range(recorded.shape[1]):
        for phone, (name, gain_db) in enumerate(town.PHONE_DB.items()):
            choice = rng.integers(CHOICES)
            for _ in range(town.SAMPLES):
                for mast, (cell, eirp) in enumerate(town.EIRP_DBM.items()):
                    power = town.sample(gains[mast][stop], eirp + gain_db, rng)
                    heard_dbm = power if power > town.FLOOR_DBM else None
                    place = recorded[phone, stop, choice]
                    rows.append((number[mast, phone, stop, choice], cell, name, *place, heard_dbm))
    log = pd.DataFrame(rows, columns=["link", "cell", "device", "x", "y", "z", "rsrp"])
    averaging = Averaging("cell", 3.3, unbiased=not biased)
    steps = Preparation(noise_floor_dbm=town.FLOOR_DBM, averaging=averaging, keep=("cell", "device"))
    table = prepare(
        SourceTable(log, source="log"), steps, (0.0, 0.0, 0.0), ("x", "y", "z"), "rsrp"
    ).table.frame
    measured, weight = np.array(problem.objective.measured), np.zeros(number.size)
    measured[table["link"]], weight[table["link"]] = -table["rsrp"], 1.0
    weight[problem.objective.weight == 0] = 0.0
    return replace(problem, objective=replace(problem.objective, measured=measured, weight=weight))


def main() -> None:
    """Print each seed's intervals and how many hold what was planted."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--keep-faint", action="store_true")
    parser.add_argument("--biased", action="store_true")
    arguments = parser.parse_args()
    inside = {name: [] for name in PLANTED}
    found = {name: [] for name in PLANTED}
    with tempfile.TemporaryDirectory() as folder:
        whole, gains, recorded = opened(Path(folder))
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            problem = walked(whole, gains, recorded, seed, arguments.biased)
            problem = problem if arguments.keep_faint else heard(problem)
            trail = search(problem, choose(problem))
            told = certainty(problem, trail).intervals
            best = problem.parameters.named(trail.best)
            line = [f"seed {seed}: {problem.objective.num_counted} links, {trail.best_rmse_db:.2f} dB"]
            for name, planted in PLANTED.items():
                each = told[name]
                inside[name].append(any(low <= planted <= high for low, high in each.pieces))
                found[name].append(best[name])
                line.append(
                    f"{name.split('.')[0]} {best[name]:.2f} ({each.lower:.2f} to {each.upper:.2f}, {each.verdict})"
                )
            print("; ".join(line), flush=True)
    for name, planted in PLANTED.items():
        count, number = sum(inside[name]), len(inside[name])
        sure = binomtest(count, number).proportion_ci()
        print(
            f"{name}: planted {planted:g} in {count} of {number} intervals, {count / number:.2f} "
            f"({sure.low:.2f} to {sure.high:.2f}); found {np.median(found[name]):.2f} in the middle"
        )


if __name__ == "__main__":
    main()
