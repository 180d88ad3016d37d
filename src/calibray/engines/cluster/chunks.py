"""Divides links into chunks, and runs work once per chunk on the workers: tracing, replay, prediction.

The division depends only on the links and the study, never on the workers. The cache therefore contains chunks that an
earlier command has traced.
"""

from __future__ import annotations

import hashlib
import pickle
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Final, Generic, TypeVar, cast, final
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from calibray.engines.cluster.workers import Workers
from calibray.engines.section import OpenedStudy
from calibray.measurements import Measurements
from calibray.paths import Paths, join_links
from calibray.support.progress import Progress
from calibray.tracing import convergence
from calibray.tracing.convergence import Convergence

Content = TypeVar("Content")
Answer = TypeVar("Answer")

CHUNK_LINKS: Final = 1000
"""Links per chunk if there are workers and the study states no number."""

MOST_CHUNKS: Final = 64
"""Largest number of chunks of this study: each compiles a program and returns its own sums."""

_SHARED: WeakValueDictionary[bytes, Shared[Any]] = WeakValueDictionary()

_LATEST: Final[deque[Shared[Any]]] = deque(maxlen=1)
"""Keeps the last unpacked content alive: between two chunks, nothing else may refer to it."""


@final
class Shared(Generic[Content]):
    """Content that all chunks share, for instance an opened study; a process unpacks it once.

    Args:
        content: The content. If the content is an opened study, few of its links suffice, because each chunk has its
            own.
    """

    def __init__(self, content: Content) -> None:
        self.content = content

    @cached_property
    def packed(self) -> bytes:
        """The content as bytes."""
        return pickle.dumps(self.content)

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpack, (self.packed,)


def _unpack(packed: bytes) -> Shared[Any]:
    digest = hashlib.sha256(packed).digest()
    shared = _SHARED.get(digest)
    if shared is None:
        shared = _SHARED[digest] = Shared(pickle.loads(packed))
        _LATEST.append(shared)
    return shared


@dataclass(frozen=True, eq=False)
class _Task(Generic[Content, Answer]):
    """Work on the links of one chunk; picklable."""

    work: Callable[[Content, Measurements], Answer]
    shared: Shared[Content]
    links: Measurements


def for_each_chunk(
    workers: Workers,
    work: Callable[[Content, Measurements], Answer],
    content: Content,
    links: Measurements,
    size: int,
    progress: Progress | None = None,
) -> list[tuple[NDArray[np.int64], Answer]]:
    """Run a picklable function of the shared content and a chunk's links once for every chunk.

    Objects that the work loads into `content` stay on the worker; if a worker dies, its chunk is done again. After
    every chunk, `progress` is called with "tracing", the links done and all links. Returns the indices of every chunk's
    links, and the results of the work.

    Raises:
        EngineError: Workers die repeatedly, or none is left.
    """
    chunks, shared = cut(links, size), Shared(content)
    tasks = [_Task(work, shared, select_links(links, chunk)) for chunk in chunks]
    kept = workers.keep(_do_task, tasks)
    answers = workers.ask(identity, [kept], answered=count_links(chunks, progress))
    return list(zip(chunks, answers, strict=True))


def _do_task(task: _Task[Any, Any]) -> Any:
    return task.work(task.shared.content, task.links)


def identity(value: Content) -> Content:
    """The argument itself, if the object kept with a chunk is already the answer or is sent as it is."""
    return value


def count_links(chunks: Sequence[NDArray[np.int64]], progress: Progress | None) -> Callable[[int], None]:
    """A function of a finished chunk's number that reports the links done so far as "tracing"."""
    done, total = 0, sum(len(chunk) for chunk in chunks)

    def answered(index: int) -> None:
        nonlocal done
        done += len(chunks[index])
        if progress is not None:
            progress("tracing", done, total)

    return answered


def chunk_size(stated: int | None, count: int) -> int:
    """Largest number of links of a chunk, from the number that the study states and the number of all links."""
    return stated or max(CHUNK_LINKS, -(-count // MOST_CHUNKS))


def stated_chunk_size(study: OpenedStudy) -> int | None:
    """The number of links of a chunk that a study states; None if it states none."""
    return getattr(study.engine, "chunk_links", None)


def cut(links: Measurements, size: int) -> list[NDArray[np.int64]]:
    """Divide links into chunks of about equal size, each with few positions from which rays are launched.

    Returns the indices of every chunk's links, in ascending order.

    Example:
        >>> links = Measurements(tx=[[0, 0, 9], [5, 0, 9]] * 2, rx=np.arange(12).reshape(4, 3), path_loss_db=[80] * 4)
        >>> [chunk.tolist() for chunk in cut(links, 2)]
        [[0, 2], [1, 3]]
    """
    # Rays start at the end of the link that has fewer distinct positions; links with a common start stay together.
    ends = (np.unique(end, axis=0, return_inverse=True) for end in (links.tx, links.rx))
    _, position = min(ends, key=lambda unique: len(unique[0]))
    order = np.argsort(position.reshape(-1), kind="stable")
    return [np.sort(part) for part in np.array_split(order, -(-len(order) // size))]


def select_links(links: Measurements, chunk: NDArray[np.int64]) -> Measurements:
    """The links of a chunk, given by their indices."""
    mask = np.zeros(len(links), dtype=bool)
    mask[chunk] = True
    return links.select(mask)


def seconds_to_trace(study: OpenedStudy, chunks: Sequence[NDArray[np.int64]]) -> float:
    """Estimated time to trace chunks one after the other on two processor cores [s]."""
    return sum(study.tracer.plan(select_links(study.links, chunk)).seconds for chunk in chunks)


def trace_in_chunks(
    study: OpenedStudy, workers: Workers, *, check: bool = False, progress: Progress | None = None
) -> tuple[Paths, Convergence | None]:
    """Trace a study's links in the same chunks as a calibration, or read them from the cache.

    With `check`, every chunk is traced again with twice the samples, unless samples are added in rounds. Returns the
    path program of all links, and the changes of path loss when traced again, if `check`.

    Raises:
        InputError: The links cannot be traced.
        EngineError: The paths do not fit into memory, or workers die repeatedly.
    """
    links, size = study.links, chunk_size(stated_chunk_size(study), len(study.links))
    one_link = study.at(select_links(links, np.array([0])))
    answers = for_each_chunk(workers, partial(_trace_chunk, check), one_link, links, size, progress)
    paths = join_links([(chunk, chunk_paths) for chunk, (chunk_paths, _) in answers])
    # Rounds of rays report how many rays were needed and what the last round changed: the worst chunk counts.
    worst = {
        name: max(cast(float, chunk_paths.settings[name]) for _, (chunk_paths, _) in answers)
        for name in ("rays", "last_round_db")
        if name in paths.settings
    }
    paths = replace(paths, settings={**paths.settings, **worst})
    changes = [(chunk, change) for chunk, (_, change) in answers if change is not None]
    return paths, convergence.join(changes) if changes else None


def _trace_chunk(check: bool, study: OpenedStudy, links: Measurements) -> tuple[Paths, Convergence | None]:
    from calibray.fields import path_loss

    chunk = study.at(links)
    paths = chunk.trace()
    if not check:
        return paths, None
    loss = partial(path_loss, combining=study.radio.combining, bandwidth=study.radio.bandwidth)
    return paths, convergence.check(chunk.tracer, links, paths, loss)
