"""Links of tables in memory."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from calibray.measurements import Measurements, SourceTable, links_from_table


def links_from_frame(
    frame: pd.DataFrame, group: str | Sequence[str] | None = None, frequency: str | None = None
) -> Measurements:
    """Links without measured values from a table with the columns of positions [m]."""
    return links_from_table(SourceTable(frame.reset_index(drop=True), source="links"), group, frequency)
