"""Errors of space mapping's corrected model at the optimum (docs/measurements/expensive-engines.md).

    python benchmarks/cheap_model_errors.py --seeds 1001 1003 1006 1014 1018

runs space mapping once on each problem. After given numbers of calls, the corrected model predicts the residuals of
every link at the optimum, where it was never evaluated. Links with and without a path in the cheap model are listed
separately. "Over expected" is the root mean square of the errors divided by the standard deviations that the model
states.
"""

# ruff: noqa: E402  (the number of threads has to be set before NumPy is imported)
from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence

for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers import LeastSquares
from calibray.optimizers.multifidelity.space_mapping import SpaceMapping
from problem_families.family import PlantedProblem, problem
from problem_families.problems import cheap_model

CALLS = (4, 8, 14)
COLUMNS = (
    "problem", "d", "links", "without a path", "calls", "excess [dB]", "error with a path [dB]",
    "error without [dB]", "over expected",
)  # fmt: skip


def optimum(planted: PlantedProblem) -> NDArray[np.float64]:
    """The point with the lowest RMSE in 16 local searches and one from the planted values [d]."""
    start = planted.parameters.to_search(planted.truth)
    search = LeastSquares(planted.lower, planted.upper, starts=16, x0=start)
    while not search.done:
        points = search.ask()
        answer = planted.evaluate(points, derivatives=True)
        search.tell(points, answer.value, residuals=answer.residuals, jacobian=answer.jacobian)
    return search.best.x


def rows(kind: str, seed: int) -> None:
    """Run one problem and print its rows."""
    planted = problem(seed, kind)
    best = optimum(planted)
    answer = planted.evaluate(best[None])
    model = cheap_model(planted)
    search = SpaceMapping(planted.lower, planted.upper, budget=max(CALLS) + 2, cheap_model=model)
    lowest, known = np.inf, model.known
    for call in range(1, max(CALLS) + 2):
        points = search.ask()
        if call - 1 in CALLS and search.corrected is not None:
            mean, share = search.corrected.predict(search.box.to_unit(best[None]))
            error = answer.residuals[0] - mean[0]
            expected = np.sqrt(share[0] / search.corrected.discrepancy.precision)
            size = [
                np.sqrt(np.mean(part**2)) if len(part) else np.nan for part in (error[known], error[~known])
            ]
            over = np.sqrt(np.mean((error / np.maximum(expected, 1e-6)) ** 2))
            cells = (
                f"{kind} {seed}", len(best), len(known), int((~known).sum()), call - 1,
                f"{lowest - answer.value[0]:.4f}", f"{size[0]:.2f}", f"{size[1]:.2f}", f"{over:.1f}",
            )  # fmt: skip
            print(f"| {' | '.join(map(str, cells))} |", flush=True)
        told = planted.evaluate(points)
        lowest = min(lowest, float(told.value[0]))
        search.tell(points, told.value, residuals=told.residuals)


def print_table(
    description: str, columns: Sequence[str], print_rows: Callable[[str, int], None], seeds: list[int]
) -> None:
    """Print a table, row by row, for problems given on the command line; `seeds` are the default."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--family", default="office")
    parser.add_argument("--seeds", type=int, nargs="+", default=seeds)
    chosen = parser.parse_args()
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}", flush=True)
    for seed in chosen.seeds:
        print_rows(chosen.family, seed)


if __name__ == "__main__":
    print_table(str(__doc__), COLUMNS, rows, [1001, 1003, 1006, 1014, 1018])
