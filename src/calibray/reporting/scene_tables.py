"""Scenes and drafted studies as tables: contents, assumptions and findings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from calibray.scenes.authoring import MadeScene
from calibray.scenes.checks import Finding, SceneCheck
from calibray.study.draft import Draft
from calibray.tables import Column, Table, numbers

LISTED: Final = 12
"""Names and findings that are listed before the rest is only counted."""

_HEIGHT_SOURCES: Final = {
    "levels": "height from the number of storeys",
    "default": "no height given, default used",
}


def contents(scene: MadeScene) -> Table:
    """The contents of a new scene, and the assumptions made.

    Returns:
        A table of two columns without headings.
    """
    west, south, bottom, east, north, top = scene.bounds
    rows = [
        ("scene", str(scene.path)),
        ("extent", f"{east - west:.0f} m x {north - south:.0f} m, {bottom:.1f} m to {top:.1f} m high"),
        ("triangles", ", ".join(f"{name} {count}" for name, count in scene.triangles.items())),
        *((name, str(count)) for name, count in scene.counts.items()),
        *(("walls", text) for text in scene.walls),
        *((_HEIGHT_SOURCES[source], _listed(names)) for source, names in scene.guessed.items()),
    ]
    if scene.frame is not None:
        rows.append(("origin", _origin(scene)))
    return Table("", (Column(), Column()), tuple(rows))


def _origin(scene: MadeScene) -> str:
    if scene.frame is None:
        return ""
    longitude, latitude, height = scene.frame.to_geographic([0.0, 0.0, 0.0])
    return f"longitude {longitude:.7f}, latitude {latitude:.7f}, height {height:g} m ({scene.frame.crs})"


def _listed(names: Sequence[str]) -> str:
    first = ", ".join(names[:LISTED]) + (", ..." if len(names) > LISTED else "")
    return f"{len(names)} buildings: {first}"


def findings(check: SceneCheck) -> list[Table]:
    """The size of a scene and its defects.

    Args:
        check: The check of the scene.

    Returns:
        A table of size and verdict, and a table of the findings in the order of the check, if there are any.
    """
    west, south, bottom, east, north, top = check.bounds
    errors = sum(finding.severity == "error" for finding in check.findings)
    warnings = sum(finding.severity == "warning" for finding in check.findings)
    verdict = "cannot be used" if errors else "can be used, see the warnings" if warnings else "can be used"
    size = Table(
        "",
        (Column(), Column()),
        (
            ("scene", check.source),
            ("extent", f"{east - west:.4g} m x {north - south:.4g} m x {top - bottom:.4g} m"),
            ("from", f"({west:.4g}, {south:.4g}, {bottom:.4g}) to ({east:.4g}, {north:.4g}, {top:.4g})"),
            ("objects", str(len(check.objects))),
            ("triangles", str(check.faces)),
            ("verdict", verdict),
        ),
    )
    rows = [
        (finding.severity, finding.subject or "scene", finding.problem, finding.remedy)
        for finding in check.findings[:LISTED]
    ]
    if len(check.findings) > LISTED:
        rows.append(("", "", f"... and {len(check.findings) - LISTED} more", ""))
    columns = (Column(), Column("where"), Column("problem"), Column("remedy"))
    return [size, Table("Findings", columns, tuple(rows))] if rows else [size]


def objects(check: SceneCheck) -> Table:
    """The objects of a scene, with the numbers of their faces and of defects.

    Args:
        check: The check of the scene.

    Returns:
        One row per object.
    """
    columns = (
        Column("object"), Column("material"), numbers("faces"), numbers("open edges"), numbers("unwelded edges"),
        numbers("flipped faces"), numbers("empty faces"), numbers("repeated faces"),
    )  # fmt: skip
    rows = (
        (
            item.name, item.material, str(item.faces), str(item.open_edges), str(item.unwelded_edges),
            str(item.flipped_faces), str(item.empty_faces), str(item.repeated_faces),
        )
        for item in check.objects
    )  # fmt: skip
    return Table("Objects", columns, tuple(rows))


def assumptions(draft: Draft) -> Table:
    """The assumptions of a drafted study.

    Returns:
        One row per assumption, with its reason.
    """
    rows = tuple((entry.what, entry.value, entry.reason) for entry in draft.assumptions)
    return Table("Assumptions", (Column(), Column(), Column("reason")), rows)


def warning_lines(findings: Sequence[Finding]) -> str:
    """Findings about links as warnings.

    Returns:
        A line each; empty without findings.
    """
    return "\n".join(
        f"Warning: {finding.subject}: {finding.problem}; {finding.remedy}" for finding in findings
    )
