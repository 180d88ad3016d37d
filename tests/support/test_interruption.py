"""Ctrl-C is raised where a library wrapped it, dropped it, or must not be cut short."""

from __future__ import annotations

import contextlib
import signal

import pytest

from calibray.support import interruption


@pytest.fixture(autouse=True)
def _default_handler():
    """Ctrl-C raises, even if the tests run in the background and inherited a handler that ignores it."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.mark.parametrize("failure", [RuntimeError, SystemError, ImportError])
def test_an_interruption_that_a_library_wrapped_is_raised(failure):
    @interruption.unwrap_interruption()
    def work():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise failure("while initializing") from error

    with pytest.raises(KeyboardInterrupt):
        work()


def test_other_errors_of_a_library_are_raised_unchanged():
    @interruption.unwrap_interruption()
    def work():
        try:
            raise ValueError("another")
        except ValueError as error:
            raise RuntimeError("dr.while_loop(): encountered an exception (see above).") from error

    with pytest.raises(RuntimeError, match="while_loop"):
        work()


@pytest.mark.parametrize("pressed", [True, False])
def test_an_error_after_ctrl_c_is_an_interruption(pressed):
    def work():
        with interruption.ensure_interruption():
            with contextlib.suppress(KeyboardInterrupt):
                if pressed:
                    signal.raise_signal(signal.SIGINT)
            raise ValueError("of a library that was cut short")

    with pytest.raises(KeyboardInterrupt if pressed else ValueError):
        work()


def test_an_interruption_that_a_library_dropped_is_raised_after_the_time_of_grace(monkeypatch):
    def work(grace):
        monkeypatch.setattr(interruption, "GRACE", grace)
        with interruption.ensure_interruption():
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            interruption.raise_pending_interruption()

    work(grace=1000.0)
    with pytest.raises(KeyboardInterrupt):
        work(grace=0.0)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_deferred_interruption_waits_for_the_end_of_the_block():
    done = []

    def work():
        with interruption.defer_interruption():
            signal.raise_signal(signal.SIGINT)
            done.append("whole")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["whole"]
