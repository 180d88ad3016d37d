"""What certainty costs: draws, validation and choice, as a ratio to the calibration itself, in one run.

    python benchmarks/certainty_cost.py
    python benchmarks/certainty_cost.py STUDY ...

Processor seconds of this process and replays, on the study's own paths, compiled before anything is timed. The script
fails where all of it together costs more than ten times the calibration.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

from calibray import engines
from calibray.fitting.methods import choose
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.result.held_out import Model
from calibray.scenarios import demo_study_path
from calibray.study import Study
from calibray.tables import Column, Table, numbers
from calibray.tables.text import render
from calibray.uncertainty.assessment import certainty
from calibray.validation.choice import HeldOutResiduals, fit_prediction_model
from calibray.validation.validate import validate_problem

LIMIT = 10.0


def costs(problem: Problem) -> dict[str, tuple[float, int]]:
    """Processor seconds and replays of each part."""
    found: dict[str, tuple[float, int]] = {}

    def timed(name: str, work: Callable, *given):
        started, calls = time.process_time(), problem.engine.calls
        result = work(*given)
        found[name] = time.process_time() - started, problem.engine.calls - calls
        return result

    for _ in range(2):  # the first compiles
        trail = timed("calibration", search, problem, choose(problem))
        timed("draws and verdicts", certainty, problem, trail)
        validation = timed(
            "validation", validate_problem, problem, None, None, None, {Model.CALIBRATED: trail.minima}
        )
        name = validation.chosen
        residuals = HeldOutResiduals(validation.scale(name), "held-out blocks", 1, validation.sizes(name))
        timed("choice", fit_prediction_model, problem, trail, name, residuals)
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*", default=[str(demo_study_path())], help="study files")
    options, expensive = parser.parse_args(), False
    columns = (Column("part"), numbers("processor", "s"), numbers("replays"), numbers("ratio"))
    for file in options.studies:
        setup = Study.load(file).opened()
        found = costs(Problem.of(setup, engines.make(setup)))
        own = found["calibration"][0]
        rows = [
            (name, f"{spent:.1f}", f"{calls:,}", f"{spent / own:.2f}")
            for name, (spent, calls) in found.items()
        ]
        others = sum(spent for name, (spent, _) in found.items() if name != "calibration") / own
        print(
            render(
                Table(setup.study.path.name, columns, tuple(rows)),
                f"All other parts: {others:.1f} calibrations.",
            )
        )
        expensive |= others > LIMIT
    if expensive:
        sys.exit(f"draws, validation and choice cost more than {LIMIT:g} calibrations")


if __name__ == "__main__":
    main()
