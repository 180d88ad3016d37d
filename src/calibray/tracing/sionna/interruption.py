"""Ctrl-C in the midst of a kernel, which Dr.Jit takes for a failure of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interruptible() -> Iterator[None]:
    """Let an interruption through as what it is.

    Yields:
        Nothing; what runs meanwhile may use Dr.Jit.

    Raises:
        KeyboardInterrupt: Dr.Jit raised an error because of one.
        RuntimeError: Dr.Jit raised an error for another reason.
    """
    try:
        yield
    except RuntimeError as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise
