"""Ctrl-C in the midst of compiled code, which libraries take for a failure of their own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interruptible() -> Iterator[None]:
    """Let an interruption through as what it is.

    Yields:
        Nothing; what runs meanwhile may call Dr.Jit or import compiled modules.

    Raises:
        KeyboardInterrupt: An error was raised because of one.
        RuntimeError: An error was raised for another reason.
        SystemError: The same, of an import.
    """
    try:
        yield
    # Dr.Jit raises the one in a loop, the interpreter the other in an import.
    except (RuntimeError, SystemError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise
