"""The links of a calibration as the report shows them: positions, groups and residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.result.record import Record

POSITION_COLUMNS = tuple(f"{end}_{axis}" for end in ("tx", "rx") for axis in "xyz")


@dataclass(frozen=True, eq=False)
class Survey:
    """Links with positions.

    Attributes:
        table: The result's links.
        tx: Transmitters [L, 3], [m].
        rx: Receivers [L, 3], [m].
        group: Names of the groups [L]; None without groups.
    """

    table: pd.DataFrame
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    group: NDArray[np.object_] | None

    @property
    def distance(self) -> NDArray[np.float64]:
        """Distances between transmitter and receiver [L], [m]."""
        return np.linalg.norm(self.rx - self.tx, axis=1)

    @property
    def residual_db(self) -> NDArray[np.float64]:
        """Predicted minus measured path loss [L], [dB]; NaN without a prediction."""
        return residual(self.table)

    @property
    def has_path(self) -> NDArray[np.bool_]:
        """Whether a path leads to a link [L]; otherwise the log-distance model predicts it."""
        return self.table["has_path"].to_numpy(bool)


def residual(table: pd.DataFrame) -> NDArray[np.float64]:
    """Predicted minus measured path loss.

    Args:
        table: A result's links.

    Returns:
        Residuals [L], [dB]; those of the fallback for links without a path, NaN without a prediction.
    """
    difference = table["predicted_db"].to_numpy(float) - table["measured_db"].to_numpy(float)
    return np.where(np.isfinite(difference), difference, np.nan)


def survey(result: Record) -> Survey | None:
    """Collect the positions of a calibration's links.

    Args:
        result: The calibration. If its links have no positions, the study's measurements are read.

    Returns:
        The links with positions; None if the measurements cannot be read or have changed.
    """
    table = result.links
    if set(POSITION_COLUMNS) <= set(table.columns):
        positions = table[list(POSITION_COLUMNS)].to_numpy(float)
        group = table["group"].astype(str).to_numpy(object) if "group" in table else None
        return Survey(table, positions[:, :3], positions[:, 3:], group)
    try:
        links = result.study.measurements()
    except InputError:
        return None
    if links.row.tolist() != table["row"].tolist():
        return None
    return Survey(table, links.tx, links.rx, None if links.group is None else links.group.astype(object))
