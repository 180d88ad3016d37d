"""Ctrl-C during compiled code, where libraries convert it to their own error or drop it."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

INTERRUPTED: Final = 128 + signal.SIGINT
"""Exit status after Ctrl-C: 128 plus the number of the signal, as in shells."""

GRACE: Final = 1.0
"""Time for an interruption to reach the code that saves results, before it is raised again [s]."""


@contextmanager
def unwrap_interruption() -> Iterator[None]:
    """Raise KeyboardInterrupt in place of the error that a library made from it.

    Yields:
        Nothing; the block may call Dr.Jit or import compiled modules.

    Raises:
        KeyboardInterrupt: Ctrl-C caused the error of a library.
        RuntimeError: Raised in the block, with another cause.
        SystemError: The same.
        ImportError: The same.
    """
    try:
        yield
    # Dr.Jit raises RuntimeError in a loop, the interpreter SystemError in an import, Mitsuba ImportError in its own.
    except (RuntimeError, SystemError, ImportError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise


@contextmanager
def ensure_interruption() -> Iterator[None]:
    """Make sure that Ctrl-C ends the block, whatever a library does with it.

    Compiled code may drop an interruption that occurs in its callbacks, or raise another error. Inside this context
    `raise_pending_interruption` raises a dropped one again, and any error after Ctrl-C counts as an interruption.

    Yields:
        Nothing. Outside the main thread, or if another handler for Ctrl-C is set, the block runs unchanged.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; its cause is the error that followed, if any.
        Exception: Raised in the block without Ctrl-C.
    """
    handled = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if handled:
        _pressed.clear()
        signal.signal(signal.SIGINT, _press)
    try:
        yield
    except Exception as error:
        if _pressed:
            raise KeyboardInterrupt from error
        raise
    finally:
        if handled:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            _pressed.clear()


def raise_pending_interruption() -> None:
    """Raise a KeyboardInterrupt that was dropped within `ensure_interruption`, after a grace period.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed more than `GRACE` ago, and the block still runs.
    """
    if _pressed and time.monotonic() - _pressed[-1] > GRACE:
        raise KeyboardInterrupt


# Times of Ctrl-C within `ensure_interruption`. Global, because a process has one handler for the signal.
_pressed: list[float] = []


def _press(_: int, __: FrameType | None) -> None:
    _pressed.append(time.monotonic())
    raise KeyboardInterrupt


@contextmanager
def defer_interruption() -> Iterator[None]:
    """Delay Ctrl-C to the end of a short block that must not be interrupted.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed in the block.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if pressed:
            signal.raise_signal(signal.SIGINT)
