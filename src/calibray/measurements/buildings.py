"""Receivers inside buildings: leave them out, or move them to the nearest point outside."""

from __future__ import annotations

import numpy as np

from calibray.measurements.preparation import Preparation
from calibray.measurements.source_table import Coordinates, SourceTable


def clear_buildings(table: SourceTable, steps: Preparation, rx: Coordinates) -> SourceTable:
    """Leave out or move receivers that stand inside buildings, seen from above.

    Of the steps, `inside` and `outside` are used; the table itself is returned without them.

    Raises:
        InputError: No row remains.
    """
    if steps.inside is None or steps.outside is None:
        return table
    positions, moved = steps.outside(table.positions("rx", rx))
    if steps.inside == "drop":
        return table.keep(moved == 0, "receivers inside buildings, left out")
    too_deep = np.isnan(positions).any(axis=1)
    if count := int(((moved > 0) & ~too_deep).sum()):
        table = table.note("receivers inside buildings, moved out", count)
    table = table.assign(**{str(name): values for name, values in zip(rx, positions.T, strict=True)})
    return table.keep(np.asarray(~too_deep), "receivers deep inside buildings, left out")
