"""Replay of links in chunks: each chunk is traced and compiled on one worker, and stays there.

Candidates are sent to the workers, which return path loss of their chunks; with `reducing` they return a few sums, for
any number of links. Chunks, and thus all numbers, depend only on the study and not on the workers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, Final, cast, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.cluster.chunks import Shared, count_links, identity, select_links
from calibray.engines.cluster.workers import Workers
from calibray.engines.protocol import (
    Differentiable,
    Observing,
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
from calibray.support.progress import Progress

Open = Callable[[OpenedStudy, Mapping[str, Material]], Differentiable]
"""Opens the engine over a chunk from the opened study of its links and the materials for the trace."""

_TRACING: Final = Lock()
"""A process traces one chunk at a time."""


@dataclass(frozen=True, eq=False)
class ChunkRecipe:
    """What a chunk is made from.

    Attributes:
        shared: The opened study.
        links: The chunk's links.
        materials: Materials for the trace in place of the scene's, by name.
        open: Opens the engine over the links.
    """

    shared: Shared[OpenedStudy]
    links: Measurements
    materials: Mapping[str, Material]
    open: Open


@final
class Chunk:
    """Links that are traced and replayed together. Pickling a chunk sends its recipe instead of its paths.

    Args:
        recipe: What it is made from.
    """

    def __init__(self, recipe: ChunkRecipe) -> None:
        self._recipe = recipe
        with _TRACING:
            self.engine = recipe.open(recipe.shared.content.at(recipe.links), recipe.materials)

    def __reduce__(self) -> tuple[Any, ...]:
        return Chunk, (self._recipe,)


@final
class ChunkedReplay:
    """Links in chunks on workers, evaluated for any candidate; all chunks are opened together.

    Args:
        workers: Keep the chunks.
        study: The opened study.
        chunks: Indices of every chunk's links; together they contain every link once.
        opening: Opens the engine over a chunk's links; picklable.
        materials: Materials for the trace in place of the scene's, by name.
        progress: Called with "tracing" after every chunk.

    Attributes:
        chunks: Indices of every chunk's links.
        calls: Candidates evaluated.
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
        values = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(values), len(self._study.links)))
        for chunk, chunk_loss in self._answers(_path_loss, values):
            loss[:, chunk] = chunk_loss
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link and its derivatives, all sent to this process; see `Differentiable`."""
        values = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(values), len(self._study.links)))
        jacobian = np.empty((*loss.shape, len(self.parameters)))
        for chunk, (chunk_loss, chunk_jacobian) in self._answers(_path_loss_and_jacobian, values):
            loss[:, chunk] = chunk_loss
            jacobian[:, chunk] = chunk_jacobian
        return loss, jacobian

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """Path loss and further observables of every link, all sent to this process; see `Observing.respond`."""
        values = check_candidates(candidates, len(self.parameters))
        parts = self._workers.ask(_respond, [self._kept], values, wanted, derivatives)
        self.calls += len(values)
        return of_links(parts, list(self.chunks))

    def reducing(self, reductions: Sequence[Reduction]) -> Reduced:
        """A function that reduces every chunk's path loss on its worker; see `Chunked.reducing`."""
        kept = self._workers.keep(identity, reductions)

        def reduced(candidates: NDArray[np.float64], derivatives: bool) -> list[Any]:
            values = check_candidates(candidates, len(self.parameters))
            self.calls += len(values)
            return self._workers.ask(_reduce, [self._kept, kept], values, derivatives)

        return reduced

    def traced_with(
        self, materials: Mapping[str, Material], progress: Progress | None = None
    ) -> ChunkedReplay:
        """The same on paths traced with other materials; see `Chunked.traced_with`."""
        return ChunkedReplay(self._workers, self._study, self.chunks, self._open, materials, progress)

    def _answers(self, function: Callable, values: NDArray[np.float64]) -> zip[tuple[NDArray[np.int64], Any]]:
        answers = self._workers.ask(function, [self._kept], values)
        self.calls += len(values)
        return zip(self.chunks, answers, strict=True)


# Functions that are sent to the workers.


def _size(chunk: Chunk) -> tuple[int, bool]:
    return chunk.engine.interactions, chunk.engine.large


def _path_loss(chunk: Chunk, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
    return chunk.engine.path_loss(candidates)


def _path_loss_and_jacobian(
    chunk: Chunk, candidates: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return chunk.engine.path_loss_and_jacobian(candidates)


def _respond(
    chunk: Chunk, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool
) -> Responses:
    return cast(Observing, chunk.engine).respond(candidates, wanted, derivatives)


def _reduce(chunk: Chunk, reduction: Reduction, candidates: NDArray[np.float64], derivatives: bool) -> object:
    if derivatives:
        return reduction(*chunk.engine.path_loss_and_jacobian(candidates))
    return reduction(chunk.engine.path_loss(candidates), None)
