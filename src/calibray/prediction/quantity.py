"""Predictions as what was measured: received power or path gain in place of path loss."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.measurements import Measurements
from calibray.study import Study


def as_measured(study: Study, links: Measurements, told: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    """Columns of the quantity that a study's links were measured in.

    Args:
        study: The study.
        links: The links.
        told: Their path_loss_db, and lower_db and upper_db if they have an interval.

    Returns:
        Path gain [dB], received power or RSRP [dBm] with their intervals, whose ends change places, by column, as
        `received_power_dbm`, `received_power_lower_dbm` and `received_power_upper_dbm` [n]; none where path loss was
        measured, or the transmitted power of these links is not known.
    """
    quantity, start = study.links.quantity, _start(study, links)
    if start is None:
        return {}
    unit = "db" if quantity == "path_gain" else "dbm"
    ends = {"path_loss_db": "", "upper_db": "_lower", "lower_db": "_upper"}
    return {
        f"{quantity}{end}_{unit}": start - told[name].to_numpy(float)
        for name, end in ends.items()
        if name in told
    }


def _start(study: Study, links: Measurements) -> NDArray[np.float64] | None:
    """What path loss is taken from [n], [dBm]; None where that is not known."""
    section = study.links
    if section.quantity == "path_loss":
        return None
    if section.quantity != "received_power":
        # The transmitted power of RSRP is in the offset.
        return np.zeros(len(links))
    sent = section.tx_power_dbm
    if isinstance(sent, str):
        return links.table.numbers(sent) if sent in links.frame else None
    return None if sent is None else np.full(len(links), float(sent))
