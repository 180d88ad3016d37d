"""The two exceptions of Calibray: for bad input, and for an engine that failed while running."""

from __future__ import annotations

from typing import Final

LONGEST_MESSAGE: Final = 4000
"""Largest number of characters of a message; a value from the input may have any length."""


def _bounded(message: str) -> str:
    """The start and the end of a message that is too long; the end states the remedy."""
    if len(message) <= LONGEST_MESSAGE:
        return message
    return f"{message[: LONGEST_MESSAGE - 1000]} ... {message[-900:]}"


class InputError(ValueError):
    """Input that cannot be used.

    The message names the place (file, row, key), the value, the bound and the remedy. The command line prints it
    alone, without a traceback, and exits with 2.
    """

    def __str__(self) -> str:
        return _bounded(super().__str__())


class EngineError(RuntimeError):
    """An engine that failed while running; everything computed before is kept. The command line exits with 1."""

    def __str__(self) -> str:
        return _bounded(super().__str__())
