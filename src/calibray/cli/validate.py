"""`calibray validate` and `compare`: predict held-out blocks of links, and compare methods at equal budgets."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, Pool, StudyFile, echo, log, option, progress_bars, with_groups
from calibray.errors import InputError
from calibray.support.messages import command

if TYPE_CHECKING:
    from calibray.study import Setup


@dataclass(frozen=True)
class Division:
    """Options that select the links that are held out in turn."""

    blocks: Annotated[
        int | None,
        option(
            "N",
            "Number of blocks, each of which is held out in turn; by default, the number in the study or else 4.",
            min=2,
            max=100,
        ),
    ] = None
    by: Annotated[
        str | None,
        option(
            "COLUMN",
            "Hold out the links that share a value of this column, one value at a time; tx holds out one transmitter "
            "at a time.",
        ),
    ] = None


@with_groups
def validate(
    study_file: StudyFile,
    division: Division,
    out: Annotated[
        Path | None,
        option(
            "DIR",
            "Result folder into which to write the validation, so that `calibray report DIR` includes it.",
            "--out",
            "-o",
        ),
    ] = None,
    *,
    pool: Pool,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Hold out each block of links in turn, calibrate on the other links, and compare models on the held-out block."""
    with progress_bars(log()) as progress:
        from calibray.engines import LEDGER_FILE, open_workers
        from calibray.result.files import RESULT_FILE, VALIDATION_FILE, check_same_study, write_validation
        from calibray.study import Study
        from calibray.support.output_files import check_outputs
        from calibray.tables import render
        from calibray.validation.validate import validate as run_validation

        study = Study.load(study_file)
        if out is not None:
            check_outputs(out, (VALIDATION_FILE,), study.files(), overwrite)
            check_same_study(study, out)
        setup = study.opened() if division.by is None else None
        if setup is not None and out is not None and (out / RESULT_FILE).is_file():
            _check_same_inputs(setup, out)
        ledger = None if out is None else out / LEDGER_FILE
        if ledger is not None and study.engine.expensive and ledger.is_file():
            echo(f"RT calls that are in {ledger} are not repeated", err=True)
        with open_workers(pool.workers, pool.scheduler) as workers:
            validation = run_validation(
                setup or study, blocks=division.blocks, by=division.by, workers=workers, progress=progress,
                ledger=ledger,
            )  # fmt: skip
    echo(json.dumps(validation.content(), indent=2) if as_json else render(*validation.summary()))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_validation(validation, study, out, validation.content())
        if note := _unused_text(out, validation.chosen):
            echo(f"Note: {note}", err=True)
        following = f"; next: {command('report', out)}" if (out / RESULT_FILE).is_file() else ""
        echo(f"Written to {out / VALIDATION_FILE}{following}", err=True)


def _unused_text(folder: Path, chosen: str) -> str:
    """Return a note if the predictions of the folder's result do not use the chosen model; otherwise, an empty text."""
    from calibray.calibration.result import Result
    from calibray.result.files import RESULT_FILE
    from calibray.result.wording import unused_choice_text

    if not (folder / RESULT_FILE).is_file():
        return ""
    used = Result.load(folder, allow_changed_inputs=True).prediction.model.name
    return "" if used == chosen else unused_choice_text(chosen)


def _check_same_inputs(setup: Setup, folder: Path) -> None:
    """Before time is spent, refuse a folder whose result was calibrated with another scene or with other links.

    Raises:
        InputError: The links, or a file of the scene or of an antenna, changed since the calibration.
    """
    from calibray.calibration.result import Result
    from calibray.result.files import changed_files, has_links

    result = Result.load(folder, allow_changed_inputs=True)
    changed = changed_files(result, setup.files)
    if not has_links(result, setup.links):
        changed = [*changed, str(setup.links.source)]
    if changed:
        raise InputError(
            f"{folder}: {', '.join(changed[:5])} changed since the result in this folder was calibrated; run the study "
            "again, or give another folder"
        )


@dataclass(frozen=True)
class Runs:
    """Options for the runs to compare."""

    methods: Annotated[
        str,
        option(
            "NAMES", "Names of the methods, separated by commas; METHOD@CALLS sets the budget of one method."
        ),
    ] = "sgwo-im,gwo,gwo@600,vector-surrogate,gaussian-process,differential-evolution,random,least-squares"
    seeds: Annotated[int, option("N", "Number of runs of each method; the seeds are 0 to N - 1.")] = 25
    budget: Annotated[int, option("CALLS", "Number of RT calls per run.")] = 225
    workers: Annotated[int, option("N", "Number of local processes.")] = 1


@with_groups
def compare(
    study_file: Annotated[Path, typer.Argument(metavar="STUDY", help="The study file, in TOML.")],
    out: Annotated[
        Path,
        option("DIR", "Folder for the tables, the figure and the finished runs.", "--out", "-o"),
    ],
    runs: Runs,
    overwrite: Overwrite = False,
) -> None:
    """Compare methods on a study over many seeds, with equal budgets of RT calls and with replayed paths."""
    import os

    # The matrices are small, so BLAS threads cost more time than they save; instead, runs are distributed over
    # processes. NumPy reads these variables on import, both here and in the workers.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

    from functools import partial

    from calibray.comparison.comparison import FILES, optimum_text, parse_methods, table, write
    from calibray.comparison.comparison import compare as run_comparison
    from calibray.comparison.method_runs import study_problem
    from calibray.study import Study
    from calibray.support.output_files import check_outputs
    from calibray.tables import render

    names = [name.strip() for name in runs.methods.split(",") if name.strip()]
    check_outputs(out, FILES, Study.load(study_file).files(), overwrite)
    parsed = parse_methods(names, runs.budget)
    with progress_bars(log()) as progress:
        comparison = run_comparison(
            partial(study_problem, study_file),
            parsed, seeds=runs.seeds, out=out, workers=runs.workers, progress=progress,
            announce=partial(echo, err=True),
        )  # fmt: skip
    write(comparison, out)
    echo(render(table(comparison), optimum_text(comparison)))
    for name, seed, failure in comparison.failures():
        echo(f"Warning: {name}, seed {seed}: {failure}", err=True)
    echo(f"Written to {out}: {', '.join(FILES)}", err=True)
