"""Predictions over a grid of square cells, as data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.scenes.triangles import Triangles


@dataclass(frozen=True, eq=False)
class PredictedGrid:
    """Path loss, or received power, over a grid of square cells: abstract, `CoverageMap` is the final class.

    Attributes:
        tx: Position of the transmitter [3], [m].
        height: Height of the receivers over the ground [m].
        cell: Width of the cells [m].
        x: Eastings of the cells' middles, ascending [nx], [m].
        y: Northings, ascending [ny], [m].
        z: Heights of the receivers [ny, nx], [m].
        path_loss_db: Path loss, offsets included [ny, nx], [dB]; +inf where no path leads, NaN at the transmitter.
        lower_db: Lower end of the interval [ny, nx], [dB]; NaN where no path leads, or without a level.
        upper_db: Upper end [ny, nx], [dB].
        level: Probability that a measurement lies within; None where it was not asked for.
        power_dbm: Transmitted power [dBm] of a map of received power; None for path loss.
        frame: Where the scene lies on the globe; None where nothing tells.
        triangles: The scene, for drawing.
    """

    tx: NDArray[np.float64]
    height: float
    cell: float
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    path_loss_db: NDArray[np.float64]
    lower_db: NDArray[np.float64]
    upper_db: NDArray[np.float64]
    level: float | None
    power_dbm: float | None
    frame: Frame | None
    triangles: Triangles

    @property
    def layers(self) -> dict[str, NDArray[np.float64]]:
        """What is shown and its interval by name, each [ny, nx]: path loss [dB], or received power [dBm]."""
        if self.power_dbm is None:
            value, ends = "path_loss_db", {"lower_db": self.lower_db, "upper_db": self.upper_db}
            best = self.path_loss_db
        else:
            # More loss is less power: the ends change places.
            value, best = "received_power_dbm", self.power_dbm - self.path_loss_db
            ends = {"lower_dbm": self.power_dbm - self.upper_db, "upper_dbm": self.power_dbm - self.lower_db}
        return {value: best, **({} if self.level is None else ends)}

    def table(self) -> pd.DataFrame:
        """One row per cell, from south to north and west to east: x_m, y_m, z_m and the layers."""
        x, y = np.meshgrid(self.x, self.y)
        columns = {"x_m": x, "y_m": y, "z_m": self.z, **self.layers}
        return pd.DataFrame({name: values.reshape(-1) for name, values in columns.items()})
