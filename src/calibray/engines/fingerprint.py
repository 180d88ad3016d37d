"""What an engine's answers depend on besides the candidate, as a fingerprint."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from xml.etree import ElementTree

from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.parameters import Parameters
from calibray.scenes import Scene
from calibray.study import Study
from calibray.tracing.cache import meshes

TRACER: tuple[str, ...] = ("sionna-rt", "mitsuba", "drjit")


def fingerprint(
    study: Study,
    scene: Scene,
    links: Measurements,
    parameters: Parameters,
    engine: str,
    carriers: Mapping[float, Mapping[str, Material]] | None = None,
) -> str:
    """The problem that an engine solves for each candidate.

    Method and seed do not count, nor do measured values, bounds and starts: calls are shared by all that vary them.
    For re-tracing the versions of the tracer count; a program's own version cannot be known, its words count.

    Args:
        study: The study.
        scene: Its scene.
        links: Its links.
        parameters: What the candidates' components stand for.
        engine: Name of the engine.
        carriers: The scene's materials at each carrier of the links [Hz]; none where all links have the study's.

    Returns:
        SHA-256 in hexadecimal.
    """
    free = {f"{parameter.material}.{parameter.constant}" for parameter in parameters}
    record = {
        "engine": engine,
        "made by": [version(name) for name in TRACER] if engine == "retrace" else study.engine.command,
        "frequency": study.scene.frequency,
        "bandwidth": study.scene.bandwidth,
        "combining": study.objective.combining,
        "antennas": [antenna.record() for antenna in study.antenna_pair],
        "trace": study.trace.record(),
        "parameters": list(parameters.names),
        "materials": _fixed(scene.materials, free),
        "objects": [asdict(entry) for entry in scene.objects],
    }
    if law := parameters.law(parameters.start):
        record["law"] = {
            name: {key: value for key, value in entry.items() if f"{name}.{key}" not in parameters.names}
            for name, entry in law.items()
        }
    if carriers:
        record["carriers"] = {str(each): _fixed(materials, free) for each, materials in carriers.items()}
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    digest.update(_geometry(scene))
    for mesh in meshes(scene):
        digest.update(mesh.read_bytes())
    for positions in (links.tx, links.rx):
        digest.update(positions.astype("<f8").tobytes())
    if links.frequency is not None:
        digest.update(links.frequency.astype("<f8").tobytes())
    return digest.hexdigest()


def _fixed(materials: Mapping[str, Material], free: set[str]) -> dict[str, dict[str, object]]:
    """The constants of materials that no parameter acts on."""
    return {
        name: {
            constant: value
            for constant, value in asdict(material).items()
            if f"{name}.{constant}" not in free
        }
        for name, material in materials.items()
    }


def _geometry(scene: Scene) -> bytes:
    """The scene without its materials' constants, of which free parameters must not count."""
    root = ElementTree.fromstring(scene.xml)
    for constants in root.findall("bsdf"):
        root.remove(constants)
    return ElementTree.tostring(root)
