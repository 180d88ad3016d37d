"""From a study to what it runs on: its scene, tracer, stored paths and engine."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from calibray.engines.carriers import CarrierPaths, ReplayCarriers
from calibray.engines.command import Command
from calibray.engines.compression import compress
from calibray.engines.exchange import Surroundings
from calibray.engines.fingerprint import fingerprint
from calibray.engines.ledger import Ledger
from calibray.engines.program import Program
from calibray.engines.protocol import Progress
from calibray.engines.recorded import Recorded
from calibray.engines.replay import Replay
from calibray.engines.retrace import CarrierTracer, Retrace
from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.parameters import Parameters
from calibray.paths import Paths, take_links
from calibray.scenes import Scene, read_scene
from calibray.study import Study
from calibray.tracing.factory import SIONNA, kept_trace
from calibray.tracing.protocol import Tracer

ENGINES: Final = ("replay", "retrace", "command")


def make(
    study: Study,
    name: str | None = None,
    progress: Progress | None = None,
    ledger: str | Path | None = None,
    executor: Executor | None = None,
) -> Replay | ReplayCarriers | Retrace | Command | Recorded:
    """The engine of a study.

    Args:
        study: The study.
        name: "replay", "retrace" or "command"; the study's own if None.
        progress: Called with (done, in all) after every chunk of receivers traced, or every RT call of a batch.
        ledger: SQLite file to keep RT calls in. Replay has no use for it: finding an answer there takes longer
            than computing it.
        executor: What runs the calls of a batch, for "command" only.

    Returns:
        The engine, over all links of the study, those held out included.

    Raises:
        InputError: The engine is unknown, or does not fit the study or the executor; the ledger cannot be used; or
            the study's scene, links or parameters cannot be used.
    """
    name = name or study.engine.name
    if name not in ENGINES:
        raise InputError(f"engine {name!r}: must be one of {', '.join(ENGINES)}")
    if executor is not None and name != "command":
        raise InputError(
            f"engine {name!r} runs in this process; --workers and --scheduler need engine 'command'"
        )
    links = study.measurements()
    scene = make_scene(study)
    parameters = make_parameters(study, scene, links)
    options = study.objective.combining, study.scene.bandwidth
    if name == "replay":
        if study.engine.compress_db is not None:  # before anything is traced
            _check_compressible(study, links, parameters)
        paths = compressed_paths(study, traced_paths(study, scene, links, progress), parameters)
        return make_replay(study, paths, links, parameters)
    if name == "retrace":
        parts = _carrier_tracers(study, scene, links, parameters)
        engine = Retrace(parts, scene.materials, parameters, *options, progress)
    else:
        engine = _command(study, scene, links, parameters, executor, progress)
    if ledger is None:
        return engine
    problem = fingerprint(study, scene, links, parameters, name, _carriers(study, links, parameters))
    return Recorded(engine, Ledger(ledger), problem, name)


def _command(
    study: Study,
    scene: Scene,
    links: Measurements,
    parameters: Parameters,
    executor: Executor | None,
    progress: Progress | None,
) -> Command:
    section = study.engine
    if section.command is None:
        raise InputError(
            f"{study.path}: engine 'command' needs engine.command, the program and its arguments, "
            'as ["octave-cli", "model.m"]'
        )
    folder = study.path.resolve().parent
    program = Program(section.command, folder, section.timeout, section.retries, section.format)
    surroundings = Surroundings(
        frequency=study.scene.frequency,
        bandwidth=study.scene.bandwidth,
        combining=study.objective.combining,
        antennas=study.antenna_pair,
        tx=links.tx,
        rx=links.rx,
        link_frequency=links.frequency,
    )
    return Command(
        program,
        surroundings,
        scene.materials,
        parameters,
        executor,
        progress,
        source=str(study.path),
        carriers=_carriers(study, links, parameters),
        give_up_after=section.give_up_after,
    )


def _carrier_tracers(
    study: Study, scene: Scene, links: Measurements, parameters: Parameters
) -> list[CarrierTracer]:
    if links.frequency is None:
        return [CarrierTracer(_tracer(study, scene), links, np.arange(len(links)))]
    return [
        CarrierTracer(
            _tracer(study, _scene_at(study, parameters, frequency), frequency),
            links.select(links.frequency == frequency),
            index,
        )
        for frequency, index in links.carriers
    ]


def make_parameters(study: Study, scene: Scene, links: Measurements) -> Parameters:
    """The parameters of a study.

    Args:
        study: The study.
        scene: Its scene.
        links: The links, for their carriers.

    Returns:
        The parameters.

    Raises:
        InputError: The scene lacks a material, a start lies outside its bounds, or a law leaves physics at a carrier.
    """
    parameters = study.parameter_set(scene.materials, scene.laws)
    parameters.check_carriers([frequency for frequency, _ in links.carriers])
    return parameters


def make_replay(
    study: Study, paths: Paths, links: Measurements, parameters: Parameters
) -> Replay | ReplayCarriers:
    """The replay of a study on stored paths.

    Args:
        study: The study.
        paths: The paths of the links, at the study's carrier.
        links: The links.
        parameters: What the candidates' components stand for.

    Returns:
        The engine; with a program for each carrier where the links have carriers of their own.
    """
    options = study.objective.combining, study.scene.bandwidth
    if links.frequency is None and not parameters.has_laws:
        return Replay(paths, parameters, *options)
    if links.frequency is None:
        return ReplayCarriers(
            [CarrierPaths(paths, np.arange(len(links)))], parameters, paths.materials, *options
        )
    materials = _carriers(study, links, parameters)
    carriers = [
        CarrierPaths(take_links(paths, index).at(frequency, materials[frequency]), index)
        for frequency, index in links.carriers
    ]
    return ReplayCarriers(carriers, parameters, paths.materials, *options)


def compressed_paths(study: Study, paths: Paths, parameters: Parameters) -> Paths:
    """The paths to replay for a study: few weighted ones where it asks for them, else all.

    Args:
        study: The study.
        paths: The paths of the links, at the study's carrier.
        parameters: What the candidates' components stand for.

    Returns:
        The path program.
    """
    if study.engine.compress_db is None:
        return paths
    return compress(paths, parameters, study.engine.compress_db).paths


def _check_compressible(study: Study, links: Measurements, parameters: Parameters) -> None:
    if study.objective.combining != "power" or links.frequency is not None or parameters.has_laws:
        raise InputError(
            f"{study.path}: engine.compress_db = {study.engine.compress_db:g} needs objective.combining = 'power' and "
            "a single carrier without coefficients of laws; remove it"
        )


def _carriers(study: Study, links: Measurements, parameters: Parameters) -> dict[float, dict[str, Material]]:
    """The scene's materials before calibration at each carrier of the links [Hz]."""
    return {frequency: _scene_at(study, parameters, frequency).materials for frequency, _ in links.carriers}


def _scene_at(study: Study, parameters: Parameters, frequency: float) -> Scene:
    """A study's scene at another carrier, with the parameters' starts."""
    scene = read_scene(study.scene_source, frequency, study.overrides, study.objects)
    return replace(scene, materials=parameters.materials(parameters.start, scene.materials, frequency))


def traced_paths(study: Study, scene: Scene, links: Measurements, progress: Progress | None = None) -> Paths:
    """The paths of some links in a study's scene, from the cache if they were traced before.

    Links that differ in their carrier alone are traced once.

    Args:
        study: The study.
        scene: Its scene, with the materials to trace with.
        links: The links.
        progress: Called with (receivers traced, receivers in all) after every chunk.

    Returns:
        The path program.
    """
    told = None if progress is None else lambda _, done, total: progress(done, total)
    return kept_trace(SIONNA, scene, study.scene.frequency, study.trace, study.antenna_pair, links, told)


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
        parameters = study.parameter_set(scene.materials, scene.laws)
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


def _tracer(study: Study, scene: Scene, frequency: float | None = None) -> Tracer:
    return SIONNA(scene, frequency or study.scene.frequency, study.trace, *study.antenna_pair)
