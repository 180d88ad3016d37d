"""The command line: parse, call, print.

Data goes to stdout, progress and messages to stderr. The exit status is 0 for done, 1 for failed while
running, 2 for bad input. Commands import what they need when they run, so that `--version` answers at once.
"""

from __future__ import annotations

from importlib import metadata
from typing import Annotated

import typer
from rich.console import Console
from typer.core import TyperGroup

from calibray.errors import EngineError, InputError

log = Console(stderr=True, highlight=False)
"""Where progress and messages go; data goes to stdout through `typer.echo`."""


class Commands(TyperGroup):
    """A group of commands whose expected failures are one message and an exit status, not a traceback."""

    def invoke(self, ctx: typer.Context) -> object:
        """Runs the command.

        Args:
            ctx: What was parsed from the command line.

        Returns:
            What the command returns.

        Raises:
            typer.Exit: With 2 on bad input, with 1 when an engine failed.
        """
        try:
            return super().invoke(ctx)
        except InputError as error:
            typer.echo(f"Error: {error}", err=True)
            raise typer.Exit(2) from error
        except EngineError as error:
            typer.echo(f"Error: {error}", err=True)
            raise typer.Exit(1) from error


app = typer.Typer(
    cls=Commands,
    name="calibray",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
"""All commands; a module that adds one imports this and decorates with `@app.command()`."""


def _print_version(wanted: bool) -> None:
    """Prints the version and ends, if it was asked for."""
    if wanted:
        typer.echo(f"calibray {metadata.version('calibray')}")
        raise typer.Exit


@app.callback()
def calibray(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Calibrate the radio materials of a ray-traced scene from measurements."""


@app.command()
def doctor() -> None:
    """Tell what is installed, try whether tracing and replay work here, and say what to do if not."""
    from calibray.doctor import examine, render

    with log.status("Trying Dr.Jit, Sionna RT and JAX"):
        diagnosis = examine()
    typer.echo(render(diagnosis))
    if not diagnosis.usable:
        raise typer.Exit(1)


def main() -> None:
    """Runs the command line of this process and ends it."""
    app()
