"""What runs the calls of a batch: threads of this process, or a Dask cluster."""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from socket import create_connection, gaierror
from time import monotonic, sleep
from typing import Final, NoReturn

from calibray.errors import InputError
from calibray.spelling import shortened

PATIENCE = 30
"""How long to wait for a scheduler [s]."""

_ADDRESS: Final = re.compile(
    r"(?:(?:tcp|tls|wss?)://)?(?P<host>\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]]{1,253}):(?P<port>[0-9]{1,5})"
)


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
    _await_scheduler(scheduler)
    try:
        client = Client(scheduler, timeout=PATIENCE)
    # Whatever another program than a scheduler makes of Dask's greeting.
    except (OSError, ValueError, TypeError, RuntimeError, AssertionError) as error:
        _refuse(scheduler, str(error))
    with client:
        # A worker that dies gives its calls back to the scheduler, which gives them to others.
        yield client.get_executor(pure=False)


def _await_scheduler(scheduler: str) -> None:
    """Wait until something answers at an address; Dask itself would leave noise behind where nothing does.

    Raises:
        InputError: It is no address, or nothing answers there.
    """
    match = _ADDRESS.fullmatch(scheduler)
    if match is None or not 1 <= int(match["port"]) <= 65_535:
        raise InputError(
            f"--scheduler {shortened(scheduler)}: is no address; give host and port, as tcp://10.0.0.1:8786"
        )
    host, end = match["host"].strip("[]"), monotonic() + PATIENCE
    while True:
        try:
            create_connection((host, int(match["port"])), timeout=PATIENCE).close()
        except (gaierror, UnicodeError) as error:
            _refuse(scheduler, str(error))
        except OSError as error:
            if monotonic() > end:
                _refuse(scheduler, str(error))
            sleep(0.5)
        else:
            return


def _refuse(scheduler: str, fault: str) -> NoReturn:
    raise InputError(
        f"--scheduler {shortened(scheduler)}: no Dask scheduler answers there ({shortened(fault, 200)}); start one, "
        "or correct the address"
    ) from None
