"""`calibray report`: write a result as an HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, ResultFolder, echo, log, progress_bars


def report(
    folder: ResultFolder,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="HTML file to write instead of DIR/report.html."),
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="Also write the figures as SVG and PNG into DIR/figures.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write a result as one HTML file: summary, values, figures, map, and the scene in 3-D."""
    with progress_bars(log()) as progress:
        from calibray.calibration.result import Result
        from calibray.reporting.page import FIGURES, FILE
        from calibray.reporting.page import report as write_report

        result = Result.load(folder)
        file = write_report(
            result,
            out or folder / FILE,
            figures=folder / FIGURES if figures else None,
            overwrite=overwrite,
            progress=progress,
        )
    echo(f"Written to {file}", err=True)


def export(
    folder: ResultFolder,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder to write into.", show_default=False)
    ],
    copy: Annotated[
        bool, typer.Option("--copy", help="Copy the meshes too, so that the folder is self-contained.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write the calibrated scene for Sionna RT, a script that loads it, and its materials as tables."""
    from calibray.calibration.result import Result
    from calibray.reporting.export import export as write
    from calibray.reporting.wording import sampling_text, scene_alone_text

    result = Result.load(folder)
    names = write(result, out, copy, overwrite)
    for note in filter(None, (scene_alone_text(result), sampling_text(result))):
        echo(f"Note: {note}", err=True)
    echo(f"Written to {out}: {', '.join(names)}", err=True)
