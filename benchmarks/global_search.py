"""Whether `auto` on replay finds the lowest minimum, in drawn districts and offices with thick slabs.

    python benchmarks/global_search.py --first 3700 --districts 20 --offices 10 --truths 4 --out search.jsonl

Slabs are 60 % thicker than in the scene, so that they resonate often. Truths are drawn uniformly within the bounds, and
the noise is 3 dB. The lowest known minimum is the lowest one that is found by `auto`, by the same searches without
basin hopping, from 2,048 starting points of another seed, or by a search from the truth. The gap is the RMSE minus this
minimum.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from calibray.errors import InputError
from calibray.fitting.search import least_squares, local_searches
from calibray.optimizers.least_squares import LeastSquares
from calibray.tables import Column, Table, numbers, render
from finished_runs import append_run
from ray_mapping import Foreign, Place, district, office, planted

MANY: Final = 2048
METHODS: Final = ("auto", "without hopping")


def searched(place: Place, engine: Foreign, number: int) -> dict[str, Any]:
    """Gaps and costs of the searches for one truth."""
    seed, parameters = int(place.name.split("-")[-1]), engine.parameters
    problem, truth = planted(place, engine, np.random.default_rng([40, seed, number]))
    starts = local_searches(engine.replay.interactions)
    first, true = (parameters.to_search(values)[None] for values in (parameters.start, truth))
    problem.squares(first, derivatives=True)  # compiles

    def run(*arguments: Any, **settings: Any) -> tuple[LeastSquares, float]:
        before = time.process_time()
        return least_squares(problem, *arguments, **settings), time.process_time() - before

    runs = {METHODS[0]: run(starts, first)}
    with patch("calibray.optimizers.least_squares.PATIENCE", 0):
        runs[METHODS[1]] = run(starts, first)
    more = run(MANY, np.concatenate([first, true]), seed=1)[0]
    best = min(more.best.y, *(search.best.y for search, _ in runs.values()))
    return {
        "parameters": len(parameters),
        "gaps_db": {name: search.best.y - best for name, (search, _) in runs.items()},
        "evaluations": {name: search.evaluations for name, (search, _) in runs.items()},
        "seconds": {name: seconds for name, (_, seconds) in runs.items()},
    }


def summary(lines: list[dict[str, Any]]) -> Table:
    """The table's rows, one per method."""
    rows = []
    for name in METHODS:
        gaps, evaluations, seconds = (
            np.array([line[key][name] for line in lines]) for key in ("gaps_db", "evaluations", "seconds")
        )
        rows.append(
            (
                name,
                str(len(lines)),
                f"{(gaps > 1e-3).sum()}",
                f"{(gaps > 1e-2).sum()}",
                f"{gaps.max():.4f}",
                f"{np.median(evaluations):,.0f}",
                f"{seconds.mean():.1f}",
            )
        )
    columns = ("runs", "above 0.001 dB", "above 0.01 dB", "largest gap [dB]", "evaluations", "CPU [s]")
    return Table("Searches", (Column("search"), *map(numbers, columns)), tuple(rows))


def main() -> None:
    """Search every place and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--first", type=int, default=3700, help="first seed of districts and offices")
    parser.add_argument("--districts", type=int, default=20)
    parser.add_argument("--offices", type=int, default=10)
    parser.add_argument("--truths", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("search.jsonl"), help="file of the finished runs")
    options, lines = parser.parse_args(), []
    for make, count in ((district, options.districts), (office, options.offices)):
        for seed in range(options.first, options.first + count):
            with tempfile.TemporaryDirectory() as folder:
                try:
                    place = make(seed, Path(folder))
                    engine = Foreign(place, "thicker")
                except InputError as error:
                    print(f"{make.__name__} {seed}: {error}", flush=True)
                    continue
                for number in range(options.truths):
                    line = {"place": f"{make.__name__}-{seed}", "truth": number}
                    line |= searched(place, engine, number)
                    lines.append(line)
                    append_run(options.out, line)
    print(render(summary(lines)))


if __name__ == "__main__":
    main()
