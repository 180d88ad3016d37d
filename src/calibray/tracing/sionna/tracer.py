"""Finding the paths of links with Sionna RT.

Sionna's solver is a chain of stages: candidates by shooting and bouncing, exact geometry by the image method, fields.
The first two never depend on what is calibrated, so their result is kept (`Trace`) and compiled into a path program.
The third stage remains at hand as the rival that replay is measured and tested against.

Receivers, and rays if need be, are shared out over launches (`calibray.tracing.launches`): Sionna's path buffer is
shared by all receivers of a source, and its memory grows with samples x depth x receivers (NVlabs/sionna#1172). A
buffer that filled up is traced again, larger.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from sionna.rt.path_solvers.field_calculator import FieldCalculator
from sionna.rt.path_solvers.image_method import ImageMethod
from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator
from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.paths import Paths, concatenate
from calibray.paths.chains import Chains, compile_chains, zenith_azimuth
from calibray.scenes import Scene, check_material_name, read_scene
from calibray.tracing.launches import Launch, Plan, paths_that_fit, plan
from calibray.tracing.memory import available
from calibray.tracing.settings import Antenna, TraceSettings, as_antenna
from calibray.tracing.sionna.antennas import jones_vectors, patterns_of, turned
from calibray.tracing.sionna.arrays import aligned, gather, per_interaction, points, to_complex, vertices_of
from calibray.tracing.sionna.chunks import Chunk, share_of_rays, without_repeats
from calibray.tracing.sionna.loading import load, scattering_pattern, shape_materials

LANES: Final = 20_000_000  # samples x depth x receivers of one launch
BUFFER: Final = 1_000_000  # paths that the buffer of one launch holds at first
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

Progress = Callable[[int, int], None]


class Links(Protocol):
    """Anything with transmitter and receiver positions [L, 3], [m]; `Measurements` above all."""

    @property
    def tx(self) -> np.ndarray: ...  # noqa: D102
    @property
    def rx(self) -> np.ndarray: ...  # noqa: D102


def trace(
    scene: str | Path | Scene,
    measurements: Links,
    *,
    frequency: float,
    tx_antenna: Antenna | Mapping[str, object] | None = None,
    rx_antenna: Antenna | Mapping[str, object] | None = None,
    materials: Mapping[str, Material | Mapping[str, object]] | None = None,
    progress: Progress | None = None,
    **settings: int | bool,
) -> Paths:
    """Find the paths of every link and compile them.

    Args:
        scene: Mitsuba XML file, `sionna:NAME` for a bundled scene, or a scene already read.
        measurements: The links; their values and carriers are not looked at (for another carrier, `Paths.at`).
        frequency: Carrier frequency [Hz].
        tx_antenna: Transmit antenna, as `Antenna` or a mapping with its attributes.
        rx_antenna: Receive antenna.
        materials: Constants in place of the scene's, by material name.
        progress: Called with (receivers traced, receivers in all) after every launch.
        **settings: The attributes of `TraceSettings`.

    Returns:
        The path program; `links_without_path` tells which links it cannot say anything about.

    Raises:
        InputError: The scene, an antenna, a setting or a position cannot be used.
        EngineError: There are more paths than fit into memory.
    """
    tracer = Tracer(
        scene if isinstance(scene, Scene) else read_scene(scene, frequency, materials),
        frequency,
        _settings(settings),
        as_antenna(tx_antenna),
        as_antenna(rx_antenna),
    )
    return tracer.trace(measurements, progress).paths()


def _settings(settings: Mapping[str, int | bool]) -> TraceSettings:
    unknown = set(settings) - set(TraceSettings().record())
    if unknown:
        raise InputError(
            f"trace: unknown setting {sorted(unknown)[0]!r}; known: {', '.join(TraceSettings().record())}"
        )
    return TraceSettings(**settings)  # type: ignore[arg-type]


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
        self._tx_patterns, self._rx_patterns = patterns_of(tx_antenna), patterns_of(rx_antenna)
        self._scene = load(scene)
        self._scene.frequency = self.frequency
        self._shape_material = shape_materials(self._scene)
        self._candidates, self._images = SBDeterministicCandidateGenerator(), ImageMethod()
        self._fields = FieldCalculator()
        self.set_materials(scene.materials)

    def set_materials(self, materials: Mapping[str, Material]) -> None:
        """Give Sionna's materials other constants.

        Args:
            materials: Constants by material name; materials not named keep theirs.

        Raises:
            InputError: The scene has no material of a name.
        """
        names = list(self.scene.materials)
        for name, material in materials.items():
            check_material_name(name, self.scene.materials, "materials")
            target = self._scene.radio_materials[f"calibray-{names.index(name)}"]
            for constant in FLOATS:  # opaque: a literal would be compiled into the kernels
                setattr(target, constant, dr.opaque(mi.Float, getattr(material, constant)))
            target.scattering_pattern = scattering_pattern(material)

    def plan(self, links: Links) -> Plan:
        """How the links will be traced.

        Args:
            links: The links.

        Returns:
            The launches, with an estimate of the memory that they take.

        Raises:
            InputError: There is no link, a position is not finite, or a link's ends coincide.
        """
        return plan(_positions(links)[0], self.settings, LANES, BUFFER)

    def trace(self, links: Links, progress: Progress | None = None) -> Trace:
        """Find the paths of every link with the present materials.

        Args:
            links: The links.
            progress: Called with (receivers traced, receivers in all) after every launch.

        Returns:
            The paths in Sionna's buffers.

        Raises:
            InputError: There is no link, a position is not finite, or a link's ends coincide.
            EngineError: There are more paths than fit into memory.
        """
        tx, rx = _positions(links)
        room = paths_that_fit(available(), self.settings.max_depth)
        chunks: list[Chunk] = []
        pieces: list[Chunk] = []
        found = done = 0
        for launch in self.plan(links).launches:
            pieces.append(self._trace_launch(launch, rx[launch.links], room - found))
            found += len(pieces[-1].link)
            if launch.last:
                chunks += without_repeats(pieces)
                pieces = []
                done += len(launch.links)
            if progress is not None:
                progress(done, len(rx))
        return Trace(self, tx, rx, tuple(chunks))

    def enclosed(self, points: np.ndarray) -> np.ndarray:
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
            hit = self._scene.mi_scene.ray_intersect(ray, mi.Bool(active))
            active &= np.array(hit.is_valid(), dtype=bool)
            if not active.any():
                break
            odd ^= active
            ray = hit.spawn_ray(ray.d)
            dr.eval(ray)
        return odd.reshape(len(points), -1).mean(axis=1) > 0.5

    def _trace_launch(self, launch: Launch, targets: np.ndarray, room: int) -> Chunk:
        settings, size = self.settings, BUFFER
        most = (launch.rays * settings.max_depth + 1) * len(targets) + 2  # a path a lane, and the direct ones
        src, tgt = points(launch.source[None]), points(targets)
        while True:
            with share_of_rays(launch, settings.samples):
                buffer = self._candidates(
                    mi_scene=self._scene.mi_scene,
                    src_positions=src,
                    tgt_positions=tgt,
                    samples_per_src=launch.rays,
                    max_num_paths_per_src=size,
                    max_depth=settings.max_depth,
                    los=settings.line_of_sight and launch.first == 0,
                    specular_reflection=settings.specular_reflection,
                    diffuse_reflection=settings.diffuse_reflection,
                    refraction=settings.refraction,
                    diffraction=settings.diffraction,
                    edge_diffraction=settings.edge_diffraction,
                    seed=launch.seed,
                )
                buffer.schedule()
                dr.eval()
            count = int(np.array(buffer.paths_counter).item())
            if count > room:
                raise EngineError(
                    f"more paths than fit into memory, with {len(targets)} receivers at work; "
                    "lower trace.samples or trace.max_depth, or trace fewer links at once"
                )
            if count < size - 1:
                break
            size = min(4 * size, most)
        buffer.shrink()
        buffer.detach_geometry()
        if buffer.buffer_size:
            buffer = self._images(
                scene=self._scene.mi_scene,
                paths=buffer,
                src_positions=src,
                tgt_positions=tgt,
                diffraction=settings.diffraction,
                diffraction_lit_region=settings.diffraction_lit_region,
            )
            buffer.discard_invalid()
            buffer.schedule()
            dr.eval()  # at once: what is left to be computed would hold on to all candidates and the whole buffer
        return Chunk(buffer, src, tgt, launch.links[np.array(buffer.target_indices, dtype=np.int64)])

    def compile(self, chunk: Chunk, tx: np.ndarray, rx: np.ndarray) -> Paths:
        """Compile one chunk into a path program.

        Args:
            chunk: Paths in Sionna's buffer.
            tx: Transmitter of every link [L, 3], [m].
            rx: Receiver of every link [L, 3], [m].

        Returns:
            The program, its paths in the buffer's order.
        """
        program = compile_chains(self._chains(chunk, tx, rx))
        departure, arrival = program.departure_direction, program.arrival_direction
        return Paths(
            frequency=self.frequency,
            materials=dict(self.scene.materials),
            tx_position=tx,
            rx_position=rx,
            link=chunk.link.astype(np.int32),
            delay=program.delay,
            spreading=program.spreading,
            departure=zenith_azimuth(departure),
            arrival=zenith_azimuth(-arrival),
            tx_field=turned(
                jones_vectors(self.tx_antenna, self._tx_patterns, departure, "out"),
                program.departure_rotation,
            ),
            rx_field=turned(
                jones_vectors(self.rx_antenna, self._rx_patterns, -arrival, "in"),
                program.arrival_rotation * [1, -1],
            ),
            first=program.first,
            kind=program.kind,
            material=program.material,
            cos_incidence=program.cos_incidence,
            rotation=program.rotation,
            diffuse=program.diffuse,
            diffraction=program.diffraction,
            settings={**self.settings.record(), "scene": self.scene.source, "sionna_rt": rt.__version__},
        )

    def _chains(self, chunk: Chunk, tx: np.ndarray, rx: np.ndarray) -> Chains:
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
                wedges, ends = buffer.diffracting_wedges, (gather(chunk.source, buffer.source_indices),
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
            samples=self.settings.samples,
            edge=wedge[0],
            normal_n=wedge[1],
            edge_lengths=wedge[2],
        )

    def field_stage(self, chunk: Chunk) -> np.ndarray:
        """Sionna's own field stage on stored paths, with the present materials.

        Args:
            chunk: Paths in Sionna's buffer.

        Returns:
            Path gains [P, R, T], complex.
        """
        if not len(chunk.link):
            return np.zeros((0, self.rx_antenna.ports, self.tx_antenna.ports), dtype=complex)
        buffer = chunk.buffer
        valid = mi.Bool(buffer.valid)
        count = dr.width(chunk.target)
        found = self._fields(
            wavelength=self._scene.wavelength,
            paths=buffer,
            samples_per_src=self.settings.samples,
            diffraction=self.settings.diffraction,
            src_positions=chunk.source,
            tgt_positions=chunk.target,
            src_orientations=points(np.array([self.tx_antenna.orientation])),
            tgt_orientations=points(np.tile(self.rx_antenna.orientation, (count, 1))),
            src_antenna_patterns=self._tx_patterns,
            tgt_antenna_patterns=self._rx_patterns,
        )
        dr.eval(found.a, found.tau)  # at once: every array read on its own would run the whole stage again
        buffer.valid = valid  # the field stage narrows it
        return np.array([[to_complex(gain) for gain in row] for row in found.a]).transpose(2, 0, 1)


@dataclass(frozen=True)
class Trace:
    """A traced campaign in Sionna's buffers.

    Attributes:
        tracer: The tracer that found it.
        tx: Transmitter of every link [L, 3], [m].
        rx: Receiver of every link [L, 3], [m].
        chunks: The paths.
    """

    tracer: Tracer
    tx: np.ndarray
    rx: np.ndarray
    chunks: tuple[Chunk, ...]

    def paths(self) -> Paths:
        """Compile the paths, ordered by link."""
        return concatenate([self.tracer.compile(chunk, self.tx, self.rx) for chunk in self.chunks])

    def link(self) -> np.ndarray:
        """Link of every path, non-decreasing [P]."""
        return np.sort(np.concatenate([chunk.link for chunk in self.chunks]), kind="stable")

    def delay(self) -> np.ndarray:
        """Sionna's propagation delays in the order of `link` [P], [s]; known once `path_gains` has run."""
        found = [
            np.array(chunk.buffer.tau, dtype=float) if len(chunk.link) else np.zeros(0)
            for chunk in self.chunks
        ]
        return np.concatenate(found)[self._order()]

    def path_gains(self) -> np.ndarray:
        """Sionna's path gains with the tracer's present materials.

        Returns:
            Gains in the order of `paths()` [P, R, T], complex.
        """
        return np.concatenate([self.tracer.field_stage(chunk) for chunk in self.chunks])[self._order()]

    def _order(self) -> np.ndarray:
        return np.argsort(np.concatenate([chunk.link for chunk in self.chunks]), kind="stable")


def _positions(links: Links) -> tuple[np.ndarray, np.ndarray]:
    tx, rx = np.asarray(links.tx, dtype=float), np.asarray(links.rx, dtype=float)
    if tx.shape != rx.shape or tx.ndim != 2 or tx.shape[1:] != (3,) or not len(tx):
        raise InputError(
            f"links: tx has the shape {tx.shape}, rx {rx.shape}; both must be [links, 3], with at least one link"
        )
    for name, position in (("tx", tx), ("rx", rx)):
        bad = np.flatnonzero(~np.isfinite(position).all(axis=1))
        if len(bad):
            raise InputError(f"link {bad[0]}: {name} position {position[bad[0]]} is not finite; give metres")
    same = np.flatnonzero(np.linalg.norm(tx - rx, axis=1) < 1e-3)
    if len(same):
        raise InputError(
            f"link {same[0]}: transmitter and receiver coincide at {tx[same[0]]}; check the columns"
        )
    return tx, rx
