"""Every method on five problems at equal budgets of RT calls: the tables and figures of docs/measurements/methods.

    python benchmarks/methods.py --seeds 25 --workers 2

needs `pip install 'calibray[optimizers]'` and the data of both measured campaigns (see examples/README.md). Finished
runs are stored under out/methods, so that a killed benchmark continues where it stopped; delete the folder to measure
again. Excess RMSE can be compared between machines, but times cannot.
"""

# ruff: noqa: E402  (the number of threads has to be set before NumPy is imported)
from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

for library in (
    "OMP",
    "OPENBLAS",
    "MKL",
):  # read when NumPy is loaded; one core per run, here and in the workers
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

from calibray.cli.console import log, progress_bars
from calibray.comparison.comparison import compare, figure, parse_methods, table
from calibray.comparison.method_runs import ComparisonProblem, study_problem
from calibray.scenarios import demo_study_path
from calibray.support.figure_style import write
from calibray.support.output_files import write_table, write_text
from markdown_tables import render_markdown
from problem_families.problems import landscape_problem

ROOT = Path(__file__).resolve().parents[1]
METHODS = (
    "vector-surrogate", "sgwo-im", "gwo", "gwo@600", "gaussian-process", "dfo-ls", "cma-es",
    "differential-evolution", "random", "least-squares",
)  # fmt: skip
PROBLEMS: dict[str, tuple[str, Callable[[], ComparisonProblem]]] = {
    "demo": ("The demo district, 3 permittivities", partial(study_problem, demo_study_path())),
    "boulder": ("Boulder at 28.5 GHz (NIST)", partial(study_problem, ROOT / "examples/nist_boulder.toml")),
    "auckland": ("Auckland at 1.88 GHz", partial(study_problem, ROOT / "examples/auckland_tower.toml")),
    "hall": (
        "Thick resonating panes, 3 parameters, hundreds of local minima",
        partial(landscape_problem, "hall"),
    ),
    "blocks": ("8 parameters, 60 links", partial(landscape_problem, "blocks")),
}


def main() -> None:
    """Run what is missing and write tables and figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--budget", type=int, default=225)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--runs", type=Path, default=ROOT / "out/methods", help="folder of the finished runs")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs/measurements/methods", help="folder for tables and figures"
    )
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    sections = ["# Methods compared\n\n`benchmarks/methods.py` generated this page from " f"{chosen.seeds} seeds, with "
                f"{chosen.budget} RT calls unless the method's name states otherwise."]  # fmt: skip
    for name in chosen.problems:
        title, open_problem = PROBLEMS[name]
        with progress_bars(log()) as progress:
            finished = compare(
                open_problem, parse_methods(chosen.methods, chosen.budget), seeds=chosen.seeds,
                out=chosen.runs / name, workers=chosen.workers, progress=progress,
            )  # fmt: skip
        write_table(chosen.out / f"{name}.csv", finished.table())
        write(figure(finished), chosen.out / f"{name}.png")
        sections.append(
            f"## {title}\n\nThe optimum of {finished.optimum:.6g} dB was found by {finished.found_by}.\n\n"
            f"{render_markdown(table(finished))}\n\n![Excess RMSE versus RT calls]({name}.png)"
        )
        print(sections[-1], flush=True)
    write_text(chosen.out / "tables.md", "\n\n".join(sections) + "\n")


if __name__ == "__main__":
    main()
