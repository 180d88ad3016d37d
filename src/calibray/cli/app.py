"""The command-line application: its commands and its error handling.

Data are written to stdout; progress and messages are written to stderr. The exit status is 0 for success, 1 for a
failure while running, 2 for bad input, 130 for Ctrl-C and 143 for SIGTERM. Each command imports its dependencies when
it runs, so that `--version` responds immediately.
"""

from __future__ import annotations

from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from calibray.cli.console import echo
from calibray.cli.doctor import cache, doctor, ledger
from calibray.cli.init import init, open, schema
from calibray.cli.predict import map, predict, suggest
from calibray.cli.run import demo, export, report, run, trace
from calibray.cli.scene import scene
from calibray.cli.validate import compare, validate
from calibray.errors import EngineError, InputError
from calibray.support.interruption import ensure_interruption, exit_status, interrupt_on_termination
from calibray.support.memory import check_address_space

LONGEST: Final = 4096
"""Maximum number of characters in an argument; this is also the maximum length of a path on Linux."""


class Commands(TyperGroup):
    """A group of commands that reports expected failures with a message and an exit status, without a traceback."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse overlong and empty arguments, then parse the arguments."""
        for argument in args:
            if len(argument) > LONGEST:
                ctx.fail(f"an argument has {len(argument)} characters; the maximum is {LONGEST}")
            # An empty folder name would mean the current folder.
            if not argument.strip():
                ctx.fail("an argument is empty; give a value, or omit the option")
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command, and convert errors to exit statuses.

        Raises:
            typer.Exit: The exit status is 2 for bad input, 1 for any other expected failure, 130 for Ctrl-C, and 143
                for SIGTERM.
            BrokenPipeError: The reader of stdout has closed the stream; Typer handles this error.
        """
        try:
            check_address_space()
            with interrupt_on_termination(), ensure_interruption():
                return super().invoke(ctx)
        except InputError as error:
            echo(f"Error: {error}", err=True)
            raise typer.Exit(2) from error
        except EngineError as error:
            echo(f"Error: {error}", err=True)
            raise typer.Exit(1) from error
        except MemoryError as error:
            echo("Error: not enough memory; close other programs, or reduce the number of links", err=True)
            raise typer.Exit(1) from error
        except BrokenPipeError:
            raise
        except OSError as error:
            file = "" if error.filename is None else f"{error.filename}: "
            fault = f"cannot be read or written ({error.strerror or error}); check permissions and disk space"
            if isinstance(error, FileNotFoundError):
                fault = "file not found; restore it, or correct its path"
            echo(f"Error: {file}{fault}", err=True)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as error:
            # The interrupted command itself reports which results were kept. An error that occurred during the
            # interruption is reported here.
            if isinstance(error.__cause__, (InputError, EngineError)):
                echo(f"Error: {error.__cause__}", err=True)
            echo("Interrupted", err=True)
            raise typer.Exit(exit_status()) from error


app = typer.Typer(
    cls=Commands,
    name="calibray",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    # The help is plain text because Rich would double the time that --help takes.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
"""All commands. To add a command, write a function in a module of this package, and add it to the list below."""


def _print_version(requested: bool) -> None:
    """If requested, print the version and exit."""
    if requested:
        from importlib import metadata

        echo(f"calibray {metadata.version('calibray')}")
        raise typer.Exit


@app.callback()
def calibray(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Calibrate the radio materials of a ray-traced scene against measured path loss."""


for command in (  # in the order of `--help`
    doctor, demo, open, init, schema, run, report, compare, validate, trace, predict, map, suggest, export, ledger,
    cache,
):  # fmt: skip
    # Without `short_help`, Typer truncates the summary. The help omits the "Raises" section, which matters only to
    # Python callers.
    text = (command.__doc__ or "").partition("\n    Raises:")[0]
    app.command(help=text, short_help=text.partition("\n\n")[0])(command)
app.add_typer(scene)
