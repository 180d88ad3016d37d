"""Splits a trace into launches that fit into memory, for any number of rays and receivers.

A launch sends rays from one transmitter and searches for paths to several receivers, or vice versa
(`starts_at_receivers`). Below, *transmitter* means the end that sends the rays. The tracer stores data for every
combination of ray, interaction and receiver, called a *lane*. The receivers of a transmitter are therefore divided
among launches; if one receiver needs too many lanes, the rays are divided as well. Sionna's rays form a lattice of
directions that does not depend on the seed. Each launch uses a share of the lattice, so all launches together send the
same rays as a single launch would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, overload

import numpy as np
from numpy.typing import NDArray

from calibray.support.messages import counted, duration
from calibray.tracing.settings import TraceSettings

LONG_TRACE_SECONDS: Final = 30.0
"""Duration above which a trace is announced before it starts [s]."""
SHORT_TRACE_SECONDS: Final = 1.0
"""Duration below which a trace with one launch needs no announcement [s]."""
LANE_BYTES: Final = 40
"""Peak memory per lane during tracing [bytes], measured by benchmarks/memory.py --lanes."""
PATH_BYTES: Final = (650, 260)
"""Memory per path and per interaction until compilation [bytes], measured by benchmarks/memory.py --paths."""
BUFFER_BYTES: Final = (50, 30)
"""Memory per path and per interaction in the tracer's buffer [bytes]."""
LANES_PER_SECOND: Final = 3e7
"""Number of lanes that two processor cores trace per second, for estimates of the duration of a trace."""
ADAPTIVE_SECONDS: Final = 3.0
"""Approximate duration per transmitter on two cores if rays are added in rounds [s]."""
SMALL_LAUNCH: Final = 5_000_000
"""Maximum number of lanes of a small launch; such a launch finds a few thousand candidate paths in at most 0.4 s."""
POINT_TOLERANCE: Final = 0.01
"""Side length of the grid cells for comparing interaction points [m]; points of different paths are rarely this
close."""


@dataclass(frozen=True)
class Launch:
    """Rays from one transmitter, and the receivers for which the tracer searches for paths.

    Attributes:
        source: Position of the transmitter [3], [m].
        links: Indices of the links that end at these receivers [n].
        first: Index of the first ray in the lattice of all rays.
        rays: Number of rays.
        seed: Seed of the tracer's random numbers.
        last: Whether this is the last launch to these receivers.
    """

    source: NDArray[np.float64]
    links: NDArray[np.int64]
    first: int
    rays: int
    seed: int
    last: bool


class Launches(Sequence[Launch]):
    """The launches of a trace, each created on request, because 10^12 rays would need too many launches to store.

    Args:
        receivers: Transmitter [3], [m], and links [n] of each set of receivers that is traced together.
        settings: The tracer's settings.
        shares: Number of launches among which the rays to each set of receivers are divided.
    """

    def __init__(
        self,
        receivers: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]],
        settings: TraceSettings,
        shares: int,
    ) -> None:
        self._receivers, self._settings, self._shares = receivers, settings, shares

    def __len__(self) -> int:
        return len(self._receivers) * self._shares

    @overload
    def __getitem__(self, index: int) -> Launch: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Launch]: ...
    def __getitem__(self, index: int | slice) -> Launch | Sequence[Launch]:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        receiver_set, share = divmod(range(len(self))[index], self._shares)
        source, links = self._receivers[receiver_set]
        # Shares differ by at most one ray and together contain all rays.
        first, end = (self._settings.rays * k // self._shares for k in (share, share + 1))
        seed = launch_seed(self._settings.seed, share)
        return Launch(source, links, first, end - first, seed, last=share == self._shares - 1)


@dataclass(frozen=True)
class TracePlan:
    """The launches of a trace and their costs.

    Attributes:
        launches: The launches; launches to the same receivers are consecutive.
        lanes: Rays x interactions x receivers of the largest launch.
        buffer: Size of the buffer for the paths of a launch [bytes].
        adaptive: Whether each launch is followed by further launches until path loss converges.
    """

    launches: Sequence[Launch]
    lanes: int
    buffer: int
    adaptive: bool = False

    @property
    def memory(self) -> int:
        """Estimated memory [bytes] that the trace needs, excluding the paths that it finds."""
        return self.lanes * LANE_BYTES + self.buffer

    @property
    def seconds(self) -> float:
        """Estimated duration on two processor cores [s]."""
        return len(self.launches) * (ADAPTIVE_SECONDS if self.adaptive else self.lanes / LANES_PER_SECOND)

    def announcement(self, links: int) -> str:
        """One line on the expected cost of tracing `links` links; empty for a single short launch."""
        if len(self.launches) == 1 and self.seconds < SHORT_TRACE_SECONDS:
            return ""
        task = f"Tracing {counted(links, 'link')}"
        if self.adaptive:
            return (
                f"{task} from {counted(len(self.launches), 'position')}, adding rays until path loss converges; this "
                f"takes about {duration(self.seconds)} on two cores, or longer if new paths are still found"
            )
        launches = "1 launch" if len(self.launches) == 1 else f"{len(self.launches):,} launches"
        return (
            f"{task} in {launches} of up to {self.lanes:,} rays x interactions x "
            f"receivers; this takes about {self.memory / 2**30:.1f} GiB, plus the memory of the scene and the paths, "
            f"and {duration(self.seconds)} on two cores"
        )


def starts_at_receivers(tx: NDArray[np.float64], rx: NDArray[np.float64], settings: TraceSettings) -> bool:
    """Whether the receivers send the rays, which is the case if there are fewer receivers than transmitters.

    A deterministic path is the same in both directions, so it can be reversed after it has been found. Diffuse
    reflection is not reversible: the scattered direction, and the probability with which the tracer chose that
    direction, are valid for only one direction of travel. Traces with diffuse reflection therefore start at the
    transmitters.
    """
    return not settings.diffuse_reflection and len(np.unique(rx, axis=0)) < len(np.unique(tx, axis=0))


def plan_trace(source: NDArray[np.float64], settings: TraceSettings, lanes: int, buffer: int) -> TracePlan:
    """Split a trace into launches; `source` contains the position from which the rays of each link start [L, 3], [m].

    The product of rays, interactions and receivers in a launch is at most `lanes`; the buffer of a launch initially has
    room for `buffer` paths.
    """
    depth = max(settings.max_depth, 1)
    rays, adaptive = settings.rays, settings.adaptive
    # In an adaptive search, rays are independent of the receivers, so one search per source serves all receivers.
    receivers_together = len(source) if adaptive else max(1, lanes // (rays * depth))
    shares = 1
    if settings.max_depth and not adaptive:
        shares = min(rays, -(-rays * depth // lanes))  # -(-a // b) rounds up
    positions, group = np.unique(source, axis=0, return_inverse=True)
    group = group.reshape(-1)
    links_of_source = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    receiver_sets = [
        (position, part)
        for position, links in zip(positions, links_of_source, strict=True)
        for part in np.array_split(links, -(-len(links) // receivers_together))
    ]
    lanes_per_receiver = -(-rays // shares) * settings.max_depth
    largest = lanes_per_receiver * (1 if adaptive else max(len(links) for _, links in receiver_sets))
    buffer_bytes = buffer * (BUFFER_BYTES[0] + BUFFER_BYTES[1] * depth)
    return TracePlan(Launches(receiver_sets, settings, shares), largest, buffer_bytes, adaptive)


def launch_seed(seed: int, number: int) -> int:
    """Seed of launch `number` to the same receivers; the first launch has the seed of the trace."""
    return seed if number == 0 else int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def lattice_directions(first: int, count: int, samples: int) -> NDArray[np.float64]:
    """Points [2, count] of the Fibonacci lattice of `samples` points, starting at index `first`.

    Sionna RT maps these points of the unit square to the directions of its rays.

    Example:
        >>> lattice_directions(0, 3, 3)[1].tolist()
        [0.0, 0.5, 1.0]
    """
    if samples == 1:
        return np.full((2, 1), 0.5)
    n = np.arange(first, first + count)
    golden_ratio = (1 + np.sqrt(5)) / 2
    return np.stack([np.modf(n / golden_ratio)[0], n / (samples - 1)])


def pad_receivers(position: NDArray[np.float64], lanes_per_receiver: int) -> NDArray[np.float64]:
    """Repeat the last receiver [n, 3] so that launches have only a few different numbers of receivers.

    The tracer compiles its code for each number of receivers, which takes 1 to 3 s. The number is rounded up to a power
    of two, or to a multiple of the largest power of two for which a launch is small.

    Example:
        >>> [len(pad_receivers(np.zeros((n, 3)), 1_000_000)) for n in (1, 2, 3, 4, 5, 6)]
        [1, 2, 4, 4, 8, 8]
    """
    step = 1
    while step < len(position) and 2 * step * lanes_per_receiver <= SMALL_LAUNCH:
        step *= 2
    return np.pad(position, ((0, -len(position) % step), (0, 0)), mode="edge")


def find_repeats(
    launch: NDArray[np.int64],
    link: NDArray[np.integer],
    kind: NDArray[np.int64],
    shape: NDArray[np.int64],
    vertex: NDArray[np.float64],
    is_sample: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Mask [P] of the paths that an earlier launch to the same receivers has already found.

    A deterministic path is the same for any ray that finds it: it interacts with the same objects at the same points.
    Paths with a diffuse reflection are random samples and never count as repeats. `launch` [P] is in ascending order.
    `kind` [P, D] is 0 after the last interaction, and `vertex` [P, D, 3] contains the interaction points [m].
    """
    repeats = np.zeros(len(link), dtype=bool)
    rows = np.flatnonzero(~is_sample)
    if not len(rows):
        return repeats
    present = kind[rows] != 0
    cell = np.where(present[..., None], vertex[rows], 0) / POINT_TOLERANCE
    head = np.hstack([link[rows, None], kind[rows], np.where(present, shape[rows], 0)])
    # Points are compared by their grid cells. A second grid, shifted by half a cell, joins points that a cell boundary
    # of the first grid separates, unless a boundary of the second grid separates them along another axis.
    for offset in (0.0, 0.5):
        grid = np.floor(cell + offset).astype(np.int64).reshape(len(rows), -1)
        _, first, group = np.unique(np.hstack([head, grid]), axis=0, return_index=True, return_inverse=True)
        repeats[rows] |= launch[rows[first[group.reshape(-1)]]] < launch[rows]
    return repeats


def paths_that_fit(memory: int, depth: int) -> int:
    """Number of paths with up to `depth` interactions that can be traced and compiled in `memory` [bytes]."""
    return memory // (PATH_BYTES[0] + PATH_BYTES[1] * depth)
