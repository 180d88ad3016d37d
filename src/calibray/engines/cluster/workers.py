"""Workers keep chunks of links for replay, and run the calls of an external program.

Objects that are kept with a chunk are made on one worker and stay there. Functions are sent to the worker, which
returns only their results. Chunks are numbered and results return in that order, so sums over chunks do not depend on
the workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Sized
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol, final

from calibray.engines.cluster.dask_workers import Answered, DaskWorkers, scheduler_client
from calibray.engines.cluster.local_workers import LocalWorkers
from calibray.errors import InputError
from calibray.support.cache_folder import cache_folder
from calibray.support.memory import available_memory


class Workers(Protocol):
    """Runs the work of an engine: this process, processes on this machine, or a Dask cluster."""

    def executor(self) -> Executor | None:
        """An executor for the calls of an external program; None to run one call after the other."""
        ...

    def keep(self, make: Callable[[Any], Any], sources: Sequence[Any]) -> Sized:
        """Make an object for every chunk and keep it on the chunk's worker until the returned handle is deleted.

        The picklable function `make` creates the object from its source.
        """
        ...

    def ask(
        self,
        function: Callable[..., Any],
        kept: Sequence[Sized],
        *arguments: Any,
        answered: Answered | None = None,
    ) -> list[Any]:
        """Call a picklable function on the objects that are kept with every chunk, and return the results by chunk.

        The first arguments of the function are the objects, given by their handles from `keep`; the other arguments are
        the same for all chunks. `answered` is called with a chunk's number after its answer.

        Raises:
            EngineError: Workers die repeatedly, or none is left.
        """
        ...


@final
class InProcess:
    """This process works on one chunk after the other.

    Args:
        at_most: Largest number of chunks to keep; other chunks are made again for each question. If None, chunks are
            kept until they use half of the memory that was free at the start.
    """

    def __init__(self, at_most: int | None = None) -> None:
        self._at_most, self._reserve = at_most, available_memory() // 2

    def executor(self) -> None:
        """None: calls run one after the other."""
        return

    def keep(self, make: Callable[[Any], Any], sources: Sequence[Any]) -> Sized:
        """Make and keep an object for every chunk; see `Workers.keep`."""
        return _KeptHere(make, list(sources), self._has_room)

    def ask(
        self,
        function: Callable[..., Any],
        kept: Sequence[Sized],
        *arguments: Any,
        answered: Answered | None = None,
    ) -> list[Any]:
        """Call a function on the objects of every chunk; see `Workers.ask`."""
        handles = [handle for handle in kept if isinstance(handle, _KeptHere)]
        answers = []
        for index in range(len(handles[0])):
            answers.append(function(*(handle[index] for handle in handles), *arguments))
            if answered is not None:
                answered(index)
        return answers

    def _has_room(self, kept: int) -> bool:
        if self._at_most is not None:
            return kept < self._at_most
        # Without a cache folder, a chunk that is not kept would be traced again for each question.
        return cache_folder() is None or available_memory() > self._reserve


@dataclass(eq=False)
class _KeptHere:
    """Objects that are made on first use and kept as long as memory suffices."""

    make: Callable[[Any], Any]
    sources: list[Any]
    has_room: Callable[[int], bool]
    objects: dict[int, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.sources)

    def __getitem__(self, index: int) -> Any:
        if index in self.objects:
            return self.objects[index]
        kept = self.make(self.sources[index])
        if self.has_room(len(self.objects)):
            self.objects[index] = kept
        return kept


@contextmanager
def open_workers(workers: int | None = None, scheduler: str | None = None) -> Iterator[Workers | None]:
    """Open workers for `engines.make`, `calibrate`, `validate` and predictions, and close them at the end.

    Args:
        workers: Number of workers on this machine: processes that keep chunks of links, or external programs that run
            in parallel.
        scheduler: Address of a Dask scheduler, for instance "tcp://10.0.0.1:8786". Its workers need Calibray and must
            see the study's folder under the same path.

    Yields:
        The workers; None if neither is given.

    Raises:
        InputError: Both arguments are given, the number is not positive, Dask is not installed, or no scheduler
            answers.
    """
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler: give only one of them; a cluster has its own workers")
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: must be at least 1")
    with ExitStack() as opened:
        if scheduler is not None:
            client = opened.enter_context(scheduler_client(scheduler))
            yield DaskWorkers(lambda: client, lambda: client.get_executor(pure=False))
        elif workers is not None:
            # Processes and threads start on first use: an engine needs one of them. Each thread starts one external
            # program after the other and waits for it.
            local = LocalWorkers(workers, lambda: opened.enter_context(ThreadPoolExecutor(workers)))
            opened.callback(local.close)
            yield local
        else:
            yield None
