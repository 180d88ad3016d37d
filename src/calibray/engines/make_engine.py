"""Make the engine of a study, and a fingerprint of everything that determines its answers, except the candidate."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import cast
from xml.etree import ElementTree

from calibray.engines.cluster.workers import Workers, check_workers
from calibray.engines.kinds import KINDS
from calibray.engines.ledger.ledger import Ledger
from calibray.engines.ledger.recorded import Recorded
from calibray.engines.protocol import Answering, Engine
from calibray.engines.section import Openable, OpenedStudy
from calibray.errors import InputError
from calibray.materials import Material
from calibray.paths import Paths
from calibray.scenes import Scene
from calibray.support.messages import type_name
from calibray.support.progress import Progress
from calibray.tracing.cache import mesh_files


def make(
    study: Openable,
    name: str | None = None,
    progress: Progress | None = None,
    ledger: str | Path | None = None,
    workers: Workers | None = None,
    *,
    paths: Paths | None = None,
) -> Engine:
    """Make the engine of a study.

    Args:
        study: The study, opened or not.
        name: "replay", "retrace" or "command"; if None, the study's engine.
        progress: Called with "tracing" after every launch of a trace, or with "running" after every RT call of a batch.
        ledger: SQLite file that stores RT calls. Replay does not use the ledger, because evaluating paths is faster
            than reading stored answers.
        workers: Workers that run the calls of a batch (engine "command") or keep chunks of links (engine "replay").
        paths: Paths of the study's links for "replay"; if None, the paths are traced or read from the cache.

    Returns:
        The engine for all links of the study, including held-out links.

    Raises:
        InputError: The engine is unknown, is unsuitable for the study, or does not support workers; or the ledger, or
            the study's scene, links or parameters, cannot be used.
    """
    check_workers(workers)
    if not hasattr(study, "opened"):
        raise InputError(
            f"study: is a {type_name(study)}; it must be a Study; read a file with Study.load(file)"
        )
    opened = study.opened()
    name = opened.engine.name if name is None else name
    if name not in KINDS:
        raise InputError(f"engine {name!r}: must be one of {', '.join(KINDS)}")
    if workers is not None and not (KINDS[name].external or KINDS[name].chunked):
        raise InputError(
            f"engine {name!r} runs in this process; --workers and --scheduler require the engine 'command' or 'replay'"
        )
    if name != opened.engine.name:
        opened = opened.replace(engine=name)
    engine = opened.engine.open(opened, paths, progress, workers)
    if ledger is None or not opened.engine.expensive:
        return engine
    # Every expensive kind of engine returns its answers one by one.
    files = opened.engine.program_files(opened)
    return Recorded(cast(Answering, engine), Ledger(ledger), fingerprint(opened), name, progress, files)


def fingerprint(study: OpenedStudy) -> str:
    """Fingerprint (SHA-256, in hexadecimal) of the problem that an engine solves for each candidate.

    The method, seed, measured values, bounds and start values are excluded, so that studies which differ only in these
    share stored calls. For re-tracing, the fingerprint includes the tracer's versions. An external program's version is
    unknown, so its command line is included instead.
    """
    links, parameters, radio = study.links, study.parameters, study.radio
    # Calibrated constants are part of the candidate.
    free = {f"{parameter.material}.{parameter.constant}" for parameter in parameters}
    record = {
        "engine": study.engine.name,
        "made by": study.engine.answers_by(study),
        "frequency": radio.frequency,
        "bandwidth": radio.bandwidth,
        "combining": radio.combining,
        "antennas": [antenna.record() for antenna in radio.antennas],
        "trace": study.trace_settings.record(),
        "parameters": list(parameters.names),
        "materials": _fixed_constants(study.scene.materials, free),
        "objects": [asdict(entry) for entry in study.scene.objects],
    }
    if law := parameters.law_coefficients(parameters.start):
        record["law"] = {
            name: {key: value for key, value in entry.items() if f"{name}.{key}" not in parameters.names}
            for name, entry in law.items()
        }
    if radio.observables:
        record["observables"] = [wanted.record() for wanted in radio.observables]
    if study.carriers:
        record["carriers"] = {
            str(frequency): _fixed_constants(materials, free)
            for frequency, materials in study.carriers.items()
        }
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    digest.update(_geometry(study.scene))
    for mesh in mesh_files(study.scene):
        digest.update(mesh.read_bytes())
    for positions in (links.tx, links.rx):
        digest.update(positions.astype("<f8").tobytes())
    if links.frequency is not None:
        digest.update(links.frequency.astype("<f8").tobytes())
    return digest.hexdigest()


def _fixed_constants(materials: Mapping[str, Material], free: set[str]) -> dict[str, dict[str, object]]:
    """The constants of every material, by name, that are not calibrated."""
    return {
        name: {
            constant: value
            for constant, value in asdict(material).items()
            if f"{name}.{constant}" not in free
        }
        for name, material in materials.items()
    }


def _geometry(scene: Scene) -> bytes:
    """The scene's XML without material constants, because the candidate contains the calibrated constants."""
    root = ElementTree.fromstring(scene.xml)
    for constants in root.findall("bsdf"):
        root.remove(constants)
    return ElementTree.tostring(root)
