"""Replay of links in blocks: each is traced and compiled where it lives and stays there.

Candidates go out, and what is wanted of a block's path loss comes back: with `reducing` some sums, whatever the number
of its links. Blocks follow from the study alone, never from the machines, and so does every number.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, final
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from calibray.engines.crew import Crew
from calibray.engines.protocol import Differentiable, Reduced, Reduction, check_candidates
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.progress import Progress

if TYPE_CHECKING:
    from calibray.study.setup import Setup

Open = Callable[["Setup", Mapping[str, Material]], Differentiable]
"""The opened study of a block's links, and materials to trace with, to the engine over them."""

_TRACING: Final = Lock()
"""A process traces one block at a time."""

_SHARED: WeakValueDictionary[bytes, Shared] = WeakValueDictionary()


@final
class Shared:
    """An opened study that blocks share; a process unpacks it once, and loads the scene once.

    Args:
        setup: The study, with few links or many: a block brings its own.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup

    @cached_property
    def packed(self) -> bytes:
        """The study as bytes."""
        return pickle.dumps(self.setup)

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpacked, (self.packed,)


def _unpacked(packed: bytes) -> Shared:
    digest = hashlib.sha256(packed).digest()
    found = _SHARED.get(digest)
    if found is None:
        found = _SHARED[digest] = Shared(pickle.loads(packed))
    return found


@dataclass(frozen=True, eq=False)
class Recipe:
    """What a block is made of.

    Attributes:
        shared: The opened study.
        links: The block's links.
        materials: Materials to trace with in place of the scene's, by name.
        open: Opens the engine over the links.
    """

    shared: Shared
    links: Measurements
    materials: Mapping[str, Material]
    open: Open


@final
class Block:
    """Links that are traced and evaluated together. What is sent of it is its recipe.

    Args:
        recipe: What it is made of.
    """

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        with _TRACING:
            self.engine = recipe.open(recipe.shared.setup.at(recipe.links), recipe.materials)

    def __reduce__(self) -> tuple[Any, ...]:
        return Block, (self._recipe,)


@final
class Blocks:
    """Links in blocks, evaluated for any candidate where they live; they are opened at once.

    Args:
        crew: Where they live.
        setup: The opened study.
        blocks: Links of every block; together they hold every link once.
        opening: Opens the engine over a block's links; a function that can be sent.
        materials: Materials to trace with in place of the scene's, by name.
        progress: Called with the stage "tracing" whenever a block is open.

    Attributes:
        blocks: Links of every block.
        calls: Candidates evaluated.
        parameters: What the candidates' components stand for.
        materials: The materials before calibration, as traced with.
    """

    def __init__(
        self,
        crew: Crew,
        setup: Setup,
        blocks: Sequence[NDArray[np.int64]],
        opening: Open,
        materials: Mapping[str, Material] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._crew, self._setup, self._open = crew, setup, opening
        self.blocks, self.calls, self.parameters = blocks, 0, setup.parameters
        self.materials = {**setup.scene.materials, **(materials or {})}
        links = [setup.links.select(_mask(each, len(setup.links))) for each in blocks]
        shared, done = Shared(setup.at(links[0])), 0

        def traced(index: int) -> None:
            nonlocal done
            done += len(blocks[index])
            if progress is not None:
                progress("tracing", done, len(setup.links))

        self._kept = crew.keep(Block, [Recipe(shared, each, materials or {}, opening) for each in links])
        sizes = crew.ask(_size, [self._kept], answered=traced)
        self.interactions = sum(interactions for interactions, _ in sizes)
        self.large = any(large for _, large in sizes)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        given = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(given), len(self._setup.links)))
        for links, part in zip(self.blocks, self._crew.ask(_path_loss, [self._kept], given), strict=True):
            loss[:, links] = part
        self.calls += len(given)
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link, and its derivatives by the parameters, all brought here.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        given = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(given), len(self._setup.links)))
        jacobian = np.empty((*loss.shape, len(self.parameters)))
        for links, part in zip(self.blocks, self._crew.ask(_jacobian, [self._kept], given), strict=True):
            loss[:, links], jacobian[:, links] = part
        self.calls += len(given)
        return loss, jacobian

    def reducing(self, reductions: Sequence[Reduction]) -> Reduced:
        """What reduces the path loss of every block where that lives; see `Parted.reducing`."""
        kept = self._crew.keep(_itself, reductions)

        def reduced(candidates: NDArray[np.float64], derivatives: bool) -> list[Any]:
            given = check_candidates(candidates, len(self.parameters))
            self.calls += len(given)
            return self._crew.ask(_reduced, [self._kept, kept], given, derivatives)

        return reduced

    def traced_with(self, materials: Mapping[str, Material], progress: Progress | None = None) -> Blocks:
        """The same on paths traced with other materials; see `Parted.traced_with`."""
        return Blocks(self._crew, self._setup, self.blocks, self._open, materials, progress)


def cut(links: Measurements, size: int) -> list[NDArray[np.int64]]:
    """Cut links into blocks of about equal numbers, with few positions to send rays from in each.

    Args:
        links: The links.
        size: Number of links of a block, at most.

    Returns:
        Links of every block, in ascending order.

    Example:
        >>> links = Measurements(tx=[[0, 0, 9], [5, 0, 9]] * 2, rx=np.arange(12).reshape(4, 3), path_loss_db=[80] * 4)
        >>> [block.tolist() for block in cut(links, 2)]
        [[0, 2], [1, 3]]
    """
    ends = (np.unique(end, axis=0, return_inverse=True) for end in (links.tx, links.rx))
    _, place = min(ends, key=lambda found: len(found[0]))
    order = np.argsort(place.reshape(-1), kind="stable")
    return [np.sort(part) for part in np.array_split(order, -(-len(order) // size))]


def seconds_to_trace(setup: Setup, blocks: Sequence[NDArray[np.int64]]) -> float:
    """About how long it takes to trace blocks here, one after the other.

    Args:
        setup: The opened study.
        blocks: Links of every block.

    Returns:
        Seconds on two cores of a processor.

    Raises:
        InputError: The links cannot be traced.
    """
    links = (setup.links.select(_mask(each, len(setup.links))) for each in blocks)
    return sum(setup.tracer.plan(each).seconds for each in links)


def _mask(links: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    mask = np.zeros(count, dtype=bool)
    mask[links] = True
    return mask


def _size(block: Block) -> tuple[int, bool]:
    return block.engine.interactions, block.engine.large


def _path_loss(block: Block, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
    return block.engine.path_loss(candidates)


def _jacobian(
    block: Block, candidates: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return block.engine.path_loss_and_jacobian(candidates)


def _reduced(
    block: Block, reduction: Reduction, candidates: NDArray[np.float64], derivatives: bool
) -> object:
    if derivatives:
        return reduction(*block.engine.path_loss_and_jacobian(candidates))
    return reduction(block.engine.path_loss(candidates), None)


def _itself(given: Reduction) -> Reduction:
    return given
