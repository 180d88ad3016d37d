"""Rays added in rounds until path loss stands still; what they find is kept, and found once for all receivers.

A round sends out as many rays as all rounds before it, in other directions. Its chains of interactions are those of the
source; the ones that are new are tried for every receiver by the method of images. Two rounds in a row that change the
path loss of no link by more than `STILL_DB` end the search: the last one is the check that a second trace with twice
the rays would have been.
"""

# Mitsuba makes its types when its variant is chosen: its stubs know them as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from calibray.errors import EngineError
from calibray.materials import Material
from calibray.support.progress import Progress
from calibray.tracing.settings import ROUND
from calibray.tracing.sionna.arrays import aligned, points
from calibray.tracing.sionna.chunks import Chunk, rays_towards, without_repeats
from calibray.tracing.sionna.reciprocity import turned_around
from calibray.tracing.sionna.sequences import Meshes, Unhidden, keys, possible, unfolded
from calibray.tracing.trace_plan import Launch, TracePlan, directions, seed_of

if TYPE_CHECKING:
    from calibray.tracing.sionna.tracer import Tracer

STILL_DB: Final = 0.05
"""Change of a link's path loss with twice the rays that counts as standing still [dB]."""
QUIET: Final = 2
"""Rounds in a row that may change nothing more before the search ends."""
LAUNCHES: Final = 256
"""Launches of a source after which the search ends anyway: 64 million rays."""
KEPT: Final = 4
"""Positions whose chains are kept for the next links."""
SIZE: Final = 100_000
"""Chains that the buffer of a launch holds at first."""
BATCH: Final = 500_000
"""Chains x receivers whose geometry is computed together."""

_LOG: Final = logging.getLogger(__name__)


def search(
    tracer: Tracer,
    plan: TracePlan,
    ends: tuple[NDArray[np.float64], NDArray[np.float64]],
    backwards: bool,
    room: int,
    constants: Mapping[str, Material],
    progress: Progress | None,
) -> tuple[tuple[Chunk, ...], dict[str, object]]:
    """Find the paths of links, the rays added in rounds.

    Args:
        tracer: The tracer.
        plan: A launch for every position that sends.
        ends: Transmitter and receiver of every link [L, 3] each, [m].
        backwards: Whether the receivers send.
        room: Paths that fit into memory.
        constants: The materials traced with.
        progress: Called with ("tracing", receivers traced, receivers in all) before the first position and after
            every one.

    Returns:
        The paths, and for the record how many rays were sent out, and what the last round changed.

    Raises:
        EngineError: There are more paths than fit into memory.
    """
    others, done = ends[0 if backwards else 1], 0
    if progress is not None:
        progress("tracing", 0, len(others))
    chunks: list[Chunk] = []
    searches: list[Search] = []
    for launch in plan.launches:
        left = room - sum(len(chunk.link) for chunk in chunks)
        chains = SourceChains.of(tracer, launch.source, constants)
        searches.append(Search(tracer, chains, launch, others[launch.links], backwards, left))
        searches[-1].run()
        chunks += searches[-1].chunks
        done += len(launch.links)
        if progress is not None:
            progress("tracing", done, len(others))
    told = {
        "rays": max(each.rays for each in searches),
        "last_round_db": max(each.change_db for each in searches),
    }
    return tuple(chunks), told


class SourceChains:
    """The chains of interactions that rays from a position meet.

    They are the same for all receivers, so that rays are sent out once for all blocks of links that are traced here.

    Args:
        tracer: The tracer.
        source: The position [3], [m].
    """

    def __init__(self, tracer: Tracer, source: NDArray[np.float64]) -> None:
        self.meshes = Meshes(tracer.mitsuba)
        self._tracer, self._source = tracer, source
        self._known = np.zeros((0, 2 * tracer.settings.max_depth + 2), dtype=np.int64)
        self._new: list[PathsBuffer | None] = []

    @classmethod
    def of(
        cls, tracer: Tracer, source: NDArray[np.float64], constants: Mapping[str, Material]
    ) -> SourceChains:
        """Those found before, or none yet.

        Args:
            tracer: The tracer.
            source: The position [3], [m].
            constants: The materials that it traces with.

        Returns:
            The chains.
        """
        key = source.tobytes(), tracer.settings, tuple(constants.items())
        if key not in tracer.known_chains:
            while len(tracer.known_chains) >= KEPT:
                del tracer.known_chains[next(iter(tracer.known_chains))]
            tracer.known_chains[key] = cls(tracer, source)
        return tracer.known_chains[key]

    def new(self, number: int, room: int) -> PathsBuffer | None:
        """Chains that a launch finds and those before it did not.

        Args:
            number: Number of the launch.
            room: Paths that fit into memory.

        Returns:
            The chains; None where there are none.

        Raises:
            EngineError: There are more than fit into memory.
        """
        while len(self._new) <= number:
            chains = self._shoot(len(self._new), room)
            self._known, fresh = _fresh(self._known, keys(chains, self.meshes))
            self._new.append(chains.gather(mi.UInt(aligned(fresh, np.uint32))) if len(fresh) else None)
        return self._new[number]

    def _shoot(self, number: int, room: int) -> PathsBuffer:
        """Chains that the rays of one launch meet."""
        seed = self._tracer.settings.seed
        shift = np.random.default_rng([seed, number]).random((2, 1)) * (number > 0)
        above = points(np.zeros((1, 3)))
        with rays_towards((directions(0, ROUND, ROUND) + shift) % 1.0):
            return self._tracer.candidates(
                Unhidden(self._tracer.mitsuba), points(self._source[None]), above, ROUND,
                seed_of(seed, number), False, SIZE, room,
            )  # fmt: skip


@dataclass
class Search:
    """The search for the paths of one source.

    Attributes:
        tracer: The tracer.
        chains: What rays from the source meet.
        launch: The source, and its links.
        targets: The other ends of the links [R, 3], [m].
        backwards: Whether the source is the links' receiver.
        room: Paths that fit into memory.
        chunks: What was found.
        rays: Rays sent out so far.
        change_db: Largest change of a link's path loss in the last round [dB].
    """

    tracer: Tracer
    chains: SourceChains
    launch: Launch
    targets: NDArray[np.float64]
    backwards: bool
    room: int
    chunks: list[Chunk] = field(default_factory=list)
    rays: int = 0
    change_db: float = 0.0

    def run(self) -> None:
        """Find the paths.

        Raises:
            EngineError: There are more than fit into memory.
        """
        settings = self.tracer.settings
        power = self._keep([self._direct()])
        if settings.max_depth == 0:
            return
        sent, quiet = 0, 0
        while quiet < QUIET and sent < LAUNCHES:
            pieces: list[Chunk] = []
            for _ in range(max(sent, 1)):
                fresh = self.chains.new(sent, self.room)
                sent += 1
                if fresh is not None:
                    pieces += self._try(fresh)
            gained = self._keep(pieces)
            with np.errstate(divide="ignore", invalid="ignore"):
                rise = np.where(gained > 0, 10 * np.log10((power + gained) / power), 0.0)
            self.rays, self.change_db = sent * ROUND, float(rise.max())
            power += gained
            quiet = quiet + 1 if self.change_db <= STILL_DB else 0
        if quiet < QUIET and self.change_db > STILL_DB:
            _LOG.warning(
                "%s rays from %s still changed path loss by up to %.2f dB: paths may be missing",
                f"{self.rays:,}", self.launch.source.tolist(), self.change_db,
            )  # fmt: skip

    def _direct(self) -> Chunk:
        """The paths without an interaction."""
        ends = points(self.launch.source[None]), points(self.targets)
        scene = self.tracer.mitsuba
        direct = self.tracer.settings.line_of_sight
        buffer = self.tracer.candidates(scene, *ends, 0, 0, direct, len(self.targets) + 2, self.room)
        return self._chunk(buffer, *ends)

    def _try(self, chains: PathsBuffer) -> list[Chunk]:
        """The paths that chains are to any of the receivers."""
        found = list(possible(unfolded(chains, self.launch.source, self.chains.meshes), self.targets))
        chain, target = (np.concatenate(part) for part in zip(*found, strict=True))
        chunks = []
        for start in range(0, len(chain), BATCH):
            some = slice(start, start + BATCH)
            buffer = chains.gather(mi.UInt(aligned(chain[some], np.uint32)))
            buffer._tgt_indices = mi.UInt(aligned(target[some], np.uint32))
            buffer.schedule()
            dr.eval()
            ends = points(self.launch.source[None]), points(self.targets)
            chunks.append(self._chunk(buffer, *ends))
        return chunks

    def _chunk(self, buffer: PathsBuffer, source: mi.Point3f, target: mi.Point3f) -> Chunk:
        """Candidates of the source as paths in the direction of the wave."""
        if self.backwards:
            buffer, source, target = turned_around(buffer, target), target, source
        self.tracer.settle(buffer, source, target)
        end: Any = buffer.source_indices if self.backwards else buffer.target_indices
        return Chunk(buffer, source, target, self.launch.links[np.array(end, dtype=np.int64)])

    def _keep(self, pieces: list[Chunk]) -> NDArray[np.float64]:
        """Keep what was not found before, and tell the power that every link gained [R].

        Raises:
            EngineError: There is more than fits into memory.
        """
        before = len(self.chunks)
        # The first one holds the direct paths, and is kept in any case: it tells where the links' ends are.
        earlier = self.chunks[1:]
        fresh = [chunk for chunk in pieces if len(chunk.link) or not before]
        # A plane may count as two, by a rounding, and its chain be tried again.
        self.chunks += without_repeats([*earlier, *fresh])[len(earlier) :] if before and fresh else fresh
        if sum(len(chunk.link) for chunk in self.chunks) > self.room:
            raise EngineError(
                f"more paths than fit into memory, with {len(self.targets)} receivers at work; lower trace.max_depth, "
                "or trace fewer links at once"
            )
        gained = np.zeros(len(self.targets))
        order = np.argsort(self.launch.links)
        for chunk in self.chunks[before:]:
            gain = self.tracer.field_stage(chunk)
            power = (np.abs(gain) ** 2).sum(axis=1).mean(axis=1)
            place = order[np.searchsorted(self.launch.links[order], chunk.link)]
            gained += np.bincount(place, power, len(self.targets))
        return gained


def _fresh(known: NDArray[np.int64], found: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Chains known from now on [n, k], and which of those found are new [m]."""
    both, first = np.unique(np.vstack([known, found]), axis=0, return_index=True)
    return both, np.sort(first[first >= len(known)] - len(known))
