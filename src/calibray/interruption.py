"""Ctrl-C in the midst of compiled code, which libraries take for a failure of their own, or drop."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

GRACE: Final = 1.0
"""Time that an interruption may take to reach whoever keeps what was computed [s]."""


@contextmanager
def interruptible() -> Iterator[None]:
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
def noticed() -> Iterator[Callable[[], None]]:
    """See to it that Ctrl-C is not lost where it falls into a callback of a library, which drops exceptions.

    Yields:
        What to call now and then; it raises KeyboardInterrupt where one was dropped before. Outside the main thread, or
        where interruptions are ignored or seen to otherwise, it does nothing.
    """
    pressed: list[float] = []

    def press(_: int, __: FrameType | None) -> None:
        pressed.append(time.monotonic())
        raise KeyboardInterrupt

    def check() -> None:
        if pressed and time.monotonic() - pressed[-1] > GRACE:
            raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is not signal.default_int_handler:
        yield lambda: None
        return
    signal.signal(signal.SIGINT, press)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def deferred() -> Iterator[None]:
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
