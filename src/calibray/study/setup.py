"""A study, opened: its links, its scene and its parameters, each read once, and the tracer that finds their paths."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.parameters import Parameters
from calibray.paths import Paths, take_links
from calibray.scenes import Scene, check_material_name, read_scene
from calibray.scenes.scene_file import content
from calibray.study.model import Study
from calibray.support.progress import Progress
from calibray.tracing import cache
from calibray.tracing.default_tracer import SIONNA
from calibray.tracing.positions import EnclosedAntennas
from calibray.tracing.protocol import Tracer, TracerFactory
from calibray.tracing.trace_plan import LONG_TRACE_SECONDS

_LOG: Final = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Setup:
    """A study, opened once: what engines, fingerprints, problems and predictions take.

    Attributes:
        study: The study.
        links: All its links, those held out included.
        scene: Its scene, with the parameters' starts: what is sampled while tracing follows the materials.
        parameters: What a candidate's components stand for.
        held_out: Which links are held out [links].
        factory: What opens the scene in a ray tracer.
    """

    study: Study
    links: Measurements
    scene: Scene
    parameters: Parameters
    held_out: NDArray[np.bool_]
    factory: TracerFactory

    @classmethod
    def open(cls, study: Study, tracer: TracerFactory = SIONNA, links: Measurements | None = None) -> Setup:
        """Read what a study names; nothing is traced yet.

        Args:
            study: The study.
            tracer: What opens the scene in a ray tracer.
            links: Links in place of the study's; none of them is held out.

        Returns:
            The opened study.

        Raises:
            InputError: The links, the scene, the parameters or the hold-out cannot be used.
        """
        held_out = None
        if links is None:
            links = study.measurements()
            held_out = study.held_out(links)
        scene = read_scene(study.scene_source, study.scene.frequency, study.overrides, study.objects)
        parameters = study.parameter_set(scene.materials, scene.laws)
        parameters.check_carriers([frequency for frequency, _ in links.carriers])
        scene = replace(scene, materials=parameters.materials(parameters.start, scene.materials))
        if held_out is None:
            held_out = np.zeros(len(links), dtype=bool)
        return cls(study, links, scene, parameters, held_out, tracer)

    def opened(self) -> Setup:
        """Itself: what takes a study or one that is open calls this on either."""
        return self

    def replace(self, method: str | None = None, seed: int | None = None, engine: str | None = None) -> Setup:
        """The same with another method, seed or engine; nothing is read again (see `Study.replace`).

        Args:
            method: Name of the method, or None to keep it.
            seed: Seed, or None to keep it.
            engine: Name of the engine, or None to keep it.

        Returns:
            The changed setup.

        Raises:
            InputError: A value is impossible.
        """
        return self._with_tracer(replace(self, study=self.study.replace(method, seed, engine)))

    def at(self, links: Measurements) -> Setup:
        """The same for other links, none of them held out; nothing is read or loaded again.

        Args:
            links: The links.

        Returns:
            The changed setup.
        """
        return self._with_tracer(replace(self, links=links, held_out=np.zeros(len(links), dtype=bool)))

    @property
    def tracer(self) -> Tracer:
        """The ray tracer with the scene at the study's carrier, loaded when first used."""
        if "tracer" not in self._loaded:
            self._loaded["tracer"] = self._tracer(self.scene, self.study.scene.frequency)
        return self._loaded["tracer"]

    @cached_property
    def _loaded(self) -> dict[str, Tracer]:
        """The tracer, once it is loaded, for all setups of one scene."""
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """What is sent to another process: all but what is loaded; files are found from another folder, too."""
        here = {each.name: getattr(self, each.name) for each in fields(self)}
        return here | {"scene": replace(self.scene, path=self.scene.path.absolute())}

    @cached_property
    def carriers(self) -> dict[float, dict[str, Material]]:
        """The scene's materials before calibration by carrier of the links [Hz]; none where all have the study's."""
        return {frequency: self._scene_at(frequency).materials for frequency, _ in self.links.carriers}

    @cached_property
    def enclosed(self) -> EnclosedAntennas | None:
        """Antennas that stand inside closed bodies of the scene; None where a program outside answers."""
        if self.study.engine.external:
            return None
        tracer, links = self.tracer, self.links
        return EnclosedAntennas.of(links.row, tracer.enclosed(links.tx), tracer.enclosed(links.rx))

    @cached_property
    def files(self) -> dict[str, str]:
        """SHA-256 of every file that the scene and the antennas are read from, by path as the study finds it."""
        antennas = [Path(each.gain_file) for each in self.study.antenna_pair if each.gain_file is not None]
        files = dict.fromkeys([self.scene.path, *cache.mesh_files(self.scene), *antennas])
        read = {file: content(file) if file == self.scene.path else file.read_bytes() for file in files}
        return {str(file): hashlib.sha256(each).hexdigest() for file, each in read.items()}

    def tracer_at(self, frequency: float) -> Tracer:
        """The ray tracer with the scene at another carrier.

        Args:
            frequency: The carrier [Hz].

        Returns:
            The tracer, loaded anew.
        """
        return self._tracer(self._scene_at(frequency), frequency)

    def trace(
        self, materials: Mapping[str, Material] | None = None, progress: Progress | None = None
    ) -> Paths:
        """The paths of the links, from the cache if they were traced before.

        Links that differ in their carrier alone are traced once.

        Args:
            materials: Constants in place of the scene's, by material name.
            progress: Called with the stage "tracing" after every launch.

        Returns:
            The path program.

        Raises:
            InputError: The tracer cannot be used, or the scene lacks a material.
            EngineError: There are more paths than fit into memory.
        """
        for name in materials or {}:
            check_material_name(name, self.scene.materials, "materials")
        scene = replace(self.scene, materials={**self.scene.materials, **(materials or {})})
        if self.links.frequency is None:
            return self._trace(self.links, scene, progress)
        ends = np.hstack([self.links.tx, self.links.rx])
        _, first, place = np.unique(ends, axis=0, return_index=True, return_inverse=True)
        once = replace(self.links.select(np.isin(np.arange(len(self.links)), first)), frequency=None)
        # `select` keeps the links' order, `unique` sorts them.
        order = np.argsort(np.argsort(first))
        return take_links(self._trace(once, scene, progress), order[place.reshape(-1)])

    def _trace(self, links: Measurements, scene: Scene, progress: Progress | None) -> Paths:
        study = self.study
        digest = cache.trace_digest(
            self.factory.versions,
            scene,
            study.scene.frequency,
            study.trace,
            study.antenna_pair,
            links.tx,
            links.rx,
        )
        paths = cache.load_trace(digest)
        if paths is None:
            plan = self.tracer.plan(links)
            if plan.seconds > LONG_TRACE_SECONDS:
                _LOG.warning("%s", plan.announcement(len(links)))
            paths = self.tracer.trace(links, progress, scene.materials)
            cache.store_trace(digest, paths)
        return paths

    def _with_tracer(self, changed: Setup) -> Setup:
        """A tracer serves on, whoever loads it: neither links nor methods have a say in it."""
        changed.__dict__["_loaded"] = self._loaded
        return changed

    def _scene_at(self, frequency: float) -> Scene:
        study, parameters = self.study, self.parameters
        scene = read_scene(study.scene_source, frequency, study.overrides, study.objects)
        starts = parameters.materials(parameters.start, scene.materials, frequency)
        return replace(scene, materials=starts)

    def _tracer(self, scene: Scene, frequency: float) -> Tracer:
        return self.factory(scene, frequency, self.study.trace, *self.study.antenna_pair)
