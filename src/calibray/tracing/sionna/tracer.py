"""Sionna RT as a `Tracer`: finds the paths of links and compiles them.

All receivers of a source share Sionna's path buffer, whose memory grows with samples x depth x receivers
(NVlabs/sionna#1172). Receivers, and rays if needed, are therefore divided among launches
(`calibray.tracing.trace_plan`). A launch that fills its buffer is repeated with a larger buffer.
"""

# Mitsuba defines its types only when a variant is chosen, so its stubs declare these types as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Final

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from calibray.materials import Material
from calibray.paths import Paths, concatenate
from calibray.scenes import Scene
from calibray.support.interruption import unwrap_interruption
from calibray.support.memory import available_memory
from calibray.support.progress import Progress
from calibray.tracing.protocol import LinkPositions, Links, Solution, link_positions
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna.adaptive_sampling import AdaptiveSearch, SequenceCache
from calibray.tracing.sionna.buffers import TracedBuffer, drop_repeats, reverse, to_points
from calibray.tracing.sionna.solver import Rays, Solver
from calibray.tracing.trace_plan import (
    Launch,
    TracePlan,
    lattice_directions,
    pad_receivers,
    paths_that_fit,
    plan_trace,
    starts_at_receivers,
)

LANES: Final = 20_000_000
"""Maximum product of the numbers of rays, interactions and receivers in one launch."""
BUFFER: Final = 1_000_000
"""Initial capacity of the buffer of one launch [paths]."""


@dataclass(frozen=True, eq=False)
class Trace:
    """The traced paths of links in Sionna's buffers, ready to be compiled or evaluated.

    Attributes:
        solver: The solver that found the paths.
        materials: The constants with which the paths were found, by material name.
        tx: Transmitter of every link [L, 3], [m].
        rx: Receiver of every link [L, 3], [m].
        buffers: The paths.
        record: Entries for the settings of the path program: the number of rays and the convergence of an adaptive
            search.
    """

    solver: Solver
    materials: dict[str, Material]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    buffers: tuple[TracedBuffer, ...]
    record: Mapping[str, object] = field(default_factory=dict)

    def paths(self) -> Paths:
        """Compile the paths, ordered by link."""
        origin = self.solver.origin
        ends = LinkPositions(self.tx - origin, self.rx - origin)
        paths = concatenate([self.solver.compile(part, ends, self.materials) for part in self.buffers])
        if origin.any():
            # Positions and vertices are in double precision, because single precision would round vertices by up to
            # half a metre.
            paths = replace(paths, tx_position=self.tx, rx_position=self.rx, vertex=paths.vertex + origin)
        return replace(paths, settings={**paths.settings, **self.record})

    def link(self) -> NDArray[np.integer]:
        """Link of every path, non-decreasing [P]."""
        return self._all_links()[self._order()]

    def delay(self) -> NDArray[np.float64]:
        """Sionna's propagation delays [P], [s], in the order of `link`; available after `path_gains` has run."""
        delays = [
            np.array(part.buffer.tau, dtype=float) if len(part.link) else np.zeros(0) for part in self.buffers
        ]
        return np.concatenate(delays)[self._order()]

    def path_gains(self, materials: Mapping[str, Material] | None = None) -> NDArray[np.complex128]:
        """Path gains [P, R, T] from Sionna's field stage, in the order of `paths()`.

        `materials` gives, by name, constants that replace those used for the trace.
        """
        self.solver.set_materials({**self.materials, **(materials or {})})
        return np.concatenate([self.solver.compute_fields(part) for part in self.buffers])[self._order()]

    def _all_links(self) -> NDArray[np.integer]:
        return np.concatenate([part.link for part in self.buffers])

    def _order(self) -> NDArray[np.int64]:
        return np.argsort(self._all_links(), kind="stable")


class Tracer:
    """A scene loaded into Sionna RT, with antennas and settings, ready to trace links.

    Args:
        scene: The scene.
        frequency: Carrier frequency [Hz].
        settings: The tracer's settings.
        tx_antenna: Transmit antenna.
        rx_antenna: Receive antenna.

    Raises:
        InputError: Sionna cannot load the scene, the frequency is out of range, or an antenna's gain table cannot be
            used.
    """

    def __init__(
        self,
        scene: Scene,
        frequency: float,
        settings: TraceSettings,
        tx_antenna: Antenna,
        rx_antenna: Antenna,
    ) -> None:
        self.solver = Solver(scene, frequency, settings, tx_antenna, rx_antenna)
        self.sequence_cache = SequenceCache()

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self.solver.scene

    @property
    def frequency(self) -> float:
        """Carrier frequency [Hz]."""
        return self.solver.frequency

    @property
    def settings(self) -> TraceSettings:
        """The tracer's settings."""
        return self.solver.settings

    def with_settings(self, settings: TraceSettings) -> Tracer:
        """Copy the tracer, with different settings; the copy shares the loaded scene."""
        other = copy(self)
        other.solver = self.solver.with_settings(settings)
        return other

    def plan(self, links: Links) -> TracePlan:
        """Plan the launches of a trace in the local frame; see `calibray.tracing.protocol.Tracer.plan`."""
        tx, rx = link_positions(links)
        sources = rx if starts_at_receivers(tx, rx, self.settings) else tx
        return plan_trace(sources - self.solver.origin, self.settings, LANES, BUFFER)

    @unwrap_interruption()
    def trace(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Paths:
        """Find the paths of every link and compile them; see `calibray.tracing.protocol.Tracer.trace`."""
        paths = self.find_paths(links, progress, materials).paths()
        # Dr.Jit keeps freed buffers for its next kernel; after a trace of a million rays, these buffers occupy 1.7 GB.
        dr.flush_malloc_cache()
        return paths

    @unwrap_interruption()
    def solve(self, links: Links, materials: Mapping[str, Material]) -> Solution:
        """Find the paths of every link and compute their gains with Sionna's field stage."""
        trace = self.find_paths(links, None, materials)
        return Solution(trace.path_gains(), trace.link(), trace.delay())

    @unwrap_interruption()
    def find_paths(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Trace:
        """Find the paths of every link and keep them in Sionna's buffers; the arguments are those of `trace`."""
        tx, rx = link_positions(links)
        backwards = starts_at_receivers(tx, rx, self.settings)
        targets = (tx if backwards else rx) - self.solver.origin
        constants = self.solver.set_materials(materials or {})
        plan = self.plan(links)
        max_paths = paths_that_fit(available_memory(), self.settings.max_depth)
        if self.settings.adaptive:
            search = AdaptiveSearch(self.solver, self.sequence_cache, constants, backwards, max_paths)
            buffers, record = search.run(plan, targets, progress)
            return Trace(self.solver, constants, tx, rx, buffers, record)

        traced: list[TracedBuffer] = []
        same_receivers: list[
            TracedBuffer
        ] = []  # of consecutive launches among which the rays to the same receivers are divided
        num_paths = done = 0
        if progress is not None:
            progress("tracing", 0, len(rx))
        for launch in plan.launches:
            part = self._trace_launch(launch, targets[launch.links], backwards, max_paths - num_paths)
            same_receivers.append(part)
            num_paths += len(part.link)
            if launch.last:
                traced += drop_repeats(same_receivers)
                same_receivers = []
                done += len(launch.links)
            if progress is not None:
                progress("tracing", done, len(rx))
        return Trace(self.solver, constants, tx, rx, tuple(traced))

    def _trace_launch(
        self, launch: Launch, targets: NDArray[np.float64], backwards: bool, max_paths: int
    ) -> TracedBuffer:
        settings = self.settings
        share = None
        if launch.rays < settings.rays:
            share = lattice_directions(launch.first, launch.rays, settings.rays)
        rays = Rays(
            count=launch.rays,
            seed=launch.seed,
            directions=share,
            # Among launches to the same receivers, only the first searches for direct paths.
            direct=settings.line_of_sight and launch.first == 0,
            buffer_size=BUFFER,
            max_paths=max_paths,
        )
        source = to_points(launch.source[None])
        target = to_points(pad_receivers(targets, launch.rays * settings.max_depth))
        buffer = self.solver.find_candidates(self.solver.mitsuba_scene, source, target, rays)
        if backwards:
            buffer, source, target = reverse(buffer, target), target, source
        self.solver.compute_geometry(buffer, source, target, len(targets))
        # After reversal, the receivers of the launch are the sources of the paths.
        end = buffer.source_indices if backwards else buffer.target_indices
        return TracedBuffer(buffer, source, target, launch.links[np.array(end, dtype=np.int64)])

    @unwrap_interruption()
    def enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether each point [n, 3], [m], lies inside a closed body of the scene, for example a building; shape [n].

        A ray from inside a closed body crosses its surface an odd number of times. Because surfaces can have gaps, rays
        are sent in several directions, and the majority decides. All rays point upwards, because buildings often lack a
        floor. A room is also a closed body.
        """
        azimuth, elevation = np.meshgrid(np.linspace(0.1, 2 * np.pi, 6), np.radians([25.0, 50.0, 75.0]))
        directions = np.stack(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        ).reshape(3, -1)
        local = np.asarray(points, dtype=float) - self.solver.origin
        origin = np.repeat(local, directions.shape[1], axis=0)
        ray = mi.Ray3f(mi.Point3f(*origin.T), mi.Vector3f(*np.tile(directions, len(points))))
        odd, active = np.zeros(len(origin), dtype=bool), np.ones(len(origin), dtype=bool)
        # At every surface, a ray passes from inside to outside or vice versa.
        for _ in range(64):
            hit = self.solver.mitsuba_scene.ray_intersect(ray, mi.Bool(active))
            active &= np.array(hit.is_valid(), dtype=bool)
            if not active.any():
                break
            odd ^= active
            ray = hit.spawn_ray(ray.d)
            dr.eval(ray)
        return odd.reshape(len(points), -1).mean(axis=1) > 0.5
