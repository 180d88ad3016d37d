"""The command line as a whole: its commands, and how their failures end.

Data goes to stdout, progress and messages to stderr. The exit status is 0 for done, 1 for failed while running, 2 for
bad input, 130 for Ctrl-C. Commands import what they need when they run, so that `--version` answers at once.
"""

from __future__ import annotations

from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from calibray.cli import INTERRUPTED
from calibray.cli.cache import cache
from calibray.cli.compare import compare
from calibray.cli.demo import demo
from calibray.cli.doctor import doctor
from calibray.cli.export import export
from calibray.cli.init import init
from calibray.cli.ledger import ledger
from calibray.cli.map import map
from calibray.cli.predict import predict
from calibray.cli.report import report
from calibray.cli.run import run
from calibray.cli.scene import scene
from calibray.cli.schema import schema
from calibray.cli.suggest import suggest
from calibray.cli.trace import trace
from calibray.cli.validate import validate
from calibray.errors import EngineError, InputError
from calibray.support.interruption import ensure_interruption

LONGEST: Final = 4096
"""The number of characters beyond which an argument is refused; Linux takes no longer path."""


class Commands(TyperGroup):
    """A group of commands whose expected failures are one message and an exit status, not a traceback."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Part the command from what is its own.

        Args:
            ctx: What will be parsed.
            args: The command line.

        Returns:
            The arguments that are the command's.
        """
        for argument in args:
            if len(argument) > LONGEST:
                ctx.fail(f"an argument has {len(argument)} characters, must have at most {LONGEST}")
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command.

        Args:
            ctx: What was parsed from the command line.

        Returns:
            What the command returns.

        Raises:
            typer.Exit: With 2 on bad input, with 1 when an engine failed, or a file could not be read or
                written, with 130 on Ctrl-C.
            BrokenPipeError: Nobody reads on; what calls this knows how to end.
        """
        try:
            with ensure_interruption():
                return super().invoke(ctx)
        except InputError as error:
            typer.echo(f"Error: {error}", err=True)
            raise typer.Exit(2) from error
        except EngineError as error:
            typer.echo(f"Error: {error}", err=True)
            raise typer.Exit(1) from error
        except BrokenPipeError:
            raise
        except OSError as error:
            place = "" if error.filename is None else f"{error.filename}: "
            typer.echo(
                f"Error: {place}cannot be used ({error.strerror or error}); check it, and the disk", err=True
            )
            raise typer.Exit(1) from error
        except KeyboardInterrupt as error:
            # What the command has to say of what was kept it said itself; what went wrong on the way is not to be lost.
            if isinstance(error.__cause__, (InputError, EngineError)):
                typer.echo(f"Error: {error.__cause__}", err=True)
            typer.echo("Interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from error


app = typer.Typer(
    cls=Commands,
    name="calibray",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    # Help is plain text, which Rich would take as long to draw as all else takes.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
"""All commands; one more is a module with a function, named below."""


def _print_version(wanted: bool) -> None:
    """Print the version and end, if it was asked for."""
    if wanted:
        from importlib import metadata

        typer.echo(f"calibray {metadata.version('calibray')}")
        raise typer.Exit


@app.callback()
def calibray(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Calibrate the radio materials of a ray-traced scene from measurements."""


COMMANDS = (  # one after the other, as `--help` lists them
    doctor,
    demo,
    init,
    schema,
    run,
    report,
    compare,
    validate,
    trace,
    predict,
    map,
    suggest,
    export,
    ledger,
    cache,
)
for command in COMMANDS:
    # Of a summary that is not given Typer lists the beginning only.
    app.command(short_help=(command.__doc__ or "").partition("\n\n")[0])(command)
app.add_typer(scene)
