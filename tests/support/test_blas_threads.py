"""One thread for the linear algebra, and as many as before afterwards."""

import pytest
import scipy.linalg  # noqa: F401  (loads the second BLAS, so that both are counted from the start)
from threadpoolctl import threadpool_info, threadpool_limits

from calibray.support import blas_threads


@pytest.fixture(autouse=True)
def _two_threads():
    """The suite runs with one thread, which would hide a limit that has no effect."""
    with threadpool_limits(2, user_api="blas"):
        yield


def _numbers():
    return [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]


def test_threads_are_as_before_afterwards():
    before = _numbers()
    with blas_threads.single_blas_thread():
        assert set(_numbers()) == {1}
        with blas_threads.single_blas_thread(wanted=False):
            assert set(_numbers()) == {1}
    assert _numbers() == before


def test_nothing_is_changed_where_it_is_not_wanted():
    before = _numbers()
    with blas_threads.single_blas_thread(wanted=False):
        assert _numbers() == before


def test_libraries_are_looked_up_once(monkeypatch):
    with blas_threads.single_blas_thread():
        pass
    monkeypatch.setattr(blas_threads, "ThreadpoolController", lambda: pytest.fail("looked up again"))
    with blas_threads.single_blas_thread():
        assert set(_numbers()) == {1}
