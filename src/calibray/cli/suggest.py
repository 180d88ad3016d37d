"""`calibray suggest`: suggest where to measure next."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import AllowChangedInputs, Overwrite, echo, log, print_costs


def suggest(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder that `calibray run` wrote.", show_default=False)
    ],
    candidates_file: Annotated[
        Path,
        typer.Argument(
            metavar="CANDIDATES",
            help="CSV or Parquet file of candidate links, with the columns that `calibray predict` reads.",
            show_default=False,
        ),
    ],
    count: Annotated[int, typer.Option(metavar="N", min=1, help="Number of links to suggest.")] = 5,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Also write the table to this CSV or Parquet file."),
    ] = None,
    observables: Annotated[
        bool,
        typer.Option("--observables", help="Also say which further observable is worth measuring there."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    allow_changed_inputs: AllowChangedInputs = False,
    overwrite: Overwrite = False,
) -> None:
    """Suggest where to measure next: the candidate links that are expected to narrow the intervals most."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.calibration.result import Result
        from calibray.measurements.table_files import read_table
        from calibray.prediction.predict import as_links
        from calibray.prediction.suggestion import suggest as suggest_links
        from calibray.prediction.suggestion_tables import suggestion_tables
        from calibray.support.output_tables import check_table, write_table
        from calibray.tables.text import render

        print_costs()
        result = Result.load(folder, allow_changed_inputs=allow_changed_inputs)
        study = result.study
        links = as_links(result, read_table(candidates_file))
        if out is not None:
            check_table(out, [candidates_file, *study.files()], overwrite)
        suggestion = suggest_links(
            result, links, count, progress, allow_changed_inputs=allow_changed_inputs, observables=observables
        )
    echo(
        json.dumps(suggestion.to_dict("records"), indent=2)
        if as_json
        else render(*suggestion_tables(suggestion))
    )
    if out is not None:
        write_table(out, suggestion)
