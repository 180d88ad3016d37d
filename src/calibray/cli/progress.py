"""Progress bars for people who wait."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich import progress as rich_progress
from rich.console import Console

from calibray.progress import Progress


@contextmanager
def progress_bars(console: Console) -> Iterator[Progress]:
    """Progress bars, one for each stage of the work; none where nobody watches.

    Args:
        console: Where to draw them; must be a terminal, else nothing is drawn.

    Yields:
        What to call with the stage's name, how much is done, and out of how much.
    """
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
        disable=not console.is_terminal,
        transient=True,
        speed_estimate_period=3600.0,  # [s]; a launch of rays may take longer than Rich looks back by itself
    ) as bars:
        tasks = {"tracing": bars.add_task("tracing", total=None)}

        def report(stage: str, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report
