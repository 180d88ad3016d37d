"""Links parted into blocks, and work that is done once for each of them where blocks live; what it gives comes back.

How links are parted follows from them and the study alone, so that blocks of one command are found in the cache by the
next.
"""

from __future__ import annotations

import hashlib
import pickle
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar, final
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from calibray.measurements import Measurements
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Crew
    from calibray.study.setup import Setup

Content = TypeVar("Content")
Answer = TypeVar("Answer")

BLOCK_LINKS: Final = 1000
"""Links of a block where workers are given and the study does not say,"""

BLOCKS: Final = 64
"""unless that makes more blocks than these: each has its sums, and its program is compiled."""

_SHARED: WeakValueDictionary[bytes, Shared[Any]] = WeakValueDictionary()

_LATEST: Final[deque[Shared[Any]]] = deque(maxlen=1)
"""What was unpacked last: between two blocks nobody else may hold on to it."""


@final
class Shared(Generic[Content]):
    """What blocks share, as an opened study; a process unpacks it once, and loads the scene once.

    Args:
        content: What is shared; of a study its links may be few, for a block brings its own.
    """

    def __init__(self, content: Content) -> None:
        self.content = content

    @cached_property
    def packed(self) -> bytes:
        """The content as bytes."""
        return pickle.dumps(self.content)

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpacked, (self.packed,)


def _unpacked(packed: bytes) -> Shared[Any]:
    digest = hashlib.sha256(packed).digest()
    found = _SHARED.get(digest)
    if found is None:
        found = _SHARED[digest] = Shared(pickle.loads(packed))
        _LATEST.append(found)
    return found


@dataclass(frozen=True, eq=False)
class Part(Generic[Content, Answer]):
    """Work on the links of one block.

    Attributes:
        work: What is done; a function that can be sent.
        shared: What it takes first, the same for all blocks.
        links: The block's links.
    """

    work: Callable[[Content, Measurements], Answer]
    shared: Shared[Content]
    links: Measurements


def of_blocks(
    crew: Crew,
    work: Callable[[Content, Measurements], Answer],
    content: Content,
    links: Measurements,
    size: int,
    progress: Progress | None = None,
) -> list[tuple[NDArray[np.int64], Answer]]:
    """Do some work once for every block of links, where blocks live.

    Args:
        crew: Where they live; a block whose worker dies is done again.
        work: What is done with what is shared and the links of a block; a function that can be sent.
        content: What is shared; what the work loads with it stays with the worker.
        links: The links.
        size: Number of links of a block, at most.
        progress: Called with the stage "tracing", the links done and all of them, whenever a block is done.

    Returns:
        Links of every block, and what the work gave.

    Raises:
        EngineError: Workers die again and again, or none is left.
    """
    blocks, shared, done = cut(links, size), Shared(content), 0

    def answered(index: int) -> None:
        nonlocal done
        done += len(blocks[index])
        if progress is not None:
            progress("tracing", done, len(links))

    kept = crew.keep(_done, [Part(work, shared, chosen(links, each)) for each in blocks])
    return list(zip(blocks, crew.ask(itself, [kept], answered=answered), strict=True))


def block_size(given: int | None, count: int) -> int:
    """Number of links of a block, at most.

    Args:
        given: What the study says, if it does.
        count: Number of links in all.

    Returns:
        The number.
    """
    return given or max(BLOCK_LINKS, -(-count // BLOCKS))


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
    return sum(setup.tracer.plan(chosen(setup.links, each)).seconds for each in blocks)


def chosen(links: Measurements, block: NDArray[np.int64]) -> Measurements:
    """The links of a block.

    Args:
        links: All links.
        block: Those of the block, ascending.

    Returns:
        Its links.
    """
    mask = np.zeros(len(links), dtype=bool)
    mask[block] = True
    return links.select(mask)


def itself(given: Content) -> Content:
    """What was given: what is kept is made elsewhere, or what is asked for is kept.

    Args:
        given: Anything.

    Returns:
        The same.
    """
    return given


def _done(part: Part[Any, Any]) -> Any:
    return part.work(part.shared.content, part.links)
