"""Comparison of models on held-out links, with the bootstrap error of the difference."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.result.held_out import Judgement, Model
from calibray.validation.blocks import blocks

CLUSTER_LINKS: Final = 4
"""Neighbouring links that are resampled together, since they share part of their noise."""

MOST_CLUSTERS: Final = 1000
"""Most clusters; with more links, clusters are larger."""

RESAMPLES: Final = 2000


def compare(
    errors: NDArray[np.float64],
    baselines: Mapping[Model, NDArray[np.float64]],
    position: NDArray[np.float64],
    seed: int = 0,
) -> Judgement:
    """Compare a model with its best baseline.

    The error of the difference comes from resampling clusters of neighbouring links, the same ones for both models.

    Args:
        errors: Residuals of the model on held-out links [n], [dB]; links with a non-finite residual are left out.
        baselines: Residuals of each baseline on the same links [n], [dB].
        position: Positions of the receivers [n, 3], [m].
        seed: Seed of the resampling.

    Returns:
        The comparison.
    """
    table = np.stack([errors, *baselines.values()])
    finite = np.isfinite(table).all(axis=0)
    square, count = table[:, finite] ** 2, int(finite.sum())
    if not count:
        return Judgement(0, np.nan, next(iter(baselines)), np.nan, np.nan, 0)
    rmse = np.sqrt(square.mean(axis=1))
    best = 1 + int(np.argmin(rmse[1:]))
    cluster = blocks(position[finite], min(max(count // CLUSTER_LINKS, min(count, 2)), MOST_CLUSTERS))
    size = np.bincount(cluster)
    total = np.stack([np.bincount(cluster, weights=square[row]) for row in (0, best)])
    resampled = np.random.default_rng(seed).integers(len(size), size=(RESAMPLES, len(size)))
    model_rmse, baseline_rmse = np.sqrt(total[:, resampled].sum(axis=2) / size[resampled].sum(axis=1))
    # Resampling k clusters underestimates the variance over new clusters by (k - 1) / k.
    correction = np.sqrt(len(size) / (len(size) - 1)) if len(size) > 1 else np.inf
    error = float(np.std(baseline_rmse - model_rmse) * correction) if len(size) > 1 else np.inf
    name = list(baselines)[best - 1]
    return Judgement(count, float(rmse[0]), str(name), float(rmse[best]), error, len(size))
