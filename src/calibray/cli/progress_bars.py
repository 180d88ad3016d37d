"""Progress for people who wait: bars on a terminal, plain lines every few seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from typing import Final

from rich import progress as rich_progress
from rich.console import Console

from calibray.support import interruption
from calibray.support.progress import Progress

EVERY: Final = 4.0
"""Seconds between two lines where there is no terminal; work that is shorter prints none.

A command with two spells of work, one after the other, is silent for less than twice as long.
"""


STARTING: Final = "starting"
"""What is told before the first stage that counts: reading, loading, compiling."""


@contextmanager
def progress_bars(console: Console, every: float | None = None) -> Iterator[Progress]:
    """Progress, stage by stage: bars on a terminal, else lines.

    Args:
        console: Where to show them.
        every: Time between two lines [s]; `EVERY` if None.

    Yields:
        What to call with the stage's name, how much is done, and out of how much.
    """
    told = _bars(console) if console.is_terminal else _lines(console, every or EVERY)
    with told as report, interruption.ensure_interruption():

        def progress(stage: str, done: int, total: int | None) -> None:
            interruption.raise_pending_interruption()
            report(stage, done, total)

        yield progress


@contextmanager
def _bars(console: Console) -> Iterator[Progress]:
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
        speed_estimate_period=3600.0,  # [s]; a launch of rays may take longer than Rich looks back by itself
    ) as bars:
        # Reading, loading and compiling come before the first stage that counts.
        tasks = {STARTING: bars.add_task(STARTING, total=1)}

        def report(stage: str, done: int, total: int | None) -> None:
            if STARTING in tasks:
                bars.remove_task(tasks.pop(STARTING))
            known = 1 if total is None and not done else total
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=known, completed=done)
            bars.update(tasks[stage], completed=done, total=known)

        yield report


@dataclass
class _State:
    """How far the work is."""

    stage: str = STARTING
    done: int = 0
    total: int | None = None
    since: float = field(default_factory=time.monotonic)
    lock: Lock = field(default_factory=Lock)

    def report(self, stage: str, done: int, total: int | None) -> None:
        with self.lock:
            if stage != self.stage or done < self.done:
                self.stage, self.since = stage, time.monotonic()
            self.done, self.total = done, total

    def line(self) -> str:
        with self.lock:
            return line(self.stage, self.done, self.total, time.monotonic() - self.since)


@contextmanager
def _lines(console: Console, every: float) -> Iterator[Progress]:
    """Lines from a thread of its own: work that says nothing for long is told of too."""
    state, over = _State(), Event()

    def tell() -> None:
        while not over.wait(every):
            console.print(state.line(), soft_wrap=True, markup=False)

    teller = Thread(target=tell, name="progress", daemon=True)
    teller.start()
    try:
        yield state.report
    finally:
        over.set()
        teller.join()


def line(stage: str, done: int, total: int | None, seconds: float) -> str:
    """Progress as a plain line.

    Args:
        stage: The stage.
        done: How much is done.
        total: Out of how much; None if unknown.
        seconds: Time since the stage began [s].

    Returns:
        Stage, share, rate and time left, as far as they are known.

    Example:
        >>> line("tracing", 30, 120, 15.0)
        'tracing 30/120, 25 %, 2/s, 15 s, about 45 s left'
        >>> line("starting", 0, None, 5.0)
        'starting, 5 s'
    """
    parts = [stage if total is None and not done else f"{stage} {done}" + (f"/{total}" if total else "")]
    if total:
        parts.append(f"{done / total:.0%}".replace("%", " %"))
    rate = done / seconds if seconds > 0 else 0.0
    if done:
        parts.append(f"{rate:.3g}/s")
    parts.append(f"{seconds:.0f} s")
    if total and rate and done < total:
        parts.append(f"about {(total - done) / rate:.0f} s left")
    return ", ".join(parts)
