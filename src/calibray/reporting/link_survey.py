"""The links of a calibration as the report shows them: where they stand, and what is left of their path loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.result.record import Record

ENDS = tuple(f"{end}_{axis}" for end in ("tx", "rx") for axis in "xyz")


@dataclass(frozen=True, eq=False)
class Survey:
    """Links with positions.

    Attributes:
        table: The result's links.
        tx: Transmitters [L, 3], [m].
        rx: Receivers [L, 3], [m].
        group: Labels of the groups [L]; None without groups.
    """

    table: pd.DataFrame
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    group: NDArray[np.object_] | None

    @property
    def distance(self) -> NDArray[np.float64]:
        """Straight distances [L], [m]."""
        return np.linalg.norm(self.rx - self.tx, axis=1)

    @property
    def residual_db(self) -> NDArray[np.float64]:
        """Calibrated minus measured path loss [L], [dB]; NaN without a path."""
        return residual(self.table)


def residual(table: pd.DataFrame, column: str = "after_db") -> NDArray[np.float64]:
    """A model minus what was measured.

    Args:
        table: A result's links.
        column: The model's column.

    Returns:
        Differences [L], [dB]; NaN where no path leads or nothing is known.
    """
    difference = table[column].to_numpy(float) - table["measured_db"].to_numpy(float)
    return np.where(np.isfinite(difference), difference, np.nan)


def survey(result: Record) -> Survey | None:
    """Where the links of a calibration stand.

    Args:
        result: The calibration. Results of the version before do not tell; for them the study's links are read.

    Returns:
        The links with positions; None where they are not to be had any more.
    """
    table = result.links
    if set(ENDS) <= set(table.columns):
        ends = table[list(ENDS)].to_numpy(float)
        group = table["group"].astype(str).to_numpy(object) if "group" in table else None
        return Survey(table, ends[:, :3], ends[:, 3:], group)
    try:
        links = result.study.measurements()
    except InputError:
        return None
    if links.row.tolist() != table["row"].tolist():
        return None
    return Survey(table, links.tx, links.rx, None if links.group is None else links.group.astype(object))
