"""Weighted draws from a posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Draws:
    """Weighted points.

    Attributes:
        point: The points [n, d].
        density: Log posterior density [n] at the points, up to a constant.
        weight: Weights [n] of the points, which sum to one.
        agree: Whether the independent populations of the sampler agree.
    """

    point: NDArray[np.float64]
    density: NDArray[np.float64]
    weight: NDArray[np.float64]
    agree: bool = True


def pooled(draws: Sequence[Draws]) -> Draws:
    """Draws from a mixture of several posteriors with equal weights."""
    return Draws(
        np.concatenate([each.point for each in draws]),
        np.concatenate([each.density for each in draws]),
        np.concatenate([each.weight for each in draws]) / len(draws),
        all(each.agree for each in draws),
    )


def evenly_spaced(count: int, most: int) -> NDArray[np.int64]:
    """Indices of `most` evenly spaced items out of `count`; all indices if `count` is not larger."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def systematic_resampling(
    weight: NDArray[np.float64], count: int, random: np.random.Generator
) -> NDArray[np.intp]:
    """Draw indices [count] with given weights [n] by systematic resampling; the indices are in ascending order."""
    total = np.cumsum(weight)
    quantile = (np.arange(count) + random.random()) / count * total[-1]
    return np.minimum(np.searchsorted(total, quantile), len(weight) - 1)
