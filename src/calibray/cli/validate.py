"""`calibray validate`: what calibration is worth where nothing was fitted."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from calibray.cli.console import StudyFile, log


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
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Calibrate without each block of links in turn, and judge the twin and its rivals by the block left out."""
    from calibray.calibration.validate import validate as judge
    from calibray.cli.progress import progress_bars
    from calibray.study import Study
    from calibray.tables.text import render

    with progress_bars(log) as progress:
        found = judge(Study.load(study_file), blocks=blocks, by=by, progress=progress)
    typer.echo(json.dumps(found.content(), indent=2) if as_json else render(*found.summary()))
