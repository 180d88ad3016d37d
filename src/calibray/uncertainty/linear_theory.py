"""How far a calibration's answer can be trusted: intervals from the curvature of the sum of squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from calibray.result.verdict import CONFIDENCE, Interval, Verdict


def intervals(
    best: NDArray[np.float64],
    residuals: NDArray[np.float64],
    jacobian: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    nuisances: int,
    count: int | None = None,
) -> list[Interval]:
    """Confidence intervals of the parameters from the curvature of the sum of squares at the optimum.

    A parameter is called not identifiable when its 95 % interval is wider than half of its bounds. Linear theory:
    other minima, and errors that neighbouring links share, can make the truth wider.

    Args:
        best: The optimum [d].
        residuals: Residuals there, offsets eliminated [m], [dB].
        jacobian: Their derivatives [m, d].
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        nuisances: Number of offsets fitted beside the parameters.
        count: Number of residuals that those given stand for, with the same sums of squares and products; their own
            if None.

    Returns:
        One interval per parameter.
    """
    freedom = max((len(residuals) if count is None else count) - len(best) - nuisances, 1)
    reach = float(stdtrit(freedom, (1 + CONFIDENCE) / 2))  # Student's t: standard errors either side
    variance = float(residuals @ residuals) / freedom
    values, vectors = np.linalg.eigh((scaled := jacobian * (upper - lower)).T @ scaled)
    values = np.maximum(values, values.max(initial=0.0) * 1e-12 + 1e-300)
    errors = np.sqrt(variance * ((vectors**2) @ (1 / values))) * (upper - lower)
    found = []
    for value, error, low, high in zip(best, errors, lower, upper, strict=True):
        ends = max(value - reach * error, low), min(value + reach * error, high)
        span = high - low
        verdict = Verdict.IDENTIFIED
        if 2 * reach * error > span / 2:
            verdict = Verdict.NOT_IDENTIFIABLE
        elif min(value - low, high - value) < 1e-6 * span:
            verdict = Verdict.AT_BOUND
        found.append(Interval(float(error), float(ends[0]), float(ends[1]), verdict))
    return found
