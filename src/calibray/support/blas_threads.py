"""Threads of the linear algebra: the matrices of a calibration are so small that threads slow it down."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache

from threadpoolctl import ThreadpoolController


def single_blas_thread(wanted: bool = True) -> AbstractContextManager[object]:
    """Context in which the linear algebra uses one thread; nothing changes unless it is wanted."""
    return _libraries().limit(limits=1, user_api="blas") if wanted else nullcontext()


@cache
def _libraries() -> ThreadpoolController:
    """The loaded libraries; cached, because the search reads all memory maps of the process."""
    # Import SciPy's library as well, so that it is among them.
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
