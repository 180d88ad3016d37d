"""One thread for the linear algebra inside the context, and as many as before afterwards."""

import pytest
import scipy.linalg  # noqa: F401  (its BLAS library must be loaded to be limited)
from threadpoolctl import threadpool_info

from calibray.support import memory


def blas_thread_counts():
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]


def test_threads_are_limited_in_the_context_only():
    before = blas_thread_counts()
    assert before
    with memory.single_blas_thread():
        assert set(blas_thread_counts()) == {1}
        with memory.single_blas_thread(wanted=False):
            assert set(blas_thread_counts()) == {1}
    assert blas_thread_counts() == before


def test_nothing_changes_unless_wanted():
    before = blas_thread_counts()
    with memory.single_blas_thread(wanted=False):
        assert blas_thread_counts() == before


def test_libraries_are_searched_once(monkeypatch):
    with memory.single_blas_thread():
        pass
    with monkeypatch.context() as patched:
        patched.setattr("threadpoolctl.ThreadpoolController", lambda: pytest.fail("searched again"))
        limited = memory.single_blas_thread()
    with limited:
        assert set(blas_thread_counts()) == {1}
