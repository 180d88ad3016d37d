"""How a trace is cut into launches that fit into memory, whatever number of samples and receivers is asked for.

A launch sends rays from one transmitter and looks for paths to some receivers, or the other way round
(`starts_at_receivers`); what is said of transmitters here holds for whichever end sends. The tracer keeps a few numbers
for every ray, interaction and receiver, a *lane*, so the receivers of a transmitter are shared out; if one receiver is
too much already, the rays are. Sionna's rays lie on a lattice of directions that a seed does not change: a launch takes
a share of the lattice of all rays, and the launches together send out the rays that one would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, overload

import numpy as np
from numpy.typing import NDArray

from calibray.support.messages import duration
from calibray.tracing.settings import TraceSettings

LONG_TRACE_SECONDS: Final = 30.0
"""A trace that takes longer is announced before it starts [s]."""

LANE_BYTES: Final = 40
"""Bytes of a lane at the peak of tracing, measured by benchmarks/memory.py --lanes."""
PATH_BYTES: Final = (650, 260)
"""Bytes of a path, and of each of its interactions, until it is compiled; measured by benchmarks/memory.py --paths."""
BUFFER_BYTES: Final = (50, 30)
"""The same in the tracer's buffer."""
RATE: Final = 3e7
"""Rays x interactions x receivers a second that two cores of a processor trace, to say how long a trace will take."""
SEARCH: Final = 3.0
"""About how long two cores take with the rays of one position where they are added in rounds [s]."""
SHORT: Final = 1.0
"""A trace of one launch that takes less is not worth a line [s]."""
GRID: Final = 0.01
"""Interaction points of one path found twice agree better, those of two seldom do [m]."""


@dataclass(frozen=True)
class Launch:
    """Rays from one transmitter to some receivers.

    Attributes:
        source: Position of the transmitter [3], [m].
        links: The links that end at the receivers [n].
        first: Number of the first ray within the lattice of all rays.
        rays: Number of rays sent out.
        seed: Seed of the tracer's random numbers.
        last: Whether all rays to these receivers are sent out with this launch.
    """

    source: NDArray[np.float64]
    links: NDArray[np.int64]
    first: int
    rays: int
    seed: int
    last: bool


class Launches(Sequence[Launch]):
    """The launches of a trace, each made when it is asked for: of 10^12 rays there are too many to be kept.

    Args:
        receivers: Transmitter [3], [m] and links [n] of each set of receivers that are traced together.
        settings: The tracer's switches.
        pieces: Number of launches to each set of receivers.
    """

    def __init__(
        self,
        receivers: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]],
        settings: TraceSettings,
        pieces: int,
    ) -> None:
        self._receivers, self._settings, self._pieces = receivers, settings, pieces

    def __len__(self) -> int:
        return len(self._receivers) * self._pieces

    @overload
    def __getitem__(self, index: int) -> Launch: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Launch]: ...
    def __getitem__(self, index: int | slice) -> Launch | Sequence[Launch]:
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]
        place, piece = divmod(range(len(self))[index], self._pieces)
        source, links = self._receivers[place]
        first, end = (self._settings.rays * k // self._pieces for k in (piece, piece + 1))
        seed, last = seed_of(self._settings.seed, piece), piece == self._pieces - 1
        return Launch(source, links, first, end - first, seed, last)


@dataclass(frozen=True)
class TracePlan:
    """The launches of a trace.

    Attributes:
        launches: The launches; those to the same receivers follow each other.
        lanes: Rays times interactions times receivers of the largest one.
        buffer: Bytes of the buffer that holds the paths of a launch.
        adaptive: Whether a launch is the first of several, and rays are added until path loss stands still.
    """

    launches: Sequence[Launch]
    lanes: int
    buffer: int
    adaptive: bool = False

    @property
    def memory(self) -> int:
        """Memory that tracing takes besides the paths found, estimated [bytes]."""
        return self.lanes * LANE_BYTES + self.buffer

    @property
    def seconds(self) -> float:
        """About how long two cores of a processor take [s]."""
        return len(self.launches) * (SEARCH if self.adaptive else self.lanes / RATE)

    def announcement(self, links: int) -> str:
        """What a long trace will take, in a line.

        Args:
            links: Number of links.

        Returns:
            The line; empty if one small launch does it all.
        """
        if len(self.launches) == 1 and self.seconds < SHORT:
            return ""
        if self.adaptive:
            return (
                f"Tracing {links:,} links from {len(self.launches):,} positions, rays added until path loss stands "
                f"still; about {duration(self.seconds)} on two cores, longer where rays still find paths"
            )
        return (
            f"Tracing {links:,} links in {len(self.launches):,} launches of up to {self.lanes:,} rays x interactions x "
            f"receivers; about {self.memory / 2**30:.1f} GiB of memory, besides that of the scene and the paths found, "
            f"and {duration(self.seconds)} on two cores"
        )


def starts_at_receivers(tx: NDArray[np.float64], rx: NDArray[np.float64], settings: TraceSettings) -> bool:
    """Whether rays are sent out by the receivers: they are, where there are fewer of them than transmitters.

    A path is the same in both directions, and is turned around after it was found. Diffuse reflection is not: how a
    ray is scattered, and how likely the tracer was to choose it, is told for one direction alone. Such traces start at
    the transmitters.

    Args:
        tx: Transmitter of every link [L, 3], [m].
        rx: Receiver of every link [L, 3], [m].
        settings: The tracer's switches.

    Returns:
        True where the receivers send.
    """
    return not settings.diffuse_reflection and len(np.unique(rx, axis=0)) < len(np.unique(tx, axis=0))


def plan_trace(source: NDArray[np.float64], settings: TraceSettings, lanes: int, buffer: int) -> TracePlan:
    """Cut a trace into launches.

    Args:
        source: The end of every link that sends out the rays [L, 3], [m].
        settings: The tracer's switches.
        lanes: Rays times interactions times receivers that a launch may have.
        buffer: Paths that the buffer of a launch holds at first.

    Returns:
        The launches.
    """
    depth = max(settings.max_depth, 1)
    # Rays of several rounds look for no receiver: chains are found once for all of them.
    samples, alone = settings.rays, settings.adaptive
    together = len(source) if alone else max(1, lanes // (samples * depth))
    pieces = min(samples, -(-samples * depth // lanes)) if settings.max_depth and not alone else 1
    positions, group = np.unique(source, axis=0, return_inverse=True)
    members = np.split(
        np.argsort(group.reshape(-1), kind="stable"), np.cumsum(np.bincount(group.reshape(-1)))[:-1]
    )
    receivers = [
        (position, part)
        for position, index in zip(positions, members, strict=True)
        for part in np.array_split(index, -(-len(index) // together))
    ]
    rays = -(-samples // pieces)
    largest = rays * settings.max_depth * (1 if alone else max(len(part) for _, part in receivers))
    size = buffer * (BUFFER_BYTES[0] + BUFFER_BYTES[1] * depth)
    return TracePlan(Launches(receivers, settings, pieces), largest, size, alone)


def seed_of(seed: int, piece: int) -> int:
    """Seed of one of several launches to the same receivers; the first has the trace's own.

    Args:
        seed: Seed of the trace.
        piece: Number of the launch.

    Returns:
        The seed.
    """
    return seed if piece == 0 else int(np.random.SeedSequence([seed, piece]).generate_state(1)[0])


def directions(first: int, rays: int, samples: int) -> NDArray[np.float64]:
    """A share of the Fibonacci lattice on the unit square, from which Sionna RT takes the directions of its rays.

    Args:
        first: The first point of the share.
        rays: Number of points of the share.
        samples: Number of points of the whole lattice.

    Returns:
        The points [2, rays].

    Example:
        >>> directions(0, 3, 3)[1].tolist()
        [0.0, 0.5, 1.0]
    """
    if samples == 1:
        return np.full((2, 1), 0.5)
    n = np.arange(first, first + rays)
    return np.stack([np.modf(n / ((1 + np.sqrt(5)) / 2))[0], n / (samples - 1)])


def find_repeats(
    piece: NDArray[np.int64],
    link: NDArray[np.integer],
    kind: NDArray[np.int64],
    shape: NDArray[np.int64],
    vertex: NDArray[np.float64],
    drawn: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Paths that an earlier one of several launches to the same receivers has found already.

    A path that is not drawn at random is one and the same whichever ray found it: it meets the same objects in the same
    points. Paths with a diffuse reflection are samples, and each counts.

    Args:
        piece: Which launch found the path, ascending [P].
        link: Link of the path [P].
        kind: Kinds of interaction, 0 beyond the last one [P, D].
        shape: Objects met [P, D].
        vertex: Interaction points [P, D, 3], [m].
        drawn: Whether a path is a sample [P].

    Returns:
        True for the paths to leave out [P].
    """
    found = np.zeros(len(link), dtype=bool)
    rows = np.flatnonzero(~drawn)
    if not len(rows):
        return found
    present = kind[rows] != 0
    where = np.where(present[..., None], vertex[rows], 0) / GRID
    head = np.hstack([link[rows, None], kind[rows], np.where(present, shape[rows], 0)])
    # Two grids: points that a line of one parts lie together in the other.
    for offset in (0.0, 0.5):
        grid = np.floor(where + offset).astype(np.int64).reshape(len(rows), -1)
        _, first, group = np.unique(np.hstack([head, grid]), axis=0, return_index=True, return_inverse=True)
        found[rows] |= piece[rows[first[group.reshape(-1)]]] < piece[rows]
    return found


def paths_that_fit(memory: int, depth: int) -> int:
    """Number of paths that can be traced and compiled in some memory.

    Args:
        memory: The memory [bytes].
        depth: Largest number of interactions of a path.

    Returns:
        The number.
    """
    return memory // (PATH_BYTES[0] + PATH_BYTES[1] * depth)
