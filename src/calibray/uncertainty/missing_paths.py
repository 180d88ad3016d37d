"""Errors of links to which the twin lacks paths, such as paths through buildings.

Missing paths add power. They hardly change links in sight, but raise the power of links out of sight by as much as the
twin makes these too weak.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calibray.fitting.problem import Problem

CANDIDATES: Final = 16
"""Candidates between the bounds whose median is the loss that the twin expects of a link."""

STRONGEST: Final = 0.05
"""Quantile of the excess of the strongest links, which is that of the line of sight if some links have it."""


def excess_db(problem: Problem) -> NDArray[np.float64]:
    """Path loss of links out of sight in excess of free space and of the strongest links [L], [dB].

    It is the median over candidates between the bounds; minus infinity in sight, where the twin has the strongest path.
    """
    links, (lower, upper) = problem.setup.with_obstruction().links, problem.parameters.search_bounds
    points = qmc.scale(qmc.Sobol(len(lower), rng=0).random(CANDIDATES), lower, upper)
    electrical = np.maximum(links.distance, 1e-3) * (1.0 if links.frequency is None else links.frequency)
    excess = np.median(problem.modelled(points), axis=0) - 20.0 * np.log10(electrical)
    strongest = np.quantile(excess[problem.objective.weight > 0], STRONGEST)
    weak = (links.table.numbers("out_of_sight") > 0) & np.isfinite(excess)
    return np.where(weak, excess - strongest, -np.inf)


def missing_db(excess: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Change of path loss by missing power at a level below the line of sight, for links of this excess [dB]."""
    return 10.0 * np.logaddexp(0.0, (excess - level) * (0.1 * np.log(10.0))) / np.log(10.0)
