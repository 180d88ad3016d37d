"""What the curvature at the optimum tells: linear theory, where draws start and what stands where none can be made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.problem import Evaluation, Problem
from calibray.fitting.search import Trail
from calibray.result.verdict import Interval, Reason
from calibray.uncertainty.linear_theory import intervals


def by_curvature(problem: Problem, trail: Trail, told: Evaluation) -> dict[str, Interval]:
    """Intervals by linear theory, taken in the search space: of what spans decades, the logarithm is uncertain.

    Args:
        problem: The problem.
        trail: Its finished search.
        told: The optimum evaluated, with derivatives.

    Returns:
        An interval for every parameter, by name.
    """
    parameters = problem.parameters
    nuisances = int(problem.objective.determined.sum())
    point = parameters.to_search(trail.best)
    scale = np.sqrt(told.num_rows / told.residuals.shape[1])
    found = intervals(
        point, told.residuals[0] * scale, told.slopes[0] * scale, *parameters.search_bounds, nuisances,
        told.num_rows,
    )  # fmt: skip
    lower, upper = (
        parameters.from_search(np.array(ends))
        for ends in zip(*((each.lower, each.upper) for each in found), strict=True)
    )
    unit = parameters.search_slope(trail.best)
    return {
        name: Interval(each.standard_error * float(unit[k]), float(lower[k]), float(upper[k]), each.verdict)
        for k, (name, each) in enumerate(zip(parameters.names, found, strict=True))
    }


def alone(local: dict[str, Interval], reason: Reason) -> dict[str, Interval]:
    """Intervals by curvature that stand by themselves, with the reason.

    Args:
        local: The intervals.
        reason: Why there is nothing better.

    Returns:
        The same intervals, the reason told.
    """
    return {name: replace(each, reason=reason) for name, each in local.items()}


def covariances(problem: Problem, points: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Covariance of the parameters at minima, nowhere wider than a third of the range.

    Args:
        problem: The problem.
        points: The minima, in the search space [k, d].
        freedom: Rows of the residuals less the unknowns.

    Returns:
        A matrix for every minimum [k, d, d].
    """
    told = problem.squares(points, derivatives=True)
    lower, upper = problem.parameters.search_bounds
    curvature = told.curvature * np.outer(upper - lower, upper - lower)
    variance = told.value**2 * told.num_rows / freedom
    # A prior as wide as a third of the range keeps what the data cannot tell within it.
    precision = curvature / variance[:, None, None] + 9.0 * np.eye(len(lower))
    return np.linalg.inv(precision) * np.outer(upper - lower, upper - lower)
