"""Local methods on the 53 least squares problems of Moré and Wild (docs/measurements/expensive-engines.md).

    python benchmarks/more_wild.py

A problem is solved to a tolerance t if f <= f_L + t (f_0 - f_L), where f_L is the lowest sum of squares that any method
reached. The data profile is the share of problems solved within a number of simplex gradients, each of n + 1
evaluations. The box extends to both sides of the starting point by ten times its largest coordinate, or by 10.
"""

# ruff: noqa: E402  (the number of threads has to be set before NumPy is imported)
from __future__ import annotations

import argparse
import os

for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers import label, make
from calibray.tables import Column, Table, numbers
from markdown_tables import render_markdown
from problem_families.more_wild import MoreWild, problems

RADIUS = 0.005  # of the box, so that the first trust region is a tenth of the starting point, the default of DFO-LS
OPTIONS = {
    "pounders": {"radius": RADIUS, "tolerance": 1e-11},
    "dfo-ls": {"radius": RADIUS, "tolerance": 1e-11},
    "gauss-newton": {"step": 1e-9, "tolerance": 1e-14},
}
GRADIENTS = (2, 5, 10, 20)
TOLERANCES = (1e-1, 1e-3, 1e-5, 1e-7)


def history(problem: MoreWild, method: str) -> NDArray[np.float64]:
    """Lowest sum of squares after every evaluation."""
    half = 10 * max(1.0, float(np.abs(problem.start).max()))
    budget = max(GRADIENTS) * (len(problem.start) + 1)
    lower, upper = problem.start - half, problem.start + half
    optimizer = make(method, lower, upper, budget=budget, options=OPTIONS[method])
    values: list[float] = []
    while not optimizer.done:
        points = optimizer.ask()
        with np.errstate(all="ignore"):
            residuals = np.array([problem.residuals(point) for point in points])
            squares = np.sum(residuals**2, axis=1)
        failed = ~(np.isfinite(residuals).all(axis=1) & (squares < 1e100))
        residuals[failed] = np.nan
        value = np.where(failed, np.inf, np.sqrt(squares / residuals.shape[1]))
        optimizer.tell(points, value, residuals=residuals)
        values += np.where(failed, np.inf, squares).tolist()
    return np.minimum.accumulate(values)


def main() -> None:
    """Run all problems and print the data profiles."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", nargs="+", choices=OPTIONS, default=list(OPTIONS))
    methods = parser.parse_args().methods
    solved = np.zeros((len(methods), len(TOLERANCES), len(GRADIENTS)))
    chosen = problems()
    for problem in chosen:
        runs = [history(problem, method) for method in methods]
        lowest, first = min(run[-1] for run in runs), float(np.sum(problem.residuals(problem.start) ** 2))
        for row, run in enumerate(runs):
            for column, tolerance in enumerate(TOLERANCES):
                reached = run <= lowest + tolerance * (first - lowest)
                calls = int(np.argmax(reached)) + 1 if reached.any() else np.inf
                within = np.array(GRADIENTS) * (len(problem.start) + 1)
                solved[row, column] += (calls <= within) / len(chosen)
    columns = (
        Column("method"),
        Column("tolerance"),
        *(numbers(f"{number} gradients") for number in GRADIENTS),
    )
    rows = tuple(
        (label(method), f"{tolerance:g}", *(f"{share:.2f}" for share in solved[row, column]))
        for column, tolerance in enumerate(TOLERANCES)
        for row, method in enumerate(methods)
    )
    print(render_markdown(Table("", columns, rows)))


if __name__ == "__main__":
    main()
