"""A trace, and the check that it sent out enough rays, as tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.paths import Paths
from calibray.reporting.result_tables import suspects
from calibray.tables import Column, Table, numbers
from calibray.tables.text import LISTED, rows_text
from calibray.tracing.convergence import Convergence
from calibray.tracing.positions import EnclosedAntennas

VISIBLE_DB: Final = 0.005
"""Change [dB] that is not 0 when shown to 0.01 dB."""


def found(paths: Paths, row: NDArray[np.int64], enclosed: EnclosedAntennas | None) -> Table:
    """What a trace found.

    Args:
        paths: What was traced.
        row: Line of every link in the source file [L].
        enclosed: Antennas inside closed bodies; None where nothing was looked for.

    Returns:
        The table.
    """
    reached = np.bincount(paths.link, minlength=paths.num_links) > 0
    rows = [
        ("links", f"{paths.num_links:,}", ""),
        ("paths", f"{paths.num_paths:,}", ""),
        ("interactions", f"{paths.num_interactions:,}", ""),
        *suspects(row[~reached].tolist(), "", enclosed),
    ]
    return Table("Trace", (Column(), numbers(), Column()), tuple(rows))


def convergence(change: Convergence, row: NDArray[np.int64], tolerance_db: float) -> tuple[Table | str, ...]:
    """What tracing again with more samples changed.

    Args:
        change: The changes.
        row: Line of every link in the source file [L].
        tolerance_db: Change of a link's path loss that is let stand [dB].

    Returns:
        An overview, the links that changed most if any did, and a verdict.
    """
    most = _most_changed(change, row)
    verdict = _verdict(change, len(row), tolerance_db)
    return (_overview(change, row), *([most] if most.rows else []), verdict)


def rounds(settings: Mapping[str, object], tolerance_db: float) -> str:
    """What the last round of a trace changed whose rays were added in rounds.

    Args:
        settings: How the paths were traced (`Paths.settings`).
        tolerance_db: Change of a link's path loss that is let stand [dB].

    Returns:
        The verdict.
    """
    rays, change = int(str(settings["rays"])), float(str(settings["last_round_db"]))
    if not rays:
        return "Converged: only direct paths were looked for, and no ray is needed for them."
    told = f"{rays:,} rays a position were sent out; the later half of them changed"
    if change <= tolerance_db:
        least = f"{max(change, 0.01):.2f}"
        return (
            f"Converged: {told} no link by more than {least} dB (fidelity.tolerance_db = {tolerance_db:g})."
        )
    return f"Not converged: {told} a link by {change:.2f} dB (fidelity.tolerance_db = {tolerance_db:g})."


def _overview(change: Convergence, row: NDArray[np.int64]) -> Table:
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
            f"{change.change_db[link]:+.2f}",
            f"{change.paths_before[link]:,}",
            f"{change.paths_after[link]:,}",
        )
        for link in change.largest[:LISTED]
        if abs(change.change_db[link]) >= VISIBLE_DB
    )
    return Table("", columns, rows)


def _verdict(change: Convergence, links: int, tolerance_db: float) -> str:
    if change.converged(tolerance_db):
        return f"Converged: no link changed by more than {tolerance_db:g} dB (fidelity.tolerance_db)."
    above = int((np.abs(change.change_db) > tolerance_db).sum())
    return (
        f"Not converged: {above} of {links} links changed by more than {tolerance_db:g} dB "
        f"(fidelity.tolerance_db); raise trace.samples to {2 * change.samples} or more and check again."
    )
