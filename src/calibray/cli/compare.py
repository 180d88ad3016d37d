"""`calibray compare`: methods side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from calibray.cli.console import Overwrite, log

FAMILY_FILES: Final = ("family.csv", "family_runs.csv")


def compare(
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Folder for tables and figure; finished runs are kept there."
        ),
    ],
    study_file: Annotated[Path | None, typer.Argument(metavar="STUDY", help="The study file (TOML).")] = None,
    family: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="In place of a study: problems planted from seeds, in a district or an office.",
        ),
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            metavar="NAMES", help="Methods with commas between; METHOD@CALLS has a budget of its own."
        ),
    ] = "sgwo-im,gwo,gwo@600,vector-surrogate,gaussian-process,differential-evolution,random,least-squares",
    seeds: Annotated[
        str,
        typer.Option(
            metavar="N",
            help="Runs of each method, from seeds 0 to N - 1. With --family: its problems, as 0:20.",
        ),
    ] = "25",
    repeats: Annotated[
        int, typer.Option(metavar="N", help="With --family: runs of each method on each problem.")
    ] = 1,
    budget: Annotated[int, typer.Option(metavar="CALLS", help="RT calls of a run.")] = 225,
    workers: Annotated[int, typer.Option(metavar="N", help="Processes that run at once.")] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Run methods from many seeds on a study's stored paths, or on a family of problems, at equal budgets."""
    import os

    # The matrices are small: threads cost more than they give, and the runs are what is spread over cores.
    # The variables are read when NumPy is loaded, here and in the workers.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

    from calibray.comparison.family import seed_range
    from calibray.errors import InputError

    names = [name.strip() for name in methods.split(",") if name.strip()]
    if (study_file is None) == (family is None):
        raise InputError("compare: give a study file, or --family district or office, and not both")
    chosen = seed_range(seeds)
    if study_file is not None:
        if chosen.start or repeats != 1:
            raise InputError(
                "compare: a range of --seeds and --repeats go with --family; give a number of seeds"
            )
        _on_study(study_file, out, names, len(chosen), budget, workers, overwrite)
    elif family is not None:
        names = [name for name in names if name != "least-squares"]
        _on_family(family, out, names, chosen, repeats, budget, workers, overwrite)


def _on_study(
    study_file: Path, out: Path, names: list[str], seeds: int, budget: int, workers: int, overwrite: bool
) -> None:
    from functools import partial

    from calibray.cli.progress import progress_bars
    from calibray.comparison.arena import study_arena
    from calibray.comparison.comparison import compare as run_all
    from calibray.comparison.contender import Contender
    from calibray.comparison.tables import optimum, table
    from calibray.files import check_outputs
    from calibray.reporting.excess import FILES, write
    from calibray.study import Study
    from calibray.tables.text import render

    check_outputs(out, FILES, Study.load(study_file).files(), overwrite)
    contenders = [Contender.parse(name, budget) for name in dict.fromkeys(names)]
    calls = seeds * sum(contender.budget for contender in contenders)
    typer.echo(
        f"{seeds * len(contenders):,} runs of {calls:,} RT calls together, less those kept in {out}", err=True
    )
    with progress_bars(log()) as progress:
        finished = run_all(
            partial(study_arena, study_file),
            names, seeds=seeds, budget=budget, out=out, workers=workers, progress=progress,
        )  # fmt: skip
    write(finished, out)
    typer.echo(render(table(finished), optimum(finished)))
    for name, seed, failure in finished.failures():
        typer.echo(f"Warning: {name}, seed {seed}: {failure}", err=True)
    typer.echo(f"Written to {out}: {', '.join(FILES)}", err=True)


def _on_family(
    kind: str,
    out: Path,
    names: list[str],
    seeds: range,
    repeats: int,
    budget: int,
    workers: int,
    overwrite: bool,
) -> None:
    from calibray.cli.progress import progress_bars
    from calibray.comparison.family import compare_family
    from calibray.comparison.family_tables import tables
    from calibray.files import check_outputs, write_table
    from calibray.tables.text import render

    check_outputs(out, FAMILY_FILES, (), overwrite)
    with progress_bars(log()) as progress:
        finished = compare_family(
            kind, seeds, names, budget=budget, repeats=repeats, out=out, workers=workers, progress=progress
        )
    write_table(out / FAMILY_FILES[0], finished.table())
    write_table(out / FAMILY_FILES[1], finished.history())
    for table in tables(finished):
        typer.echo(render(table))
    for name, seed, failure in finished.failures():
        typer.echo(f"Warning: {name}, problem {seed}: {failure}", err=True)
    for seed, reason in finished.unmade:
        typer.echo(f"Warning: problem {seed} could not be made: {reason}", err=True)
    typer.echo(f"Written to {out}: {', '.join(FAMILY_FILES)}", err=True)
