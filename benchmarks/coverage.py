"""How often intervals hold the truth: planted values, replayed paths of the demo district, several worlds of errors.

    python benchmarks/coverage.py --repetitions 200
    python benchmarks/coverage.py --repetitions 20 --worlds random,offset

Every repetition draws a truth for each material evenly from its range, makes path losses of it, adds the errors of its
world, and calibrates with the method's profiles. A row tells how often the interval held the truth: over all
repetitions, and where the verdict was "identified" or "weakly identified". The last row is the negative control:
the same intervals with the noise understated by two, which must cover too seldom; the script fails if they do not.

In the world `links-differ` every link sees walls of its own; that buildings differ, which several links share, needs a
trace with a material for every building, which this script does not make.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import fdtr, fdtri

from calibray import engines
from calibray.calibration.problem import Problem
from calibray.calibration.search import rounds
from calibray.inference.nuisance import Nuisance, make_term
from calibray.inference.profile import LIKELY, profiles, threshold_square
from calibray.inference.verdicts import Verdict, verdicts
from calibray.optimizers import LeastSquares
from calibray.scenarios import demo_study_path
from calibray.study import Study
from calibray.tables import Column, Table, numbers
from calibray.tables.text import render

NOISE_DB = 3.0
RANGE_M = 60.0
SPREAD = 0.15
OFFSET_DB = 4.0
OUTLIERS, OUTLIER_DB = 0.1, 20.0
FREEDOM = 4.0

World = Callable[[Problem, np.ndarray, np.random.Generator], np.ndarray]
"""Problem, truth [d] and random numbers to measured path loss [L], [dB]."""


def _plain(problem: Problem, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    loss = problem.engine.path_loss(truth[None])[0]
    return loss + NOISE_DB * random.standard_normal(len(loss))


def _correlated(problem: Problem, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    place = problem.setup.links.rx
    distance = np.linalg.norm(place[:, None] - place[None], axis=2)
    factor = np.linalg.cholesky(np.exp(-distance / RANGE_M) + 1e-9 * np.eye(len(place)))
    loss = problem.engine.path_loss(truth[None])[0]
    return loss + NOISE_DB * factor @ random.standard_normal(len(loss))


def _links_differ(problem: Problem, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    count, parameters = len(problem.setup.links), problem.parameters
    walls = truth * np.exp(SPREAD * random.standard_normal((count, len(truth))))
    loss = problem.engine.path_loss(np.clip(walls, parameters.lower, parameters.upper))
    return loss[np.arange(count), np.arange(count)] + NOISE_DB * random.standard_normal(count)


def _offset(problem: Problem, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return _plain(problem, truth, random) + OFFSET_DB


def _outliers(problem: Problem, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    measured = _plain(problem, truth, random)
    return measured + OUTLIER_DB * (random.random(len(measured)) < OUTLIERS)


def _student(problem: Problem, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    loss = problem.engine.path_loss(truth[None])[0]
    scale = NOISE_DB * np.sqrt((FREEDOM - 2) / FREEDOM)
    return loss + scale * random.standard_t(FREEDOM, len(loss))


WORLDS: dict[str, World] = {
    "random": _plain,
    "correlated": _correlated,
    "links-differ": _links_differ,
    "offset": _offset,
    "offset-free": _offset,
    "outliers": _outliers,
    "student-t": _student,
}


def judged(problem: Problem, level: float, starts: int, seed: int) -> list[Verdict]:
    """Calibrate, and tell what the data say of every parameter."""
    search = LeastSquares(*problem.parameters.search_bounds, starts=starts, seed=seed)
    for _ in rounds(search, problem.evaluate):
        pass
    found = problem.evaluate(search.minima)
    square, rows = found.value**2, found.residuals.shape[1]
    freedom = rows - len(problem.parameters) - int(problem.objective.determined.sum())
    likely = square <= square.min() + LIKELY * (threshold_square(square.min(), freedom) - square.min())

    def evaluate(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        told = problem.evaluate(points, derivatives=True)
        return told.value, told.residuals, told.slopes

    lower, upper = problem.parameters.search_bounds
    curves = profiles(evaluate, lower, upper, search.minima[likely][:24], freedom, level=level)
    names = problem.parameters.names
    whole = verdicts(curves, evaluate, names, lower, upper, freedom, level=level)
    # A noise of half the size: a quarter of the excess that is let stand.
    narrow = float(fdtr(1, freedom, fdtri(1, freedom, level) / 4))
    return [*whole, *verdicts(curves, evaluate, names, lower, upper, freedom, level=narrow)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--level", type=float, default=0.95)
    parser.add_argument("--starts", type=int, default=64, help="local searches of each calibration")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    setup = Study.load(demo_study_path()).opened()
    problem = Problem.of(setup, engines.make(setup, "replay"))
    parameters, rows, control = problem.parameters, [], []
    for name in given.worlds.split(","):
        random = np.random.default_rng([given.seed, list(WORLDS).index(name)])
        held, width, identified = [], [], []
        for turn in range(given.repetitions):
            truth = parameters.from_search(random.uniform(*parameters.search_bounds))
            objective = replace(problem.objective, measured=WORLDS[name](problem, truth, random))
            if name.endswith("free"):
                term = make_term(setup.links, "offset")
                objective = replace(objective, nuisance=Nuisance(len(setup.links), (term,)))
            found = judged(replace(problem, objective=objective), given.level, given.starts, turn)
            count, point = len(parameters), parameters.to_search(truth)
            whole, narrow = found[:count], found[count:]
            held.append([each.lower <= at <= each.upper for each, at in zip(whole, point, strict=True)])
            width.append([each.upper - each.lower for each in whole])
            identified.append([each.name in ("identified", "weakly identified") for each in whole])
            if name == "random":
                control.append(
                    [each.lower <= at <= each.upper for each, at in zip(narrow, point, strict=True)]
                )
            print(f"{name}: {turn + 1} of {given.repetitions}", end="\r", file=sys.stderr)
        rows += _rows(name, parameters.names, np.array(held), np.array(identified), np.array(width))
    if control:
        shape = np.array(control)
        rows += _rows(
            "random, noise understated", parameters.names, shape, shape | True, np.full(shape.shape, np.nan)
        )
    columns = (
        Column("world"), Column("parameter"), numbers("covered"), numbers("covered where identified"),
        numbers("identified"), numbers("median width"),
    )  # fmt: skip
    title = f"Coverage of nominal {given.level:.0%} intervals, {given.repetitions} repetitions"
    print(render(Table(title, columns, tuple(rows))))
    told = np.array(control)[:, :2] if control else np.zeros((1, 1))
    if told.mean() > given.level - 0.03:
        sys.exit("negative control: intervals with the noise understated by two cover as if they were right")


def _rows(
    world: str, names: tuple[str, ...], held: np.ndarray, identified: np.ndarray, width: np.ndarray
) -> list[tuple[str, ...]]:
    rows = []
    for k, name in enumerate(names):
        told = held[identified[:, k], k]
        rows.append((
            world, name, f"{held[:, k].mean():.2f}", f"{told.mean():.2f}" if len(told) else "-",
            f"{identified[:, k].mean():.2f}", "-" if np.isnan(width[0, k]) else f"{np.median(width[:, k]):.2f}",
        ))  # fmt: skip
    return rows


if __name__ == "__main__":
    main()
