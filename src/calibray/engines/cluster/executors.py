"""What runs the calls of a batch: threads of this process, or a Dask cluster."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from importlib.util import find_spec
from socket import create_connection, gaierror
from time import monotonic, sleep
from typing import TYPE_CHECKING, Final, NoReturn

from calibray.errors import InputError
from calibray.support.messages import shortened

if TYPE_CHECKING:
    from distributed import Client

PATIENCE = 30
"""How long to wait for a scheduler [s]."""

FEW: Final = 8
"""Worker processes that any machine may be asked for."""

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
    with open_client(scheduler) as client:
        # A worker that dies gives its calls back to the scheduler, which gives them to others.
        yield client.get_executor(pure=False)


@contextmanager
def open_client(scheduler: str) -> Iterator[Client]:
    """Dask's client of a scheduler, closed at the end.

    Args:
        scheduler: Its address, for instance "tcp://10.0.0.1:8786".

    Yields:
        The client.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
    """
    _need_dask("--scheduler")
    from distributed import Client

    _await_scheduler(scheduler)
    try:
        client = Client(scheduler, timeout=PATIENCE)
    # Whatever another program than a scheduler makes of Dask's greeting.
    except (OSError, ValueError, TypeError, RuntimeError, AssertionError) as error:
        _refuse(scheduler, str(error))
    with client:
        yield client


@contextmanager
def open_local_client(workers: int) -> Iterator[Client]:
    """Dask's client of worker processes on this machine, which end with it; each has its share of the cores.

    Args:
        workers: Their number.

    Yields:
        The client.

    Raises:
        InputError: The number is not positive or beyond what this machine can use, or Dask is not installed.
    """
    most = max(os.cpu_count() or 1, FEW)
    if not 1 <= workers <= most:
        raise InputError(
            f"--workers {workers}: must be at least 1 and at most {most}, each is a process that works all the time; "
            "more of them need more machines, and --scheduler"
        )
    _need_dask("--workers")
    from distributed import Client, LocalCluster

    from calibray.engines.cluster.cores import Cores

    # Blocks are as large as the study says, and a worker beyond some share of the memory would be ended by Dask.
    options = {"threads_per_worker": 1, "processes": True, "dashboard_address": None, "memory_limit": 0}
    # Ends of workers are told by who gives them blocks.
    quiet = logging.ERROR
    with (
        LocalCluster(n_workers=workers, silence_logs=quiet, **options) as cluster,
        Client(cluster) as client,
    ):
        client.register_plugin(Cores(workers))
        yield client


def _need_dask(option: str) -> None:
    if find_spec("distributed") is None:
        raise InputError(f"{option} needs Dask; install it with: pip install 'calibray[dask]'")


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
