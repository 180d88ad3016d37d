"""The workers of a Dask cluster, reached through its scheduler."""

from __future__ import annotations

import logging
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Sized
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from socket import create_connection, gaierror
from typing import TYPE_CHECKING, Any, Final, NoReturn, cast, final

from calibray.errors import EngineError, InputError
from calibray.support.messages import shortened

if TYPE_CHECKING:
    from distributed import Client, Future

SCHEDULER_WAIT = 30.0
"""Maximum time to wait for an answer from a scheduler [s]."""

POLL: Final = 0.5
"""Interval between checks for dead workers [s]."""

REPLACEMENT_WAIT: Final = 10.0
"""Maximum time [s] to wait for the replacement of a dead worker before its chunks move to other workers."""

NO_WORKER_WAIT: Final = 600.0
"""Maximum time [s] to wait for a new worker when no worker is left."""

MOST_DEATHS: Final = 4
"""Number of worker deaths on one chunk after which the run ends, because the chunk is probably too large."""

FETCH_WAIT: Final = POLL
"""Initial time limit for the transfer of a finished answer [s]. The limit doubles with every request, so that even
large answers eventually arrive. Dead workers are detected between requests.
"""

Answered = Callable[[int], None]
"""A function that is called with the index of a chunk after the chunk's answer has arrived."""


def count_death(deaths: Counter[int], chunk: int) -> None:
    """Count the death of a worker that died while processing a chunk.

    Raises:
        EngineError: Too many workers died while processing this chunk.
    """
    deaths[chunk] += 1
    if deaths[chunk] >= MOST_DEATHS:
        raise EngineError(
            f"chunk {chunk + 1}: {MOST_DEATHS} workers died while processing it; give workers more memory, or lower "
            "engine.chunk_links"
        )


_ADDRESS: Final = re.compile(
    r"(?:(?:tcp|tls|wss?)://)?(?P<host>\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]]{1,253}):(?P<port>[0-9]{1,5})"
)
_LOG: Final = logging.getLogger(__name__)


@dataclass(eq=False)
class _KeptRemotely:
    """Objects on workers, one per chunk: the worker that last made the object, and Dask's reference to it."""

    make: Callable[[Any], Any]
    sources: list[Any]
    objects: dict[int, tuple[str, Future]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.sources)


@final
class DaskWorkers:
    """The workers of a Dask cluster, to which this process connects on first use.

    A chunk stays on one worker, its home. If that worker dies, its replacement or another worker receives the chunk and
    makes its objects again. The paths are then read from the cache if all workers share the cache folder. `connect`
    returns Dask's client, and `open_executor` returns an executor for the calls of an external program.
    """

    def __init__(self, connect: Callable[[], Client], open_executor: Callable[[], Executor]) -> None:
        self._connect, self._open_executor = connect, open_executor
        self._homes: dict[int, str] = {}
        self._deaths: Counter[int] = Counter()
        self._most_workers = 0

    def executor(self) -> Executor:
        """An executor for the calls of an external program; see `Workers.executor`."""
        return self._open_executor()

    @cached_property
    def _client(self) -> Client:
        return self._connect()

    def keep(self, make: Callable[[Any], Any], sources: Sequence[Any]) -> Sized:
        """Make and keep an object for every chunk; see `Workers.keep`."""
        return _KeptRemotely(make, list(sources))

    def ask(
        self,
        function: Callable[..., Any],
        kept: Sequence[Sized],
        *arguments: Any,
        answered: Answered | None = None,
    ) -> list[Any]:
        """Call a function for every chunk, with the objects kept for it; see `Workers.ask`."""
        handles = [handle for handle in kept if isinstance(handle, _KeptRemotely)]
        count = len(handles[0])
        self._assign_homes(range(count), self._living(at_least=1))
        waiting = {index: self._submit(function, handles, index, arguments) for index in range(count)}
        patience = dict.fromkeys(waiting, FETCH_WAIT)
        answers: dict[int, Any] = {}
        while waiting:
            self._wait_for_any(list(waiting.values()))
            for index in [index for index, future in waiting.items() if future.done()]:
                if not self._fetch(waiting[index], index, answers, patience[index]):
                    patience[index] *= 2
                    continue
                del waiting[index]
                if answered is not None:
                    answered(index)
            for index in self._move_from_dead(waiting):
                waiting[index] = self._submit(function, handles, index, arguments)
        return [answers[index] for index in range(count)]

    def _submit(
        self,
        function: Callable[..., Any],
        handles: Sequence[_KeptRemotely],
        index: int,
        arguments: tuple[Any, ...],
    ) -> Future:
        home = self._homes[index]
        for handle in handles:
            if handle.objects.get(index, ("",))[0] != home:
                future = self._client.submit(handle.make, handle.sources[index], workers=[home], pure=False)
                handle.objects[index] = home, future
        objects = (handle.objects[index][1] for handle in handles)
        # With pure=True, Dask would return the stored result of an earlier identical call.
        return self._client.submit(function, *objects, *arguments, workers=[home], pure=False)

    def _wait_for_any(self, futures: list[Future]) -> None:
        from distributed import wait

        try:
            wait(futures, timeout=POLL, return_when="FIRST_COMPLETED")
        except TimeoutError:
            return

    def _fetch(self, future: Future, index: int, answers: dict[int, Any], patience: float) -> bool:
        """Fetch an answer; return False if its worker died or if the transfer takes longer than `patience` [s]."""
        from distributed import KilledWorker

        try:
            answers[index] = future.result(timeout=patience)
        except TimeoutError:
            return False
        except KilledWorker:
            # The worker that held the chunk is gone; `_move_from_dead` moves the chunk.
            return False
        return True

    def _move_from_dead(self, waiting: dict[int, Future]) -> list[int]:
        """Assign the chunks of dead workers to other workers.

        Raises:
            EngineError: Too many workers died while processing one chunk, or no worker is left.
        """
        living = self._living()
        lost = [index for index in waiting if self._homes[index] not in living]
        if not lost:
            return []
        _LOG.warning(
            "the workers of %d of %d chunks died; these chunks are opened again", len(lost), len(self._homes)
        )
        living = self._living(at_least=self._most_workers)
        for index in lost:
            waiting[index].cancel()
            del self._homes[index]
            count_death(self._deaths, index)
        self._assign_homes(lost, living)
        return lost

    def _assign_homes(self, chunks: Sequence[int], living: list[str]) -> None:
        """Assign every chunk without a home to the worker with the fewest chunks."""
        self._most_workers = max(self._most_workers, len(living))
        load = {worker: 0 for worker in living}
        for home in self._homes.values():
            if home in load:
                load[home] += 1
        for index in chunks:
            if index not in self._homes:
                self._homes[index] = min(load, key=lambda worker: load[worker])
                load[self._homes[index]] += 1

    def _living(self, at_least: int = 0) -> list[str]:
        """Return the addresses of the live workers, after waiting for more if there are too few.

        Raises:
            EngineError: No worker appeared within `NO_WORKER_WAIT`.
        """
        start, warned = time.monotonic(), False
        while True:
            living, waited = sorted(cast(dict[str, int], self._client.nthreads())), time.monotonic() - start
            if len(living) >= at_least or (living and waited > REPLACEMENT_WAIT):
                return living
            if waited > NO_WORKER_WAIT:
                raise EngineError(
                    f"the Dask cluster has had no worker for {NO_WORKER_WAIT:g} s; start a worker"
                )
            if not living and not warned:
                _LOG.warning("the Dask cluster has no worker; waiting for a worker")
                warned = True
            time.sleep(POLL)


@contextmanager
def scheduler_client(scheduler: str) -> Iterator[Client]:
    """Connect to a Dask scheduler at an address such as "tcp://10.0.0.1:8786"; the client is closed on exit.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
    """
    _require_dask("--scheduler")
    from distributed import Client

    _wait_for_scheduler(scheduler)
    try:
        client = Client(scheduler, timeout=SCHEDULER_WAIT)
    # A program other than a scheduler may answer Dask's handshake with arbitrary data.
    except (OSError, ValueError, TypeError, RuntimeError, AssertionError) as error:
        _refuse(scheduler, str(error))
    with client:
        yield client


def _require_dask(option: str) -> None:
    if find_spec("distributed") is None:
        raise InputError(f"{option} needs Dask; install it with: pip install 'calibray[dask]'")


def _wait_for_scheduler(scheduler: str) -> None:
    """Wait until a program answers at an address, because Dask logs tracebacks if nothing answers.

    Raises:
        InputError: The address is malformed, or nothing answers at the address.
    """
    match = _ADDRESS.fullmatch(scheduler)
    if match is None or not 1 <= int(match["port"]) <= 65_535:
        raise InputError(
            f"--scheduler {shortened(scheduler)}: is not an address; give a host and a port, for example "
            "tcp://10.0.0.1:8786"
        )
    host, end = match["host"].strip("[]"), time.monotonic() + SCHEDULER_WAIT
    while True:
        try:
            create_connection((host, int(match["port"])), timeout=SCHEDULER_WAIT).close()
        except (gaierror, UnicodeError) as error:
            _refuse(scheduler, str(error))
        except OSError as error:
            if time.monotonic() > end:
                _refuse(scheduler, str(error))
            time.sleep(POLL)
        else:
            return


def _refuse(scheduler: str, fault: str) -> NoReturn:
    raise InputError(
        f"--scheduler {shortened(scheduler)}: no Dask scheduler answers at this address ({shortened(fault, 200)}); "
        "start a scheduler, or correct the address"
    ) from None
