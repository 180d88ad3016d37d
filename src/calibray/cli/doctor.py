"""`calibray doctor`: whether this machine can trace and replay."""

from __future__ import annotations

import typer

from calibray.cli.console import log


def doctor() -> None:
    """Tell what is installed, try whether tracing and replay work here, and say what to do if not."""
    from calibray.diagnosis import examine
    from calibray.reporting.diagnosis import table
    from calibray.tables.text import render

    with log.status("Trying Dr.Jit, Sionna RT and JAX"):
        diagnosis = examine()
    typer.echo(render(table(diagnosis)))
    if not diagnosis.usable:
        raise typer.Exit(1)
