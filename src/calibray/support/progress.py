"""Reporting the progress of long work."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int | None], None]
"""Called with the stage ("tracing", "calibrating", ...), the amount done, and the total amount; None if unknown.

What a stage has found so far follows its name after a colon: "calibrating: best RMSE 3.10 dB".
"""


def with_stage(progress: Progress | None, stage: str) -> Progress | None:
    """Report progress under another stage, such as "checking" for a trace that checks another one.

    Example:
        >>> progress = with_stage(lambda *parts: print(*parts), "checking")
        >>> progress("tracing", 3, 40)
        checking 3 40
    """
    if progress is None:
        return None
    return lambda _, done, total: progress(stage, done, total)


def with_total(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Report the progress of one of several parts, after the amount `before`, as that of the whole work.

    Example:
        >>> progress = with_total(lambda *parts: print(*parts), 100, 250)
        >>> progress("tracing", 3, 40)
        tracing 103 250
    """
    if progress is None:
        return None
    return lambda stage, done, _: progress(stage, before + done, total)
