"""Sionna RT's solver, stage by stage: candidate paths from rays, exact geometry from the method of images, and fields.

The first two stages depend on the material constants only through the choice of a ray's next interaction. The paths
from these two stages are therefore kept and compiled into a path program. The field stage is the reference against
which replay is tested.
"""

# Mitsuba defines its types only when a variant is chosen, so its stubs declare these types as plain objects.
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Final

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from numpy.typing import NDArray
from sionna.rt.path_solvers import sb_deterministic
from sionna.rt.path_solvers.field_calculator import FieldCalculator
from sionna.rt.path_solvers.image_method import ImageMethod
from sionna.rt.path_solvers.paths_buffer import PathsBuffer
from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator
from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

from calibray.errors import EngineError
from calibray.materials import SCALAR_CONSTANTS, Material, check_frequency
from calibray.paths import Paths
from calibray.paths.chains import Chains
from calibray.scenes import Scene, check_material_name
from calibray.support.messages import counted
from calibray.tracing.antennas import AntennaPattern
from calibray.tracing.protocol import Links, compile_paths
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna.buffers import (
    TracedBuffer,
    aligned,
    drop_empty_entries,
    normals_at,
    per_interaction,
    to_numpy,
    to_numpy_complex,
    to_points,
    vertices_of,
)
from calibray.tracing.sionna.scene import antenna_patterns, load_scene, scattering_pattern, shape_ids
from calibray.tracing.trace_plan import SMALL_LAUNCH

HASHES: Final = (16_777_213, 67_108_859)
"""Numbers of entries in Sionna's hash table, for small and for large launches. Sionna drops candidates whose hashes
collide. Of 31,430 candidates in a launch to 25 receivers, Sionna drops 1,067 with its default of one million entries,
36 with 16 million, and 4 with 67 million. A table of 67 million entries takes 0.5 GB and 0.3 s per launch. The numbers
are primes, because the lowest bits of the hashes vary least."""


@dataclass(frozen=True, eq=False)
class Rays:
    """The rays to launch, and the size of the buffer for the candidate paths that they find.

    Attributes:
        count: Number of rays; with 0, only direct paths are searched for.
        seed: Seed of the random numbers.
        directions: Directions as points of the unit square [2, count]; Sionna's own lattice if None.
        direct: Whether direct paths are also searched for.
        buffer_size: Initial size of the buffer [candidates]; a full buffer is replaced by a larger one.
        max_paths: Number of candidates that fit into memory.
    """

    count: int
    seed: int
    directions: NDArray[np.float64] | None
    direct: bool
    buffer_size: int
    max_paths: int


class Solver:
    """The stages of Sionna RT's solver for one loaded scene; arguments and errors are the same as in `Tracer`."""

    def __init__(
        self,
        scene: Scene,
        frequency: float,
        settings: TraceSettings,
        tx_antenna: Antenna,
        rx_antenna: Antenna,
    ) -> None:
        self.scene, self.frequency, self.settings = scene, check_frequency(frequency), settings
        self.tx_antenna, self.rx_antenna = tx_antenna, rx_antenna
        self._patterns = AntennaPattern.of(tx_antenna), AntennaPattern.of(rx_antenna)
        self._tx_functions, self._rx_functions = antenna_patterns(tx_antenna), antenna_patterns(rx_antenna)
        # All positions below are in this local frame (`Scene.local_origin`).
        self.origin = scene.local_origin
        self._scene = load_scene(scene)
        self._scene.frequency = self.frequency
        # The names of Sionna's materials end with the index of the material (`Scene.xml`).
        self._material_of_shape = {
            key: int(shape.bsdf().name.split("-")[-1]) for key, shape in shape_ids(self.mitsuba_scene).items()
        }
        self._generate_candidates = SBDeterministicCandidateGenerator()
        self._apply_image_method = ImageMethod()
        self._calculate_fields = FieldCalculator()

    @property
    def mitsuba_scene(self) -> Any:
        """The scene in Mitsuba; neither Sionna nor Mitsuba provides types for it."""
        return self._scene.mi_scene

    def with_settings(self, settings: TraceSettings) -> Solver:
        """Copy the solver, with different settings; the copy shares the loaded scene."""
        other = copy(self)
        other.settings = settings
        return other

    def set_materials(self, materials: Mapping[str, Material]) -> dict[str, Material]:
        """Set the constants of Sionna's materials, either as given or from the scene, and return all constants."""
        for name in materials:
            check_material_name(name, self.scene.materials, "materials")
        constants = {**self.scene.materials, **materials}
        for index, material in enumerate(constants.values()):
            target = self._scene.radio_materials[f"calibray-{index}"]
            # The constants are opaque, because Dr.Jit would compile literals into its kernels.
            for constant in SCALAR_CONSTANTS:
                setattr(target, constant, dr.opaque(mi.Float, getattr(material, constant)))
            target.scattering_pattern = scattering_pattern(material)
        return constants

    def find_candidates(
        self, mitsuba_scene: Any, source: mi.Point3f, targets: mi.Point3f, rays: Rays
    ) -> PathsBuffer:
        """Launch rays from the sources and collect candidate paths to the targets.

        `mitsuba_scene` is a Mitsuba scene, or an object with the same ray queries.

        Raises:
            EngineError: The candidates do not fit into memory.
        """
        settings, size = self.settings, rays.buffer_size
        # There is at most one candidate per ray, interaction and target, plus the direct paths.
        most = (rays.count * settings.max_depth + 1) * dr.width(targets) + 2
        while True:
            with _ray_directions(rays.directions), _hash_table(HASHES[most > SMALL_LAUNCH]):
                buffer = self._generate_candidates(
                    mi_scene=mitsuba_scene,
                    src_positions=source,
                    tgt_positions=targets,
                    samples_per_src=max(rays.count, 1),
                    max_num_paths_per_src=size,
                    max_depth=settings.max_depth if rays.count else 0,
                    los=rays.direct,
                    specular_reflection=settings.specular_reflection,
                    diffuse_reflection=settings.diffuse_reflection,
                    refraction=settings.refraction,
                    diffraction=settings.diffraction,
                    edge_diffraction=settings.edge_diffraction,
                    seed=rays.seed,
                )
            buffer.schedule()
            dr.eval()
            num_candidates = int(np.array(buffer.paths_counter).item())
            if num_candidates > rays.max_paths:
                num_receivers = len(np.unique(to_numpy(targets), axis=0))  # without the repeated receivers
                raise EngineError(
                    f"more paths than fit into memory, with {counted(num_receivers, 'receiver')} at once; "
                    "reduce trace.samples or trace.max_depth, or trace fewer links at once"
                )
            # The counter stops at the size of the buffer, so a full buffer may have lost candidates.
            if num_candidates < size - 1:
                break
            size = min(4 * size, most)
        buffer.shrink()
        buffer.detach_geometry()
        return drop_empty_entries(buffer)

    def compute_geometry(
        self, buffer: PathsBuffer, source: mi.Point3f, target: mi.Point3f, num_receivers: int
    ) -> None:
        """Compute the exact geometry of candidates by the method of images, in place.

        Candidates that turn out not to be paths are dropped, as are candidates of the receivers that `pad_receivers`
        added after the first `num_receivers`. Receivers are the targets, or the sources if candidates were reversed.
        """
        if not buffer.buffer_size:
            return
        self._apply_image_method(
            scene=self.mitsuba_scene,
            paths=buffer,
            src_positions=source,
            tgt_positions=target,
            diffraction=self.settings.diffraction,
            diffraction_lit_region=self.settings.diffraction_lit_region,
        )
        limit = dr.opaque(mi.UInt, num_receivers)
        buffer.valid &= (buffer.source_indices < limit) & (buffer.target_indices < limit)
        buffer.discard_invalid()
        buffer.schedule()
        # The buffer is evaluated immediately, because pending results would keep all candidates and the whole buffer in
        # memory.
        dr.eval()

    def compute_fields(self, traced: TracedBuffer) -> NDArray[np.complex128]:
        """Compute path gains [P, R, T] with Sionna's field stage and the most recently set constants."""
        if not len(traced.link):
            return np.zeros((0, self.rx_antenna.ports, self.tx_antenna.ports), dtype=complex)
        buffer = traced.buffer
        valid = mi.Bool(buffer.valid)
        num_tx, num_rx = dr.width(traced.source), dr.width(traced.target)
        fields: Any = self._calculate_fields(
            wavelength=self._scene.wavelength,
            paths=buffer,
            samples_per_src=self.settings.rays,
            diffraction=self.settings.diffraction,
            src_positions=traced.source,
            tgt_positions=traced.target,
            src_orientations=to_points(np.tile(self.tx_antenna.orientation, (num_tx, 1))),
            tgt_orientations=to_points(np.tile(self.rx_antenna.orientation, (num_rx, 1))),
            src_antenna_patterns=self._tx_functions,
            tgt_antenna_patterns=self._rx_functions,
        )
        # Both arrays are evaluated together; otherwise, reading each array would run the whole stage again.
        dr.eval(fields.a, fields.tau)
        # The field stage may mark paths as invalid; the original marks are restored, so that the stage can run again.
        buffer.valid = valid
        return np.array([[to_numpy_complex(gain) for gain in row] for row in fields.a]).transpose(2, 0, 1)

    def compile(self, traced: TracedBuffer, ends: Links, materials: Mapping[str, Material]) -> Paths:
        """Compile the paths of one buffer; the ends of all links [L, 3], [m], are in the local frame."""
        chains = self._chains(traced, ends)
        paths = compile_paths(
            chains, traced.link, ends, frequency=self.frequency, materials=materials, antennas=self._patterns
        )
        settings = {**self.settings.record(), "scene": self.scene.source, "sionna_rt": rt.__version__}
        return replace(paths, settings=settings)

    def _chains(self, traced: TracedBuffer, ends: Links) -> Chains:
        buffer, count = traced.buffer, len(traced.link)
        depth = buffer.depth_dim_size
        shape, of_path = np.unique(np.array(buffer.shapes, dtype=np.int64), return_inverse=True)
        material = np.array([self._material_of_shape.get(key, 0) for key in shape.tolist()], dtype=np.int64)
        normal = np.zeros((count, depth, 3))
        wedge_arrays: dict[str, NDArray[np.float64]] = {}
        kind = per_interaction(buffer, "interaction_types")
        if count and kind.any():
            for step in range(depth):
                normal[:, step] = normals_at(buffer, step, kind[:, step] != 0)
            if self.settings.diffraction:
                source = dr.gather(mi.Point3f, traced.source, buffer.source_indices)
                target = dr.gather(mi.Point3f, traced.target, buffer.target_indices)
                # Sionna's own lengths are used, so that replay reproduces their known error
                # (docs/explanation/fidelity.md).
                after, before = self._calculate_fields._diffraction_compute_s_s_prime(buffer, source, target)
                wedges: Any = buffer.diffracting_wedges
                lengths = np.stack([np.array(before, dtype=float), np.array(after, dtype=float)], axis=1)
                one_edge = {
                    "edge": to_numpy(wedges.e_hat), "normal_n": to_numpy(wedges.nn), "edge_lengths": lengths
                }  # fmt: skip
                # A Sionna RT path has at most one diffraction, which can occur at any step.
                wedge_arrays = {
                    name: np.broadcast_to(values[:, None], (count, depth, values.shape[1]))
                    for name, values in one_edge.items()
                }
        return Chains(
            source=ends.tx[traced.link],
            target=ends.rx[traced.link],
            vertex=vertices_of(buffer),
            normal=normal,
            kind=kind,
            material=material[of_path].reshape(count, depth),
            probability=np.array(buffer.probs, dtype=float).reshape(count, depth),
            samples=self.settings.rays,
            **wedge_arrays,
        )


@contextmanager
def _hash_table(entries: int) -> Iterator[None]:
    """Set the number of entries in Sionna's hash table."""
    own = SBCandidateGenerator.MIN_SPEC_COUNT_SIZE
    SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = entries
    try:
        yield
    finally:
        SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = own


@contextmanager
def _ray_directions(directions: NDArray[np.float64] | None) -> Iterator[None]:
    """Set the directions of Sionna's rays, as points of the unit square [2, rays]; Sionna's own lattice if None."""
    # Sionna has no argument for the directions of rays, so the function that makes the lattice is replaced.
    sionna_lattice = sb_deterministic.fibonacci_lattice
    if directions is not None:
        sb_deterministic.fibonacci_lattice = lambda _: mi.Point2f(
            *(aligned(axis, np.float32) for axis in directions)
        )
    try:
        yield
    finally:
        sb_deterministic.fibonacci_lattice = sionna_lattice
