"""`calibray validate`: what calibration is worth where nothing was fitted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, Scheduler, StudyFile, Workers, log


def validate(
    study_file: StudyFile,
    blocks: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=2,
            max=100,
            help="Spatial blocks, each held out in turn; the study's, or 4, unless given.",
        ),
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN", help="Hold out each label of a column in turn; tx for each transmitter."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            help="Write it into this folder, that of a result of the study: `calibray report DIR` shows it then.",
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate without each block of links in turn, and judge the twin and its rivals by the block left out."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.engines import open_workers
        from calibray.result.files import VALIDATION_FILE, write_validation
        from calibray.study import Study
        from calibray.support.output_files import check_outputs
        from calibray.tables.text import render
        from calibray.validation.validate import validate as judge

        study = Study.load(study_file)
        if out is not None:
            check_outputs(out, (VALIDATION_FILE,), study.files(), overwrite)
        with open_workers(workers, scheduler) as pool:
            found = judge(study, blocks=blocks, by=by, workers=pool, progress=progress)
    typer.echo(json.dumps(found.content(), indent=2) if as_json else render(*found.summary()))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_validation(found, out, found.content())
        typer.echo(f"Written to {out / VALIDATION_FILE}", err=True)
