"""Additional calls of space mapping with a misleading cheap model, on planted problems.

    python benchmarks/misleading.py --seeds 0:5

runs space mapping on each problem of the families with its own cheap model, with none (the vector surrogate), and with
three models without information on the problem: *scrambled*, the problem's own model with its links shuffled and its
box mirrored; *tones*, smooth random functions of the same size for every link; and *noise*, random numbers without any
smoothness, repeatable at each point. It prints the median calls to come within a tolerance, and the difference from
those without a cheap model. It also prints the median difference between the i-th fastest run with the model and the
i-th fastest without it, over the number of runs that both solve. Finished runs are stored under out/misleading; a
killed benchmark continues where it stopped.
"""

# ruff: noqa: E402  (the number of threads has to be set before NumPy is imported)
from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from calibray.cli.console import log, progress_bars
from calibray.comparison.comparison import quantile
from calibray.comparison.method_runs import (
    BudgetedMethod,
    ComparisonProblem,
    MethodRun,
    RunFile,
)
from calibray.optimizers.protocol import CheapAnswer, CheapModel, Constants
from calibray.tables import Column, Table, numbers
from markdown_tables import render_markdown
from problem_families.family_comparison import method_fingerprint, seed_range
from problem_families.problems import planted_problem

ROOT = Path(__file__).resolve().parents[1]
TOLERANCES_DB = (0.05, 0.02)


@dataclass(frozen=True, eq=False)
class Scrambled:
    """A cheap model with the answers of other links at the mirrored point.

    Attributes:
        model: The model.
        ends: Sum of the lower and upper bounds [d].
        order: The link that answers for each one [m].
    """

    model: CheapModel
    ends: NDArray[np.float64]
    order: NDArray[np.int64]

    @property
    def constants(self) -> Constants:
        """The value of the original model."""
        return self.model.constants

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask of the rows for which it has an answer [m]."""
        return self.model.known[self.order]

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `CheapModel.residuals`."""
        return self.model.residuals(self.ends - points, constants)[:, self.order]

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """See `CheapModel.answer`."""
        answer = self.model.answer(self.ends - points, constants)
        return CheapAnswer(
            answer.residuals[:, self.order],
            -answer.by_point[:, self.order],
            answer.by_constant[:, self.order],
        )


@dataclass(frozen=True, eq=False)
class Tones:
    """Smooth random functions: for every link a sum of sines over the box.

    Attributes:
        size: Root mean square of each link's residuals [dB].
        wave: Wave numbers of the tones with respect to the parameters [t, d].
        phase: Phases of the tones [t].
        weight: Weight of every tone in every link [t, m].
    """

    size: float
    wave: NDArray[np.float64]
    phase: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def constants(self) -> Constants:
        """None."""
        return Constants.none()

    @property
    def known(self) -> NDArray[np.bool_]:
        """It claims to know every row [m]."""
        return np.ones(self.weight.shape[1], dtype=bool)

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `CheapModel.residuals`."""
        return self.size * np.sin(points @ self.wave.T + self.phase) @ self.weight

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """See `CheapModel.answer`."""
        steep = self.size * np.cos(points @ self.wave.T + self.phase)
        slope = np.einsum("nt,td,tm->nmd", steep, self.wave, self.weight)
        return CheapAnswer(
            self.residuals(points, constants), slope, np.zeros((len(points), self.weight.shape[1], 0))
        )


@dataclass(frozen=True, eq=False)
class Noise:
    """Normal random numbers, repeatable at each point, with random derivatives.

    Attributes:
        size: Standard deviation of the numbers [dB].
        width: Range of each parameter [d].
        links: Number of rows m.
    """

    size: float
    width: NDArray[np.float64]
    links: int

    @property
    def constants(self) -> Constants:
        """None."""
        return Constants.none()

    @property
    def known(self) -> NDArray[np.bool_]:
        """It claims to know every row [m]."""
        return np.ones(self.links, dtype=bool)

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `CheapModel.residuals`."""
        return self._drawn(points)[:, 0]

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """See `CheapModel.answer`."""
        drawn = self._drawn(points)
        slope = np.moveaxis(drawn[:, 1:], 1, -1) / self.width
        return CheapAnswer(drawn[:, 0], slope, np.zeros((len(points), self.links, 0)))

    def _drawn(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Numbers from generators seeded with the bits of each point [n, 1 + d, m]."""
        shape = (1 + len(self.width), self.links)
        bits = np.ascontiguousarray(points).view(np.uint64)
        return self.size * np.array([np.random.default_rng(row).standard_normal(shape) for row in bits])


def scrambled(problem: ComparisonProblem) -> CheapModel:
    """The problem's cheap model, scrambled."""
    model = own(problem)
    order = np.random.default_rng(0).permutation(len(model.known))
    return Scrambled(model, problem.lower + problem.upper, order)


def tones(problem: ComparisonProblem, count: int = 20) -> CheapModel:
    """Tones with about one period over the box, as large as the residuals at its centre."""
    rng, (size, links) = np.random.default_rng(0), in_the_middle(problem)
    wave = rng.normal(0.0, np.pi, (count, len(problem.lower))) / (problem.upper - problem.lower)
    weight = rng.standard_normal((count, links)) * np.sqrt(2.0 / count)
    return Tones(size, wave, rng.uniform(0.0, 2.0 * np.pi, count), weight)


def noise(problem: ComparisonProblem) -> CheapModel:
    """Noise as large as the residuals at the centre of the box."""
    size, links = in_the_middle(problem)
    return Noise(size, problem.upper - problem.lower, links)


def in_the_middle(problem: ComparisonProblem) -> tuple[float, int]:
    """Root mean square of the residuals at the centre of the box [dB], and their number."""
    answer = problem.evaluate(0.5 * (problem.lower + problem.upper)[None], False)
    return float(answer.value[0]), answer.residuals.shape[1]


def own(problem: ComparisonProblem) -> CheapModel:
    """The problem's cheap model."""
    if problem.cheap_model is None:
        raise RuntimeError(f"{problem.name} has no cheap model")
    return problem.cheap_model()


MODELS: dict[str, Callable[[ComparisonProblem], CheapModel] | None] = {
    "none": None, "own": own, "scrambled": scrambled, "tones": tones, "noise": noise,
}  # fmt: skip


def with_model(problem: ComparisonProblem, name: str) -> ComparisonProblem:
    """The problem with a different cheap model."""
    make = MODELS[name]
    return replace(problem, cheap_model=None if make is None else lambda: make(problem))


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--families", nargs="+", default=["district", "office"])
    parser.add_argument("--seeds", default="0:5")
    parser.add_argument(
        "--models", nargs="+", choices=MODELS, default=list(MODELS), help="'none' is always run too"
    )
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--budget", type=int, default=60)
    parser.add_argument(
        "--runs", type=Path, default=ROOT / "out/misleading", help="folder of the finished runs"
    )
    chosen = parser.parse_args()
    method = BudgetedMethod.parse("space-mapping", chosen.budget)
    places = [(kind, seed) for kind in chosen.families for seed in seed_range(chosen.seeds)]
    runs: dict[str, list[MethodRun]] = {name: [] for name in dict.fromkeys(["none", *chosen.models])}
    lowest: list[float] = []
    with progress_bars(log()) as progress:
        for done, (kind, seed) in enumerate(places):
            progress("problems", done, len(places))
            problem = planted_problem(kind, seed)
            found = []
            for name in runs:
                store = RunFile(
                    chosen.runs / "runs.jsonl",
                    f"{problem.fingerprint}-{method_fingerprint('space-mapping')}-{name}",
                )
                for repeat in range(chosen.repeats):
                    kept = store.find(method.key(repeat))
                    run = kept or store.add(method.run(with_model(problem, name), repeat))
                    runs[name].append(run)
                    found.append(run.at(run.evaluations))
            lowest += [min(problem.minimum, *found)] * chosen.repeats
    print(render_markdown(compared(runs, np.array(lowest))))
    for name, each in runs.items():
        for run in each:
            if run.failure:
                print(f"- {name}, seed {run.seed}: a run failed: {run.failure}")


def compared(runs: dict[str, list[MethodRun]], lowest: NDArray[np.float64]) -> Table:
    """Calls to a tolerance with every cheap model, and their excess over those without one."""
    rows = []
    for name, each in runs.items():
        cells = [name]
        for tolerance in TOLERANCES_DB:
            calls, without = (
                np.array([run.first(low + tolerance) for run, low in zip(some, lowest, strict=True)])
                for some in (each, runs["none"])
            )
            median, base = (quantile(values, 0.5) for values in (calls, without))
            solved = [np.mean(calls <= limit) for limit in (15, 30, 60)]
            both = min(np.isfinite(calls).sum(), np.isfinite(without).sum())
            behind = np.sort(calls)[:both] - np.sort(without)[:both]
            cells += [
                _count(median), _count(median - base, "+") if name != "none" else "",
                _count(float(np.median(behind)), "+") if name != "none" and both else "",
                " / ".join(f"{share:.2f}" for share in solved),
            ]  # fmt: skip
        rows.append(tuple(cells))
    columns = [Column("cheap model")]
    for tolerance in TOLERANCES_DB:
        columns += [
            numbers(f"median calls to {tolerance:g} dB"), numbers("more than without"),
            numbers("more along the profile"), numbers("solved at 15 / 30 / 60"),
        ]  # fmt: skip
    return Table("", tuple(columns), tuple(rows))


def _count(calls: float, sign: str = "") -> str:
    """A number of calls; a dash if at least half of the runs did not solve their problem."""
    return f"{calls:{sign}.1f}" if np.isfinite(calls) else "-"


if __name__ == "__main__":
    main()
