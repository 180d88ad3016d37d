"""Scenes and drafted studies as tables: contents, assumptions and findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.paths import Paths
from calibray.reporting.result_tables import suspicious_rows
from calibray.scenes.authoring import MadeScene
from calibray.scenes.checks import Finding, SceneCheck
from calibray.study.draft import Draft
from calibray.support.messages import counted
from calibray.tables import LISTED, Column, Table, numbers, rows_text
from calibray.tracing.convergence import Convergence
from calibray.tracing.protocol import EnclosedAntennas

_HEIGHT_SOURCES: Final = {
    "levels": "height from the number of storeys",
    "default": "no usable height given, so the default is used",
}


def contents(scene: MadeScene) -> Table:
    """The contents of a new scene, and the assumptions made for it."""
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
        longitude, latitude, height = scene.frame.to_geographic([0.0, 0.0, 0.0])
        place = f"longitude {longitude:.7f}, latitude {latitude:.7f}, height {height:g} m ({scene.frame.crs})"
        rows.append(("origin", place))
    return Table("", (Column(), Column()), tuple(rows))


def _listed(names: Sequence[str]) -> str:
    first = ", ".join(names[:LISTED]) + (", ..." if len(names) > LISTED else "")
    return f"{counted(len(names), 'building')}: {first}"


def findings(check: SceneCheck) -> list[Table]:
    """The size of a scene, a verdict on the scene, and its defects, if any."""
    west, south, bottom, east, north, top = check.bounds
    errors = sum(finding.severity == "error" for finding in check.findings)
    warnings = sum(finding.severity == "warning" for finding in check.findings)
    verdict = "cannot be used" if errors else "can be used; see the warnings" if warnings else "can be used"
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
    """The objects of a scene, each with its number of faces and number of defects."""
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
    """The assumptions of a drafted study, each with its reason."""
    rows = tuple((entry.what, entry.value, entry.reason) for entry in draft.assumptions)
    return Table("Assumptions", (Column(), Column(), Column("reason")), rows)


def warning_lines(findings: Sequence[Finding]) -> str:
    """Format findings about links as warnings, one per line."""
    return "\n".join(
        f"Warning: {finding.subject}: {finding.problem}; {finding.remedy}" for finding in findings
    )


def overview(paths: Paths, row: NDArray[np.int64], enclosed: EnclosedAntennas | None) -> Table:
    """Numbers of links, paths and interactions, and the links to check, identified by their rows in the file [L].

    If `enclosed` is None, the antennas were not checked.
    """
    reached = np.bincount(paths.link, minlength=paths.num_links) > 0
    rows = [
        ("links", f"{paths.num_links:,}", ""),
        ("paths", f"{paths.num_paths:,}", ""),
        ("interactions", f"{paths.num_interactions:,}", ""),
        *suspicious_rows(row[~reached].tolist(), "", enclosed),
    ]
    return Table("Trace", (Column(), numbers(), Column()), tuple(rows))


def convergence(change: Convergence, row: NDArray[np.int64], tolerance_db: float) -> tuple[Table | str, ...]:
    """Changes in path loss due to tracing with more samples: a summary, the most affected links, and a verdict.

    Links are identified by their rows in the source file [L]; `tolerance_db` is the largest acceptable change [dB].
    """
    most_changed = _most_changed(change, row)
    verdict = _verdict(change, len(row), tolerance_db)
    return (_summary(change, row), *([most_changed] if most_changed.rows else []), verdict)


def last_round(settings: Mapping[str, object], tolerance_db: float) -> str:
    """State the verdict on the last round of a trace that adds rays in rounds.

    `settings` contains the trace settings of the paths; `tolerance_db` is the largest acceptable change in a link's
    path loss [dB].
    """
    rays, change = int(str(settings["rays"])), float(str(settings["last_round_db"]))
    if not rays:
        return "Converged: only direct paths were searched, which requires no rays."
    text = f"{rays:,} rays per position; the second half of these rays changed"
    tolerance = f"(fidelity.tolerance_db = {tolerance_db:g})"
    if change <= tolerance_db:
        return f"Converged: {text} no link by more than {max(change, 0.01):.2f} dB {tolerance}."
    remedy = "increase trace.samples, or reduce trace.max_depth"
    return f"Not converged: {text} a link by {change:.2f} dB {tolerance}; {remedy}."


def _summary(change: Convergence, row: NDArray[np.int64]) -> Table:
    rows = (
        ("median", f"{change.quantile(0.5):.2f} dB", ""),
        ("95 % of the links", f"{change.quantile(0.95):.2f} dB", ""),
        ("largest", f"{change.quantile(1.0):.2f} dB", ""),
        ("links that gained paths", str(len(change.gained)), rows_text(row[change.gained].tolist())),
        ("links that lost paths", str(len(change.lost)), rows_text(row[change.lost].tolist())),
    )
    title = f"Change from {change.samples:,} to {2 * change.samples:,} samples"
    return Table(title, (Column(), numbers(), Column()), rows)


def _most_changed(change: Convergence, row: NDArray[np.int64]) -> Table:
    columns = (numbers("Row"), numbers("change", "dB"), numbers("paths before"), numbers("after"))
    rows = tuple(
        (
            str(row[link]),
            f"{change.change_db[link]:+z.2f}",
            f"{change.paths_before[link]:,}",
            f"{change.paths_after[link]:,}",
        )
        for link in change.largest[:LISTED]
        # Smaller changes round to 0.00 dB.
        if abs(change.change_db[link]) >= 0.005
    )
    return Table("", columns, rows)


def _verdict(change: Convergence, links: int, tolerance_db: float) -> str:
    if change.converged(tolerance_db):
        return f"Converged: no link changed by more than {tolerance_db:g} dB (fidelity.tolerance_db)."
    above = int((np.abs(change.change_db) > tolerance_db).sum())
    return (
        f"Not converged: {above} of {links} links changed by more than {tolerance_db:g} dB "
        f"(fidelity.tolerance_db); increase trace.samples to {2 * change.samples} or more and check again."
    )
