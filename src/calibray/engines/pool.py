"""What runs the calls of a batch: threads of this process, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager

from calibray.errors import InputError

PATIENCE = 30  # how long to wait for a scheduler [s]


@contextmanager
def open_executor(workers: int | None = None, scheduler: str | None = None) -> Iterator[Executor | None]:
    """An executor for the calls of a batch, closed at the end.

    Args:
        workers: How many programs run at once on this machine. Threads start and watch them, for it is the programs
            that work.
        scheduler: Address of a Dask scheduler, for instance "tcp://10.0.0.1:8786"; its workers need Calibray and
            see the study's folder under the same path.

    Yields:
        The executor; None if neither is given, for one call after the other.

    Raises:
        InputError: Both are given, the number is not positive, Dask is not installed, or no scheduler answers.
    """
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler: give one of them; a cluster brings its own workers")
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: must be at least 1")
    if scheduler is not None:
        with _cluster(scheduler) as executor:
            yield executor
    elif workers is not None:
        with ThreadPoolExecutor(workers) as executor:
            yield executor
    else:
        yield None


@contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs Dask; install it with: pip install 'calibray[dask]'") from None
    try:
        client = Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from None
    with client:
        # A worker that dies gives its calls back to the scheduler, which gives them to others.
        yield client.get_executor(pure=False)
