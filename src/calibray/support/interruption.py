"""Handling of Ctrl-C in compiled code, where a library can drop the interruption or convert it to another error."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ExtensionFileLoader
from types import FrameType
from typing import Final

INTERRUPTED: Final = 128 + signal.SIGINT
"""Exit status after Ctrl-C: 128 plus the number of the signal, as in shells."""

TERMINATED: Final = 128 + signal.SIGTERM
"""Exit status after SIGTERM, which schedulers and `timeout` send."""

INTERVAL: Final = 0.2
"""Time [s] after which a dropped interruption is raised again, short enough that a user does not notice the delay."""

Handler = Callable[[int, FrameType | None], None]
"""Signal handler: a function of the signal number and the interrupted frame."""


@contextmanager
def unwrap_interruption() -> Iterator[None]:
    """Raise KeyboardInterrupt in place of the error to which a library converted it.

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
    # Dr.Jit raises RuntimeError in a loop. During imports, the interpreter raises SystemError, and Mitsuba raises
    # ImportError.
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

    Compiled code can drop an interruption that occurs in one of its callbacks, or raise another error instead. Within
    this context, a dropped interruption is raised again, and any error that follows Ctrl-C is treated as an
    interruption.

    Yields:
        Nothing. Outside the main thread, or if another handler for Ctrl-C is set, the block runs unchanged.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed. The cause of this exception is the error that followed, if any.
        Exception: The block raised this exception, and Ctrl-C was not pressed.
    """
    with (
        _handler(signal.SIGALRM, signal.SIG_DFL, _raise_again),
        _handler(signal.SIGINT, signal.default_int_handler, _press),
    ):
        try:
            yield
        except Exception as error:
            if _pressed:
                raise KeyboardInterrupt from error
            raise


def acknowledge_interruption() -> None:
    """Stop repeating the interruption, because the caller has caught it and will raise it after saving results."""
    if signal.getsignal(signal.SIGALRM) is _raise_again:
        signal.setitimer(signal.ITIMER_REAL, 0)


# Numbers of the signals received within `ensure_interruption`. The list is global, because a process has one handler
# per signal.
_pressed: list[int] = []


@contextmanager
def _handler(number: signal.Signals, default: Handler | signal.Handlers, handler: Handler) -> Iterator[None]:
    """Handle a signal within the block, if this is the main thread and the signal has its default handler."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(number) is not default:
        yield
        return
    _pressed.clear()
    signal.signal(number, handler)
    try:
        yield
    finally:
        acknowledge_interruption()
        signal.signal(number, default)
        _pressed.clear()


def _press(number: int, frame: FrameType | None) -> None:
    _pressed.append(number)
    # Starting a thread here would be unsafe, because the interrupted code can hold locks of the threading module.
    if signal.getsignal(signal.SIGALRM) is _raise_again:
        signal.setitimer(signal.ITIMER_REAL, INTERVAL, INTERVAL)
        if _initializes_extension(frame):
            return
    raise KeyboardInterrupt


def _raise_again(_: int, frame: FrameType | None) -> None:
    """Raise a dropped interruption again, unless it is still being handled, for example while results are saved."""
    error = sys.exception()
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    if error is None and not _initializes_extension(frame):
        raise KeyboardInterrupt


def _initializes_extension(frame: FrameType | None) -> bool:
    """Whether a compiled module is being initialized, when an exception can abort the process."""
    while frame is not None:
        if frame.f_code in (
            ExtensionFileLoader.create_module.__code__,
            ExtensionFileLoader.exec_module.__code__,
        ):
            return True
        frame = frame.f_back
    return False


@contextmanager
def interrupt_on_termination() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C within the block, even if Ctrl-C is ignored, as in a background job.

    Yields:
        Nothing. Outside the main thread, or if another handler for SIGTERM is set, the block runs unchanged.

    Raises:
        KeyboardInterrupt: The process received SIGTERM; `exit_status` then returns `TERMINATED`.
    """
    _terminated.clear()
    with _handler(signal.SIGTERM, signal.SIG_DFL, _terminate):
        yield


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
