"""`calibray compare`: compare methods at equal budgets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, echo, log, with_groups


@dataclass(frozen=True)
class Runs:
    """Options that state the runs to compare."""

    methods: Annotated[
        str,
        typer.Option(
            metavar="NAMES", help="Methods, separated by commas; METHOD@CALLS sets the budget of one method."
        ),
    ] = "sgwo-im,gwo,gwo@600,vector-surrogate,gaussian-process,differential-evolution,random,least-squares"
    seeds: Annotated[int, typer.Option(metavar="N", help="Runs of each method, with seeds 0 to N - 1.")] = 25
    budget: Annotated[int, typer.Option(metavar="CALLS", help="RT calls per run.")] = 225
    workers: Annotated[int, typer.Option(metavar="N", help="Number of local processes.")] = 1


@with_groups
def compare(
    study_file: Annotated[Path, typer.Argument(metavar="STUDY", help="The study file, in TOML.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            help="Folder for the tables and the figure; it also keeps finished runs.",
        ),
    ],
    runs: Runs,
    overwrite: Overwrite = False,
) -> None:
    """Compare methods on a study: many seeds, equal budgets of RT calls, replayed paths."""
    import os

    # The matrices are small, so threads of BLAS cost more than they gain; runs are distributed over processes instead.
    # NumPy reads these variables when it is imported, here and in the workers.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

    from functools import partial

    from calibray.cli.progress_bars import progress_bars
    from calibray.comparison.comparison import FILES, optimum_text, parse_methods, table, write
    from calibray.comparison.comparison import compare as run_comparison
    from calibray.comparison.method_runs import study_problem
    from calibray.study import Study
    from calibray.support.output_files import check_outputs
    from calibray.tables import render

    names = [name.strip() for name in runs.methods.split(",") if name.strip()]
    check_outputs(out, FILES, Study.load(study_file).files(), overwrite)
    parsed = parse_methods(names, runs.budget)
    calls = runs.seeds * sum(method.budget for method in parsed)
    echo(
        f"{runs.seeds * len(parsed):,} runs with {calls:,} RT calls in total; runs are kept in {out} are not repeated",
        err=True,
    )
    with progress_bars(log()) as progress:
        comparison = run_comparison(
            partial(study_problem, study_file),
            names, seeds=runs.seeds, budget=runs.budget, out=out, workers=runs.workers, progress=progress,
        )  # fmt: skip
    write(comparison, out)
    echo(render(table(comparison), optimum_text(comparison)))
    for name, seed, failure in comparison.failures():
        echo(f"Warning: {name}, seed {seed}: {failure}", err=True)
    echo(f"Written to {out}: {', '.join(FILES)}", err=True)
