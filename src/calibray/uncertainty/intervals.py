"""How far a calibration's answer can be trusted: intervals from the curvature of the sum of squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Interval:
    """How well the links determine one parameter.

    Attributes:
        standard_error: From the residuals' scatter and the derivatives at the optimum, in the parameter's unit.
        lower: Lower end of the 95 % interval, within the bounds; of the lowest piece where there are several.
        upper: Upper end, of the highest piece.
        verdict: "identified", "weakly identified", "ambiguous", "at bound" or "not identifiable".
        pieces: Lower and upper end of every piece, ascending, where the interval was taken from draws.
        reason: Why the verdict is what it is, in words.
        approximate: Whether something stands in for the engine, which gives no derivatives.
    """

    standard_error: float
    lower: float
    upper: float
    verdict: str
    pieces: tuple[tuple[float, float], ...] = ()
    reason: str = ""
    approximate: bool = False

    @property
    def told(self) -> str:
        """The verdict as it is shown."""
        return f"{self.verdict}, approximate" if self.approximate else self.verdict


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
    # SciPy is for who computes intervals; a result that holds some is read without it.
    from scipy.special import stdtrit

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
        verdict = "identified"
        if 2 * reach * error > span / 2:
            verdict = "not identifiable"
        elif min(value - low, high - value) < 1e-6 * span:
            verdict = "at bound"
        found.append(Interval(float(error), float(ends[0]), float(ends[1]), verdict))
    return found
