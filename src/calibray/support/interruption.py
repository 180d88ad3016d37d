"""Handling of Ctrl-C in compiled code, where a library can convert it to another error or drop it."""

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

TERMINATED: Final = 128 + signal.SIGTERM
"""Exit status after SIGTERM, which schedulers and `timeout` send."""

GRACE: Final = 1.0
"""Time for an interruption to reach the code that saves results, before the interruption is raised again [s]."""


@contextmanager
def unwrap_interruption() -> Iterator[None]:
    """Raise KeyboardInterrupt instead of the error to which a library converted it.

    Yields:
        Nothing; the block may call Dr.Jit or import compiled modules.

    Raises:
        KeyboardInterrupt: Ctrl-C caused the library's error.
        RuntimeError: The block raised this error for another reason.
        SystemError: As for RuntimeError.
        ImportError: As for RuntimeError.
    """
    try:
        yield
    # In a loop, Dr.Jit raises RuntimeError; during imports, the interpreter raises SystemError, Mitsuba ImportError.
    except (RuntimeError, SystemError, ImportError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise


@contextmanager
def ensure_interruption() -> Iterator[None]:
    """Ensure that Ctrl-C ends the block, even if a library handles or drops the interruption.

    Compiled code can drop an interruption that occurs in its callbacks, or raise another error. Within this context,
    `raise_pending_interruption` raises a dropped interruption again, and any error after Ctrl-C is treated as an
    interruption.

    Yields:
        Nothing. Outside the main thread, or if another handler for Ctrl-C is set, the block runs unchanged.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; its cause is the error that followed, if any.
        Exception: The block raised this exception, and Ctrl-C was not pressed.
    """
    handled = _has_handler(signal.SIGINT, signal.default_int_handler)
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
    """Raise again a KeyboardInterrupt that was dropped within `ensure_interruption`, after a grace period.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed more than `GRACE` seconds ago, and the block is still running.
    """
    if _pressed and time.monotonic() - _pressed[-1] > GRACE:
        raise KeyboardInterrupt


# Times at which Ctrl-C was pressed within `ensure_interruption`; global, because a process has one signal handler.
_pressed: list[float] = []


def _has_handler(number: signal.Signals, handler: object) -> bool:
    """Whether this is the main thread, which alone can set handlers, and a signal has this handler."""
    return threading.current_thread() is threading.main_thread() and signal.getsignal(number) is handler


def _press(_: int, __: FrameType | None) -> None:
    _pressed.append(time.monotonic())
    raise KeyboardInterrupt


@contextmanager
def interrupt_on_termination() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C within the block, even if Ctrl-C is ignored, as in a background job.

    Yields:
        Nothing. Outside the main thread, or if another handler for SIGTERM is set, the block runs unchanged.

    Raises:
        KeyboardInterrupt: The process received SIGTERM; `exit_status` then returns `TERMINATED`.
    """
    handled = _has_handler(signal.SIGTERM, signal.SIG_DFL)
    if handled:
        _terminated.clear()
        signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        if handled:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def exit_status() -> int:
    """The exit status after an interruption: `TERMINATED` after SIGTERM, otherwise `INTERRUPTED`."""
    return TERMINATED if _terminated else INTERRUPTED


_terminated: list[int] = []  # the numbers of the signals received within `interrupt_on_termination`


def _terminate(number: int, frame: FrameType | None) -> None:
    _terminated.append(number)
    handler = signal.getsignal(signal.SIGINT)
    (handler if callable(handler) else _press)(number, frame)


@contextmanager
def defer_interruption() -> Iterator[None]:
    """Delay Ctrl-C until the end of a short block that must not be interrupted.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed during the block.
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
            signal.raise_signal(pressed[0])
