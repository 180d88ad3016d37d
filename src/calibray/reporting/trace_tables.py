"""A trace, and the check that it has enough rays, as tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.paths import Paths
from calibray.reporting.result_tables import suspicious_rows
from calibray.tables import Column, Table, numbers
from calibray.tables.text import LISTED, rows_text
from calibray.tracing.convergence import Convergence
from calibray.tracing.positions import EnclosedAntennas

VISIBLE_DB: Final = 0.005
"""Change [dB] that is not 0 when rounded to 0.01 dB."""


def overview(paths: Paths, row: NDArray[np.int64], enclosed: EnclosedAntennas | None) -> Table:
    """Numbers of links, paths and interactions, and the links that need a look.

    Args:
        paths: The traced paths.
        row: Row of every link in the source file [L].
        enclosed: Antennas inside closed bodies; None if this was not checked.

    Returns:
        The table.
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
    """How path loss changed when the scene was traced again with more samples.

    Args:
        change: The changes.
        row: Row of every link in the source file [L].
        tolerance_db: Largest change of a link's path loss that is acceptable [dB].

    Returns:
        A summary, the links that changed most if any did, and a verdict.
    """
    most_changed = _most_changed(change, row)
    verdict = _verdict(change, len(row), tolerance_db)
    return (_summary(change, row), *([most_changed] if most_changed.rows else []), verdict)


def last_round(settings: Mapping[str, object], tolerance_db: float) -> str:
    """How path loss changed in the last round of a trace whose rays are added in rounds.

    Args:
        settings: How the paths were traced (`Paths.settings`).
        tolerance_db: Largest change of a link's path loss that is acceptable [dB].

    Returns:
        The verdict.
    """
    rays, change = int(str(settings["rays"])), float(str(settings["last_round_db"]))
    if not rays:
        return "Converged: only direct paths were searched, and these need no rays."
    text = f"{rays:,} rays per position; the second half of them changed"
    tolerance = f"(fidelity.tolerance_db = {tolerance_db:g})"
    if change <= tolerance_db:
        return f"Converged: {text} no link by more than {max(change, 0.01):.2f} dB {tolerance}."
    return f"Not converged: {text} a link by {change:.2f} dB {tolerance}."


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
