"""The console for messages and progress, and the arguments that several commands share.

On a terminal, progress is shown by bars. Otherwise, a plain line is printed every few seconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache, wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Annotated, Any, Final, get_type_hints

import typer

from calibray.errors import InputError
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from rich.console import Console

    from calibray.measurements import Measurements
    from calibray.study import Study


@cache
def log() -> Console:
    """The console on stderr for progress and messages; data are written to stdout with `typer.echo`.

    Rich is imported here, on first use, so that `--version` and `--help` do not load it.
    """
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def echo(text: str, err: bool = False, nl: bool = True) -> None:
    """Print text, with control characters escaped so that names from files cannot control the terminal."""
    from calibray.support.messages import printable

    typer.echo(printable(text, keep="\n\t"), err=err, nl=nl)


@cache
def print_costs() -> None:
    """Make every prediction print its expected cost to stderr before the prediction starts."""
    import logging

    class Echo(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            echo(record.getMessage(), err=True)

    from calibray.prediction.batches import LOG

    LOG.setLevel(logging.INFO)
    LOG.addHandler(Echo())
    LOG.propagate = False


def option(placeholder: str, meaning: str, *names: str, **limits: Any) -> Any:
    """An option that takes a value; `names` is needed only if its name differs from that of the Python argument."""
    return typer.Option(*names, metavar=placeholder, help=meaning, **limits)


StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="The study file, in TOML.", show_default=False)
]

ResultFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder that `calibray run` wrote.", show_default=False)
]

Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace existing files that Calibray did not write.")
]
"""Whether output may replace a user's file; an input file is never replaced."""


@dataclass(frozen=True)
class Pool:
    """Options for the workers; the fields are the arguments of `calibray.engines.open_workers`."""

    workers: Annotated[
        int | None, option("N", "Number of local processes among which the chunks of links are divided.")
    ] = None
    scheduler: Annotated[
        str | None, option("ADDRESS", "Address of the Dask scheduler whose workers process chunks of links.")
    ] = None


@dataclass(frozen=True)
class Permissions:
    """Options that permit operations that Calibray otherwise refuses."""

    allow_changed_inputs: Annotated[
        bool,
        typer.Option(
            "--allow-changed-inputs",
            help="Continue even if a file of the result, the scene or an antenna has changed.",
        ),
    ] = False
    overwrite: Overwrite = False


def read_origin(text: str) -> tuple[float, float]:
    """Read the longitude and latitude [deg] from the text of ``--origin``.

    Raises:
        InputError: The text is not a valid longitude and latitude.
    """
    try:
        longitude, latitude = (float(part) for part in text.split(","))
    except ValueError:
        longitude = latitude = float("nan")
    if not (abs(longitude) <= 180 and abs(latitude) <= 90):
        raise InputError(
            f"--origin {text}: must be longitude and latitude in degrees, such as 11.5755,48.1374"
        )
    return longitude, latitude


def with_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Convert a command so that each field of its dataclass arguments becomes a command-line option."""
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

    # Typer reads the options from the signature and from the annotations.
    flat.__annotations__ = {option.name: option.annotation for option in options}
    flat.__signature__ = Signature(options)  # type: ignore[attr-defined]
    return flat


def warn(study: Study, links: Measurements) -> None:
    """Print warnings about suspicious links to stderr.

    Raises:
        InputError: All receivers or all transmitters are far from the scene, or the scene cannot be read.
    """
    from calibray.reporting.scene_tables import warning_lines
    from calibray.study.link_checks import suspicions

    if findings := suspicions(study, links):
        echo(warning_lines(findings), err=True)


LINE_INTERVAL: Final = 4.0
"""Interval between progress lines if stderr is not a terminal [s]; work that ends sooner prints no line."""

STARTING: Final = "starting"
"""The stage that is shown, for example during imports, until the work reports its first stage."""


def progress_bars(console: Console, every: float | None = None) -> AbstractContextManager[Progress]:
    """Show the progress of each stage, as bars on a terminal and otherwise as lines at least `every` seconds apart.

    Returns:
        A context manager that yields a function of the stage, the amount done and the total (None if unknown).
    """
    return _bars(console) if console.is_terminal else _lines(console, every or LINE_INTERVAL)


@contextmanager
def _bars(console: Console) -> Iterator[Progress]:
    # Rich is imported on first use, so that `--version` and `--help` do not load it.
    from rich import progress as rich_progress

    columns = (
        rich_progress.SpinnerColumn(),
        rich_progress.TextColumn("{task.description:<12}"),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeElapsedColumn(),
        rich_progress.TextColumn("left:"),
        rich_progress.TimeRemainingColumn(),
    )
    with rich_progress.Progress(
        *columns,
        console=console,
        transient=True,
        # In [s]; a launch of rays can take longer than the 30 s over which Rich averages by default.
        speed_estimate_period=3600.0,
    ) as bars:
        tasks = {STARTING: bars.add_task(STARTING, total=1)}

        def report(stage: str, done: int, total: int | None) -> None:
            if STARTING in tasks:
                bars.remove_task(tasks.pop(STARTING))
            # If there is no total and nothing is done, the stage is shown as a single step.
            shown_total = 1 if total is None and not done else total
            name = stage.partition(": ")[0]
            if name not in tasks:
                tasks[name] = bars.add_task(stage, total=shown_total, completed=done)
            bars.update(tasks[name], description=stage, completed=done, total=shown_total)

        yield report


@dataclass
class _State:
    """The current stage and its progress."""

    stage: str = STARTING
    done: int = 0
    total: int | None = None
    since: float = field(default_factory=time.monotonic)
    lock: Lock = field(default_factory=Lock)

    def report(self, stage: str, done: int, total: int | None) -> None:
        with self.lock:
            name = stage.partition(": ")[0]
            if name != self.stage.partition(": ")[0] or done < self.done:
                self.since = time.monotonic()
            self.stage, self.done, self.total = stage, done, total

    def line(self) -> str:
        with self.lock:
            return line(self.stage, self.done, self.total, time.monotonic() - self.since)


@contextmanager
def _lines(console: Console, every: float) -> Iterator[Progress]:
    """Print progress lines from a separate thread, so that lines also appear while the work reports no progress."""
    state, finished = _State(), Event()

    def print_lines() -> None:
        while not finished.wait(every):
            console.print(state.line(), soft_wrap=True, markup=False)

    printer = Thread(target=print_lines, name="progress", daemon=True)
    printer.start()
    try:
        yield state.report
    finally:
        finished.set()
        printer.join()


def line(stage: str, done: int, total: int | None, seconds: float) -> str:
    """Format stage, share, rate, elapsed time and remaining time as one line; unknown values are left out.

    Example:
        >>> line("tracing", 30, 120, 15.0)
        'tracing 30/120, 25 %, 2/s, 15 s, about 45 s left'
        >>> line("starting", 0, None, 5.0)
        'starting, 5 s'
        >>> line("calibrating: best RMSE 3.10 dB", 50, 100, 5.0)
        'calibrating 50/100, 50 %, 10/s, 5 s, about 5 s left, best RMSE 3.10 dB'
    """
    name, _, detail = stage.partition(": ")
    parts = [name if total is None and not done else f"{name} {done}" + (f"/{total}" if total else "")]
    if total:
        parts.append(f"{done / total:.0%}".replace("%", " %"))
    rate = done / seconds if seconds > 0 else 0.0
    if done:
        parts.append(f"{rate:.3g}/s")
    parts.append(f"{seconds:.0f} s")
    if total and rate and done < total:
        parts.append(f"about {(total - done) / rate:.0f} s left")
    return ", ".join([*parts, detail] if detail else parts)
