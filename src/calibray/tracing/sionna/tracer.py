"""Finding the paths of links with Sionna RT.

Sionna's solver is a chain of stages: candidates by shooting and bouncing, exact geometry by the image method, fields.
The first two never depend on what is calibrated, so their result is kept (`Trace`) and compiled into a path program.
The third stage remains at hand as the rival that replay is measured and tested against.

Receivers, and rays if need be, are shared out over launches (`calibray.tracing.trace_plan`): Sionna's path buffer is
shared by all receivers of a source, and its memory grows with samples x depth x receivers (NVlabs/sionna#1172). A
buffer that filled up is traced again, larger.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from numpy.typing import NDArray
from sionna.rt.path_solvers.field_calculator import FieldCalculator
from sionna.rt.path_solvers.image_method import ImageMethod
from sionna.rt.path_solvers.paths_buffer import PathsBuffer
from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator
from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.paths import Paths
from calibray.paths.chains import Chains
from calibray.scenes import Scene, check_material_name
from calibray.support.interruption import unwrap_interruption
from calibray.support.memory import available_memory
from calibray.support.progress import Progress
from calibray.tracing.antennas import Radiator
from calibray.tracing.compilation import compile_paths
from calibray.tracing.protocol import Links, Solution, positions
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna.antennas import patterns_of
from calibray.tracing.sionna.arrays import aligned, gather, per_interaction, points, to_complex, vertices_of
from calibray.tracing.sionna.chunks import Chunk, rays_towards, without_empty_places, without_repeats
from calibray.tracing.sionna.loading import load, mitsuba_scene, scattering_pattern, shape_materials
from calibray.tracing.sionna.reciprocity import turned_around
from calibray.tracing.sionna.rounds import SourceChains, search
from calibray.tracing.sionna.stored import Trace
from calibray.tracing.trace_plan import (
    Launch,
    TracePlan,
    directions,
    paths_that_fit,
    plan_trace,
    starts_at_receivers,
)

LANES: Final = 20_000_000
"""Samples x depth x receivers of one launch."""
BUFFER: Final = 1_000_000
"""Paths that the buffer of one launch holds at first."""
# Candidates whose hashes meet in Sionna's table pass for one, and the others are lost: with its million entries 16 of
# 6,030 (100 receivers in Munich, 25 at once), with this many none. A prime: the lowest bits of FNV hashes differ least.
SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = 16_777_213
FLOATS: Final = (
    "relative_permittivity",
    "conductivity",
    "thickness",
    "scattering_coefficient",
    "xpd_coefficient",
)


class Tracer:
    """A scene loaded into Sionna RT, with antennas and settings, ready to trace links.

    Args:
        scene: The scene.
        frequency: Carrier frequency [Hz].
        settings: The tracer's switches.
        tx_antenna: Transmit antenna.
        rx_antenna: Receive antenna.

    Raises:
        InputError: Sionna cannot load the scene, the frequency is not a positive number, or an antenna's file of gains
            cannot be used.
    """

    def __init__(
        self,
        scene: Scene,
        frequency: float,
        settings: TraceSettings,
        tx_antenna: Antenna,
        rx_antenna: Antenna,
    ) -> None:
        if not (np.isfinite(frequency) and frequency > 0):
            raise InputError(f"frequency = {frequency!r}: must be a finite number of Hz greater than 0")
        self.scene, self.frequency, self.settings = scene, float(frequency), settings
        self.tx_antenna, self.rx_antenna = tx_antenna, rx_antenna
        self._radiators = Radiator.of(tx_antenna), Radiator.of(rx_antenna)
        self._tx_patterns, self._rx_patterns = patterns_of(tx_antenna), patterns_of(rx_antenna)
        self._scene = load(scene)
        self._scene.frequency = self.frequency
        self._shape_material = shape_materials(self._scene)
        self._candidates, self._images = SBDeterministicCandidateGenerator(), ImageMethod()
        self.known_chains: dict[Any, SourceChains] = {}
        self._fields = FieldCalculator()

    def with_settings(self, settings: TraceSettings) -> Tracer:
        """The tracer with other switches, on the same scene in Sionna's memory.

        Args:
            settings: The switches.

        Returns:
            Another tracer.
        """
        other = copy(self)
        other.settings = settings
        return other

    def plan(self, links: Links) -> TracePlan:
        """How the links will be traced.

        Args:
            links: The links.

        Returns:
            The launches, with an estimate of the memory that they take.

        Raises:
            InputError: There is no link, a position is not finite, or a link's ends coincide.
        """
        tx, rx = positions(links)
        return plan_trace(
            rx if starts_at_receivers(tx, rx, self.settings) else tx, self.settings, LANES, BUFFER
        )

    @unwrap_interruption()
    def trace(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Paths:
        """Find the paths of every link.

        Args:
            links: The links.
            progress: Called with ("tracing", receivers traced, receivers in all) after every launch.
            materials: Constants in place of the scene's, by name.

        Returns:
            The path program, its materials those traced with.

        Raises:
            InputError: There is no link, a position is not finite, a link's ends coincide, or the scene lacks a
                material.
            EngineError: There are more paths than fit into memory.
        """
        return self.find(links, progress, materials).paths()

    @unwrap_interruption()
    def solve(self, links: Links, materials: Mapping[str, Material]) -> Solution:
        """Find the paths of every link and compute their gains with Sionna's own field stage.

        Args:
            links: The links.
            materials: Constants in place of the scene's, by name.

        Returns:
            The gains.

        Raises:
            InputError: As for `trace`.
            EngineError: There are more paths than fit into memory.
        """
        found = self.find(links, None, materials)
        return Solution(found.path_gains(), found.link(), found.delay())

    @unwrap_interruption()
    def find(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Trace:
        """Find the paths of every link, and leave them in Sionna's buffers.

        Args:
            links: The links.
            progress: Called with ("tracing", receivers traced, receivers in all) before the first launch and after
                every one.
            materials: Constants in place of the scene's, by name.

        Returns:
            The paths in Sionna's buffers.

        Raises:
            InputError: There is no link, a position is not finite, a link's ends coincide, or the scene lacks a
                material.
            EngineError: There are more paths than fit into memory.
        """
        tx, rx = positions(links)
        backwards = starts_at_receivers(tx, rx, self.settings)
        ends = tx if backwards else rx
        constants = self.give(materials or {})
        room = paths_that_fit(available_memory(), self.settings.max_depth)
        if self.settings.adaptive:
            found, told = search(self, self.plan(links), (tx, rx), backwards, room, constants, progress)
            return Trace(self, constants, tx, rx, found, told)
        chunks: list[Chunk] = []
        pieces: list[Chunk] = []
        count = done = 0
        if progress is not None:
            progress("tracing", 0, len(rx))
        for launch in self.plan(links).launches:
            pieces.append(self._trace_launch(launch, ends[launch.links], room - count, backwards))
            count += len(pieces[-1].link)
            if launch.last:
                chunks += without_repeats(pieces)
                pieces = []
                done += len(launch.links)
            if progress is not None:
                progress("tracing", done, len(rx))
        return Trace(self, constants, tx, rx, tuple(chunks))

    @property
    def mitsuba(self) -> Any:
        """The scene that Mitsuba holds."""
        return mitsuba_scene(self._scene)

    def give(self, materials: Mapping[str, Material]) -> dict[str, Material]:
        """Give Sionna's materials the scene's constants, some of them replaced.

        Args:
            materials: Constants in place of the scene's, by name.

        Returns:
            The constants of all materials.

        Raises:
            InputError: The scene has no material of a name.
        """
        for name in materials:
            check_material_name(name, self.scene.materials, "materials")
        constants = {**self.scene.materials, **materials}
        for index, material in enumerate(constants.values()):
            target = self._scene.radio_materials[f"calibray-{index}"]
            # Opaque: a literal would be compiled into the kernels.
            for constant in FLOATS:
                setattr(target, constant, dr.opaque(mi.Float, getattr(material, constant)))
            target.scattering_pattern = scattering_pattern(material)
        return constants

    @unwrap_interruption()
    def enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points lie inside closed bodies of the scene, such as buildings.

        Rays that rise in several directions cross a closed body's surface an odd number of times; the majority
        decides, as scenes have gaps. Rays rise because buildings often lack a floor. A room counts as a body too.

        Args:
            points: Positions [n, 3], [m].

        Returns:
            True where enclosed [n].
        """
        azimuth, elevation = np.meshgrid(np.linspace(0.1, 2 * np.pi, 6), np.radians([25.0, 50.0, 75.0]))
        rise = np.stack(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        rise = rise.reshape(3, -1)
        origin = np.repeat(np.asarray(points, dtype=float), rise.shape[1], axis=0)
        ray = mi.Ray3f(mi.Point3f(*origin.T), mi.Vector3f(*np.tile(rise, len(points))))
        odd, active = np.zeros(len(origin), dtype=bool), np.ones(len(origin), dtype=bool)
        for _ in range(64):
            hit = mitsuba_scene(self._scene).ray_intersect(ray, mi.Bool(active))
            active &= np.array(hit.is_valid(), dtype=bool)
            if not active.any():
                break
            odd ^= active
            ray = hit.spawn_ray(ray.d)
            dr.eval(ray)
        return odd.reshape(len(points), -1).mean(axis=1) > 0.5

    def _trace_launch(
        self, launch: Launch, targets: NDArray[np.float64], room: int, backwards: bool
    ) -> Chunk:
        samples = self.settings.rays
        share = directions(launch.first, launch.rays, samples) if launch.rays < samples else None
        src, tgt = points(launch.source[None]), points(targets)
        direct = self.settings.line_of_sight and launch.first == 0
        with rays_towards(share):
            buffer = self.candidates(self.mitsuba, src, tgt, launch.rays, launch.seed, direct, BUFFER, room)
        if backwards:
            buffer, src, tgt = turned_around(buffer, tgt), tgt, src
        self.settle(buffer, src, tgt)
        end = buffer.source_indices if backwards else buffer.target_indices
        return Chunk(buffer, src, tgt, launch.links[np.array(end, dtype=np.int64)])

    def candidates(
        self,
        scene: Any,
        source: mi.Point3f,
        targets: mi.Point3f,
        rays: int,
        seed: int,
        direct: bool,
        size: int,
        room: int,
    ) -> PathsBuffer:
        """Send out rays, and keep what may be a path.

        Args:
            scene: Mitsuba's scene, or what answers as it does.
            source: Where the rays start.
            targets: Where paths are to end.
            rays: Number of rays.
            seed: Seed of the random numbers.
            direct: Whether direct paths are looked for.
            size: Candidates that the buffer holds at first.
            room: Candidates that fit into memory.

        Returns:
            The candidates.

        Raises:
            EngineError: There are more than fit into memory.
        """
        settings, count = self.settings, dr.width(targets)
        # A path a lane, and the direct ones.
        most = (rays * settings.max_depth + 1) * count + 2
        while True:
            buffer = self._candidates(
                mi_scene=scene,
                src_positions=source,
                tgt_positions=targets,
                samples_per_src=max(rays, 1),
                max_num_paths_per_src=size,
                max_depth=settings.max_depth if rays else 0,
                los=direct,
                specular_reflection=settings.specular_reflection,
                diffuse_reflection=settings.diffuse_reflection,
                refraction=settings.refraction,
                diffraction=settings.diffraction,
                edge_diffraction=settings.edge_diffraction,
                seed=seed,
            )
            buffer.schedule()
            dr.eval()
            found = int(np.array(buffer.paths_counter).item())
            if found > room:
                raise EngineError(
                    f"more paths than fit into memory, with {count} receivers at work; "
                    "lower trace.samples or trace.max_depth, or trace fewer links at once"
                )
            if found < size - 1:
                break
            size = min(4 * size, most)
        buffer.shrink()
        buffer.detach_geometry()
        return without_empty_places(buffer)

    def settle(self, buffer: PathsBuffer, source: mi.Point3f, target: mi.Point3f) -> None:
        """Compute the geometry of candidates by the method of images, and leave those that are paths.

        Args:
            buffer: The candidates; changed.
            source: Where their sources stand.
            target: Where their targets stand.
        """
        if not buffer.buffer_size:
            return
        self._images(
            scene=mitsuba_scene(self._scene),
            paths=buffer,
            src_positions=source,
            tgt_positions=target,
            diffraction=self.settings.diffraction,
            diffraction_lit_region=self.settings.diffraction_lit_region,
        )
        buffer.discard_invalid()
        buffer.schedule()
        # At once: what is left to be computed would hold on to all candidates and the whole buffer.
        dr.eval()

    def compile(
        self,
        chunk: Chunk,
        tx: NDArray[np.float64],
        rx: NDArray[np.float64],
        materials: Mapping[str, Material],
    ) -> Paths:
        """Compile one chunk into a path program.

        Args:
            chunk: Paths in Sionna's buffer.
            tx: Transmitter of every link [L, 3], [m].
            rx: Receiver of every link [L, 3], [m].
            materials: The constants that they were found with.

        Returns:
            The program, its paths ordered by link.
        """
        return compile_paths(
            self._chains(chunk, tx, rx),
            chunk.link,
            tx,
            rx,
            frequency=self.frequency,
            materials=materials,
            antennas=self._radiators,
            settings={**self.settings.record(), "scene": self.scene.source, "sionna_rt": rt.__version__},
        )

    def _chains(self, chunk: Chunk, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> Chains:
        buffer, count = chunk.buffer, len(chunk.link)
        depth = buffer.depth_dim_size
        shape, of_path = np.unique(np.array(buffer.shapes, dtype=np.int64), return_inverse=True)
        material = np.array([self._shape_material.get(key, 0) for key in shape.tolist()], dtype=np.int64)
        normal = np.zeros((count, depth, 3))
        wedge = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2))
        kind = per_interaction(buffer, "interaction_types")
        if count and kind.any():
            for step in range(depth):
                active = mi.Bool(aligned(kind[:, step] != 0, np.bool_))
                found = buffer.get_primitive_props(mi.UInt(step + 1), True, False, active)
                normal[:, step] = np.array(found, dtype=float).T.reshape(-1, 3)
            if self.settings.diffraction:
                # Not typed by Sionna but for None, which stands where nothing diffracts.
                wedges: Any = buffer.diffracting_wedges
                ends = (gather(chunk.source, buffer.source_indices),
                                                           gather(chunk.target, buffer.target_indices))  # fmt: skip
                after, before = self._fields._diffraction_compute_s_s_prime(buffer, *ends)
                wedge = (
                    np.array(wedges.e_hat, dtype=float).T,
                    np.array(wedges.nn, dtype=float).T,
                    np.stack([np.array(before, dtype=float), np.array(after, dtype=float)], axis=1),
                )
        return Chains(
            source=tx[chunk.link],
            target=rx[chunk.link],
            vertex=vertices_of(buffer),
            normal=normal,
            kind=kind,
            material=material[of_path].reshape(count, depth),
            probability=np.array(buffer.probs, dtype=float).reshape(count, depth),
            samples=self.settings.rays,
            edge=wedge[0],
            normal_n=wedge[1],
            edge_lengths=wedge[2],
        )

    def field_stage(self, chunk: Chunk) -> NDArray[np.complex128]:
        """Sionna's own field stage on stored paths, with the constants given last.

        Args:
            chunk: Paths in Sionna's buffer.

        Returns:
            Path gains [P, R, T], complex.
        """
        if not len(chunk.link):
            return np.zeros((0, self.rx_antenna.ports, self.tx_antenna.ports), dtype=complex)
        buffer = chunk.buffer
        valid = mi.Bool(buffer.valid)
        ends = dr.width(chunk.source), dr.width(chunk.target)
        found: Any = self._fields(
            wavelength=self._scene.wavelength,
            paths=buffer,
            samples_per_src=self.settings.rays,
            diffraction=self.settings.diffraction,
            src_positions=chunk.source,
            tgt_positions=chunk.target,
            src_orientations=points(np.tile(self.tx_antenna.orientation, (ends[0], 1))),
            tgt_orientations=points(np.tile(self.rx_antenna.orientation, (ends[1], 1))),
            src_antenna_patterns=self._tx_patterns,
            tgt_antenna_patterns=self._rx_patterns,
        )
        # At once: every array read on its own would run the whole stage again.
        dr.eval(found.a, found.tau)
        # The field stage narrows it.
        buffer.valid = valid
        return np.array([[to_complex(gain) for gain in row] for row in found.a]).transpose(2, 0, 1)
