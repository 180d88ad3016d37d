"""The opened study: one calibration problem with its links, scene, parameters and paths."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import Answering
from calibray.engines.section import EngineSection, RadioSettings
from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import Ground, Measurements
from calibray.parameters import Parameters
from calibray.paths import Paths, take_links
from calibray.scenes import Scene, check_material_name, read_scene, read_triangles
from calibray.scenes.checks.positions import UNDER, locate
from calibray.scenes.obstruction import Region, with_obstruction
from calibray.scenes.scene_file import read_content as scene_content
from calibray.study.displacement import (
    ACROSS,
    DIRECTIONS,
    RECEIVER,
    Displacement,
    averaged,
    check_labels,
    displaced,
    displacement_loss,
    displacements,
    displaces,
    mounted_at_displaced,
    spread_db,
)
from calibray.study.facades import (
    roughness_effects,
    with_facade_materials,
    with_facades,
    without_facade_materials,
)
from calibray.study.model import StudyModel
from calibray.study.mounting import link_mountings, pose_effects, with_population
from calibray.study.regions import region_effects
from calibray.study.row_steps import scene_place, study_links, study_regions
from calibray.study.sections import AntennasSection
from calibray.support.messages import type_name
from calibray.support.progress import Progress
from calibray.tracing import SIONNA, cache
from calibray.tracing.antennas import POSE, Mounting, mount
from calibray.tracing.protocol import EnclosedAntennas, Tracer, TracerFactory
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.trace_plan import LONG_TRACE_SECONDS

if TYPE_CHECKING:
    from calibray.fields import Effects

_LOG: Final = logging.getLogger(__name__)


@final
@dataclass(frozen=True, eq=False)
class Setup:
    """An opened study: its links, scene and parameters, which are read once, and the ray tracer.

    Attributes:
        study: The study.
        links: All links of the study, including the held-out links.
        scene: The scene with the start values of the parameters, because the materials affect how the tracer samples
            paths.
        parameters: The parameters, in the order of the values of a candidate.
        held_out: Mask [L] of the held-out links.
        factory: Function that opens the scene in a ray tracer.
        placed: Values of the parameters at which paths are traced, if parameters displace antennas; by default, the
            start values.
        neighbours: Distances to the neighbouring positions at which paths are traced, as fractions of the largest
            displacement.
    """

    study: StudyModel
    links: Measurements
    scene: Scene
    parameters: Parameters
    held_out: NDArray[np.bool_]
    factory: TracerFactory
    placed: Mapping[str, float] = field(default_factory=dict)
    neighbours: tuple[float, ...] = ACROSS

    @classmethod
    def open(
        cls, study: StudyModel, tracer: TracerFactory = SIONNA, links: Measurements | None = None
    ) -> Setup:
        """Read the files of a study without tracing.

        Args:
            study: The study.
            tracer: Function that opens the scene in a ray tracer.
            links: Links that replace those of the study; none of these links is held out.

        Raises:
            InputError: The links, the scene, the parameters or ``[holdout]`` cannot be used.
        """
        if not isinstance(study, StudyModel):
            raise InputError(
                f"study: is a {type_name(study)}, must be a Study; read a file with Study.load(file)"
            )
        held_out = None
        if links is None:
            links = study_links(study)
            if any(entry.spread is not None for entry in study.parameters.values()):
                # Only the links determine which transmitters exist.
                study = type(study).from_content(with_population(study, links), study.path)
            held_out = study.held_out(links)
            columns = {POSE: study.links.transmitter, RECEIVER: study.links.device}
            for kind, column in columns.items():
                check_labels(str(study.path), study.parameters, links, kind, column)
        scene = _scene_of(study, study.scene.frequency)
        parameters = study.parameter_set(scene.materials, scene.laws)
        parameters.check_carriers([frequency for frequency, _ in links.carriers])
        # The tracer samples reflection and refraction with the constants of the scene, here the start values.
        scene = replace(scene, materials=parameters.materials(parameters.start, scene.materials))
        if held_out is None:
            held_out = np.zeros(len(links), dtype=bool)
        setup = cls(study, links, scene, parameters, held_out, tracer)
        return setup.with_obstruction() if study.uses_obstruction else setup

    def opened(self) -> Setup:
        """Return the setup itself, so that functions can accept both studies and opened studies."""
        return self

    def replace(self, method: str | None = None, seed: int | None = None, engine: str | None = None) -> Setup:
        """The setup with another method, seed or engine (see `Study.replace`); no file is read again.

        Raises:
            InputError: A value is invalid.
        """
        return self._with_tracer(replace(self, study=self.study.replace(method, seed, engine)))

    def at(self, links: Measurements) -> Setup:
        """The setup with other links, none of which is held out; no file is read again."""
        setup = self._with_tracer(replace(self, links=links, held_out=np.zeros(len(links), dtype=bool)))
        return setup.with_obstruction() if self.study.uses_obstruction else setup

    def with_parameters(self, parameters: Parameters) -> Setup:
        """The setup with other parameters; the scene is not loaded again."""
        return self._with_tracer(replace(self, parameters=parameters))

    def with_obstruction(self) -> Setup:
        """The setup whose links have the columns that are computed from the scene (`obstruction.COLUMNS`)."""
        study = self.study
        links = with_obstruction(
            self.links,
            self.scene,
            study.scene.frequency,
            self.regions,
            clutter=study.uses_clutter,
            cluster_m=study.cluster_m,
        )
        return self if links is self.links else self._with_tracer(replace(self, links=links))

    def effects(self, paths: Paths, links: NDArray[np.int64] | None = None) -> Effects:
        """Effects on paths other than those of material constants, such as antenna errors and losses in regions.

        `links` contains the indices of the links to which the paths belong; if None, the paths belong to all links.
        """
        effects = self._pose_and_region_effects(paths, links)
        return effects + self._displacement_effects(paths, effects)

    def _pose_and_region_effects(self, paths: Paths, links: NDArray[np.int64] | None = None) -> Effects:
        chosen = np.arange(len(self.links)) if links is None else links
        poses = pose_effects(self.study, self.mountings, self.links.table, self.parameters, (paths, chosen))
        return poses + self._path_effects(paths)

    def _path_effects(self, paths: Paths) -> Effects:
        """The effects that depend only on the path: losses in regions and at rough surfaces."""
        study, parameters, frequency = self.study, self.parameters, self.study.scene.frequency
        displaced = self._position_error_m is not None
        extra = region_effects(study.regions, self.regions, parameters, paths, frequency, displaced=displaced)
        return extra + roughness_effects(study.roughness_mm, parameters, paths)

    @cached_property
    def regions(self) -> dict[str, Region]:
        """The regions with extra loss, by name."""
        return study_regions(self.study)

    @cached_property
    def _displacements(self) -> tuple[Displacement, ...]:
        if not any(displaces(item.name) for item in self.parameters):
            return ()
        columns = {POSE: self.study.links.transmitter, RECEIVER: self.study.links.device}
        return displacements(self.parameters.items, self.links, columns, self._ground)

    @property
    def _placed(self) -> NDArray[np.float64]:
        """Values of the parameters at which paths are traced."""
        return np.array([self.placed.get(item.name, item.start) for item in self.parameters])

    def placed_at(self, values: Mapping[str, float], neighbours: tuple[float, ...] = ()) -> Setup:
        """The setup with paths traced at the antenna positions that correspond to the parameter values `values`.

        The setup is unchanged if no parameter displaces antennas. Path loss is interpolated between these positions and
        `neighbours` on each side (fractions of the largest displacement). Without neighbours, path loss does not depend
        on displacements.
        """
        if not any(displaces(item.name) for item in self.parameters):
            return self
        return self._with_tracer(replace(self, placed=dict(values), neighbours=neighbours))

    @property
    def _links_in_place(self) -> Measurements:
        links = self.links
        for displacement in self._displacements:
            links = displacement.moved(links, (displacement.weights @ self._placed)[displacement.group])
        return links

    def _displacement_effects(self, paths: Paths, others: Effects) -> Effects:
        """The change in path loss due to displacements, from traces at neighbouring positions."""
        if not self._displacements or not self.neighbours:
            return ()

        in_place = {item.name: 0.0 for item in self.parameters if displaces(item.name)}

        def traced(links: Measurements) -> tuple[Paths, Effects]:
            moved = self._with_tracer(replace(self, links=links, placed=in_place))
            paths = moved._mounted(moved._trace_links(links, self.scene, None), self.scene)
            return paths, moved._pose_and_region_effects(paths)

        placed, links = (self.parameters, self._placed), self._links_in_place
        return (
            displacement_loss(self._displacements, placed, self.neighbours, links, (paths, others), traced),
        )

    @property
    def radio(self) -> RadioSettings:
        """Carrier, bandwidth, combination of paths, antennas and observables."""
        study = self.study
        wanted = tuple(section.wanted(name) for name, section in study.observables.items())
        return RadioSettings(
            study.scene.frequency,
            study.scene.bandwidth,
            study.objective.combining,
            study.antenna_pair,
            wanted,
        )

    @property
    def known_antennas(self) -> tuple[Antenna, Antenna] | None:
        """Transmit and receive antennas of an engine that exports rays; None if unstated or not common to all links."""
        section = self.study.antennas
        known = section != AntennasSection() if section.known is None else section.known
        return self.radio.antennas if known and not self.study.links.mountings else None

    @property
    def trace_settings(self) -> TraceSettings:
        """Settings of the ray tracer."""
        return self.study.trace

    @property
    def engine(self) -> EngineSection:
        """The section ``[engine]``."""
        return self.study.engine

    @property
    def source(self) -> Path:
        """The study file."""
        return self.study.path

    @property
    def tracer_versions(self) -> Mapping[str, str]:
        """Versions of the components of the ray tracer, by name."""
        return self.factory.versions

    @property
    def tracer(self) -> Tracer:
        """The ray tracer with the scene at the study's carrier, loaded on first use."""
        if "tracer" not in self._loaded:
            self._loaded["files"] = self._files_digest()
            self._loaded["tracer"] = self._open_tracer(self.scene, self.study.scene.frequency)
        return self._loaded["tracer"]

    @cached_property
    def _loaded(self) -> dict[str, Any]:
        """The loaded tracer and the digest of its files; empty before loading.

        All setups with the same scene share this dictionary.
        """
        return {}

    def _files_digest(self) -> str:
        return cache.files_digest(self.scene, self.study.antenna_pair)

    def __getstate__(self) -> dict[str, Any]:
        """The state sent to another process: without the loaded tracer, and with the absolute path of the scene."""
        state = {item.name: getattr(self, item.name) for item in fields(self)}
        return state | {"scene": replace(self.scene, path=self.scene.path.absolute())}

    @property
    def carriers(self) -> dict[float, dict[str, Material]]:
        """Materials before calibration, keyed by carrier [Hz]; empty if all links use the carrier of the study."""
        return self._materials_by_carrier

    @cached_property
    def _materials_by_carrier(self) -> dict[float, dict[str, Material]]:
        return {frequency: self._scene_at(frequency).materials for frequency, _ in self.links.carriers}

    @cached_property
    def enclosed(self) -> EnclosedAntennas | None:
        """Antennas inside closed bodies or below the ground; None if an external program computes path loss."""
        if self.study.engine.external:
            return None
        ends = (self.links.tx, self.links.rx)
        enclosed = [self.tracer.enclosed(points) for points in ends]
        if not np.any(enclosed):
            return EnclosedAntennas.of(self.links.row, *enclosed)
        triangles = read_triangles(self.scene)
        below = [locate(triangles, points) == UNDER for points in ends]
        return EnclosedAntennas.of(self.links.row, *enclosed, *below)

    @cached_property
    def files(self) -> dict[str, str]:
        """SHA-256 digests of all files of the scene, antennas, rays, regions and facades, by path."""
        return input_digests(self.study, self.scene)

    def tracer_at(self, frequency: float) -> Tracer:
        """A new ray tracer with the scene at another carrier [Hz]."""
        return self._open_tracer(self._scene_at(frequency), frequency)

    def trace(
        self, materials: Mapping[str, Material] | None = None, progress: Progress | None = None
    ) -> Paths:
        """The paths of the links: traced, read from the cache, or obtained from a ray table or an external program.

        A program that returns rays is called once. Links that differ only in carrier are traced once. `materials`
        replace the materials of the scene with the same names. `progress` is called with "tracing" after every launch.

        Raises:
            InputError: The tracer cannot be used, or the scene lacks a material.
            EngineError: The paths do not fit into memory.
        """
        for name in materials or {}:
            check_material_name(name, self.scene.materials, "materials")
        if self.study.rays_path is not None:
            return _paths_of_table(self, self.study.rays_path, materials or {})
        if self.study.engine.exports_rays:
            return _paths_of_program(self, materials or {}, progress)
        scene = replace(self.scene, materials={**self.scene.materials, **(materials or {})})
        if self.links.frequency is None:
            return self._mounted(self._trace_links(self._links_in_place, scene, progress), scene)
        # Paths do not depend on the carrier, so a pair of positions that occurs at several carriers is traced once.
        ends = np.hstack([self.links.tx, self.links.rx])
        _, first, pair = np.unique(ends, axis=0, return_index=True, return_inverse=True)
        distinct = replace(self.links.select(np.isin(np.arange(len(ends)), first)), frequency=None)
        # `select` keeps the order of links, but `unique` sorts pairs; `rank` is the index of a pair among the selected
        # links.
        rank = np.argsort(np.argsort(first))
        return self._mounted(
            take_links(self._trace(distinct, scene, progress), rank[pair.reshape(-1)]), scene
        )

    def _trace_links(self, links: Measurements, scene: Scene, progress: Progress | None) -> Paths:
        """Paths of the links. If positions have errors, the power of a link is the mean over displaced receivers."""
        errors = self._position_error_m
        if errors is None:
            return self._trace(links, scene, progress)
        return averaged(self._trace(displaced(links, errors, self._ground), scene, progress), links)

    @cached_property
    def _ground(self) -> Ground | None:
        """Function that returns the height of the lowest surface, or +inf; None if heights are not above ground."""
        return None if self.study.links.heights is None else scene_place(self.study).surfaces().lowest_surface

    @cached_property
    def _position_error_m(self) -> NDArray[np.float64] | None:
        """Standard deviation [L], [m], of receiver position errors along x and y; None if positions are exact."""
        stated = self.study.links.position_error_m
        if stated is None or not self.links.measured:
            return None
        errors = self.links.table.numbers(stated)
        if (errors < 0).any():
            row = int(np.flatnonzero(errors < 0)[0])
            place = (
                self.links.table.cell(row, stated) if isinstance(stated, str) else "links.position_error_m"
            )
            raise InputError(f"{place}: {errors[row]:g} must be at least 0 [m]")
        return errors

    def with_position_noise(self) -> Setup:
        """The setup with link weights that account for position errors; the setup itself if positions are exact.

        The additional variance is the variance of path loss over displaced receivers at the start values.
        """
        errors, links, study = self._position_error_m, self.links, self.study
        if errors is None:
            return self
        from calibray.engines.replay import Computation, Replay

        mountings = mounted_at_displaced(self.mountings, len(links))
        around = displaced(self._links_in_place, errors, self._ground)
        paths = self._mounted(self._trace(around, self.scene, None), self.scene, mountings)
        effects = self._pose_and_region_effects(paths, np.tile(np.arange(len(links)), len(DIRECTIONS)))
        replay = Replay(paths, self.parameters, effects=effects, computation=Computation(batch=1))
        loss = replay.path_loss(self.parameters.start[None])[0]
        # If standard deviations are stated, weights are inverse variances.
        variance = 1 / links.weight if study.links.std is not None else (study.noise.std_db or 0.0) ** 2
        weight = 1 / (variance + spread_db(loss) ** 2)
        return self._with_tracer(replace(self, links=replace(links, weight=weight)))

    def _mounted(self, paths: Paths, scene: Scene, mountings: Mapping[str, Mounting] | None = None) -> Paths:
        """The paths with the antenna fields of each link, if antennas differ, and with the materials of facades."""
        study, mountings = self.study, self.mountings if mountings is None else mountings
        paths = mount(paths, mountings) if mountings else paths
        if not study.facades:
            return paths
        return with_facades(paths, study.facades, study.facade_paths, scene_place(study), scene.materials)

    @cached_property
    def mountings(self) -> dict[str, Mounting]:
        """The antennas at those ends ("tx", "rx") at which they differ between links.

        Raises:
            InputError: A column is missing or malformed, or names an unknown antenna.
        """
        return link_mountings(self.study, self._links_in_place)

    def _trace(self, links: Measurements, scene: Scene, progress: Progress | None) -> Paths:
        study, scene = self.study, without_facade_materials(scene, self.study.facades)
        digest = cache.trace_digest(
            self.factory.versions, scene, study.scene.frequency, study.trace, study.antenna_pair, links
        )
        paths = cache.load_trace(digest)
        if paths is None:
            plan = self.tracer.plan(links)
            if plan.seconds > LONG_TRACE_SECONDS:
                _LOG.warning("%s", plan.announcement(len(links)))
            paths = self.tracer.trace(links, progress, scene.materials)
            # The trace is stored only if the files have not changed since the tracer read them.
            if self._files_digest() == self._loaded["files"]:
                cache.store_trace(digest, paths)
        return paths

    def with_trace(self, settings: TraceSettings) -> Setup:
        """The setup with other settings of the ray tracer; the scene is not loaded again."""
        changed = replace(self, study=self.study.model_copy(update={"trace": settings}))
        tracer = self.tracer.with_settings(settings)
        changed.__dict__["_loaded"] = {**self._loaded, "tracer": tracer}
        return changed

    def _with_tracer(self, changed: Setup) -> Setup:
        """A changed setup that keeps the loaded tracer, because the tracer does not depend on links or methods."""
        changed.__dict__["_loaded"] = self._loaded
        known = {name: value for name, value in vars(self).items() if name in ("regions", "_ground")}
        changed.__dict__.update(known)
        return changed

    def _scene_at(self, frequency: float) -> Scene:
        study, parameters = self.study, self.parameters
        scene = _scene_of(study, frequency)
        materials = parameters.materials(parameters.start, scene.materials, frequency)
        return replace(scene, materials=materials)

    def _open_tracer(self, scene: Scene, frequency: float) -> Tracer:
        scene = without_facade_materials(scene, self.study.facades)
        return self.factory(scene, frequency, self.study.trace, *self.study.antenna_pair)


def input_digests(study: StudyModel, scene: Scene) -> dict[str, str]:
    """SHA-256 digests of the files of a study's scene, regions, facades, antennas and rays.

    The keys are paths relative to the study, or absolute paths for files outside its folder.
    """
    antennas = [*study.stated_antennas.values(), *study.antenna_types.values()]
    gains = [Path(antenna.gain_file) for antenna in antennas if antenna.gain_file is not None]
    digests = {_from_study(study, scene.path): hashlib.sha256(scene_content(scene.path)).hexdigest()}
    rays = [] if study.rays_path is None else [study.rays_path]
    outlines = (*study.region_paths.values(), *study.facade_paths.values())
    regions = [file for file in outlines if file is not None]
    for file in (*cache.mesh_files(scene), *gains, *rays, *regions):
        digests[_from_study(study, file)] = hashlib.sha256(file.read_bytes()).hexdigest()
    return digests


def _from_study(study: StudyModel, file: Path) -> str:
    """The path of a file relative to the study, or its absolute path if it is outside the study's folder."""
    file, folder = file.resolve(), study.path.parent.resolve()
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else str(file)


def _scene_of(study: StudyModel, frequency: float) -> Scene:
    """The scene at a carrier [Hz], with the materials of facades."""
    scene = read_scene(study.scene_source, frequency, study.overrides, study.objects)
    return with_facade_materials(scene, study.facades, study.facade_constants, frequency)


def _paths_of_table(setup: Setup, file: Path, materials: Mapping[str, Material]) -> Paths:
    """The paths of the study's ray table. The powers in the table apply at the start values."""
    from calibray.engines.rays.compile import RaySetting, compile_rays
    from calibray.engines.rays.table import RayTable, read_ray_file

    paths = compile_rays(RayTable.of(read_ray_file(file)), RaySetting.of(setup))
    return replace(paths, materials={**paths.materials, **materials})


def _paths_of_program(setup: Setup, materials: Mapping[str, Material], progress: Progress | None) -> Paths:
    """The paths that the study's program returns. Their powers are computed with `materials`."""
    from calibray.engines.rays.export import Exporting

    scene = replace(setup.scene, materials={**setup.scene.materials, **materials})
    # The program receives the material constants in the order of a candidate.
    candidate = [getattr(scene.materials[item.material], item.constant) for item in setup.parameters]
    program = cast(Answering, setup.study.engine.open(setup, None, progress, None))
    return Exporting(program, replace(setup, scene=scene)).export(np.array(candidate)).paths
