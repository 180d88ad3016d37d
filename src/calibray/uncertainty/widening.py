"""Intervals where draws are too few to tell where the posterior ends: wide rather than narrow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from calibray.result.verdict import Interval, Reason, ReasonKind, Verdict
from calibray.uncertainty.verdicts import IDENTIFIED, WEAKLY


def widened(drawn: Interval, local: Interval, share: Callable[[float], float]) -> Interval:
    """An interval from few draws and one by linear theory, together.

    Args:
        drawn: The one from draws of a flattened posterior.
        local: The one by the curvature at the optimum.
        share: A value to its place between the bounds, 0 to 1.

    Returns:
        From the lower of both lower ends to the upper of both upper ends; what is left so wide is no longer called
        identified.

    Example:
        >>> few = Interval(0.1, 2.0, 3.0, Verdict.IDENTIFIED, ((2.0, 3.0),))
        >>> wide = widened(few, Interval(0.1, 4.0, 9.0, Verdict.IDENTIFIED), lambda value: value / 10)
        >>> wide.lower, wide.upper, str(wide.verdict)
        (2.0, 9.0, 'not identifiable')
    """
    lower, upper = min(drawn.lower, local.lower), max(drawn.upper, local.upper)
    left, verdict, reason = share(upper) - share(lower), drawn.verdict, drawn.reason
    if verdict in (Verdict.IDENTIFIED, Verdict.WEAKLY_IDENTIFIED) and left > IDENTIFIED:
        verdict = Verdict.WEAKLY_IDENTIFIED if left <= WEAKLY else Verdict.NOT_IDENTIFIABLE
        reason = Reason(ReasonKind.TOO_FEW_DRAWS, {"share": float(left)})
    return replace(drawn, lower=lower, upper=upper, pieces=((lower, upper),), verdict=verdict, reason=reason)
