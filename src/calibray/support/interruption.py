"""Ctrl-C in the midst of compiled code, which libraries take for a failure of their own, or drop."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

GRACE: Final = 1.0
"""Time that an interruption may take to reach whoever keeps what was computed [s]."""


@contextmanager
def unwrap_interruption() -> Iterator[None]:
    """Let an interruption through as what it is.

    Yields:
        Nothing; what runs meanwhile may call Dr.Jit or import compiled modules.

    Raises:
        KeyboardInterrupt: An error was raised because of one.
        RuntimeError: An error was raised for another reason.
        SystemError: The same, of an import.
        ImportError: The same, of a library's own import.
    """
    try:
        yield
    # Dr.Jit raises the first in a loop, the interpreter the second in an import, and Mitsuba the third in its own.
    except (RuntimeError, SystemError, ImportError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise


@contextmanager
def ensure_interruption() -> Iterator[None]:
    """See to it that Ctrl-C ends what runs meanwhile, whatever a library makes of it.

    Compiled code drops interruptions that fall into its callbacks, and raises errors of its own in their place: `check`
    raises again those that were dropped, and whatever fails after Ctrl-C was pressed is an interruption.

    Yields:
        Nothing. Outside the main thread, or where interruptions are ignored or seen to otherwise, they are left alone.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; its cause is the error that came of it, if one did.
        Exception: What was raised without it.
    """
    mine = threading.current_thread() is threading.main_thread()
    mine = mine and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if mine:
        _pressed.clear()
        signal.signal(signal.SIGINT, _press)
    try:
        yield
    except Exception as error:
        if _pressed:
            raise KeyboardInterrupt from error
        raise
    finally:
        if mine:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            _pressed.clear()


def raise_pending_interruption() -> None:
    """Go on, unless Ctrl-C was pressed a while ago and nobody has heeded it.

    Raises:
        KeyboardInterrupt: It was, within `ensure_interruption`.
    """
    if _pressed and time.monotonic() - _pressed[-1] > GRACE:
        raise KeyboardInterrupt


# When, within `ensure_interruption`; there is one keyboard, and one handler of its signal, a process.
_pressed: list[float] = []


def _press(_: int, __: FrameType | None) -> None:
    _pressed.append(time.monotonic())
    raise KeyboardInterrupt


@contextmanager
def defer_interruption() -> Iterator[None]:
    """Let Ctrl-C wait until something is made that a library would leave half-made, and say nothing.

    Yields:
        Nothing; what runs meanwhile is short.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed meanwhile.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if pressed:
            signal.raise_signal(signal.SIGINT)
