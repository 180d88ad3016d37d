"""Threads of the linear algebra: matrices of a calibration are small, and threads cost more there than they give."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache

from threadpoolctl import ThreadpoolController


def single_blas_thread(wanted: bool = True) -> AbstractContextManager[object]:
    """One thread for the linear algebra, as long as the context lasts.

    Args:
        wanted: Whether; nothing is changed if not.

    Returns:
        The context.
    """
    return _libraries().limit(limits=1, user_api="blas") if wanted else nullcontext()


@cache
def _libraries() -> ThreadpoolController:
    """The libraries that are loaded: looked up once, for that reads all that the process has mapped."""
    # Loads those that are used later, if they are not yet.
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
