"""`calibray report`: a result as a page to look at."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, log


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder that `calibray run` wrote.", show_default=False)
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="HTML file to write instead of DIR/report.html."),
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="Write the figures as well, as SVG and PNG, into DIR/figures.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write a result as one HTML file that opens from disk: summary, values, figures, map, and the scene in 3-D."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.calibration.result import Result
        from calibray.reporting.page import FIGURES, FILE
        from calibray.reporting.page import report as write

        result = Result.load(folder)
        pictures = folder / FIGURES if figures else None
        file = out or folder / FILE
        written = write(result, file, figures=pictures, overwrite=overwrite, progress=progress)
    typer.echo(f"Written to {written}", err=True)
