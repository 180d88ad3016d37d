"""What a calibrated scene has to beat: models that know distances and measurements only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibray.errors import EngineError
from calibray.measurements import Measurements


@dataclass(frozen=True)
class LogDistance:
    """The log-distance model that any calibration has to beat: path loss = intercept + slope log10(distance).

    Attributes:
        intercept_db: Path loss at 1 m, [dB].
        slope_db: Loss per decade of distance, [dB]: ten times the path loss exponent.
    """

    intercept_db: float
    slope_db: float

    @classmethod
    def fit(
        cls, distance: NDArray[np.float64], path_loss_db: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> LogDistance:
        """Fit by weighted least squares.

        Args:
            distance: Straight distances [m].
            path_loss_db: Path losses [dB].
            weight: Weights; 0 leaves a link out.

        Returns:
            The model.

        Raises:
            EngineError: Fewer than two links count.
        """
        if np.count_nonzero(weight) < 2:
            raise EngineError("the log-distance model needs at least two links")
        root = np.sqrt(weight)
        design = np.stack([np.ones_like(distance), np.log10(distance)], axis=1)
        (intercept, slope), *_ = np.linalg.lstsq(design * root[:, None], path_loss_db * root, rcond=None)
        return cls(float(intercept), float(slope))

    def path_loss(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss at straight distances [m], [dB]."""
        return self.intercept_db + self.slope_db * np.log10(distance)


def log_distance(
    links: Measurements, measured: NDArray[np.float64], weight: NDArray[np.float64], frequency: float
) -> NDArray[np.float64]:
    """Path loss of the log-distance model fitted to links; over carriers it rises as in free space.

    Args:
        links: The links.
        measured: Their measured path loss [L], [dB].
        weight: Weights; 0 leaves a link out [L].
        frequency: Carrier of the study, which the law is stated for [Hz].

    Returns:
        Its path loss at all links [L], [dB].

    Raises:
        EngineError: Fewer than two links count.
    """
    rise = 0.0 if links.frequency is None else 20 * np.log10(links.frequency / frequency)
    model = LogDistance.fit(links.distance, measured - rise, weight)
    return model.path_loss(links.distance) + rise
