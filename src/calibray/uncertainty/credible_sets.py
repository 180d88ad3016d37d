"""Credible sets of one parameter: highest posterior density, in one or more pieces.

Gaussian kernels with locally adapted widths smooth the density of the weighted draws (B. W. Silverman, Density
Estimation for Statistics and Data Analysis, 1986, section 5.2); they are mirrored at the bounds. The credible set is
the smallest set that covers its share of the posterior. It has two pieces if two distant ranges fit the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

QUANTILES: Final = 400
"""Quantiles that represent the draws."""

GRID: Final = 101
"""Number of equally spaced points over the whole range, in addition to the quantiles."""

STEPS: Final = np.array([0.5, 1.0, 1.5, 2.0, 3.0])
"""Distance of points beyond the outermost quantiles, in kernel widths."""

KERNEL_SHARE: Final = 0.08
"""Share of the draws within the width of a kernel."""

LEAST_SHARE: Final = 0.005
"""Smallest share of the posterior in a piece; smaller shares are chance."""

REACH: Final = 8.5
"""Kernel widths beyond which a Gaussian is zero in double precision."""

LEAST_GAP: Final = 0.03
"""A gap between pieces is chance if it is narrower than this share of the range and than the wider piece."""


def credible_sets(
    value: NDArray[np.float64],
    weight: NDArray[np.float64],
    lower: float,
    upper: float,
    levels: Sequence[float],
) -> list[tuple[tuple[float, float], ...]]:
    """The smallest sets that cover shares of the posterior, from one smoothed density.

    Args:
        value: Draws of the parameter [n].
        weight: Their weights [n].
        lower: Lower bound of the parameter.
        upper: Upper bound of the parameter.
        levels: Shares of the posterior to cover.

    Returns:
        Lower and upper end of every piece, ascending, for each level.

    Example:
        >>> draws = np.random.default_rng(0).normal(5.0, 0.1, 4000)
        >>> (((low, high),),) = credible_sets(draws, np.full(4000, 1 / 4000), 0.0, 10.0, [0.95])
        >>> round(low, 1), round(high, 1)
        (4.8, 5.2)
    """
    width = upper - lower
    edges, mass = _masses((value - lower) / width, weight)
    # Intervals by falling density, until the level is reached.
    order = np.argsort(-mass / np.diff(edges), kind="stable")
    covered, sets = np.cumsum(mass[order]), []
    for level in levels:
        inside = np.zeros(len(mass), dtype=bool)
        inside[order[: int(np.searchsorted(covered, level * covered[-1])) + 1]] = True
        pieces = _pieces(edges, mass / mass.sum(), inside)
        sets.append(tuple((lower + low * width, lower + high * width) for low, high in pieces))
    return sets


def _masses(
    unit: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges of intervals, densest around the draws, and the smoothed mass of the posterior in each interval."""
    order = np.argsort(unit, kind="stable")
    effective = weight.sum() ** 2 / np.sum(weight**2)
    total = np.cumsum(weight[order]) / weight.sum()
    index = np.searchsorted(total, (np.arange(QUANTILES) + 0.5) / QUANTILES)
    quantile = unit[order][np.minimum(index, len(unit) - 1)]
    # A kernel is as wide as a share of the draws on its nearer side; more draws allow narrower kernels (Silverman).
    near = max(1, round(QUANTILES * KERNEL_SHARE * min(1.0, (200.0 / effective) ** 0.2)))
    above, below = np.full(QUANTILES, np.inf), np.full(QUANTILES, np.inf)
    above[:-near] = below[near:] = quantile[near:] - quantile[:-near]
    size = np.maximum(np.minimum(above, below), 1e-9)
    ends = (quantile[0] - size[0] * STEPS, quantile[-1] + size[-1] * STEPS)
    edges = np.unique(np.clip(np.concatenate([np.linspace(0, 1, GRID), quantile, *ends]), 0.0, 1.0))
    edges = np.unique(np.concatenate([edges, 0.5 * (edges[1:] + edges[:-1])]))
    # Mirror only the kernels that reach over a bound.
    low, high = quantile < REACH * size, 1.0 - quantile < REACH * size
    centre = np.concatenate([quantile, -quantile[low], 2.0 - quantile[high]])
    cumulative = ndtr((edges[:, None] - centre) / np.concatenate([size, size[low], size[high]]))
    return edges, np.diff(cumulative.sum(axis=1)) / QUANTILES


def _pieces(
    edges: NDArray[np.float64], mass: NDArray[np.float64], inside: NDArray[np.bool_]
) -> list[tuple[float, float]]:
    """Merge adjacent intervals to pieces; drop pieces and close gaps that are chance."""
    first = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
    last = np.flatnonzero(inside & ~np.concatenate([inside[1:], [False]]))
    kept: list[tuple[float, float]] = []
    for low, high in zip(first.tolist(), last.tolist(), strict=True):
        if mass[low : high + 1].sum() < LEAST_SHARE:
            continue
        start, end = float(edges[low]), float(edges[high + 1])
        if kept and start - kept[-1][1] < min(LEAST_GAP, max(end - start, kept[-1][1] - kept[-1][0])):
            start = kept.pop()[0]
        kept.append((start, end))
    return kept
