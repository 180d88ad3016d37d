"""Whether suggested points narrow intervals more than random points: planted values, replayed paths, exact profiles.

    python benchmarks/suggestion.py --repetitions 60
    python benchmarks/suggestion.py --districts demo,11 --repetitions 20
    python benchmarks/suggestion.py --districts 11,12 --repetitions 200 --separate --oracle

Each repetition draws a truth uniformly from the ranges of the materials, computes path losses with 3 dB of noise, and
measures 20 links. Then five of the other links are measured: those that `experiment_design.py` suggests, or random
ones. Profiles of the parameters and posterior draws are exact, on a grid over the whole range. The demo has its 40
links. A district with a number is that of the demo, built with this seed, with its own carrier, thicknesses and 160
places in the streets. The demo and districts 11 to 19 were used for development, the others were not.

Random points are drawn ten times. With `--oracle`, an oracle that knows the truth, but not the noise, also chooses five
points. It starts from the suggested or from random points, and replaces each in turn with the point that most often
leaves a single range in simulated noise. With `--separate`, a repetition counts only if the interval of a material has
separate ranges.

A row contains, for concrete and for glass, the median width of the 95 % interval after suggested points relative to
that after random points, and how often it is narrower (ties count half). It also contains how often ranges were
separate, how often a single range is left, and how often the other ranges were then ruled out, so that the values
between them do not fit either. The last columns are the expected width and the resulting widths, relative to the width
before.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import expit, fdtri

from calibray import engines
from calibray.fitting.problem import Problem
from calibray.prediction.experiment_design import Beliefs, Errors, choose_candidates
from calibray.scenarios import demo_study_path
from calibray.scenes import write_scene
from calibray.study import Study
from calibray.tables import Column, Table, numbers, render
from coastal_district import AVENUES, STREETS, district, scene_objects

NOISE_DB = 3.0
MEASURED, MORE = 20, 5
DRAWS, RIVALS = 96, 24
GRID = (150, 120, 3)
"""Numbers of grid values for concrete, glass and soil; soil hardly affects any link."""
JUDGED = ("concrete", "glass")
KINDS = ("suggested", "random", "oracle")
AGAIN = 10
"""Number of draws of random points for the comparison."""
SIMULATED = 48
"""Number of noise draws that the oracle uses."""
LIKELY = 2.2
"""Ratio of the sum of squares to the smallest one, up to which the oracle considers a value."""
PLACES = 160


def made(seed: int, folder: Path) -> Study:
    """A drawn district: buildings, carrier, thicknesses, two transmitters, and receivers in the streets near them."""
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
        study: The district's study.
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
        """The pieces of every parameter's 95 % profile interval, in the unit interval, with interpolated ends."""
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
        """Sum of squares at every grid point."""
        return np.sum((self.loss[:, links] - measured[links]) ** 2, axis=1)

    def suggested(
        self, square: np.ndarray, known: np.ndarray, others: np.ndarray, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Five of the other links, and the expected widths after measuring them, relative to those before."""
        log_density = -0.5 * len(known) * np.log(square)
        share = np.exp(log_density - log_density.max())
        noise = float(np.sqrt(square.min() / (len(known) - len(GRID))))
        piece = self._piece(self.pieces(square, len(known)))
        drawn = [random.choice(len(square), DRAWS, p=share / share.sum())]
        for column in piece.T:
            for which in range(column.max() + 1) if column.max() else ():
                inside = share * (column == which)
                drawn.append(random.choice(len(square), RIVALS, p=inside / inside.sum()))
        rows, draws = np.concatenate(drawn), drawn[0]
        values = self.parameters.from_search(self.lower + self.unit[draws] * self.width)
        slope = self.engine.path_loss_and_jacobian(values)[1][:, self.reached] * self.width
        scaled = slope[:, known] / noise
        beliefs = Beliefs(
            self.unit[draws],
            np.einsum("nmi,nmj->nij", scaled, scaled),
            piece[rows],
            (square[rows] - square.min()) / noise**2,
        )
        errors = Errors(noise, np.zeros((len(others), 0)), self.place[others])
        found = choose_candidates(beliefs, self.loss[np.ix_(rows, others)], slope[:, others], errors, MORE)
        return others[[each.index for each in found]], found[-1].narrowed

    def best(
        self, square: np.ndarray, truth: np.ndarray, others: np.ndarray, axis: int, first: np.ndarray
    ) -> np.ndarray:
        """Five of the other links, chosen by the oracle: each one most likely leaves a single range."""
        random = np.random.default_rng(0)
        piece = self._piece(self.pieces(square, MEASURED))[:, axis]
        value = np.round(self.unit[:, axis] * (GRID[axis] - 1)).astype(int)
        rows = np.argsort(value, kind="stable")
        rows = rows[square[rows] < LIKELY * square.min()]
        place, starts = np.unique(value[rows], return_index=True)
        piece, left, apart = (
            piece[rows[starts]],
            square[rows],
            self.loss[np.ix_(rows, others)] - truth[others],
        )
        noise = NOISE_DB * random.standard_normal((len(others), SIMULATED))
        freedom = MEASURED + MORE - len(GRID)

        def likely(chosen: list[int]) -> float:
            """Share of noise draws that leave one range; the distance of the other ranges from it breaks ties."""
            sums = (left + (apart[:, chosen] ** 2).sum(axis=1))[:, None] - 2 * apart[:, chosen] @ noise[
                chosen
            ]
            profile = np.minimum.reduceat(sums + (noise[chosen] ** 2).sum(axis=0), starts, axis=0)
            threshold = profile.min(axis=0) * (1 + fdtri(1, freedom, 0.95) / freedom)
            inside = np.zeros((GRID[axis] + 1, SIMULATED), dtype=bool)
            inside[place + 1] = profile <= threshold
            one = np.sum(inside[1:] & ~inside[:-1], axis=0) == 1
            rival = np.where(piece[:, None] == piece[profile.argmin(axis=0)], np.inf, profile).min(axis=0)
            return float(one.mean() + 0.3 * expit((rival - threshold) / NOISE_DB**2).mean())

        starting = [random.permutation(len(others))[:MORE] for _ in range(60)]
        tried = [
            [int(np.flatnonzero(others == each)[0]) for each in first],
            *(each.tolist() for each in starting),
        ]
        chosen = max(tried, key=likely)
        for turn in range(2 * MORE):
            kept = [each for k, each in enumerate(chosen) if k != turn % MORE]
            tried = [
                [*kept[: turn % MORE], new, *kept[turn % MORE :]]
                for new in range(len(others))
                if new not in kept
            ]
            chosen = max(tried, key=likely)
        return others[chosen]

    def _piece(self, pieces: list[list[tuple[float, float]]]) -> np.ndarray:
        """Index of the piece of every parameter's interval in which, or nearest to which, each grid point lies."""
        found = np.zeros(self.unit.shape, dtype=np.int64)
        for k, ends in enumerate(np.array(each) for each in pieces):
            apart = np.maximum(ends[:, 0, None] - self.unit[:, k], self.unit[:, k] - ends[:, 1, None])
            found[:, k] = np.argmin(apart, axis=0)
        return found


def repetition(exact: Exact, given: argparse.Namespace, turn: int) -> dict[str, list] | None:
    """One planted truth: pieces of intervals before and after, and the expected widths; None if it does not count.

    The pieces after points of a kind are a list over draws of these points, for each judged parameter.
    """
    random = np.random.default_rng([given.seed, turn])
    order = random.permutation(len(exact.reached))
    known, others = order[:MEASURED], order[MEASURED:]
    truth = exact.loss[random.integers(len(exact.loss))]
    measured = truth + NOISE_DB * random.standard_normal(len(truth))
    drawn = [random.permutation(others)[:MORE] for _ in range(AGAIN)]
    square = exact.squares(measured, known)
    before = exact.pieces(square, MEASURED)
    if given.separate and all(len(before[k]) == 1 for k in range(len(JUDGED))):
        return None

    def after(*draws: np.ndarray) -> list[list]:
        links = [np.concatenate([known, more]) for more in draws]
        found = [exact.pieces(exact.squares(measured, each), len(each)) for each in links]
        return [[each[k] for each in found] for k in range(len(JUDGED))]

    chosen, expected = exact.suggested(square, known, others, random)
    run = {"before": before, "expected": expected, "suggested": after(chosen), "random": after(*drawn)}
    if given.oracle:
        run["oracle"] = [
            after(exact.best(square, truth, others, k, chosen))[k] if len(before[k]) > 1 else []
            for k in range(len(JUDGED))
        ]
    return run


def judged(name: str, runs: list[dict[str, list]]) -> list[tuple[str, ...]]:
    """Rows of the table for a district, or for all districts."""
    rows, both, ranges, made = [], [], 0, 0.0
    for k, material in enumerate(JUDGED):
        first = np.array([_hull(run["before"][k]) for run in runs])
        ours, theirs = (
            np.array([[_hull(each) for each in run[kind][k]] for run in runs]) for kind in KINDS[:2]
        )
        both.append(np.log(ours / theirs))
        better = np.mean(ours < theirs - 1e-9) + 0.5 * np.mean(np.abs(ours - theirs) <= 1e-9)
        apart = [run for run in runs if len(run["before"][k]) > 1]
        counted = np.array([_counted(k, kind, apart) for kind in KINDS if kind in runs[0]])
        ranges, made = ranges + len(apart), made + counted
        expected = np.mean([run["expected"][k] for run in runs] * first)
        rows.append((
            name, material, f"{np.median(ours / theirs):.2f}", f"{better:.0%}", str(len(apart)), *_listed(counted),
            *(f"{each / np.mean(first):.2f}" for each in (expected, np.mean(ours), np.mean(theirs))),
        ))  # fmt: skip
    gain = np.mean(both, axis=0)
    narrower = f"{np.mean(gain < 0):.0%} of {len(runs)}"
    ratio = f"{np.exp(np.median(gain)):.2f}"
    return [*rows, (name, "both", ratio, narrower, str(ranges), *_listed(np.asarray(made)), "", "", "")]


def _listed(counted: NDArray[np.float64]) -> list[str]:
    """How often one range is left, and how often the others are ruled out, by kind of points."""
    return [", ".join(f"{each:.4g}" for each in column) for column in counted.T]


def _counted(k: int, kind: str, apart: list[dict[str, list]]) -> NDArray[np.float64]:
    """How often separate ranges become one after points of a kind, and how often because the others are ruled out."""
    found = np.zeros(2)
    for run in apart:
        for after in run[kind][k]:
            (low, high), one = after[0], len(after) == 1
            met = sum(end >= low and start <= high for start, end in run["before"][k])
            found += np.array([one, one and met == 1]) / len(run[kind][k])
    return found


def _hull(pieces: list[tuple[float, float]]) -> float:
    return max(pieces[-1][1] - pieces[0][0], 1e-6)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=60)
    parser.add_argument("--districts", default="demo,11,12,21,22")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--separate", action="store_true", help="count only intervals with separate ranges")
    parser.add_argument(
        "--oracle", action="store_true", help="also measure points chosen by an oracle that knows the truth"
    )
    given, runs = parser.parse_args(), {}
    for name in given.districts.split(","):
        with TemporaryDirectory() as folder:
            study = Study.load(demo_study_path()) if name == "demo" else made(int(name), Path(folder))
            exact, runs[name] = Exact(study), []
        for turn in range(given.repetitions):
            run = repetition(exact, given, turn)
            runs[name] += [] if run is None else [run]
            print(f"{name}: {turn + 1} of {given.repetitions}", end="\r", file=sys.stderr)
        print(file=sys.stderr)
    rows = [row for name, found in runs.items() if found for row in judged(name, found)]
    rows += judged("all", [run for found in runs.values() for run in found])
    kinds = ", ".join(KINDS if given.oracle else KINDS[:2])
    columns = (
        Column("district"), Column("material"), numbers("width by random's"), numbers("narrower"),
        numbers("separate ranges"), Column(f"made one: {kinds}"), Column("others ruled out"), numbers("expected"),
        numbers("came about"), numbers("random's"),
    )  # fmt: skip
    title = f"{MEASURED} links and {MORE} more, {given.repetitions} repetitions, seed {given.seed}"
    print(render(Table(title, columns, tuple(rows))))


if __name__ == "__main__":
    main()
