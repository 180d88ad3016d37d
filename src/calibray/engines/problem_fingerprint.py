"""Fingerprint of everything that an engine's answers depend on besides the candidate."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from xml.etree import ElementTree

from calibray.engines.section import OpenedStudy
from calibray.materials import Material
from calibray.scenes import Scene
from calibray.tracing.cache import mesh_files


def fingerprint(study: OpenedStudy) -> str:
    """Fingerprint (SHA-256, in hexadecimal) of the problem that an engine solves for each candidate.

    Method, seed, measured values, bounds and start values do not count: studies that differ only in these share their
    calls. Re-tracing counts the tracer's versions. An external program's version is unknown, so its command line
    counts.
    """
    links, parameters, radio = study.links, study.parameters, study.radio
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
    """The constants of all materials that are not calibrated."""
    return {
        name: {
            constant: value
            for constant, value in asdict(material).items()
            if f"{name}.{constant}" not in free
        }
        for name, material in materials.items()
    }


def _geometry(scene: Scene) -> bytes:
    """The scene's XML without material constants: some of them are calibrated, and must not count."""
    root = ElementTree.fromstring(scene.xml)
    for constants in root.findall("bsdf"):
        root.remove(constants)
    return ElementTree.tostring(root)
