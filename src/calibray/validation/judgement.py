"""Whether calibration helped where nothing was fitted, in one sentence, with the error of saying so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from calibray.validation.blocks import blocks

TOGETHER: Final = 4
"""Neighbouring links that are resampled as one: they share part of their errors."""

CLUSTERS: Final = 1000
"""The largest number of them; of more links each holds more."""

RESAMPLED: Final = 2000

CONFIDENCE: Final = 0.95
"""Confidence at which a difference counts as one."""


@dataclass(frozen=True)
class Judgement:
    """The calibrated model beside its best rival, on links that neither was fitted to.

    Attributes:
        links: Number of links.
        rmse_db: RMSE of the calibrated model [dB].
        rival: Name of the best rival.
        rival_rmse_db: Its RMSE [dB].
        error_db: Bootstrap standard error of the difference [dB].
        clusters: Number of clusters of neighbours that it was taken from.
    """

    links: int
    rmse_db: float
    rival: str
    rival_rmse_db: float
    error_db: float
    clusters: int

    @property
    def gain_db(self) -> float:
        """What calibration gained over the rival [dB]; negative where it lost."""
        return self.rival_rmse_db - self.rmse_db

    @property
    def helped(self) -> bool:
        """Whether it gained more than chance would."""
        # Few clusters tell their own scatter badly: Student's t.
        return self.gain_db > float(stdtrit(max(self.clusters - 1, 1), (1 + CONFIDENCE) / 2)) * self.error_db

    @property
    def sentence(self) -> str:
        """Whether calibration helped, over which rival, by how much, and how sure that is."""
        here = f"RMSE {self.rmse_db:.2f} dB on {self.links} links held out"
        rival = f"than {self.rival}, the best rival (bootstrap error {self.error_db:.2f} dB)"
        if self.gain_db <= 0:
            return f"Calibration did not help where nothing was fitted: {here}, {-self.gain_db:.2f} dB more {rival}."
        verb = "helped" if self.helped else "did not clearly help"
        return f"Calibration {verb} where nothing was fitted: {here}, {self.gain_db:.2f} dB less {rival}."


def compare(
    errors: NDArray[np.float64],
    rivals: Mapping[str, NDArray[np.float64]],
    position: NDArray[np.float64],
    seed: int = 0,
) -> Judgement:
    """Judge a model by its best rival.

    The error of the difference comes from resampling clusters of neighbouring links, both models on the same ones.

    Args:
        errors: Errors of the model on links held out [n], [dB]; those that are not finite are left out.
        rivals: Errors of each rival on the same links [n], [dB].
        position: Where the links' receivers stand [n, 3], [m].
        seed: Seed of the resampling.

    Returns:
        The judgement.
    """
    table = np.stack([errors, *rivals.values()])
    known = np.isfinite(table).all(axis=0)
    square, count = table[:, known] ** 2, int(known.sum())
    if not count:
        return Judgement(0, np.nan, next(iter(rivals)), np.nan, np.nan, 0)
    rmse = np.sqrt(square.mean(axis=1))
    best = 1 + int(np.argmin(rmse[1:]))
    cluster = blocks(position[known], min(max(count // TOGETHER, min(count, 2)), CLUSTERS))
    size = np.bincount(cluster)
    total = np.stack([np.bincount(cluster, weights=square[row]) for row in (0, best)])
    drawn = np.random.default_rng(seed).integers(len(size), size=(RESAMPLED, len(size)))
    mine, other = np.sqrt(total[:, drawn].sum(axis=2) / size[drawn].sum(axis=1))
    # Resampling k clusters scatters by (k - 1) / k of what k new ones would.
    error = float(np.std(other - mine) * np.sqrt(len(size) / (len(size) - 1))) if len(size) > 1 else np.inf
    return Judgement(count, float(rmse[0]), list(rivals)[best - 1], float(rmse[best]), error, len(size))
