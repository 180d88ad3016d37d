"""Whether suggested points narrow intervals more than random ones: planted values, replayed paths, exact profiles.

    python benchmarks/suggestion.py --repetitions 60
    python benchmarks/suggestion.py --districts demo,11 --repetitions 20

In every repetition a truth is drawn evenly from the ranges of the materials, path losses are made of it with noise of
3 dB, and 20 links are measured. Five more are taken of the others: those that `calibray.inference.design` suggests, or
random ones. The profile of every parameter is taken exactly, on a grid over the whole range, and so are the draws from
the posterior. The demo has its 40 links. A district with a number is that of the demo built with that seed, with a
carrier, thicknesses and 160 places in the streets of its own; 11 and 12 were developed on, others were not.

A row tells, for concrete and for glass: the median width of the 95 % interval after suggested points by that after
random ones; how often it is narrower, ties as half; how often ranges that were separate are one afterwards; and
what width was expected, of that before, beside what came about.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
import pandas as pd
from scipy.special import fdtri

from calibray import engines
from calibray.calibration.problem import Problem
from calibray.inference.design import Beliefs, Errors, choose
from calibray.scenarios import demo_study_path
from calibray.scenarios.district import AVENUES, STREETS, district, scene_objects
from calibray.scenes.meshes import write_scene
from calibray.study import Study
from calibray.tables import Column, Table, numbers
from calibray.tables.text import render

NOISE_DB = 3.0
MEASURED, MORE = 20, 5
DRAWS = 96
GRID = (150, 120, 3)
"""Values of concrete, glass and soil; soil hardly matters to any link."""
JUDGED = ("concrete", "glass")
PLACES = 160


def made(seed: int, folder: Path) -> Study:
    """A district of its own: buildings, carrier, thicknesses, two transmitters, receivers in the streets near them."""
    random = np.random.default_rng([seed, 3])
    frequency = float(random.choice([1.8e9, 2.6e9, 3.5e9, 5.9e9]))
    wall, pane = float(random.uniform(0.12, 0.35)), float(random.uniform(0.006, 0.026))
    materials = {
        "concrete": {"type": "concrete", "thickness": wall},
        "glass": {"type": "glass", "thickness": pane},
        "soil": {"relative_permittivity": 4.0, "conductivity": 0.05, "thickness": 2.0},
        "asphalt": {"relative_permittivity": 4.83, "conductivity": 0.075, "thickness": 0.5},
    }
    write_scene(folder / "scene", scene_objects(district(seed)), materials)
    avenues, streets = np.array(AVENUES), np.array(STREETS)
    tx = np.column_stack([
        random.choice(avenues[2:-2], 2) + random.uniform(-5, 5, 2),
        random.choice(streets[1:-1], 2) + random.uniform(30, 90, 2),
        np.full(2, 4.0),
    ])  # fmt: skip
    rows: list[list[float]] = []
    while len(rows) < PLACES:
        mast = tx[random.integers(2)]
        if random.random() < 0.5:
            place = random.choice(avenues) + random.uniform(-6, 6), random.uniform(-820, 700)
        else:
            place = random.uniform(-1000, 1000), random.choice(streets) + random.uniform(-6, 6)
        if 20 < np.hypot(place[0] - mast[0], place[1] - mast[1]) < 450:
            rows.append([*mast, *place, 4.0])
    columns = ["tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"]
    pd.DataFrame(np.round(rows, 2), columns=columns).assign(loss_db=100.0).to_csv(
        folder / "links.csv", index=False
    )
    demo = Study.load(demo_study_path()).content()
    content = {
        "version": 1,
        "scene": {"file": "scene/scene.xml", "frequency": frequency},
        "links": {"file": "links.csv", "tx": columns[:3], "rx": columns[3:], "value": "loss_db"},
        "antennas": {end: {"pattern": "dipole", "polarization": "V"} for end in ("tx", "rx")},
        "trace": {"max_depth": 4, "samples": 300_000},
        "parameters": {name: {"bounds": each["bounds"]} for name, each in demo["parameters"].items()},
    }
    return Study.from_content(content, folder / "study.toml")


class Exact:
    """A district whose path losses are known on a grid of values.

    Args:
        study: Its study.
    """

    def __init__(self, study: Study) -> None:
        setup = study.opened()
        problem = Problem.of(setup, engines.make(setup, "replay"))
        self.engine, self.parameters = cast(engines.Replay, problem.engine), problem.parameters
        self.reached = np.flatnonzero(np.isfinite(problem.before))
        self.place = setup.links.rx[self.reached]
        axes = [np.linspace(0.0, 1.0, count) for count in GRID]
        self.unit = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(GRID))
        self.lower, upper = self.parameters.search_bounds
        self.width = upper - self.lower
        parts = np.array_split(self.lower + self.unit * self.width, 60)
        self.loss = np.concatenate([self.engine.path_loss(part)[:, self.reached] for part in parts])

    def pieces(self, square: np.ndarray, links: int) -> list[list[tuple[float, float]]]:
        """The pieces of every parameter's 95 % interval by its profile, in the unit interval; ends interpolated."""
        freedom = links - len(GRID)
        cube = square.reshape(GRID)
        threshold = cube.min() * (1 + fdtri(1, freedom, 0.95) / freedom)
        found = []
        for axis, count in enumerate(GRID):
            profile = cube.min(axis=tuple(k for k in range(len(GRID)) if k != axis))
            inside, ends = profile <= threshold, []
            for low in np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]])):
                high = low + int(np.argmin(np.append(inside[low:], False))) - 1
                ends.append((self._end(profile, low, -1, threshold), self._end(profile, high, 1, threshold)))
            found.append([(low / (count - 1), high / (count - 1)) for low, high in ends])
        return found

    @staticmethod
    def _end(profile: np.ndarray, inside: int, step: int, threshold: float) -> float:
        outside = inside + step
        if not 0 <= outside < len(profile):
            return float(inside)
        return inside + step * (threshold - profile[inside]) / (profile[outside] - profile[inside])

    def squares(self, measured: np.ndarray, links: np.ndarray) -> np.ndarray:
        """Sum of squares at every place of the grid."""
        return np.sum((self.loss[:, links] - measured[links]) ** 2, axis=1)

    def suggested(
        self, square: np.ndarray, known: np.ndarray, others: np.ndarray, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Five of the other links, and the widths to be expected then, of those before."""
        log_density = -0.5 * len(known) * np.log(square)
        share = np.exp(log_density - log_density.max())
        drawn = random.choice(len(square), DRAWS, p=share / share.sum())
        noise = float(np.sqrt(square.min() / (len(known) - len(GRID))))
        values = self.parameters.from_search(self.lower + self.unit[drawn] * self.width)
        loss, slope = self.engine.path_loss_and_jacobian(values)
        loss, slope = loss[:, self.reached], slope[:, self.reached] * self.width
        scaled = slope[:, known] / noise
        beliefs = Beliefs(
            self.unit[drawn],
            np.einsum("nmi,nmj->nij", scaled, scaled),
            np.zeros((DRAWS, len(GRID)), dtype=np.int64),
        )
        errors = Errors(noise, np.zeros((len(others), 0)), self.place[others])
        found = choose(beliefs, loss[:, others], slope[:, others], errors, MORE)
        return others[[each.index for each in found]], found[-1].narrowed


def judged(exact: Exact, repetitions: int, seed: int, name: str) -> list[tuple[str, ...]]:
    """Rows of the table for one district."""
    before, after, expected = [], {"suggested": [], "random": []}, []
    for turn in range(repetitions):
        random = np.random.default_rng([seed, turn])
        order = random.permutation(len(exact.reached))
        known, others = order[:MEASURED], order[MEASURED:]
        truth = exact.loss[random.integers(len(exact.loss))]
        measured = truth + NOISE_DB * random.standard_normal(len(truth))
        square = exact.squares(measured, known)
        before.append(exact.pieces(square, MEASURED))
        chosen, narrowed = exact.suggested(square, known, others, random)
        expected.append(narrowed)
        for kind, more in (("suggested", chosen), ("random", random.permutation(others)[:MORE])):
            links = np.concatenate([known, more])
            after[kind].append(exact.pieces(exact.squares(measured, links), len(links)))
        print(f"{name}: {turn + 1} of {repetitions}", end="\r", file=sys.stderr)
    print(file=sys.stderr)
    wide = {kind: np.array([[_hull(each) for each in run] for run in runs]) for kind, runs in after.items()}
    first = np.array([[_hull(each) for each in run] for run in before])
    rows = []
    for k, material in enumerate(JUDGED):
        ours, theirs = wide["suggested"][:, k], wide["random"][:, k]
        better = np.mean(ours < theirs - 1e-9) + 0.5 * np.mean(np.abs(ours - theirs) <= 1e-9)
        apart = [turn for turn, run in enumerate(before) if len(run[k]) > 1]
        one = {kind: sum(len(after[kind][turn][k]) == 1 for turn in apart) for kind in after}
        rows.append((
            name, material, f"{np.median(ours / theirs):.2f}", f"{better:.0%}",
            f"{one['suggested']} and {one['random']} of {len(apart)}",
            f"{np.mean(np.array(expected)[:, k] * first[:, k]) / np.mean(first[:, k]):.2f}",
            f"{np.mean(ours) / np.mean(first[:, k]):.2f}", f"{np.mean(theirs) / np.mean(first[:, k]):.2f}",
        ))  # fmt: skip
    both = [np.log(wide[kind][:, : len(JUDGED)]).mean(axis=1) for kind in ("suggested", "random")]
    ratio, better = np.exp(np.median(both[0] - both[1])), np.mean(both[0] < both[1])
    rows.append((name, "both", f"{ratio:.2f}", f"{better:.0%}", "", "", "", ""))
    return rows


def _hull(pieces: list[tuple[float, float]]) -> float:
    return max(pieces[-1][1] - pieces[0][0], 1e-6)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=60)
    parser.add_argument("--districts", default="demo,11,12,21,22")
    parser.add_argument("--seed", type=int, default=1)
    given, rows = parser.parse_args(), []
    for name in given.districts.split(","):
        with TemporaryDirectory() as folder:
            study = Study.load(demo_study_path()) if name == "demo" else made(int(name), Path(folder))
            rows += judged(Exact(study), given.repetitions, given.seed, name)
    columns = (
        Column("district"), Column("material"), numbers("width by random's"), numbers("narrower"),
        Column("ranges made one, suggested and random"), numbers("expected"), numbers("came about"),
        numbers("random's"),
    )  # fmt: skip
    print(
        render(
            Table(f"{MEASURED} links and {MORE} more, {given.repetitions} repetitions", columns, tuple(rows))
        )
    )


if __name__ == "__main__":
    main()
