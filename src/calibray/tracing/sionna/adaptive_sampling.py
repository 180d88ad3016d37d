"""Rays are added in rounds until path loss converges (`trace.samples = "auto"`).

Each round launches as many rays as all earlier rounds together, but in different directions. The interaction sequences
that the rays find depend only on the source; for every receiver, new sequences are tested by the method of images
(`image_method`). The search ends after two successive rounds in which no link's path loss changes by more than
`CONVERGED_DB`. The last round is equivalent to a second trace with twice as many rays (`calibray.tracing.convergence`).
"""

# Mitsuba defines its types only when a variant is chosen, so its stubs declare these types as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from calibray.errors import EngineError
from calibray.materials import Material
from calibray.support.messages import counted
from calibray.support.progress import Progress
from calibray.tracing.settings import RAYS_PER_ROUND, TraceSettings
from calibray.tracing.sionna.buffers import TracedBuffer, aligned, drop_repeats, reverse, to_points
from calibray.tracing.sionna.image_method import (
    Meshes,
    Unobstructed,
    possible_pairs,
    sequence_keys,
    unfold_sequences,
)
from calibray.tracing.sionna.solver import Rays, Solver
from calibray.tracing.trace_plan import Launch, TracePlan, lattice_directions, launch_seed

CONVERGED_DB: Final = 0.05
"""Maximum change in a link's path loss in one round for the link to count as converged [dB]."""
QUIET_ROUNDS: Final = 2
"""Number of consecutive rounds without a change above `CONVERGED_DB` after which the search ends."""
MAX_LAUNCHES: Final = 256
"""Maximum number of launches per source: 64 million rays."""
GEOMETRY_BATCH: Final = 500_000
"""Maximum number of sequence-receiver pairs whose geometry is computed together, to limit memory use."""

_LOG: Final = logging.getLogger(__name__)


class SequenceCache:
    """Interaction sequences of the most recently traced sources.

    Sequences apply to all receivers, so rays are launched only once for all the chunks of links that a worker traces.
    """

    def __init__(self) -> None:
        self._sequences: dict[tuple[bytes, TraceSettings, tuple], SourceSequences] = {}

    def __len__(self) -> int:
        return len(self._sequences)

    def clear(self) -> None:
        """Remove all sequences."""
        self._sequences.clear()

    def of_source(
        self, solver: Solver, source: NDArray[np.float64], materials: Mapping[str, Material]
    ) -> SourceSequences:
        """The sequences of a source [3], [m], for these materials, which influence the interactions of rays."""
        key = source.tobytes(), solver.settings, tuple(materials.items())
        if key not in self._sequences:
            while len(self._sequences) >= 4:  # the latest four are kept for the next links
                del self._sequences[next(iter(self._sequences))]
            self._sequences[key] = SourceSequences(solver, source)
        return self._sequences[key]


class SourceSequences:
    """The interaction sequences found by rays from one source [3], [m], launch by launch."""

    def __init__(self, solver: Solver, source: NDArray[np.float64]) -> None:
        self.meshes = Meshes(solver.mitsuba_scene)
        self._solver, self._source = solver, source
        self._keys = np.zeros((0, 2 * solver.settings.max_depth + 2), dtype=np.int64)
        self._new_by_launch: list[PathsBuffer | None] = []

    def new_in_launch(self, number: int, max_paths: int) -> PathsBuffer | None:
        """The sequences first found in launch `number`, or None if there are none; the launch is run if needed."""
        while len(self._new_by_launch) <= number:
            sequences = self._launch(len(self._new_by_launch), max_paths)
            self._keys, new = _merge(self._keys, sequence_keys(sequences, self.meshes))
            self._new_by_launch.append(
                sequences.gather(mi.UInt(aligned(new, np.uint32))) if len(new) else None
            )
        return self._new_by_launch[number]

    def _launch(self, number: int, max_paths: int) -> PathsBuffer:
        """Send the rays of launch `number`."""
        seed = self._solver.settings.seed
        # Each launch after the first shifts the lattice by a random vector, modulo the unit square.
        shift = np.random.default_rng([seed, number]).random((2, 1)) * (number > 0)
        rays = Rays(
            count=RAYS_PER_ROUND,
            seed=launch_seed(seed, number),
            directions=(lattice_directions(0, RAYS_PER_ROUND, RAYS_PER_ROUND) + shift) % 1.0,
            direct=False,
            buffer_size=100_000,
            max_paths=max_paths,
        )
        # Sionna needs a target; in an unobstructed scene, any target will do.
        any_target = to_points(np.zeros((1, 3)))
        scene = Unobstructed(self._solver.mitsuba_scene)
        return self._solver.find_candidates(scene, to_points(self._source[None]), any_target, rays)


@dataclass(frozen=True, eq=False)
class AdaptiveSearch:
    """A search for the paths of links, with rays added in rounds.

    Attributes:
        solver: The solver, in which the material constants are already set.
        cache: Sequences that earlier searches found.
        materials: Material constants of the trace.
        backwards: Whether the receivers send the rays.
        max_paths: Number of paths that fit into memory.
    """

    solver: Solver
    cache: SequenceCache
    materials: Mapping[str, Material]
    backwards: bool
    max_paths: int

    def run(
        self, plan: TracePlan, targets: NDArray[np.float64], progress: Progress | None
    ) -> tuple[tuple[TracedBuffer, ...], dict[str, object]]:
        """Find the paths from the source of every launch to the other ends of the links [L, 3], [m].

        Returns the paths, and a record of the maximum number of rays per source and the maximum change in the path loss
        of any link in the last round. `progress` is called before the first source and after each source.

        Raises:
            EngineError: The paths do not fit into memory.
        """
        done = 0
        if progress is not None:
            progress("tracing", 0, len(targets))
        traced: list[TracedBuffer] = []
        searches: list[_SourceSearch] = []
        for launch in plan.launches:
            left = self.max_paths - sum(len(part.link) for part in traced)
            sequences = self.cache.of_source(self.solver, launch.source, self.materials)
            source_search = _SourceSearch(self, sequences, launch, targets[launch.links], left)
            source_search.run()
            searches.append(source_search)
            traced += source_search.traced
            done += len(launch.links)
            if progress is not None:
                progress("tracing", done, len(targets))
        return tuple(traced), {
            "rays": max(source_search.rays for source_search in searches),
            "last_round_db": max(source_search.change_db for source_search in searches),
        }


class _SourceSearch:
    """The search for the paths between one source and its targets [R, 3], [m]."""

    def __init__(
        self,
        search: AdaptiveSearch,
        sequences: SourceSequences,
        launch: Launch,
        targets: NDArray[np.float64],
        max_paths: int,
    ) -> None:
        self._solver, self._backwards = search.solver, search.backwards
        self._sequences, self._launch, self._targets = sequences, launch, targets
        self._max_paths = max_paths
        self.traced: list[TracedBuffer] = []
        self.rays = 0
        self.change_db = 0.0

    def run(self) -> None:
        """Find the paths, round by round."""
        power = self._keep([self._direct_paths()])
        if self._solver.settings.max_depth == 0:
            return
        launches, quiet = 0, 0
        while quiet < QUIET_ROUNDS and launches < MAX_LAUNCHES:
            parts: list[TracedBuffer] = []
            # Each round has as many launches as all previous rounds together.
            for _ in range(max(launches, 1)):
                sequences = self._sequences.new_in_launch(launches, self._max_paths)
                launches += 1
                if sequences is not None:
                    parts += self._paths_of(sequences)
            gained = self._keep(parts)
            # The change is inf for a link without an earlier path, and 0 for a link that gained no path.
            with np.errstate(divide="ignore", invalid="ignore"):
                change_db = np.where(gained > 0, 10 * np.log10((power + gained) / power), 0.0)
            self.rays, self.change_db = launches * RAYS_PER_ROUND, float(change_db.max())
            power += gained
            quiet = quiet + 1 if self.change_db <= CONVERGED_DB else 0
        # The launch limit may also be reached after one quiet round; in this case, no warning is needed.
        if quiet < QUIET_ROUNDS and self.change_db > CONVERGED_DB:
            x, y, z = self._launch.source.tolist()
            _LOG.warning(
                "After %s rays from position (%.1f, %.1f, %.1f) m, the last round still changed path loss by up to "
                "%.2f dB, more than the tolerance of %g dB, so paths may be missing; if this matters, reduce "
                "trace.max_depth",
                f"{self.rays:,}", x, y, z, self.change_db, CONVERGED_DB,
            )  # fmt: skip

    def _direct_paths(self) -> TracedBuffer:
        """Find the paths without interactions."""
        source, target = to_points(self._launch.source[None]), to_points(self._targets)
        rays = Rays(
            count=0,
            seed=0,
            directions=None,
            direct=self._solver.settings.line_of_sight,
            buffer_size=len(self._targets) + 2,
            max_paths=self._max_paths,
        )
        candidates = self._solver.find_candidates(self._solver.mitsuba_scene, source, target, rays)
        return self._trace_candidates(candidates)

    def _paths_of(self, sequences: PathsBuffer) -> list[TracedBuffer]:
        """Find the paths with the given interaction sequences to all receivers."""
        unfolded = unfold_sequences(sequences, self._launch.source, self._sequences.meshes)
        pairs = list(possible_pairs(unfolded, self._targets))
        sequence, target = (np.concatenate(part) for part in zip(*pairs, strict=True))
        traced = []
        for start in range(0, len(sequence), GEOMETRY_BATCH):
            batch = slice(start, start + GEOMETRY_BATCH)
            candidates = sequences.gather(mi.UInt(aligned(sequence[batch], np.uint32)))
            candidates._tgt_indices = mi.UInt(aligned(target[batch], np.uint32))
            candidates.schedule()
            dr.eval()
            traced.append(self._trace_candidates(candidates))
        return traced

    def _trace_candidates(self, candidates: PathsBuffer) -> TracedBuffer:
        """Compute the paths of candidates, directed from transmitter to receiver."""
        source, target = to_points(self._launch.source[None]), to_points(self._targets)
        if self._backwards:
            candidates, source, target = reverse(candidates, target), target, source
        self._solver.compute_geometry(candidates, source, target, len(self._targets))
        end: Any = candidates.source_indices if self._backwards else candidates.target_indices
        return TracedBuffer(candidates, source, target, self._launch.links[np.array(end, dtype=np.int64)])

    def _keep(self, parts: list[TracedBuffer]) -> NDArray[np.float64]:
        """Keep the new paths, and return the power [R] that each link gained."""
        is_first = not self.traced
        # The first buffer holds the direct paths and is kept even if empty: it defines the ends of the links.
        new = [part for part in parts if len(part.link) or is_first]
        if new and not is_first:
            # Rounding may split a plane into two, so the same sequence may be tested twice.
            earlier = self.traced[1:]
            new = drop_repeats([*earlier, *new])[len(earlier) :]
        self.traced += new
        if sum(len(part.link) for part in self.traced) > self._max_paths:
            raise EngineError(
                f"more paths than fit into memory, with {counted(len(self._targets), 'receiver')} at once; reduce "
                "trace.max_depth, or trace fewer links at once"
            )
        gained = np.zeros(len(self._targets))
        # `link` contains indices among all links; powers are in the order of this launch's links.
        order = np.argsort(self._launch.links)
        for part in new:
            gain = self._solver.compute_fields(part)
            # The power is summed over receive ports and averaged over transmit ports.
            power = (np.abs(gain) ** 2).sum(axis=1).mean(axis=1)
            target = order[np.searchsorted(self._launch.links[order], part.link)]
            gained += np.bincount(target, power, len(self._targets))
        return gained


def _merge(
    known: NDArray[np.int64], candidates: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Merge the keys of sequences; return all keys [n, k] and the indices of the new candidates [m]."""
    merged, first = np.unique(np.vstack([known, candidates]), axis=0, return_index=True)
    return merged, np.sort(first[first >= len(known)] - len(known))
