"""Links that were logged several times: do their rows count as one measurement?

    python benchmarks/repeats.py --repetitions 4 --districts development

A repetition plants a truth with 3 dB of noise per link and 0.3 dB per row. It calibrates once with the mean of each
link's three rows, and once with the rows, whose receivers are 2 mm apart so that they are not merged when the table is
read. If the rows counted as independent, intervals would be too narrow by a factor of the square root of three.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import districts
from calibray import engines
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.optimizers import LeastSquares
from calibray.study import Study
from calibray.tables import Column, Table, numbers, render
from calibray.uncertainty.assessment import certainty
from calibray.uncertainty.verdicts import credible_sets

NOISE_DB, ROW_DB = 3.0, 0.3
ROWS = 3
APART_M = 0.002
LEVEL = 0.9


def repeated(problem: Problem) -> Problem:
    """The problem of a study whose table has three rows per link."""
    study, frame = problem.setup.study, problem.setup.links.frame
    rows = frame.loc[np.repeat(frame.index, ROWS)].reset_index(drop=True)
    rows["rx_x"] += APART_M * np.tile(np.arange(ROWS), len(frame))
    file = study.path.with_name("repeated.csv")
    rows.to_csv(file, index=False)
    content = study.content()
    content["links"]["file"] = file.name
    setup = Study.from_content(content, study.path).opened()
    return Problem.of(setup, engines.make(setup, "replay"))


def inside(problem: Problem, measured: np.ndarray, truth: np.ndarray, seed: int) -> list[bool]:
    """Whether the 90 % set of each parameter contains the truth."""
    planted = replace(problem, objective=replace(problem.objective, measured=measured))
    lower, upper = problem.parameters.search_bounds
    found = certainty(planted, search(planted, LeastSquares(lower, upper, starts=32, seed=seed))).posterior
    if found is None:
        raise RuntimeError("no draws")
    draws = found.means
    return [
        any(low <= truth[k] <= high for low, high in pieces)
        for k in range(len(truth))
        for pieces in (credible_sets(draws.point[:, k], draws.weight, lower[k], upper[k], [LEVEL])[0],)
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--repetitions", type=int, default=4)
    parser.add_argument("--districts", default="development", help="names, or development or judging")
    given = parser.parse_args()
    held: dict[str, list[bool]] = {"mean of each link": [], "rows": []}
    with tempfile.TemporaryDirectory() as folder:
        for name in districts.named(given.districts):
            once = districts.make(name, Path(folder)).problem
            rows = repeated(once)
            for seed in range(given.repetitions):
                random = np.random.default_rng([seed, len(once.objective.measured)])
                truth = random.uniform(*once.parameters.search_bounds)
                loss = once.modelled(truth[None])[0]
                error = NOISE_DB * random.standard_normal(len(loss))
                each = (loss + error)[:, None] + ROW_DB * random.standard_normal((len(loss), ROWS))
                held["mean of each link"] += inside(once, each.mean(axis=1), truth, seed)
                held["rows"] += inside(rows, each.reshape(-1), truth, seed)
            shares = ", ".join(f"{kind} {np.mean(values):.2f}" for kind, values in held.items())
            print(f"{name}: {shares} of {len(held['rows'])}", file=sys.stderr)
    table = [(kind, str(len(values)), f"{np.mean(values):.2f}") for kind, values in held.items()]
    columns = (Column("calibrated with"), numbers("values"), numbers("in 90 % set"))
    print(render(Table("Links that were logged three times", columns, tuple(table))))


if __name__ == "__main__":
    main()
