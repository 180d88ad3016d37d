"""What links say of themselves, in a few lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibray.tables import Column, Table
from calibray.tables.display import hertz, named

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from calibray.measurements.links import Measurements


def summary(links: Measurements) -> tuple[Table, ...]:
    """Where links come from, and the range of what was measured.

    Args:
        links: The links.

    Returns:
        A table.
    """
    kind = "measured" if links.measured else "unmeasured"
    rows = [("number", f"{len(links):,} {kind}"), ("distance", _range(links.distance, "m"))]
    if links.measured:
        rows.append(("path loss", _range(links.path_loss_db, "dB")))
    if links.group is not None:
        rows.append(("groups", named(links.group_names)))
    if links.carriers:
        rows.append(("carriers", named(hertz(frequency) for frequency, _ in links.carriers)))
    return (Table(f"Links from {links.source}", (Column(), Column()), tuple(rows)),)


def _range(values: NDArray[np.float64], unit: str) -> str:
    return f"{values.min():.4g} to {values.max():.4g} {unit}"
