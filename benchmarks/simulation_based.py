"""Simulation-based calibration: do posteriors contain truths that were drawn from the prior?

    python benchmarks/simulation_based.py --runs 100 --districts development
    python benchmarks/simulation_based.py --runs 20 --reference 1000000 --districts development

Each run draws all unknowns of the joint model from its prior in one district: permittivities, two thicknesses with the
study's prior, and the constants that the scene fixes. Noise is Gaussian with a standard deviation of 3 dB. If the
sampler and the model are correct, a 90 % set contains its parameter in 90 % of the runs (S. Talts et al., arXiv
1804.06788).

If the data contain little information, a set is that of the prior, and contains the truths that happen to lie near the
centre of the prior. For 100 independent truths, 84 to 96 do so in 19 of 20 cases, whatever the sampler does. The truths
of a parameter are therefore a Latin hypercube: the prior is divided into as many equally probable parts as there are
runs, and each part has one truth.

With `--reference`, the distribution function of every parameter is compared with that of the given number of draws from
the prior, weighted by the likelihood. This is an independent computation of the same posterior. The path loss of these
draws is computed once per district. The distance is the largest difference between both functions; it counts if the
reference has more than 1,000 effective draws. `--members 64 256` shows populations as small as those of large programs,
and larger ones where these disagree.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats.qmc import LatinHypercube

import districts
from calibray import engines
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.optimizers import LeastSquares
from calibray.study import Setup, Study
from calibray.tables import Column, Table, numbers, render
from calibray.uncertainty.joint_model import JointModel, joint_model
from calibray.uncertainty.sequential_monte_carlo import BUDGET, EVALUATIONS, draw_posterior
from calibray.uncertainty.verdicts import credible_sets
from finished_runs import append_run

NOISE_DB = 3.0
LEVEL = 0.9
BATCH = 4096
QUANTILES = 100_000
"""Number of draws from the prior, whose quantiles are the truths."""
MOST = 20
"""Largest number of parameters and constants of a district."""
EFFECTIVE = 1000
"""Number of effective draws below which a reference does not count."""


def five_parameters(name: str, folder: Path) -> Problem:
    """A district whose study also varies two thicknesses, with declared Gaussian noise."""
    study = districts.make(name, folder).problem.setup.study
    content = study.model_dump(mode="json", by_alias=True, exclude_unset=True)
    walls, windows = ("concrete", "glass") if name == districts.DEMO else ("walls", "windows")
    setup = Setup.open(study)
    for material in (walls, windows):
        thickness = setup.scene.materials[material].thickness
        content["parameters"][f"{material}.thickness"] = {
            "bounds": [thickness / 2.5, thickness * 2.5],
            "scale": "log",
            "prior": {"value": thickness, "spread": 0.3},
        }
    content["noise"] = {"kind": "gaussian", "range_m": 0, "heterogeneity": 0}
    opened = Study.from_content(content, study.path).opened()
    return Problem.of(opened, engines.make(opened))


def planted(
    problem: Problem, model: JointModel, levels: np.ndarray, random: np.random.Generator
) -> tuple[Problem, np.ndarray]:
    """The problem with measurements of a truth, and the truth in the unit cube, at given quantiles of its prior."""
    drawn = model.draw_prior(QUANTILES, random)
    truth = np.array([[np.quantile(column, level) for column, level in zip(drawn.T, levels, strict=False)]])
    gap = model.gaps(truth, np.zeros((1, len(model.parameter_of))))[0]
    measured = problem.objective.measured.copy()
    measured[problem.objective.weight > 0] -= gap - NOISE_DB * random.standard_normal(len(gap))
    return replace(problem, objective=replace(problem.objective, measured=measured)), truth[0]


@dataclass(frozen=True, eq=False)
class Reference:
    """Draws from the prior with their gaps, for use with any measurements of a district.

    Attributes:
        model: The joint model with all constants that the scene fixes.
        measured: The measurements from which the gaps are computed [L], [dB].
        point: The study's parameters of the draws, in the unit cube [n, d].
        gap: Gaps of the draws, in single precision [n, m], [dB].
    """

    model: JointModel
    measured: np.ndarray
    point: np.ndarray
    gap: np.ndarray

    @classmethod
    def of(cls, problem: Problem, count: int) -> Reference:
        """Draw from the prior of a problem's joint model."""
        parameters, random = problem.parameters, np.random.default_rng(1)
        # The assumed errors are tiny, so that no constant is left out because of a small effect.
        model = joint_model(problem, parameters.to_search(parameters.start), 1e-12, 10)
        points, gaps = [], []
        for _ in range(0, count, BATCH):
            point = model.draw_prior(BATCH, random)
            gaps.append(model.gaps(point, np.zeros((BATCH, len(model.parameter_of)))).astype(np.float32))
            points.append(point[:, : len(parameters)])
        return cls(model, problem.objective.measured, np.concatenate(points), np.concatenate(gaps))

    def weights(self, problem: Problem, model: JointModel) -> np.ndarray:
        """Weight of every draw [n] for the measurements of a problem whose links have unit weight."""
        used = problem.objective.weight > 0
        change = (problem.objective.measured - self.measured)[used].astype(np.float32)
        logs = [
            np.logaddexp.reduce(model.marginal.densities((part + change).astype(float)), axis=1)
            for part in np.array_split(self.gap, max(1, len(self.gap) // BATCH))
        ]
        share = np.exp(np.concatenate(logs) - max(log.max() for log in logs))
        return share / share.sum()


def run(
    problem: Problem, levels: np.ndarray, seed: list[int], reference: Reference | None, members: list[int]
) -> dict[str, Any]:
    """Draw one truth; return whether the sets contain it, and the distance from the reference."""
    random, number = np.random.default_rng(seed), seed[-1]
    parameters, width = problem.parameters, len(problem.parameters)
    start = parameters.to_search(parameters.start)
    problem, truth = planted(problem, joint_model(problem, start, NOISE_DB**2, 10), levels, random)
    lower, upper = parameters.search_bounds
    trail = search(problem, LeastSquares(lower, upper, starts=32, seed=number))
    started = time.process_time()
    best = parameters.to_search(trail.best)
    freedom = problem.objective.num_counted - problem.unknowns
    model = joint_model(problem, best, float(trail.best_value**2), freedom)
    budgets = [2 * EVALUATIONS * each * model.interactions for each in members] or [BUDGET]
    posterior = draw_posterior(model, number, budget=budgets[0], largest_budget=budgets[-1])
    seconds = time.process_time() - started
    draws = posterior.means
    unit = (draws.point - lower) / (upper - lower)
    rank = [float(draws.weight[unit[:, k] <= truth[k]].sum()) for k in range(width)]
    line: dict[str, Any] = {
        "inside": _inside(unit, draws.weight, truth), "rank": rank, "seconds": seconds,
        "replays": posterior.replays, "agree": draws.agree, "names": parameters.names,
    }  # fmt: skip
    if reference is not None:
        share = reference.weights(problem, model)
        distance = [_distance(unit[:, k], draws.weight, reference.point[:, k], share) for k in range(width)]
        line |= {"distance": distance, "effective": float(1 / np.sum(share**2))}
        line["mass"] = _masses(unit, draws.weight, reference.point, share)
        line["reference inside"] = _inside(reference.point, share, truth)
    return line


def _masses(
    unit: np.ndarray, weight: np.ndarray, point: np.ndarray, share: np.ndarray
) -> list[tuple[float, int]]:
    """Share of the reference in the credible set of each parameter, and the number of intervals in the set."""
    masses = []
    for k in range(unit.shape[1]):
        pieces = _set(unit[:, k], weight)
        mass = sum(share[(point[:, k] >= low) & (point[:, k] <= high)].sum() for low, high in pieces)
        masses.append((float(mass), len(pieces)))
    return masses


def _inside(unit: np.ndarray, weight: np.ndarray, truth: np.ndarray) -> list[bool]:
    """Whether the credible set of each parameter contains the truth."""
    return [
        any(low <= truth[k] <= high for low, high in _set(unit[:, k], weight)) for k in range(unit.shape[1])
    ]


def _set(unit: np.ndarray, weight: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Intervals that form the credible set of a parameter."""
    return credible_sets(unit, weight, 0.0, 1.0, [LEVEL])[0]


def _distance(one: np.ndarray, weight: np.ndarray, other: np.ndarray, share: np.ndarray) -> float:
    """Largest distance between the distribution functions of weighted draws."""
    at = np.linspace(0, 1, 2001)
    functions = []
    for values, weights in ((one, weight), (other, share)):
        order = np.argsort(values)
        total = np.append(0.0, np.cumsum(weights[order]))
        functions.append(total[np.searchsorted(values[order], at, side="right")])
    return float(np.abs(functions[0] - functions[1]).max())


def main() -> None:
    """Run and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--districts", default="development", help="names, or development or judging")
    parser.add_argument("--reference", type=int, default=0, help="draws from the prior; 0 for no reference")
    parser.add_argument(
        "--members", type=int, nargs="+", default=[], help="of a population; then if they disagree"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "calibray-districts")
    parser.add_argument("--out", type=Path, help="append one line of JSON per run")
    given = parser.parse_args()
    names, lines = districts.named(given.districts), []
    levels = LatinHypercube(MOST, rng=np.random.default_rng(given.seed)).random(given.runs)
    # One district at a time, because a single reference needs much memory.
    order = sorted(range(given.runs), key=lambda number: number % len(names))
    made: tuple[str, Problem, Reference | None] | None = None
    for turn, number in enumerate(order):
        name = names[number % len(names)]
        if made is None or made[0] != name:
            made = None  # frees the memory first
            problem = five_parameters(name, given.folder)
            made = name, problem, Reference.of(problem, given.reference) if given.reference else None
        line = run(made[1], levels[number], [given.seed, number], made[2], given.members)
        lines.append(line | {"district": name})
        append_run(given.out, lines[-1])
        print(f"{turn + 1} of {given.runs}", end="\r", file=sys.stderr)
    print(render(summary(lines)))


def summary(lines: list[dict[str, Any]]) -> Table:
    """Coverage and distance from the reference by parameter."""
    columns = (
        Column("parameter"), numbers("runs"), numbers("in 90 % set"), numbers("mean rank"),
        numbers("in that of the reference"), numbers("share of the reference in the set"), numbers("pieces"),
        numbers("distance from reference, mean"), numbers("largest"),
    )  # fmt: skip
    rows = []
    for name in dict.fromkeys(name for line in lines for name in line["names"]):
        mine = [(line, line["names"].index(name)) for line in lines if name in line["names"]]
        judged = [(line, k) for line, k in mine if line.get("effective", 0.0) > EFFECTIVE]
        shares = ["-"] * 5
        if judged:
            inside = np.mean([line["reference inside"][k] for line, k in judged])
            mass, pieces = np.mean([line["mass"][k] for line, k in judged], axis=0)
            distance = [line["distance"][k] for line, k in judged]
            shares = [f"{inside:.2f}", f"{mass:.3f}", f"{pieces:.2f}"]
            shares += [f"{np.mean(distance):.3f}", f"{np.max(distance):.3f}"]
        rows.append((
            name, str(len(mine)), f"{np.mean([line['inside'][k] for line, k in mine]):.2f}",
            f"{np.mean([line['rank'][k] for line, k in mine]):.2f}", *shares,
        ))  # fmt: skip
    seconds = np.mean([line["seconds"] for line in lines])
    agree = np.mean([line["agree"] for line in lines])
    title = f"{len(lines)} runs, {seconds:.1f} s of CPU each, populations agree in {agree:.0%}"
    return Table(title, columns, tuple(rows))


if __name__ == "__main__":
    main()
