"""Progress: how long work tells how far it is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int | None], None]
"""Called with the stage ("tracing", "calibrating", ...), how much is done, and out of how much; None if unknown."""


def with_stage(progress: Progress | None, stage: str) -> Progress | None:
    """Tell progress under another stage's name.

    Args:
        progress: Whom to tell; None for nobody.
        stage: The name in place of that of the work itself, as "checking" for a trace that checks another.

    Returns:
        What the work calls.

    Example:
        >>> told = with_stage(lambda *parts: print(*parts), "checking")
        >>> told("tracing", 3, 40)
        checking 3 40
    """
    if progress is None:
        return None
    return lambda _, done, total: progress(stage, done, total)


def with_total(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Tell progress of one of several pieces of work as that of all.

    Args:
        progress: Whom to tell; None for nobody.
        before: How much was done before this piece.
        total: How much there is in all.

    Returns:
        What the work calls.

    Example:
        >>> told = with_total(lambda *parts: print(*parts), 100, 250)
        >>> told("tracing", 3, 40)
        tracing 103 250
    """
    if progress is None:
        return None
    return lambda stage, done, _: progress(stage, before + done, total)
