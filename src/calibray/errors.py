"""Calibray's two exceptions: one for invalid input, and one for an engine that failed while running."""

from __future__ import annotations

from typing import Final

LONGEST_MESSAGE: Final = 4000
"""Maximum number of characters in a message; a limit is needed because a message can quote input values of any
length."""


def _bounded(message: str) -> str:
    """Shorten an overlong message to its start and its end; the end is kept because it states the remedy."""
    if len(message) <= LONGEST_MESSAGE:
        return message
    return f"{message[: LONGEST_MESSAGE - 1000]} ... {message[-900:]}"


class InputError(ValueError):
    """Input that cannot be used.

    The message states where the input is (file, row, key), its value, the bound and the remedy. The command line
    prints only this message, without a traceback, and exits with status 2.
    """

    def __str__(self) -> str:
        return _bounded(super().__str__())


class EngineError(RuntimeError):
    """An engine failed while running; results computed before the failure are kept.

    After this exception, the command line exits with status 1.
    """

    def __str__(self) -> str:
        return _bounded(super().__str__())
