"""The minima of a finished search: every place where the parameters may lie."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail, rounds
from calibray.optimizers import LeastSquares

SEARCHES: Final = 64
"""Local searches for the minima, where the method kept none."""

BASINS: Final = 24
"""Minima that draws start around, at least."""

LIKELY: Final = 20.0
"""Excess of the sum of squares, in variances of the noise, up to which a minimum may matter."""


def minima(problem: Problem, trail: Trail) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Every minimum known.

    Args:
        problem: The problem.
        trail: Its finished search.

    Returns:
        Points of the search space, the best one found leading [k, d], and their mean squares [k].
    """
    known = np.concatenate([problem.parameters.to_search(trail.best)[None], trail.minima])
    if len(known) <= 2:  # the method kept its best alone
        search = LeastSquares(*problem.parameters.search_bounds, starts=SEARCHES, x0=known)
        for _ in rounds(search, problem.squares):
            pass
        known = np.concatenate([known, search.minima])
    return known, problem.squares(known).value ** 2


def likely(known: NDArray[np.float64], square: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Those that may matter for an interval.

    Args:
        known: Minima [k, d].
        square: Their mean squares [k].
        freedom: Rows of the residuals less the unknowns.

    Returns:
        Those minima, the lowest first [j, d].
    """
    order = np.argsort(square, kind="stable")
    order = order[square[order] <= square.min() * (1.0 + LIKELY / freedom)]
    return known[order]
