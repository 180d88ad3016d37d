"""Ctrl-C is raised where a library wrapped it, dropped it, or must not be cut short."""

from __future__ import annotations

import contextlib
import signal
import time
from importlib import _bootstrap_external as bootstrap_external
from importlib.machinery import ExtensionFileLoader
from types import ModuleType

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


def _drop():
    with contextlib.suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_that_a_library_dropped_is_raised_again(number):
    def work():
        with interruption.interrupt_on_termination(), interruption.ensure_interruption():
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(number)
            time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    assert signal.getitimer(signal.ITIMER_REAL)[0] == 0


def test_an_interruption_is_not_raised_again_while_it_is_handled():
    saved = []

    def work():
        with interruption.ensure_interruption():
            try:
                signal.raise_signal(signal.SIGINT)
            finally:
                for call in range(3):
                    time.sleep(1.5 * interruption.INTERVAL)
                    saved.append(call)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert saved == [0, 1, 2]


def test_an_acknowledged_interruption_is_not_raised_again():
    with interruption.ensure_interruption():
        _drop()
        interruption.acknowledge_interruption()
        time.sleep(2 * interruption.INTERVAL)


def test_a_dropped_interruption_does_not_outlast_its_block():
    with interruption.ensure_interruption():
        _drop()
    time.sleep(2 * interruption.INTERVAL)


def test_an_alarm_of_the_caller_is_left_alone():
    alarms = []
    handler = signal.signal(signal.SIGALRM, lambda *_: alarms.append(1))
    try:
        signal.setitimer(signal.ITIMER_REAL, 2 * interruption.INTERVAL)
        with interruption.ensure_interruption():
            _drop()
            interruption.acknowledge_interruption()
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 0
        time.sleep(3 * interruption.INTERVAL)
    finally:
        signal.signal(signal.SIGALRM, handler)
    assert alarms == [1]


def test_ctrl_c_waits_until_a_compiled_module_is_initialized(monkeypatch):
    """An exception inside its initialization aborts the process."""
    events = []

    def initialize(*_):
        signal.raise_signal(signal.SIGINT)
        time.sleep(2 * interruption.INTERVAL)
        events.append("initialized")

    # A module of the loader of compiled modules whose C function is replaced.
    loader = ExtensionFileLoader("compiled", "compiled.so")
    monkeypatch.setattr(bootstrap_external._imp, "exec_dynamic", initialize)

    def work():
        with interruption.ensure_interruption():
            loader.exec_module(ModuleType("compiled"))
            time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert events == ["initialized"]


def test_a_deferred_interruption_waits_for_the_end_of_the_block():
    done = []

    def work():
        with interruption.defer_interruption():
            signal.raise_signal(signal.SIGINT)
            done.append("whole")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["whole"]
