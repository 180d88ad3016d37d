"""Reporting the progress of long computations."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int | None], None]
"""A function of the stage ("tracing", "calibrating", ...), the amount done, and the total amount (None if unknown).

The name of the stage can be followed by a colon and an interim result: "calibrating: best RMSE 3.10 dB".
"""


def start_stage(progress: Progress | None, stage: str) -> None:
    """Report the start of a stage whose amount of work is unknown.

    Example:
        >>> start_stage(lambda *parts: print(*parts), "writing")
        writing 0 None
    """
    if progress is not None:
        progress(stage, 0, None)


def with_stage(progress: Progress | None, stage: str) -> Progress | None:
    """Report progress under a different stage name, such as "checking" for a trace that checks another trace.

    Example:
        >>> progress = with_stage(lambda *parts: print(*parts), "checking")
        >>> progress("tracing", 3, 40)
        checking 3 40
    """
    if progress is None:
        return None
    return lambda _, done, total: progress(stage, done, total)


def with_prefix(progress: Progress | None, prefix: str) -> Progress | None:
    """Report progress with a prefix before the name of every stage, such as the name of the method that runs.

    Example:
        >>> progress = with_prefix(lambda *parts: print(*parts), "SGWO-IM")
        >>> progress("drawing", 3, 40)
        SGWO-IM, drawing 3 40
    """
    if progress is None:
        return None
    return lambda stage, done, total: progress(f"{prefix}, {stage}", done, total)


def with_total(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Report the progress of one part as progress of the whole; `before` is the total amount of all earlier parts.

    Example:
        >>> progress = with_total(lambda *parts: print(*parts), 100, 250)
        >>> progress("tracing", 3, 40)
        tracing 103 250
    """
    if progress is None:
        return None
    return lambda stage, done, _: progress(stage, before + done, total)
