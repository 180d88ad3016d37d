"""The console for messages, and arguments that several commands share."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from calibray.measurements import Measurements
    from calibray.study import Study


@cache
def log() -> Console:
    """The console for progress and messages, on stderr; data go to stdout by `typer.echo`.

    Rich is imported here, on first use, so that `--version` and `--help` do not load it.
    """
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def echo(text: str, err: bool = False, nl: bool = True) -> None:
    """Print text with control characters escaped: names in it come from files and must not control the terminal."""
    from calibray.support.messages import printable

    typer.echo(printable(text, keep="\n\t"), err=err, nl=nl)


@cache
def print_costs() -> None:
    """Print the costs of predictions to stderr before they start."""
    import logging

    class Echo(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            echo(record.getMessage(), err=True)

    from calibray.prediction.batches import LOG

    LOG.setLevel(logging.INFO)
    LOG.addHandler(Echo())
    LOG.propagate = False


StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="The study file, in TOML.", show_default=False)
]

Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace existing files that Calibray did not write.")
]
"""Whether output may replace a user's file; an input is never replaced."""

AllowChangedInputs = Annotated[
    bool,
    typer.Option(
        "--allow-changed-inputs",
        help="Continue although a file of the result, the scene or an antenna has changed.",
    ),
]
"""Whether a result may be used although its inputs have changed."""

Workers = Annotated[
    int | None,
    typer.Option(metavar="N", help="Number of local processes among which chunks of links are distributed."),
]

Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers process chunks of links."),
]


def warn(study: Study, links: Measurements) -> None:
    """Print warnings about suspicious links to stderr.

    Raises:
        InputError: The links are far from the scene, or the scene cannot be read.
    """
    from importlib.util import find_spec

    from calibray.reporting.scene_tables import warning_lines
    from calibray.study.link_checks import examine

    if missing := [name for name in ("shapely", "trimesh") if find_spec(name) is None]:
        echo(
            f"Positions were not checked against the scene: {missing[0]} is not installed; "
            "run pip install 'calibray[scenes]'",
            err=True,
        )
        return
    try:
        findings = examine(study, links)
    except InputError:
        # An external program may read scene files that Calibray cannot.
        if study.engine.external:
            return
        raise
    if findings:
        echo(warning_lines(findings), err=True)
