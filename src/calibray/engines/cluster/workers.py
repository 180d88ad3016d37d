"""Where the blocks of a study live: in this process, or on the workers of a Dask cluster.

What is kept with a block is made where the block lives and stays there; what is asked of it is formed there, and only
the answer comes back. Blocks are told by their numbers, and answers come in their order, so that sums of them are the
same wherever they live.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol, cast, final

from calibray.engines.cluster.executors import open_client, open_local_client
from calibray.errors import EngineError, InputError
from calibray.support.cache_folder import cache_folder
from calibray.support.memory import available_memory

if TYPE_CHECKING:
    from distributed import Client, Future

LOOK: Final = 0.5
"""Time between two looks for workers that died, while answers are awaited [s]."""

REPLACEMENT: Final = 10.0
"""Time that a dead worker's replacement is waited for before others take its blocks [s]."""

PATIENCE: Final = 600.0
"""Time that any worker is waited for when none is left [s]."""

DEATHS: Final = 4
"""Workers that may die of one block before it is given up."""

_FETCH: Final = 30.0
"""Time that an answer may take to come back before it is asked for again [s]."""

_LOG: Final = logging.getLogger(__name__)

Answered = Callable[[int], None]
"""Called with the number of a block whenever its answer is there."""


class Kept(Protocol):
    """One thing for every block, kept where the block lives; it is gone when this is."""

    def __len__(self) -> int: ...


class Crew(Protocol):
    """Where blocks live."""

    def keep(self, make: Callable[[Any], Any], given: Sequence[Any]) -> Kept:
        """Make one thing for every block where that lives.

        Args:
            make: Makes it of what is given; a function that can be sent.
            given: What it is made of, for every block.

        Returns:
            What is kept.
        """
        ...

    def ask(
        self,
        function: Callable[..., Any],
        kept: Sequence[Kept],
        *given: Any,
        answered: Answered | None = None,
    ) -> list[Any]:
        """Call a function on what is kept with every block.

        Args:
            function: The function; it can be sent.
            kept: What is kept that it takes first.
            *given: What it takes besides, the same for all blocks.
            answered: Called whenever the answer of a block is there.

        Returns:
            The answers in the order of the blocks.

        Raises:
            EngineError: Workers die again and again, or none is left.
        """
        ...


@final
class Here:
    """This process: one block after the other.

    Args:
        at_most: Blocks that are kept at once; the others are made anew whenever they are asked. None for as many as
            leave half of the memory free that was free at first.
    """

    def __init__(self, at_most: int | None = None) -> None:
        self._at_most, self._reserve = at_most, available_memory() // 2

    def keep(self, make: Callable[[Any], Any], given: Sequence[Any]) -> Kept:
        """Make one thing for every block; see `Crew.keep`."""
        return _Lazily(make, list(given), self._room)

    def _room(self, kept: int) -> bool:
        if self._at_most is not None:
            return kept < self._at_most
        # Without a cache, what is not kept would be traced again and again.
        return cache_folder() is None or available_memory() > self._reserve

    def ask(
        self,
        function: Callable[..., Any],
        kept: Sequence[Kept],
        *given: Any,
        answered: Answered | None = None,
    ) -> list[Any]:
        """Call a function on what is kept with every block; see `Crew.ask`."""
        found = []
        for index in range(len(kept[0])):
            found.append(function(*(each[index] for each in kept if isinstance(each, _Lazily)), *given))
            if answered is not None:
                answered(index)
        return found


@dataclass(eq=False)
class _Lazily:
    """Things made when they are asked for, and kept while there is room for so many."""

    make: Callable[[Any], Any]
    given: list[Any]
    room: Callable[[int], bool]
    made: dict[int, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.given)

    def __getitem__(self, index: int) -> Any:
        if index in self.made:
            return self.made[index]
        made = self.make(self.given[index])
        if self.room(len(self.made)):
            self.made[index] = made
        return made


@dataclass(eq=False)
class _Remote:
    """Things on workers, by number of the block: where each was made last, and Dask's hold on it."""

    make: Callable[[Any], Any]
    given: list[Any]
    made: dict[int, tuple[str, Future]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.given)


@final
class Cluster:
    """The workers of a Dask cluster.

    A block lives on one worker. Where that dies its replacement takes the block, or another worker if none comes, and
    makes anew what was kept there: paths come from the cache if the workers share its folder.

    Args:
        client: Dask's client, connected.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._homes: dict[int, str] = {}
        self._deaths: dict[int, int] = {}
        self._size = 0

    def keep(self, make: Callable[[Any], Any], given: Sequence[Any]) -> Kept:
        """Make one thing for every block where that lives; see `Crew.keep`."""
        return _Remote(make, list(given))

    def ask(
        self,
        function: Callable[..., Any],
        kept: Sequence[Kept],
        *given: Any,
        answered: Answered | None = None,
    ) -> list[Any]:
        """Call a function on what is kept with every block; see `Crew.ask`."""
        held = [each for each in kept if isinstance(each, _Remote)]
        count = len(held[0])
        self._settle(range(count), self._living(at_least=1))
        waiting = {index: self._submit(function, held, index, given) for index in range(count)}
        found: dict[int, Any] = {}
        while waiting:
            self._await(list(waiting.values()))
            for index in [each for each, future in waiting.items() if future.done()]:
                if self._fetched(waiting[index], index, found):
                    del waiting[index]
                    if answered is not None:
                        answered(index)
            for index in self._moved(waiting):
                waiting[index] = self._submit(function, held, index, given)
        return [found[index] for index in range(count)]

    def _submit(
        self, function: Callable[..., Any], held: Sequence[_Remote], index: int, given: tuple[Any, ...]
    ) -> Future:
        home = self._homes[index]
        for each in held:
            if each.made.get(index, ("",))[0] != home:
                made = self._client.submit(each.make, each.given[index], workers=[home], pure=False)
                each.made[index] = home, made
        return self._client.submit(
            function, *(each.made[index][1] for each in held), *given, workers=[home], pure=False
        )

    def _await(self, futures: list[Future]) -> None:
        from distributed import wait

        try:
            wait(futures, timeout=LOOK, return_when="FIRST_COMPLETED")
        except TimeoutError:
            return

    def _fetched(self, future: Future, index: int, found: dict[int, Any]) -> bool:
        """Take an answer; not where it was lost with its worker after all."""
        from distributed import KilledWorker

        try:
            found[index] = future.result(timeout=_FETCH)
        except TimeoutError:
            return False
        except KilledWorker:
            # Its home is gone, and it moves with the others there.
            return False
        return True

    def _moved(self, waiting: dict[int, Future]) -> list[int]:
        """The blocks whose workers died while their answers were awaited, each with a new home."""
        living = self._living()
        lost = [index for index in waiting if self._homes[index] not in living]
        if not lost:
            return []
        _LOG.warning("%d of %d blocks lost their worker; they are opened again", len(lost), len(self._homes))
        living = self._living(at_least=self._size)
        for index in lost:
            waiting[index].cancel()
            del self._homes[index]
            self._deaths[index] = self._deaths.get(index, 0) + 1
            if self._deaths[index] >= DEATHS:
                raise EngineError(
                    f"block {index + 1}: {DEATHS} workers died with it; give workers more memory, or lower "
                    "engine.block_links"
                )
        self._settle(lost, living)
        return lost

    def _settle(self, blocks: Sequence[int], living: list[str]) -> None:
        """Give every block without a home that of the worker with the fewest."""
        self._size = max(self._size, len(living))
        load = {worker: 0 for worker in living}
        for home in self._homes.values():
            if home in load:
                load[home] += 1
        for index in blocks:
            if index not in self._homes:
                self._homes[index] = min(load, key=lambda worker: load[worker])
                load[self._homes[index]] += 1

    def _living(self, at_least: int = 0) -> list[str]:
        """Addresses of the workers, as soon as there are enough; fewer where no more come for a while.

        Raises:
            EngineError: One is needed, and there is none.
        """
        begun, told = time.monotonic(), False
        while True:
            living, waited = sorted(cast(dict[str, int], self._client.nthreads())), time.monotonic() - begun
            if len(living) >= at_least or (living and waited > REPLACEMENT):
                return living
            if waited > PATIENCE:
                raise EngineError(f"the Dask cluster has had no worker for {PATIENCE:g} s; start some")
            if not living and not told:
                _LOG.warning("the Dask cluster has no worker; waiting for one")
                told = True
            time.sleep(LOOK)


@contextmanager
def open_crew(workers: int | None = None, scheduler: str | None = None) -> Iterator[Crew | None]:
    """Where blocks live, closed at the end.

    Args:
        workers: Number of processes on this machine.
        scheduler: Address of a Dask scheduler, for instance "tcp://10.0.0.1:8786"; its workers need Calibray and
            see the study's folder under the same path.

    Yields:
        The crew; None if neither is given.

    Raises:
        InputError: Both are given, the number is not positive, Dask is not installed, or no scheduler answers.
    """
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler: give one of them; a cluster brings its own workers")
    if workers is None and scheduler is None:
        yield None
        return
    opened = open_local_client(workers) if workers is not None else open_client(scheduler or "")
    with opened as client:
        yield Cluster(client)
