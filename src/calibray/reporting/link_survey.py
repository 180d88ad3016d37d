"""The links of a calibration as shown in the report: positions, groups and residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.result.record import Record


@dataclass(frozen=True, eq=False)
class Survey:
    """Links with positions.

    Attributes:
        table: The result's links.
        tx: Transmitters [L, 3], [m].
        rx: Receivers [L, 3], [m].
        group: Name of each link's group [L]; None if the study has no groups.
        sign: 1 if path loss was measured; -1 if power or gain was measured.
    """

    table: pd.DataFrame
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    group: NDArray[np.object_] | None
    sign: int = 1

    @property
    def distance(self) -> NDArray[np.float64]:
        """Distances between transmitter and receiver [L], [m]."""
        return np.linalg.norm(self.rx - self.tx, axis=1)

    @property
    def residual_db(self) -> NDArray[np.float64]:
        """Predicted minus measured value of the measured quantity [L], [dB]; NaN in the cases listed in `residual`."""
        return residual(self.table, self.sign)

    @property
    def faint(self) -> NDArray[np.bool_]:
        """Whether each link [L] is near or below the noise floor and was therefore left out of the calibration."""
        return _faint(self.table)

    @property
    def has_path(self) -> NDArray[np.bool_]:
        """Whether a link has a path [L]."""
        return self.table["has_path"].to_numpy(bool)


class Quantity(NamedTuple):
    """The quantity that was measured.

    Attributes:
        name: Name of the quantity.
        unit: Unit of the quantity.
        sign: 1 if the quantity increases with path loss, otherwise -1.
    """

    name: str
    unit: str
    sign: int


QUANTITIES: Final = {
    "path_loss": Quantity("path loss", "dB", 1),
    "path_gain": Quantity("path gain", "dB", -1),
    "received_power": Quantity("received power", "dBm", -1),
    "rsrp": Quantity("RSRP", "dBm", -1),
}


def measured_quantity(result: Record) -> Quantity:
    """The quantity that was measured; path loss if the links have no values of another quantity."""
    quantity = result.study.links.quantity
    return QUANTITIES[quantity if _column(result) in result.links else "path_loss"]


def in_measured_quantity(result: Record, name: str) -> NDArray[np.float64]:
    """Values of the measured quantity on the links [L], in its unit.

    `name` selects the values: "measured", "before", "after" or "predicted".
    """
    path_loss_db, column = result.links[f"{name}_db"].to_numpy(float), _column(result)
    if column not in result.links:
        return path_loss_db
    # Received power plus path loss is the transmitted power, and path gain plus path loss is 0. This sum is known from
    # a link's measured values, and also converts its modelled path loss.
    reference = result.links[column].to_numpy(float) + result.links["measured_db"].to_numpy(float)
    return reference - path_loss_db


def _column(result: Record) -> str:
    quantity = result.study.links.quantity
    return f"measured_{quantity}_{'db' if quantity == 'path_gain' else 'dbm'}"


def residual(table: pd.DataFrame, sign: int) -> NDArray[np.float64]:
    """Predicted minus measured value of the measured quantity on a result's links [L], [dB].

    `sign` is 1 if the measured quantity increases with path loss, otherwise -1. For links without a path, the
    prediction is that of the fallback model. The residual is NaN if there is no prediction, and for links near or below
    the noise floor. Links just above the floor are a biased sample, because only favourable errors keep them there.
    Below the floor, only a lower bound on path loss is known.
    """
    difference = table["predicted_db"].to_numpy(float) - table["measured_db"].to_numpy(float)
    return sign * np.where(np.isfinite(difference) & ~_faint(table), difference, np.nan)


def _faint(table: pd.DataFrame) -> NDArray[np.bool_]:
    return table["faint"].to_numpy(bool) if "faint" in table else np.zeros(len(table), dtype=bool)


def survey(result: Record) -> Survey | None:
    """A calibration's links with positions; positions that the result lacks are read from the measurements.

    The function returns None if the measurements cannot be read or have changed.
    """
    table, sign = result.links, measured_quantity(result).sign
    if (ends := result.ends) is not None:
        group = table["group"].astype(str).to_numpy(object) if "group" in table else None
        return Survey(table, ends[:, :3], ends[:, 3:], group, sign)
    try:
        links = result.study.measurements()
    except InputError:
        return None
    if links.row.tolist() != table["row"].tolist():
        return None
    return Survey(
        table, links.tx, links.rx, None if links.group is None else links.group.astype(object), sign
    )
