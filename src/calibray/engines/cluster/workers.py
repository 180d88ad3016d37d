"""Workers, which keep chunks of links for replay and run the calls of an external program.

An object that is kept for a chunk is made on one worker and stays there. Functions are sent to this worker, which
returns only their results. Results are returned in the order of the chunks, so sums over chunks do not depend on the
workers.

Workers on this machine are processes that communicate only through inherited pipes. No port is open, so no other user
of the machine can send code to a worker or to the main process.
"""

from __future__ import annotations

import itertools
import logging
import os
import pickle
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Sized
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from threading import Lock
from typing import Any, Final, Protocol, cast, final, runtime_checkable
from weakref import WeakSet

from calibray.engines.cluster.dask_workers import POLL, Answered, DaskWorkers, count_death, scheduler_client
from calibray.errors import EngineError, InputError
from calibray.support.cache_folder import cache_folder
from calibray.support.memory import available_memory
from calibray.support.messages import shortened

ALWAYS_ALLOWED: Final = 8
"""Number of worker processes that is always permitted, even on a machine with few cores."""

END_WAIT: Final = 5.0
"""Maximum time to wait for a process to end before it is killed [s]."""

_LOG: Final = logging.getLogger(__name__)
_NUMBER: Final = itertools.count()
_CAN_PIN: Final = hasattr(os, "sched_setaffinity")

ObjectKey = tuple[int, int]
"""The number of a handle and the index of a chunk, which together identify an object."""


@runtime_checkable
class Workers(Protocol):
    """Runs an engine's work in this process, in other processes on this machine, or on a Dask cluster."""

    def executor(self) -> Executor | None:
        """An executor for the calls of an external program; None to run them sequentially."""
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
        """Call a picklable function for every chunk with the chunk's objects, and return the results by chunk.

        The objects are the first arguments of the function; `kept` contains their handles, as returned by `keep`. All
        other arguments are the same for all chunks. `answered` is called with a chunk's index after the chunk's answer
        has arrived.

        Raises:
            EngineError: Workers die repeatedly, or none is left.
        """
        ...


@final
class InProcess:
    """Runs the work in this process, one chunk at a time.

    If `at_most` is given, at most this many chunks are kept; the others are made again for each call. If `at_most` is
    None and there is no cache folder, all chunks are kept. If there is a cache folder, chunks are kept until they use a
    third of the memory that was free at the start, because the objects derived from the chunks need about as much
    memory again.
    """

    def __init__(self, at_most: int | None = None) -> None:
        self._at_most, self._reserve = at_most, available_memory() * 2 // 3

    def executor(self) -> None:
        """None, because calls run sequentially."""
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
        """Call a function for every chunk, with the objects kept for it; see `Workers.ask`."""
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
        # Without a cache folder, a chunk that is not kept would have to be traced again for each call.
        return cache_folder() is None or available_memory() > self._reserve


@dataclass(eq=False)
class _KeptHere:
    """Objects that are made on first use and kept as long as memory allows."""

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


@dataclass(frozen=True)
class _Question:
    """A question to a worker about a chunk.

    Attributes:
        function: The function to call.
        arguments: Arguments of the function that follow the objects.
        keys: Keys of the objects that the function receives as its first arguments.
        recipes: For each object that the worker does not have yet, the function that makes it and the source.
        handles: Handles that are still in use; objects of other handles are dropped.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    keys: tuple[ObjectKey, ...]
    recipes: dict[ObjectKey, tuple[Callable[[Any], Any], Any]]
    handles: frozenset[int]


@dataclass(eq=False)
class _KeptInProcesses:
    """Objects in worker processes, one per chunk."""

    make: Callable[[Any], Any]
    sources: list[Any]
    number: int = field(default_factory=lambda: next(_NUMBER))

    def __len__(self) -> int:
        return len(self.sources)


@dataclass(eq=False)
class _Worker:
    """A worker process with its pipe, the keys of its objects, and its current chunk."""

    process: SpawnProcess
    pipe: Connection
    objects: set[ObjectKey] = field(default_factory=set)
    chunk: int | None = None


@final
class LocalWorkers:
    """Processes on this machine, started on first use, each with its share of the processor cores.

    A chunk stays in one process. If a process dies, a new process replaces it and makes the objects of its chunks
    again. `open_executor` returns an executor for the calls of an external program.
    """

    def __init__(self, count: int, open_executor: Callable[[], Executor]) -> None:
        self._count, self._open_executor = count, open_executor
        self._workers: list[_Worker] = []
        self._handles: WeakSet[_KeptInProcesses] = WeakSet()
        self._deaths: Counter[int] = Counter()
        self._lock = Lock()

    def executor(self) -> Executor:
        """An executor for the calls of an external program; see `Workers.executor`."""
        return self._open_executor()

    def keep(self, make: Callable[[Any], Any], sources: Sequence[Any]) -> Sized:
        """Make and keep an object for every chunk; see `Workers.keep`."""
        kept = _KeptInProcesses(make, list(sources))
        self._handles.add(kept)
        return kept

    def ask(
        self,
        function: Callable[..., Any],
        kept: Sequence[Sized],
        *arguments: Any,
        answered: Answered | None = None,
    ) -> list[Any]:
        """Call a function for every chunk, with the objects kept for it; see `Workers.ask`."""
        handles = [handle for handle in kept if isinstance(handle, _KeptInProcesses)]
        with self._lock:
            try:
                answers = self._ask(function, handles, arguments, answered)
            except BaseException:
                # Other workers may still be sending answers to this question.
                self.close()
                raise
        return [answers[index] for index in range(len(answers))]

    def _ask(
        self,
        function: Callable[..., Any],
        handles: list[_KeptInProcesses],
        arguments: tuple[Any, ...],
        answered: Answered | None,
    ) -> dict[int, Any]:
        self._start_all()
        count, answers = len(handles[0]), {}
        # A chunk's index determines its worker, so that the worker already has the chunk's objects when the next
        # question arrives.
        waiting = [list(range(home, count, self._count))[::-1] for home in range(self._count)]
        while len(answers) < count:
            for home, worker in enumerate(self._workers):
                if worker.chunk is None and waiting[home]:
                    worker.chunk = waiting[home].pop()
                    self._send(worker, self._question(worker, function, handles, worker.chunk, arguments))
            for home, answer in self._receive():
                worker = self._workers[home]
                if answer is None:
                    if worker.chunk is not None:
                        waiting[home].append(worker.chunk)
                    self._replace(home)
                    continue
                result, error = answer
                if error is not None:
                    raise error
                if worker.chunk is not None:
                    answers[worker.chunk] = result
                    if answered is not None:
                        answered(worker.chunk)
                worker.chunk = None
        return answers

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.pipe.close()
            worker.process.terminate()
        for worker in self._workers:
            worker.process.join(END_WAIT)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
        self._workers.clear()

    def _start_all(self) -> None:
        """Start the processes that are not running yet.

        Raises:
            InputError: The number of processes exceeds the limit of this machine.
        """
        most = max(os.cpu_count() or 1, ALWAYS_ALLOWED)
        if self._count > most:
            raise InputError(
                f"--workers {self._count}: must be at most {most}, because each worker process keeps a core busy; "
                "for more workers, use several machines and --scheduler"
            )
        while len(self._workers) < self._count:
            self._workers.append(self._start(len(self._workers)))

    def _start(self, home: int) -> _Worker:
        context = get_context("spawn")  # a fork would copy locks held by threads of Dr.Jit and XLA
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, home, self._count), daemon=True)
        process.start()
        theirs.close()
        return _Worker(process, ours)

    def _question(
        self,
        worker: _Worker,
        function: Callable[..., Any],
        handles: list[_KeptInProcesses],
        index: int,
        arguments: tuple[Any, ...],
    ) -> _Question:
        keys = tuple((handle.number, index) for handle in handles)
        alive = frozenset(handle.number for handle in self._handles)
        recipes = {
            key: (handle.make, handle.sources[index])
            for key, handle in zip(keys, handles, strict=True)
            if key not in worker.objects
        }
        # The objects that the worker will hold after this question; it drops objects whose handles are no longer in
        # use.
        worker.objects = {key for key in worker.objects if key[0] in alive} | set(keys)
        return _Question(function, arguments, keys, recipes, alive)

    def _send(self, worker: _Worker, question: _Question) -> None:
        content = pickle.dumps(question)
        with suppress(OSError):  # a dead worker is noticed when its answer is awaited
            worker.pipe.send_bytes(content)

    def _receive(self) -> list[tuple[int, tuple[Any, Exception | None] | None]]:
        """The answers received, each with its worker's index; None stands for the answer of a worker that died."""
        homes = {worker.pipe: home for home, worker in enumerate(self._workers)}
        answers: list[tuple[int, tuple[Any, Exception | None] | None]] = []
        for pipe in cast(list[Connection], wait(list(homes), POLL)):
            try:
                answers.append((homes[pipe], pickle.loads(pipe.recv_bytes())))
            except (EOFError, OSError):
                answers.append((homes[pipe], None))
        return answers

    def _replace(self, home: int) -> None:
        """Start a process that replaces a dead process.

        Raises:
            EngineError: Too many processes died while processing the same chunk.
        """
        dead = self._workers[home]
        dead.pipe.close()
        dead.process.join(END_WAIT)
        _LOG.warning(
            "worker %d ended (exit status %s) and is being replaced", home + 1, dead.process.exitcode
        )
        if dead.chunk is not None:
            count_death(self._deaths, dead.chunk)
        self._workers[home] = self._start(home)


def _serve(pipe: Connection, home: int, count: int) -> None:
    """Answer questions until the main process ends or closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the main one ends the others
    _pin(home, count)
    objects: dict[ObjectKey, Any] = {}
    while True:
        try:
            content = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            question: _Question = pickle.loads(content)
            for key in [key for key in objects if key[0] not in question.handles]:
                del objects[key]
            for key, (make, source) in question.recipes.items():
                objects[key] = make(source)
            result = question.function(*(objects[key] for key in question.keys), *question.arguments)
            answer = pickle.dumps((result, None))
        except Exception as error:
            answer = pickle.dumps((None, _sendable(error)))
        try:
            pipe.send_bytes(answer)
        except OSError:
            return


def _sendable(error: Exception) -> Exception:
    """An error that can be sent to the main process."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # an error class of another library may raise anything
        return EngineError(f"{type(error).__name__}: {error}")
    return error


def _pin(home: int, count: int) -> None:
    """Assign a process its share of the cores before any library that counts cores is loaded.

    Otherwise, the thread pools of Dr.Jit and XLA in every process would use all cores and slow each other down.
    """
    if _CAN_PIN:
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, cores[home % count :: count] or cores)


def check_workers(workers: object) -> None:
    """Refuse any argument other than workers or None.

    Raises:
        InputError: The argument is neither workers nor None, but for example a number.
    """
    if not isinstance(workers, Workers | None):
        raise InputError(
            f"workers: is {shortened(repr(workers))}; it must be workers from engines.open_workers(NUMBER)"
        )


@contextmanager
def open_workers(workers: int | None = None, scheduler: str | None = None) -> Iterator[Workers | None]:
    """Open workers for `engines.make`, `calibrate`, `validate` and predictions, and close them at the end.

    Args:
        workers: Number of workers on this machine, which are processes that keep chunks of links or external programs
            that run in parallel.
        scheduler: Address of a Dask scheduler, for instance "tcp://10.0.0.1:8786". The scheduler's workers need an
            installation of Calibray and access to the study's folder under the same path.

    Yields:
        The workers; None if neither argument is given.

    Raises:
        InputError: Both arguments are given, the number is below 1, Dask is not installed, or no scheduler answers.
    """
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler: give only one of the two; a cluster has its own workers")
    if isinstance(workers, bool) or not isinstance(workers, int | None):
        raise InputError(f"workers: is {workers!r}; it must be a whole number")
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: must be at least 1")
    if not isinstance(scheduler, str | None):
        raise InputError(f"scheduler: is {scheduler!r}; it must be an address such as 'tcp://10.0.0.1:8786'")
    with ExitStack() as opened:
        if scheduler is not None:
            client = opened.enter_context(scheduler_client(scheduler))
            yield DaskWorkers(lambda: client, lambda: client.get_executor(pure=False))
        elif workers is not None:
            # Processes and threads start on first use, because an engine needs only one of the two. Each thread runs
            # one external program at a time.
            local = LocalWorkers(workers, lambda: opened.enter_context(ThreadPoolExecutor(workers)))
            opened.callback(local.close)
            yield local
        else:
            yield None
