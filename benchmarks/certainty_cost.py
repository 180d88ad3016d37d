"""Time taken by posterior draws, validation and choice, relative to that of the calibration itself, in one run.

    python benchmarks/certainty_cost.py
    python benchmarks/certainty_cost.py STUDY ...
    python benchmarks/certainty_cost.py --seeds 3 STUDY ...

With `--seeds`, only posterior draws from several seeds are made: their time, the widths of the 90 % sets, and their
number of effective draws, which follows from the scatter of the means over each member's kept states.

The table has the processor time of this process, the wall time, and the number of replays on the study's own paths,
which are compiled before timing starts. The script fails if all parts together cost more than ten times the calibration
and take more than a minute.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibray import engines
from calibray.fitting.problem import Problem
from calibray.fitting.search import choose, search
from calibray.result.held_out import Model
from calibray.scenarios import demo_study_path
from calibray.study import Study
from calibray.tables import Column, Table, numbers, render
from calibray.uncertainty.assessment import certainty
from calibray.uncertainty.sequential_monte_carlo import Posterior
from calibray.uncertainty.verdicts import credible_sets
from calibray.validation.choice import HeldOutResiduals, fit_prediction_model
from calibray.validation.validate import validate_problem

LIMIT = 10.0
MINUTE = 60.0
LEVEL = 0.9


def costs(problem: Problem) -> dict[str, tuple[float, float, int]]:
    """Processor time [s], wall time [s] and replays of each part."""
    found: dict[str, tuple[float, float, int]] = {}

    def timed(name: str, work: Callable, *given):
        started, clock, calls = time.process_time(), time.perf_counter(), problem.engine.calls
        result = work(*given)
        spent = time.process_time() - started, time.perf_counter() - clock
        found[name] = *spent, problem.engine.calls - calls
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


def seeds(problem: Problem, count: int) -> Table:
    """Draws from several seeds: time, replays, effective draws, and widths of the 90 % sets relative to the range."""
    trail, study = search(problem, choose(problem)), problem.setup.study
    lower, upper = problem.parameters.search_bounds
    rows, widths = [], []
    for seed in range(count):
        method = study.method.model_copy(update={"seed": seed})
        setup = replace(problem.setup, study=study.model_copy(update={"method": method}))
        started = time.process_time()
        found = certainty(replace(problem, setup=setup), trail)
        spent = time.process_time() - started
        if found.posterior is None:
            sys.exit(f"no draws: {found.record.remarks}")
        draws = found.posterior.means
        widths.append([
            sum(high - low for low, high in pieces)
            for k in range(len(lower))
            for pieces in credible_sets(draws.point[:, k], draws.weight, lower[k], upper[k], [LEVEL])
        ])  # fmt: skip
        shares = (f"{share:.2f}" for share in widths[-1] / (upper - lower))
        agree = "yes" if draws.agree else "no"
        worth = f"{effective(found.posterior):.0f}"
        rows.append((str(seed), f"{spent:.1f}", f"{found.calls:,}", agree, worth, *shares))
    apart = np.ptp(widths, axis=0) / np.mean(widths, axis=0)
    rows.append(("apart", "", "", "", "", *(f"{share:.0%}".replace("%", " %") for share in apart)))
    columns = (
        Column("seed"), numbers("processor", "s"), numbers("replays"), Column("agree"), numbers("effective"),
        *(numbers(name) for name in problem.parameters.names),
    )  # fmt: skip
    return Table(study.path.name, columns, tuple(rows))


def effective(posterior: Posterior) -> float:
    """Effective draws, for the parameter for which they are fewest."""
    populations, states, size = posterior.shape
    point = posterior.means.point.reshape(populations, states, size, -1)
    scatter = point.mean(axis=1).var(axis=(0, 1)) / point.var(axis=(0, 1, 2))
    return populations * size / float(scatter.max())


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*", default=[str(demo_study_path())], help="study files")
    parser.add_argument("--seeds", type=int, default=0, help="seeds of draws to compare; 0 for the costs")
    options, expensive = parser.parse_args(), False
    columns = (
        Column("part"), numbers("processor", "s"), numbers("clock", "s"), numbers("replays"), numbers("ratio"),
    )  # fmt: skip
    for file in options.studies:
        setup = Study.load(file).opened()
        if options.seeds:
            print(render(seeds(Problem.of(setup, engines.make(setup)), options.seeds)))
            continue
        found = costs(Problem.of(setup, engines.make(setup)))
        own = found["calibration"][0]
        rows = [
            (name, f"{spent:.1f}", f"{clock:.1f}", f"{calls:,}", f"{spent / own:.2f}")
            for name, (spent, clock, calls) in found.items()
        ]
        rest = [part for name, part in found.items() if name != "calibration"]
        others, clock = sum(spent for spent, *_ in rest) / own, sum(clock for _, clock, _ in rest)
        print(
            render(
                Table(setup.study.path.name, columns, tuple(rows)),
                f"All other parts: {others:.1f} calibrations, {clock:.1f} s by the clock.",
            )
        )
        expensive |= others > LIMIT and clock > MINUTE
    if expensive:
        sys.exit(f"draws, validation and choice cost more than {LIMIT:g} calibrations and {MINUTE:g} s")


if __name__ == "__main__":
    main()
