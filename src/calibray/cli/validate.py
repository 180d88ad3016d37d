"""`calibray validate`: refit without each block of links in turn and predict the block."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, Pool, StudyFile, echo, log, with_groups


@dataclass(frozen=True)
class Division:
    """Options that state which links are held out in turn."""

    blocks: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=2,
            max=100,
            help="Number of blocks, each held out in turn; by default the study's number, or 4.",
        ),
    ] = None
    by: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN",
            help="Hold out the links of each value of a column in turn; use tx for each transmitter.",
        ),
    ] = None


@with_groups
def validate(
    study_file: StudyFile,
    division: Division,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            help="Write the validation into this folder of a result, so that `calibray report DIR` shows it.",
        ),
    ] = None,
    *,
    pool: Pool,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate without each block of links in turn, and compare models on the held-out block."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.engines import open_workers
        from calibray.result.files import VALIDATION_FILE, write_validation
        from calibray.study import Study
        from calibray.support.output_files import check_outputs
        from calibray.tables import render
        from calibray.validation.validate import validate as run_validation

        study = Study.load(study_file)
        if out is not None:
            check_outputs(out, (VALIDATION_FILE,), study.files(), overwrite)
        with open_workers(pool.workers, pool.scheduler) as workers:
            validation = run_validation(
                study, blocks=division.blocks, by=division.by, workers=workers, progress=progress
            )
    echo(json.dumps(validation.content(), indent=2) if as_json else render(*validation.summary()))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_validation(validation, study, out, validation.content())
        echo(f"Written to {out / VALIDATION_FILE}", err=True)
