"""Whether path loss and further observables want different parameters, beyond their errors.

The parameters are fitted to path loss alone, to the further observables alone, and to both. The increase of both sums
of squares at the common fit, in units of the errors' variances, follows Fisher's F if one set of parameters explains
everything.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, ndtri

from calibray.fitting.preliminary_fits import with_estimated_errors
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, least_squares
from calibray.result.remark import Remark, RemarkKind, Value

SIGNIFICANT: Final = 0.005
"""Probability of a larger increase without a conflict, below which one is reported; errors that neighbouring links
share make small probabilities somewhat more frequent."""

STARTS: Final = 32
"""Local searches of the fits to one kind of data."""

DOMINANT: Final = 1e3
"""Weight of the further observables' rows where they alone are fitted, relative to path loss."""


def conflict(problem: Problem, minima: NDArray[np.float64]) -> tuple[Remark, ...]:
    """Compare what path loss and the further observables say of the parameters.

    Args:
        problem: The problem, with further observables.
        minima: Its relevant minima [k, d].

    Returns:
        A remark with both answers if they differ beyond the errors, or none.
    """
    objective, width = problem.objective, len(problem.parameters)
    starts = minima[:BASINS]
    links = least_squares(replace(problem, observed=()), STARTS, starts).best.x
    dominant = replace(problem, objective=replace(objective, noise_db=DOMINANT * objective.noise_db))
    further = least_squares(dominant, STARTS, starts).best.x
    freedom = objective.num_counted - problem.unknowns
    of_further = sum(each.freedom(objective.weight) for each in problem.observed) - width
    if freedom < 1 or of_further < 1:
        return ()
    own = with_estimated_errors(problem, further)
    noise_db = float(np.sqrt(_squares(own, links)[0] / freedom))
    own = replace(own, objective=replace(objective, noise_db=noise_db))
    both = least_squares(own, STARTS, np.vstack([starts, links[None], further[None]])).best.x
    increase = (
        _squares(own, both) - np.array([_squares(own, links)[0], _squares(own, further)[1]])
    ) / noise_db**2
    statistic = float(increase.sum()) / width
    probability = float(fdtrc(width, freedom + of_further, max(statistic, 0.0)))
    if probability >= SIGNIFICANT:
        return ()
    first, second = (problem.parameters.from_search(point) for point in (links, further))
    values: dict[str, Value] = {
        "observables": [each.name for each in problem.observed],
        "names": list(problem.parameters.names),
        "path_loss": first.tolist(),
        "further": second.tolist(),
        "standard_errors": float(-ndtri(max(probability, 1e-15) / 2)),
    }
    return (Remark(RemarkKind.CONFLICT, values),)


def _squares(problem: Problem, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of squares of the links' rows and of the further observables' rows [2]."""
    residuals = problem.evaluate(point[None]).residuals[0]
    further = sum(len(each.used(problem.objective.weight)) for each in problem.observed)
    links = residuals[: problem.objective.num_counted]
    return np.array([np.sum(links**2), np.sum(residuals[len(residuals) - further :] ** 2)])
