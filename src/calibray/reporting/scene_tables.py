"""Scenes as tables: what was made and assumed, and what is wrong with one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from calibray.errors import InputError
from calibray.scenes.authoring import MadeScene
from calibray.scenes.checks import Finding, SceneCheck
from calibray.study.draft import Draft
from calibray.support.output_files import check_file, replacing
from calibray.tables import Column, Table, numbers

LISTED: Final = 12  # names that are told before the rest is only counted

_GUESSES: Final = {
    "levels": "height from the number of storeys",
    "default": "height not given, default taken",
}


def made(scene: MadeScene) -> Table:
    """What was made and assumed.

    Args:
        scene: What `calibray.scenes.authoring` returned.

    Returns:
        A table of two columns without headings.
    """
    west, south, bottom, east, north, top = scene.bounds
    rows = [
        ("scene", str(scene.path)),
        ("extent", f"{east - west:.0f} m x {north - south:.0f} m, {bottom:.1f} m to {top:.1f} m high"),
        ("triangles", ", ".join(f"{name} {count}" for name, count in scene.triangles.items())),
        *((name, str(count)) for name, count in scene.counts.items()),
        *((_GUESSES[source], _listed(names)) for source, names in scene.guessed.items()),
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
    told = ", ".join(names[:LISTED]) + (", ..." if len(names) > LISTED else "")
    return f"{len(names)} buildings: {told}"


def diagnosed(found: SceneCheck) -> list[Table]:
    """What a scene is like and what is wrong with it.

    Args:
        found: What `calibray.scenes.checks.check_scene` found.

    Returns:
        Two tables: size and verdict, then the findings, the worst first, like ones together.
    """
    west, south, bottom, east, north, top = found.bounds
    errors = sum(finding.severity == "error" for finding in found.findings)
    warnings = sum(finding.severity == "warning" for finding in found.findings)
    verdict = "cannot be used as it is" if errors else "can be used, with care" if warnings else "can be used"
    size = Table(
        "",
        (Column(), Column()),
        (
            ("scene", found.source),
            ("extent", f"{east - west:.4g} m x {north - south:.4g} m x {top - bottom:.4g} m"),
            ("from", f"({west:.4g}, {south:.4g}, {bottom:.4g}) to ({east:.4g}, {north:.4g}, {top:.4g})"),
            ("objects", str(len(found.objects))),
            ("triangles", str(found.faces)),
            ("verdict", verdict),
        ),
    )
    rows = [
        (finding.severity, finding.subject or "scene", finding.problem, finding.remedy)
        for finding in found.findings[:LISTED]
    ]
    if len(found.findings) > LISTED:
        rows.append(("", "", f"and {len(found.findings) - LISTED} more", ""))
    columns = (Column(), Column("where"), Column("what"), Column("what to do"))
    return [size, Table("Findings", columns, tuple(rows))] if rows else [size]


def objects(found: SceneCheck) -> Table:
    """The meshes of a scene, counted.

    Args:
        found: What `calibray.scenes.checks.check_scene` found.

    Returns:
        One row a mesh.
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
        for item in found.objects
    )  # fmt: skip
    return Table("Objects", columns, tuple(rows))


def assumed(found: Draft) -> Table:
    """What was assumed of a drafted study.

    Args:
        found: The draft.

    Returns:
        One row an assumption, with its reason.
    """
    rows = tuple((each.what, each.value, each.reason) for each in found.assumptions)
    return Table("Assumed", (Column(), Column(), Column("because")), rows)


def warned(findings: Sequence[Finding]) -> str:
    """Suspicions about links, a line each.

    Args:
        findings: What `calibray.study.link_checks.examine` found.

    Returns:
        The lines; empty if there are none.
    """
    return "\n".join(f"Warning: {each.subject}: {each.problem}; {each.remedy}" for each in findings)


PICTURES: Final = (".png", ".svg", ".pdf")


def save_positions(
    file: Path,
    source: str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    inputs: Iterable[Path] = (),
    overwrite: bool = False,
) -> None:
    """Draw antennas over a scene seen from above, into a file.

    Args:
        file: The picture, .png, .svg or .pdf.
        source: Path of a Mitsuba XML file, or `sionna:NAME`.
        tx: Transmitters [n, 3], [m].
        rx: Receivers [m, 3], [m].
        inputs: Files that are never replaced.
        overwrite: Replace a file that Calibray did not write.

    Raises:
        InputError: The file has another ending, or must not be replaced; or the scene cannot be read.
    """
    from calibray.reporting.position_plot import draw_positions

    if file.suffix.lower() not in PICTURES:
        raise InputError(f"{file}: cannot draw a {file.suffix or 'nameless'} file; use {', '.join(PICTURES)}")
    check_file(file, inputs, overwrite)
    figure = draw_positions(source, np.unique(tx, axis=0), rx)
    with replacing(file) as partial:
        figure.savefig(partial, format=file.suffix[1:].lower(), dpi=150)
