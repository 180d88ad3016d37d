"""`calibray export`: write the calibrated scene and its materials for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, echo


def export(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder that `calibray run` wrote.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder to write into.", show_default=False)
    ],
    copy: Annotated[
        bool,
        typer.Option("--copy", help="Copy the meshes too, so that the folder is self-contained."),
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
