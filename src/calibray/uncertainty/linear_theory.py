"""Linear theory: intervals and covariances from the curvature of the sum of squares at the optimum.

These intervals replace those of the posterior if it cannot be sampled.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from calibray.fitting.problem import Evaluation, Problem
from calibray.fitting.search import Trail
from calibray.result.verdict import CONFIDENCE, Interval, Reason, ReasonKind, Verdict


def local_intervals(problem: Problem, trail: Trail, optimum: Evaluation) -> dict[str, Interval]:
    """Intervals by linear theory, by name, in the search space, where a parameter over decades is logarithmic.

    `optimum` is the evaluation of the optimum, with derivatives.
    """
    parameters = problem.parameters
    # Compressed residuals are scaled to the sum of squares of the full ones.
    scale = np.sqrt(optimum.num_rows / optimum.residuals.shape[1])
    searched = intervals(
        parameters.to_search(trail.best),
        optimum.residuals[0] * scale,
        optimum.slopes[0] * scale,
        *parameters.search_bounds,
        optimum.num_rows - problem.unknowns,
    )
    lower = parameters.from_search(np.array([interval.lower for interval in searched]))
    upper = parameters.from_search(np.array([interval.upper for interval in searched]))
    unit = parameters.search_slope(trail.best)
    return {
        name: Interval(
            interval.standard_error * float(unit[k]), float(lower[k]), float(upper[k]), interval.verdict
        )
        for k, (name, interval) in enumerate(zip(parameters.names, searched, strict=True))
    }


def with_reason(local: dict[str, Interval], reason: Reason) -> dict[str, Interval]:
    """Add to intervals by linear theory the reason why the posterior was not sampled.

    Curvature alone does not show other minima and correlated errors, so no parameter is more than weakly identified,
    unless the data contain no noise.
    """
    exact, identified = reason.kind == ReasonKind.NO_NOISE, Verdict.IDENTIFIED
    capped = {identified: identified if exact else Verdict.WEAKLY_IDENTIFIED}
    return {
        name: replace(interval, verdict=capped.get(interval.verdict, interval.verdict), reason=reason)
        for name, interval in local.items()
    }


def intervals(
    best: NDArray[np.float64],
    residuals: NDArray[np.float64],
    jacobian: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    freedom: int,
) -> list[Interval]:
    """95 % confidence intervals from the curvature of the sum of squares at the optimum [d], one per parameter.

    A parameter is not identifiable if its interval is wider than half of its bounds [d]. Other minima and correlated
    errors can make the true interval wider. Residuals [m], [dB], and their derivatives [m, d] have the nuisance
    eliminated; the freedom is the number of full residuals minus unknowns.
    """
    freedom = max(freedom, 1)
    quantile = float(stdtrit(freedom, (1 + CONFIDENCE) / 2))  # of Student's t
    variance = float(residuals @ residuals) / freedom
    scaled = jacobian * (upper - lower)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    values = np.maximum(values, values.max(initial=0.0) * 1e-12 + 1e-300)
    errors = np.sqrt(variance * ((vectors**2) @ (1 / values))) * (upper - lower)
    result = []
    for value, error, low, high in zip(best, errors, lower, upper, strict=True):
        ends = max(value - quantile * error, low), min(value + quantile * error, high)
        span = high - low
        verdict = Verdict.IDENTIFIED
        if 2 * quantile * error > span / 2:
            verdict = Verdict.NOT_IDENTIFIABLE
        elif min(value - low, high - value) < 1e-6 * span:
            verdict = Verdict.AT_BOUND
        result.append(Interval(float(error), float(ends[0]), float(ends[1]), verdict))
    return result
