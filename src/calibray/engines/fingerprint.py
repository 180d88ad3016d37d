"""What an engine's answers depend on besides the candidate, as a fingerprint."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from calibray.materials import Material
from calibray.scenes import Scene
from calibray.tracing.cache import mesh_files

if TYPE_CHECKING:
    from calibray.study.setup import Setup


def fingerprint(setup: Setup) -> str:
    """The problem that an engine solves for each candidate.

    Method and seed do not count, nor do measured values, bounds and starts: calls are shared by all that vary them.
    For re-tracing the versions of the tracer count; a program's own version cannot be known, its words count.

    Args:
        setup: The opened study; its engine counts.

    Returns:
        SHA-256 in hexadecimal.
    """
    study, scene, links, parameters = setup.study, setup.scene, setup.links, setup.parameters
    free = {f"{parameter.material}.{parameter.constant}" for parameter in parameters}
    record = {
        "engine": study.engine.name,
        "made by": study.engine.answers_by(setup),
        "frequency": study.scene.frequency,
        "bandwidth": study.scene.bandwidth,
        "combining": study.objective.combining,
        "antennas": [antenna.record() for antenna in study.antenna_pair],
        "trace": study.trace.record(),
        "parameters": list(parameters.names),
        "materials": _fixed(scene.materials, free),
        "objects": [asdict(entry) for entry in scene.objects],
    }
    if law := parameters.law_coefficients(parameters.start):
        record["law"] = {
            name: {key: value for key, value in entry.items() if f"{name}.{key}" not in parameters.names}
            for name, entry in law.items()
        }
    if setup.carriers:
        record["carriers"] = {
            str(each): _fixed(materials, free) for each, materials in setup.carriers.items()
        }
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    digest.update(_geometry(scene))
    for mesh in mesh_files(scene):
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
