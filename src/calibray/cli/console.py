"""The console for messages, and arguments that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

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

ResultFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder that `calibray run` wrote.", show_default=False)
]

Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace existing files that Calibray did not write.")
]
"""Whether output may replace a user's file; an input is never replaced."""


@dataclass(frozen=True)
class Pool:
    """Options that state the workers; their fields are the arguments of `calibray.engines.open_workers`."""

    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Number of local processes among which chunks of links are distributed."
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers process chunks of links."),
    ] = None


@dataclass(frozen=True)
class Permissions:
    """Options that permit what is refused otherwise."""

    allow_changed_inputs: Annotated[
        bool,
        typer.Option(
            "--allow-changed-inputs",
            help="Continue although a file of the result, the scene or an antenna has changed.",
        ),
    ] = False
    overwrite: Overwrite = False


def with_groups(command: Callable[..., None]) -> Callable[..., None]:
    """A command in which each argument that is a dataclass becomes one option for each of its fields."""
    arguments: dict[str, Any] = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: kind for name, kind in arguments.items() if is_dataclass(kind)}
    options: list[Parameter] = []
    for argument in signature(command).parameters.values():
        kind = arguments[argument.name]
        hints = get_type_hints(kind, include_extras=True) if argument.name in groups else arguments
        parts = signature(kind).parameters.values() if argument.name in groups else [argument]
        options += [part.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[part.name]) for part in parts]

    @wraps(command)
    def flat(**values: Any) -> None:
        grouped = {
            name: kind(**{field.name: values.pop(field.name) for field in fields(kind)})
            for name, kind in groups.items()
        }
        command(**values, **grouped)

    flat.__annotations__ = {option.name: option.annotation for option in options}
    flat.__signature__ = Signature(options)  # type: ignore[attr-defined]
    return flat


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
