"""From a study to what it runs on: its scene, tracer, stored paths and engine."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from calibray import cache
from calibray.engines.protocol import Progress
from calibray.engines.replay import Replay
from calibray.engines.retrace import Retrace
from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.paths import Paths
from calibray.scene import Scene, read_scene
from calibray.study import Study
from calibray.tracing import Tracer

ENGINES: Final = ("replay", "retrace")


def make(study: Study, name: str | None = None, progress: Progress | None = None) -> Replay | Retrace:
    """The engine of a study.

    Args:
        study: The study.
        name: "replay" or "retrace"; the study's own if None.
        progress: Called with (done, in all) after every chunk of receivers traced, or every candidate re-traced.

    Returns:
        The engine, over all links of the study, those held out included.

    Raises:
        InputError: The engine is unknown, or the study's scene, links or parameters cannot be used.
    """
    name = name or study.engine.name
    if name not in ENGINES:
        raise InputError(f"engine {name!r}: must be one of {', '.join(ENGINES)}")
    links = study.measurements()
    scene = make_scene(study)
    parameters = study.parameter_set(scene.materials)
    options = study.objective.combining, study.scene.bandwidth
    if name == "retrace":
        return Retrace(_tracer(study, scene), links, parameters, *options, progress)
    return Replay(traced_paths(study, scene, links, progress), parameters, *options)


def traced_paths(study: Study, scene: Scene, links: Measurements, progress: Progress | None = None) -> Paths:
    """The paths of some links in a study's scene, from the cache if they were traced before.

    Args:
        study: The study.
        scene: Its scene, with the materials to trace with.
        links: The links.
        progress: Called with (receivers traced, receivers in all) after every chunk.

    Returns:
        The path program.
    """
    antennas = study.antennas.tx, study.antennas.rx
    digest = cache.trace_digest(scene, study.scene.frequency, study.trace, antennas, links.tx, links.rx)
    paths = cache.find(digest)
    if paths is None:
        paths = _tracer(study, scene).trace(links, progress).paths()
        cache.keep(digest, paths)
    return paths


def make_scene(study: Study, materials: dict[str, Material] | None = None) -> Scene:
    """A study's scene.

    Args:
        study: The study.
        materials: Constants in place of the scene's, by name; None for the scene's with the parameters' starts.

    Returns:
        The scene, with the materials to trace with.

    Raises:
        InputError: The scene or the parameters cannot be used.
    """
    overrides = {**study.overrides, **(materials or {})}
    scene = read_scene(study.scene_source, study.scene.frequency, overrides, study.objects)
    if materials is None:  # what is sampled while tracing, as diffuse reflection is, follows the materials
        parameters = study.parameter_set(scene.materials)
        scene = replace(scene, materials=parameters.materials(parameters.start, scene.materials))
    return scene


def make_tracer(study: Study, materials: dict[str, Material] | None = None) -> Tracer:
    """The ray tracer loaded with a study's scene.

    Args:
        study: The study.
        materials: Constants in place of the scene's, by name; None for the scene's with the parameters' starts.

    Returns:
        The tracer.

    Raises:
        InputError: The scene or the parameters cannot be used.
    """
    return _tracer(study, make_scene(study, materials))


def _tracer(study: Study, scene: Scene) -> Tracer:
    return Tracer(scene, study.scene.frequency, study.trace, study.antennas.tx, study.antennas.rx)
