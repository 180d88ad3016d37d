"""Diagnosis: what is wrong with a scene before an hour of tracing shows it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from calibray.errors import InputError
from calibray.materials import ITU_MATERIALS
from calibray.scenes.checks.mesh_check import ObjectHealth, health
from calibray.scenes.meshes import Mesh
from calibray.scenes.scene_file import find_scene
from calibray.support.extras import library
from calibray.support.progress import Progress

Severity = Literal["error", "warning", "note"]

LARGEST: Final = 50_000.0
"""An extent [m] beyond which a scene is hardly in metres about a local origin."""


@dataclass(frozen=True)
class Finding:
    """One thing that a scene suffers from.

    Attributes:
        severity: "error" if Sionna RT or Calibray will refuse the scene, "warning" if results suffer, else "note".
        place: The object or the material that it is about; the scene itself if empty.
        problem: What is wrong.
        remedy: What to do about it.
    """

    severity: Severity
    place: str
    problem: str
    remedy: str


@dataclass(frozen=True)
class SceneDiagnosis:
    """What a scene is like.

    Attributes:
        source: What was examined.
        bounds: West, south, bottom, east, north and top [6], in the scene's unit.
        objects: Its meshes, counted.
        findings: What is wrong, the worst first.
    """

    source: str
    bounds: tuple[float, ...]
    objects: tuple[ObjectHealth, ...]
    findings: tuple[Finding, ...]

    @property
    def faces(self) -> int:
        """Number of triangles of all meshes."""
        return sum(item.faces for item in self.objects)


def diagnose(source: str | Path, progress: Progress | None = None) -> SceneDiagnosis:
    """Examine a scene.

    Args:
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        progress: Called with ("examining", meshes done, meshes in all).

    Returns:
        What it is like.

    Raises:
        InputError: It does not exist, is no scene, or a mesh of it is missing or cannot be read.
    """
    path, root = find_scene(source)
    examined: list[ObjectHealth] = []
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for name, material, mesh in read_meshes(path, root):
        examined.append(health(name, material, mesh))
        low, high = np.minimum(low, mesh.vertices.min(axis=0)), np.maximum(high, mesh.vertices.max(axis=0))
        if progress is not None:
            progress("examining", len(examined), len(root.findall("shape")))
    objects, bounds = tuple(examined), (*low.tolist(), *high.tolist())
    findings = [*_material_findings(root, objects), *_scale_findings(bounds)]
    for item in objects:
        findings += _object_findings(item)
    order = ("error", "warning", "note")
    return SceneDiagnosis(
        str(source), bounds, objects, tuple(sorted(findings, key=lambda one: order.index(one.severity)))
    )


def read_meshes(path: Path, root: ElementTree.Element) -> Iterator[tuple[str, str, Mesh]]:
    """Read the meshes of a scene, PLY and OBJ files, one after the other.

    Args:
        path: Its XML file.
        root: The element `scene`.

    Yields:
        Object, material and mesh, turned over where the file says so; shapes without a file are passed by.

    Raises:
        InputError: A mesh is missing or cannot be read, or there is none.
    """
    trimesh = library("trimesh", "scenes")
    found = 0
    for shape in root.findall("shape"):
        name = (shape.get("id") or "?").removeprefix("mesh-")
        filename = shape.find("string[@name='filename']")
        if filename is None:
            continue
        file = path.parent / filename.get("value", "")
        if not file.is_file():
            raise InputError(
                f"{path}: mesh {file} of {name!r} does not exist; copy the meshes folder beside the scene"
            )
        try:
            loaded = trimesh.load_mesh(file, process=False, maintain_order=True)
            mesh = Mesh(np.asarray(loaded.vertices, dtype=float), np.asarray(loaded.faces, dtype=np.int64))
        except Exception as error:  # whatever trimesh's readers raise on a broken file
            raise InputError(
                f"{path}: mesh {file} of {name!r} cannot be read ({error}); export it again"
            ) from None
        if not len(mesh.faces):
            raise InputError(
                f"{path}: mesh {file} of {name!r} has no face; remove the object, or export it again"
            )
        reference = shape.find("ref")
        nested = shape.find("bsdf")
        material = next((part.get("id", "") for part in (reference, nested) if part is not None), "")
        turned = shape.find("boolean[@name='flip_normals']")
        if turned is not None and turned.get("value") == "true":
            mesh = Mesh(mesh.vertices, mesh.faces[:, ::-1])
        found += 1
        yield name, material.removeprefix("mat-"), mesh
    if not found:
        raise InputError(f"{path}: the scene has no mesh; export the scene with its meshes")


def _object_findings(item: ObjectHealth) -> list[Finding]:
    share = f"of {item.faces} faces" if item.faces else ""
    faults: Sequence[tuple[int, Severity, str, str]] = (
        (
            item.unwelded_edges,
            "warning",
            "edges at which faces meet without sharing vertices: no diffraction there",
            "merge vertices by distance (Blender: M, By Distance) and export again without splitting normals",
        ),
        (
            item.crowded_edges,
            "note",
            "edges that more than two faces share: no diffraction there",
            "remove inner walls, or part the bodies that touch",
        ),
        (
            item.flipped_faces,
            "note",
            f"{share} with the normal turned inward or against their neighbours'; Sionna RT copes, others do not",
            "recalculate normals outside (Blender: Shift-N)",
        ),
        (item.empty_faces, "warning", f"{share} without area", "dissolve degenerate faces, and export again"),
        (
            item.repeated_faces,
            "warning",
            f"{share} that lie on another one: waves pass the wall twice",
            "remove the copies",
        ),
    )
    return [
        Finding(severity, item.name, f"{count} {problem}", remedy)
        for count, severity, problem, remedy in faults
        if count
    ]


def _material_findings(root: ElementTree.Element, objects: Sequence[ObjectHealth]) -> list[Finding]:
    known = {name for table in ITU_MATERIALS.values() for name in table}
    findings = []
    for bsdf in [*root.findall("bsdf"), *root.findall("shape/bsdf")]:
        identifier = bsdf.get("id") or bsdf.get("name")
        if not identifier:
            findings.append(
                Finding(
                    "error", "", f"a BSDF of type {bsdf.get('type')!r} has no id", "give it one: mat-NAME"
                )
            )
        elif bsdf.get("type") != "itu-radio-material" and identifier.removeprefix("mat-") in known:
            findings.append(
                Finding(
                    "error",
                    identifier,
                    "has a name of ITU-R P.2040's, which Sionna RT refuses",
                    f"name it mat-itu_{identifier.removeprefix('mat-')} for ITU's constants, or otherwise",
                )
            )
    defined = {
        (bsdf.get("id") or bsdf.get("name") or "").removeprefix("mat-")
        for bsdf in [*root.findall("bsdf"), *root.findall("shape/bsdf")]
    }
    for item in objects:
        if item.material not in defined:
            findings.append(
                Finding(
                    "error",
                    item.name,
                    f"refers to no material of the scene ({item.material!r})",
                    "give it one",
                )
            )
        if item.name in defined:
            findings.append(
                Finding(
                    "error",
                    item.name,
                    "is called like a material, which Sionna RT refuses",
                    "rename the object",
                )
            )
    return findings


def _scale_findings(bounds: Sequence[float]) -> list[Finding]:
    low, high = np.array(bounds[:3]), np.array(bounds[3:])
    extent = high - low
    across, centre = float(extent[:2].max()), float(np.abs((low + high) / 2)[:2].max())
    size = f"{extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g}"
    if across < 1 and np.abs([*low[:2], *high[:2]]).max() <= 180:
        return [
            Finding(
                "error",
                "",
                f"the scene is {size} large, as if in degrees of longitude and latitude",
                "project it to metres (calibray scene does)",
            )
        ]
    findings = []
    if across > LARGEST:
        findings.append(
            Finding(
                "error",
                "",
                f"the scene is {size} m large, as if in millimetres",
                "scale it by 0.001 to metres",
            )
        )
    elif centre > 100 * max(across, 1000.0):
        findings.append(
            Finding(
                "error",
                "",
                f"the scene lies {centre:.0f} m from its origin, where single precision is coarse",
                "move the origin into the scene (calibray scene does)",
            )
        )
    if 0 < extent[2] < 0.005 * across and extent[2] < 1:
        findings.append(
            Finding(
                "note",
                "",
                f"the scene is {size} m large, flat as a sheet",
                "check that heights were exported",
            )
        )
    return findings
