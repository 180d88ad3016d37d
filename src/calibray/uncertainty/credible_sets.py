"""Credible sets of one parameter: where its density is highest, in as many pieces as it takes.

The density of weighted draws is smoothed by Gaussian kernels as wide as the draws are sparse (B. W. Silverman, Density
Estimation for Statistics and Data Analysis, 1986, section 5.2), mirrored at the bounds. The set of highest density is
the smallest that holds its share of the posterior; where two values far apart explain the data, it has two pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

POINTS: Final = 400
"""Quantiles that stand for the draws."""

EVEN: Final = 101
"""Places over the whole range beside them."""

STEPS: Final = np.array([0.5, 1.0, 1.5, 2.0, 3.0])
"""Places beyond the outermost quantiles, in the size of their kernels."""

NEAR: Final = 0.08
"""Share of the draws that a kernel is as wide as."""

SLIGHT: Final = 0.005
"""Share of the posterior below which a piece is chance."""

REACH: Final = 8.5
"""Sizes beyond which nothing is left of a kernel, in double precision."""

GAP: Final = 0.03
"""Gaps narrower than this, of the range, are chance as well, where less than a piece's own width."""


def credible(
    value: NDArray[np.float64], weight: NDArray[np.float64], lower: float, upper: float, level: float
) -> tuple[tuple[float, float], ...]:
    """The set of highest density.

    Args:
        value: Draws of the parameter [n].
        weight: Their weights [n].
        lower: Its lower bound.
        upper: Its upper bound.
        level: Share of the posterior to hold.

    Returns:
        Lower and upper end of every piece, ascending.

    Example:
        >>> draws = np.random.default_rng(0).normal(5.0, 0.1, 4000)
        >>> ((low, high),) = credible(draws, np.full(4000, 1 / 4000), 0.0, 10.0, 0.95)
        >>> round(low, 1), round(high, 1)
        (4.8, 5.2)
    """
    return credible_sets(value, weight, lower, upper, (level,))[0]


def credible_sets(
    value: NDArray[np.float64],
    weight: NDArray[np.float64],
    lower: float,
    upper: float,
    levels: Sequence[float],
) -> list[tuple[tuple[float, float], ...]]:
    """The sets of highest density at several levels, the density smoothed once.

    Args:
        value: Draws of the parameter [n].
        weight: Their weights [n].
        lower: Its lower bound.
        upper: Its upper bound.
        levels: Shares of the posterior to hold.

    Returns:
        For every level what `credible` gives.
    """
    width = upper - lower
    at, mass = _masses((value - lower) / width, weight)
    order = np.argsort(-mass / np.diff(at), kind="stable")
    held, found = np.cumsum(mass[order]), []
    for level in levels:
        inside = np.zeros(len(mass), dtype=bool)
        inside[order[: int(np.searchsorted(held, level * held[-1])) + 1]] = True
        pieces = _pieces(at, mass / mass.sum(), inside)
        found.append(tuple((lower + low * width, lower + high * width) for low, high in pieces))
    return found


def _masses(
    unit: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ends of intervals, closest together where draws are, and the share of the posterior in each."""
    order = np.argsort(unit, kind="stable")
    effective = weight.sum() ** 2 / np.sum(weight**2)
    total = np.cumsum(weight[order]) / weight.sum()
    place = np.searchsorted(total, (np.arange(POINTS) + 0.5) / POINTS)
    even = unit[order][np.minimum(place, len(unit) - 1)]
    # As wide as a share of the draws reaches on its nearer side, narrower the more draws there are.
    near = max(1, round(POINTS * NEAR * min(1.0, (200.0 / effective) ** 0.2)))
    above, below = np.full(POINTS, np.inf), np.full(POINTS, np.inf)
    above[:-near] = below[near:] = even[near:] - even[:-near]
    size = np.maximum(np.minimum(above, below), 1e-9)
    ends = (even[0] - size[0] * STEPS, even[-1] + size[-1] * STEPS)
    at = np.unique(np.clip(np.concatenate([np.linspace(0, 1, EVEN), even, *ends]), 0.0, 1.0))
    at = np.unique(np.concatenate([at, 0.5 * (at[1:] + at[:-1])]))
    # Of the mirrored kernels, those count that reach back over the bound.
    low, high = even < REACH * size, 1.0 - even < REACH * size
    centre = np.concatenate([even, -even[low], 2.0 - even[high]])
    each = ndtr((at[:, None] - centre) / np.concatenate([size, size[low], size[high]]))
    return at, np.diff(each.sum(axis=1)) / POINTS


def _pieces(
    at: NDArray[np.float64], mass: NDArray[np.float64], inside: NDArray[np.bool_]
) -> list[tuple[float, float]]:
    """Runs of intervals, chance ones left out or joined."""
    first = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
    last = np.flatnonzero(inside & ~np.concatenate([inside[1:], [False]]))
    kept: list[tuple[float, float]] = []
    for low, high in zip(first.tolist(), last.tolist(), strict=True):
        if mass[low : high + 1].sum() < SLIGHT:
            continue
        start, end = float(at[low]), float(at[high + 1])
        if kept and start - kept[-1][1] < min(GAP, max(end - start, kept[-1][1] - kept[-1][0])):
            start = kept.pop()[0]
        kept.append((start, end))
    return kept
