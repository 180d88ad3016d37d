"""New starting points from minima that are known.

The best one is shifted by the difference of two others, or takes one coordinate of another.

Minima of a problem stand in rows where one cause, as a slab that resonates, acts alike everywhere: a step from one to
the next that was seen at one place leads to a minimum at another. That is the mutation of differential evolution (Storn
and Price, Journal of Global Optimization 11, 1997). Where coordinates act nearly apart, as materials do that few
paths meet both of, the best value of each is found somewhere among the minima, which is its crossover.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

PARENTS = 12
"""Lowest minima that are combined."""
SPACE = 0.05
"""Distance in the unit cube below which a point would lead to a minimum that is known, or to that of another point."""


def recombined(minima: NDArray[np.float64], number: int) -> NDArray[np.float64]:
    """Combine minima into points from which others may be reached.

    Args:
        minima: Minima in the unit cube, none within `SPACE` of another, the best first [k, d].
        number: How many points are wanted.

    Returns:
        Points inside the unit cube, those of the lowest minima first, shifted and exchanged ones in turn; fewer than
        wanted where the minima give no more.
    """
    best, low, dimension = minima[0], minima[:PARENTS], minima.shape[1]
    to, of = np.nonzero(~np.eye(len(low), dtype=bool))
    shifted = best + (low[to] - low[of])[np.lexsort((to + of, np.maximum(to, of)))]
    exchanged = np.where(np.eye(dimension, dtype=bool), low[1:, None], best).reshape(-1, dimension)
    unknown = [_unknown(points, minima) for points in (shifted, exchanged)]
    turn = np.argsort(np.concatenate([np.arange(len(points)) for points in unknown]), kind="stable")
    kept = np.empty((0, dimension))
    for point in np.concatenate(unknown)[turn]:
        if len(kept) >= number:
            break
        if (np.linalg.norm(kept - point, axis=1) > SPACE).all():
            kept = np.vstack([kept, point])
    return kept


def _unknown(points: NDArray[np.float64], minima: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points inside the unit cube that are far from every minimum."""
    inside = ((points >= 0.0) & (points <= 1.0)).all(axis=1)
    return points[inside & (cdist(points, minima) > SPACE).all(axis=1)]
