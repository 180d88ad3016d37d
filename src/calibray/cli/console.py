"""Where commands write, and the arguments that several of them take."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console


@cache
def log() -> Console:
    """Where progress and messages go; data goes to stdout through `typer.echo`.

    Rich is loaded when something is to be shown: `--version` and `--help` do without it.
    """
    from rich.console import Console

    return Console(stderr=True, highlight=False)


StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="The study file, in TOML.", show_default=False)
]

Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace files there that Calibray did not write.")
]
"""Whether output may take the place of a user's file; an input is never replaced."""

AllowChangedInputs = Annotated[
    bool,
    typer.Option(
        "--allow-changed-inputs", help="Go on although a file of the result, the scene or an antenna changed."
    ),
]
"""Whether a result is used although what it was calibrated with changed."""

Workers = Annotated[
    int | None,
    typer.Option(metavar="N", help="Processes here that blocks of links are shared out to."),
]

Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers take blocks of links."),
]
