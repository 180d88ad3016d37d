"""Division of links into chunks, work that a worker does once per chunk (tracing, prediction), and chunked replay.

The division, and thus every result, depends only on the links and the study, not on the number or type of workers.
Chunks traced by one command can therefore be read from the cache by a later command. For replay, each chunk is
traced and compiled on one worker, which keeps the chunk. Candidates are sent to the workers, which return the path loss
of their chunks. With `reducing`, the workers return only a few sums, regardless of the number of links.
"""

from __future__ import annotations

import hashlib
import pickle
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from threading import Lock
from typing import Any, Final, Generic, TypeVar, cast, final
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from calibray.engines.cluster.workers import Workers
from calibray.engines.protocol import (
    Differentiable,
    Reduced,
    Reduction,
    Responses,
    check_candidates,
    of_links,
)
from calibray.engines.section import OpenedStudy
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.measurements.observables import Statistic
from calibray.parameters import Parameters
from calibray.paths import Paths, join_links
from calibray.support.progress import Progress
from calibray.tracing import convergence
from calibray.tracing.convergence import Convergence

Content = TypeVar("Content")
Answer = TypeVar("Answer")

CHUNK_LINKS: Final = 1000
"""Default maximum number of links per chunk, raised where necessary to keep the number of chunks at or below
`MOST_CHUNKS`."""

MOST_CHUNKS: Final = 64
"""Maximum number of chunks if the study does not state a chunk size. The number is limited because every chunk compiles
its own program.
"""

_SHARED: WeakValueDictionary[bytes, Shared[Any]] = WeakValueDictionary()

_LATEST: Final[deque[Shared[Any]]] = deque(maxlen=1)
"""Reference to the most recently unpacked content, which keeps this content in memory from one chunk to the next."""


@final
class Shared(Generic[Content]):
    """Content that all chunks share, for example an opened study. Each process unpacks the content once.

    A shared study needs to contain only a few links, because each chunk brings its own.
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
    """Call a picklable function once for every chunk, with the shared content and the chunk's links.

    Objects that `work` stores in `content` stay on the worker. If a worker dies, its chunk is processed again. After
    every chunk, `progress` is called with "tracing", the number of finished links and the total number of links.
    Returns the indices of every chunk's links, and the results of `work`.

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
    """Return the argument; used if an object is itself the answer of a chunk, or if an object is sent unchanged."""
    return value


def count_links(chunks: Sequence[NDArray[np.int64]], progress: Progress | None) -> Callable[[int], None]:
    """Make a function that receives the index of a finished chunk and reports the number of links done as "tracing"."""
    done, total = 0, sum(len(chunk) for chunk in chunks)

    def answered(index: int) -> None:
        nonlocal done
        done += len(chunks[index])
        if progress is not None:
            progress("tracing", done, total)

    return answered


def chunk_size(stated: int | None, count: int) -> int:
    """Maximum number of links per chunk, from the study's maximum (if any) and the total number of links."""
    return stated or max(CHUNK_LINKS, -(-count // MOST_CHUNKS))


def stated_chunk_size(study: OpenedStudy) -> int | None:
    """Maximum number of links per chunk stated in a study; None if the study states none."""
    return getattr(study.engine, "chunk_links", None)


def cut(links: Measurements, size: int) -> list[NDArray[np.int64]]:
    """Divide links into chunks of similar size, so that the rays of each chunk start at few positions.

    Each chunk has at most `size` links. Returns the indices of every chunk's links, in ascending order.

    Example:
        >>> links = Measurements(tx=[[0, 0, 9], [5, 0, 9]] * 2, rx=np.arange(12).reshape(4, 3), path_loss_db=[80] * 4)
        >>> [chunk.tolist() for chunk in cut(links, 2)]
        [[0, 2], [1, 3]]
    """
    # Rays start at the transmitters or receivers, whichever have fewer positions; links at one position stay adjacent.
    ends = (np.unique(end, axis=0, return_inverse=True) for end in (links.tx, links.rx))
    _, position = min(ends, key=lambda unique: len(unique[0]))
    order = np.argsort(position.reshape(-1), kind="stable")
    return [np.sort(part) for part in np.array_split(order, -(-len(order) // size))]


def select_links(links: Measurements, chunk: NDArray[np.int64]) -> Measurements:
    """The links at the given indices."""
    mask = np.zeros(len(links), dtype=bool)
    mask[chunk] = True
    return links.select(mask)


def seconds_to_trace(study: OpenedStudy, chunks: Sequence[NDArray[np.int64]]) -> float:
    """Estimated time [s] to trace the chunks one after another on two processor cores."""
    return sum(study.tracer.plan(select_links(study.links, chunk)).seconds for chunk in chunks)


def trace_in_chunks(
    study: OpenedStudy, workers: Workers, *, check: bool = False, progress: Progress | None = None
) -> tuple[Paths, Convergence | None]:
    """Trace a study's links in the same chunks as a calibration, or read their paths from the cache.

    With `check`, every chunk is traced again with twice the samples. Returns the path program of all links and, with
    `check`, the changes in path loss between the two traces.

    Raises:
        InputError: The links cannot be traced, or `check` is set and the study adds samples in rounds.
        EngineError: The paths do not fit into memory, or workers die repeatedly.
    """
    links, size = study.links, chunk_size(stated_chunk_size(study), len(study.links))
    # Every chunk has its own links, so the shared study is sent with only one link.
    one_link = study.at(select_links(links, np.array([0])))
    answers = for_each_chunk(workers, partial(_trace_chunk, check), one_link, links, size, progress)
    paths = join_links([(chunk, chunk_paths) for chunk, (chunk_paths, _) in answers])
    # If rays are added in rounds, the settings state the number of rays and the last change. The joined settings keep
    # the largest value of each.
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
    again = convergence.check(
        chunk.trace_settings, lambda finer: chunk.with_trace(finer).trace(), paths, loss
    )
    return paths, again


Open = Callable[[OpenedStudy, Mapping[str, Material]], Differentiable]
"""Opens the engine of a chunk, given the opened study with the chunk's links and the materials for the trace."""

_TRACING: Final = Lock()
"""Lock that lets a process trace only one chunk at a time."""


@dataclass(frozen=True, eq=False)
class ChunkRecipe:
    """All data needed to make a chunk.

    Attributes:
        shared: The opened study.
        links: The chunk's links.
        materials: Materials by name that replace the scene's materials in the trace.
        open: Opens the engine of the chunk.
    """

    shared: Shared[OpenedStudy]
    links: Measurements
    materials: Mapping[str, Material]
    open: Open


@final
class Chunk:
    """Links that are traced and replayed together. A pickled chunk contains its recipe instead of its paths.

    Attributes:
        study: The opened study with these links.
        engine: The engine for these links.
    """

    def __init__(self, recipe: ChunkRecipe) -> None:
        self._recipe = recipe
        self._derived: tuple[Any, Any] | None = None
        with _TRACING:
            self.study = recipe.shared.content.at(recipe.links)
            self.engine = recipe.open(self.study, recipe.materials)

    def derived(self, make: Callable[[Chunk], Content]) -> Content:
        """The result of `make` for this chunk; it is kept until this method is called with another function."""
        if self._derived is None or self._derived[0] != make:
            self._derived = None  # frees the memory first
            self._derived = make, make(self)
        return self._derived[1]

    def __reduce__(self) -> tuple[Any, ...]:
        return Chunk, (self._recipe,)


Derive = Callable[[Chunk], Differentiable]
"""Derives another engine from the paths of a chunk; picklable."""


@final
class ChunkedReplay:
    """Replays links in chunks on workers, for any candidate. The constructor opens all chunks.

    Args:
        workers: Workers that keep the chunks.
        study: The opened study.
        chunks: Indices of every chunk's links; every link belongs to exactly one chunk.
        opening: Opens the engine of a chunk; picklable.
        materials: Materials by name that replace the scene's materials in the trace.
        progress: Called with "tracing" after every chunk.

    Attributes:
        chunks: Indices of every chunk's links.
        calls: Number of candidates evaluated.
        parameters: The parameters whose values a candidate contains.
        materials: The materials before calibration, as in the trace.
    """

    def __init__(
        self,
        workers: Workers,
        study: OpenedStudy,
        chunks: Sequence[NDArray[np.int64]],
        opening: Open,
        materials: Mapping[str, Material] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._workers, self._study, self._open = workers, study, opening
        self._derive: Derive | None = None
        self.chunks, self.calls, self.parameters = chunks, 0, study.parameters
        self.materials = {**study.scene.materials, **(materials or {})}
        links = [select_links(study.links, chunk) for chunk in chunks]
        shared = Shared(study.at(links[0]))
        recipes = [ChunkRecipe(shared, chunk_links, materials or {}, opening) for chunk_links in links]
        self._kept = workers.keep(Chunk, recipes)
        sizes = workers.ask(_size, [self._kept], answered=count_links(chunks, progress))
        self.interactions = sum(interactions for interactions, _ in sizes)
        self.large = any(large for _, large in sizes)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates; see `Engine.path_loss`."""
        return self._path_loss(candidates, "path_loss")

    def scene_path_loss(
        self, candidates: NDArray[np.float64], walls: Mapping[str, str]
    ) -> NDArray[np.float64]:
        """Path loss of the scene alone for candidates; see `ReplaysScene.scene_path_loss`."""
        return self._path_loss(candidates, "scene_path_loss", dict(walls))

    def _path_loss(
        self, candidates: NDArray[np.float64], method: str, *arguments: Any
    ) -> NDArray[np.float64]:
        values = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(values), len(self._study.links)))
        for chunk, chunk_loss in self._answers(method, values, *arguments):
            loss[:, chunk] = chunk_loss
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link and its derivatives, collected in this process; see `Differentiable`."""
        values = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(values), len(self._study.links)))
        jacobian = np.empty((*loss.shape, len(self.parameters)))
        for chunk, (chunk_loss, chunk_jacobian) in self._answers("path_loss_and_jacobian", values):
            loss[:, chunk] = chunk_loss
            jacobian[:, chunk] = chunk_jacobian
        return loss, jacobian

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """Path loss and further observables of every link, collected in this process; see `Observing.respond`."""
        values = check_candidates(candidates, len(self.parameters))
        answers = self._answers("respond", values, wanted, derivatives)
        return of_links([part for _, part in answers], list(self.chunks))

    def ask(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Call a function for every chunk; see `Chunked.ask`."""
        return self._workers.ask(function, [self._kept], *arguments)

    def reducing(self, reductions: Sequence[Reduction]) -> Reduced:
        """Make a function that reduces every chunk's path loss on its worker; see `Chunked.reducing`."""
        kept = self._workers.keep(identity, reductions)

        def reduced(candidates: NDArray[np.float64], derivatives: bool) -> list[Any]:
            values = check_candidates(candidates, len(self.parameters))
            self.calls += len(values)
            return self._workers.ask(_reduce, [self._kept, kept], self._derive, values, derivatives)

        return reduced

    def traced_with(
        self, materials: Mapping[str, Material], progress: Progress | None = None
    ) -> ChunkedReplay:
        """A replay of the same links with paths traced with other materials; see `Chunked.traced_with`."""
        return ChunkedReplay(self._workers, self._study, self.chunks, self._open, materials, progress)

    def derived(self, parameters: Parameters, derive: Derive) -> ChunkedReplay:
        """The same chunks with engines for other parameters; see `Chunked.derived`."""
        other = copy(self)
        other.parameters, other._derive = parameters, derive
        return other

    def _answers(
        self, method: str, values: NDArray[np.float64], *arguments: Any
    ) -> zip[tuple[NDArray[np.int64], Any]]:
        answers = self.ask(_answer, self._derive, method, values, *arguments)
        self.calls += len(values)
        return zip(self.chunks, answers, strict=True)


# The functions below are sent to the workers.


def _size(chunk: Chunk) -> tuple[int, bool]:
    return chunk.engine.interactions, chunk.engine.large


def _engine(chunk: Chunk, derive: Derive | None) -> Differentiable:
    return chunk.engine if derive is None else chunk.derived(derive)


def _answer(chunk: Chunk, derive: Derive | None, method: str, *arguments: Any) -> Any:
    return getattr(_engine(chunk, derive), method)(*arguments)


def _reduce(
    chunk: Chunk,
    reduction: Reduction,
    derive: Derive | None,
    candidates: NDArray[np.float64],
    derivatives: bool,
) -> object:
    engine = _engine(chunk, derive)
    if derivatives:
        return reduction(*engine.path_loss_and_jacobian(candidates))
    return reduction(engine.path_loss(candidates), None)
