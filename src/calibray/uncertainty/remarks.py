"""Remarks that follow from a calibration's draws."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.result.remark import Remark, RemarkKind, Value
from calibray.result.verdict import Interval
from calibray.result.wording import MOST_ODDS
from calibray.uncertainty.importance_sampling import Draws
from calibray.uncertainty.noise_models import CORRELATED, DIFFERING, GAUSSIAN, HEAVY

LIKELY: Final = 0.5
"""Posterior weight above which a departure from independent Gaussian noise is reported."""

SLACK: Final = 0.02
"""Share of a parameter's range by which a value may lie outside an interval before it is reported."""

MISSED_DB: Final = 0.01
"""RMSE by which draws must undercut the method's best candidate before it is said to have missed the optimum [dB]."""

BEST_DRAWS: Final = 16
"""Draws of highest density that are checked for it."""

DEPARTURES: Final = {
    CORRELATED: RemarkKind.CORRELATED_NOISE,
    HEAVY: RemarkKind.HEAVY_TAILS,
    DIFFERING: RemarkKind.HETEROGENEITY,
}

CAUSES: Final = (CORRELATED, HEAVY, DIFFERING, GAUSSIAN)


def departures(noise: Mapping[str, float]) -> tuple[Remark, ...]:
    """Noise models that the data favour over independent Gaussian noise.

    Args:
        noise: Posterior weights of the noise models.

    Returns:
        A remark for each that is likely.
    """
    gaussian = float(noise.get(GAUSSIAN, 0.0))
    return tuple(
        Remark(remark, {"weight": float(noise[kind]), "gaussian_weight": gaussian})
        for kind, remark in DEPARTURES.items()
        if noise.get(kind, 0.0) > LIKELY
    )


def missed(problem: Problem, posterior: Draws, trail: Trail) -> tuple[Remark, ...]:
    """Whether draws have a lower objective than the best candidate of the method.

    Args:
        problem: The problem.
        posterior: The draws.
        trail: The finished search.

    Returns:
        A remark, or none.
    """
    top = posterior.point[np.argsort(-posterior.density)[:BEST_DRAWS]]
    lowest = float(problem.squares(top).value.min())
    if lowest > trail.best_value - MISSED_DB:
        return ()
    return (Remark(RemarkKind.MISSED_OPTIMUM, {"draws_db": lowest, "found_db": float(trail.best_value)}),)


def outside_interval(
    problem: Problem,
    optimum: Mapping[str, float],
    intervals: Mapping[str, Interval],
    most_probable: Mapping[str, float],
    log_odds: float,
    noise: Mapping[str, float],
) -> tuple[Remark, ...]:
    """Whether values of least RMSE lie outside their own intervals.

    Args:
        problem: The problem.
        optimum: The values of least RMSE by parameter.
        intervals: The intervals.
        most_probable: The values of the draw of highest density by parameter.
        log_odds: Logarithm of the density of that draw over that of the values of least RMSE.
        noise: Posterior weights of the noise models.

    Returns:
        A remark that names the parameters and the cause, or none.
    """
    outside = []
    for parameter in problem.parameters:
        interval, slack = intervals[parameter.name], SLACK * (parameter.upper - parameter.lower)
        if interval.pieces and not interval.contains(optimum[parameter.name], slack):
            outside.append(parameter.name)
    if not outside:
        return ()
    holdout = problem.setup.study.holdout
    values: dict[str, Value] = {
        "names": outside,
        "values": [float(optimum[name]) for name in outside],
        "pieces": [[float(end) for piece in intervals[name].pieces for end in piece] for name in outside],
        "most_probable": [float(most_probable[name]) for name in outside],
        "cause": max(CAUSES, key=lambda kind: noise.get(kind, 0.0)),
        "odds": float(np.exp(np.clip(log_odds, 0.0, np.log(MOST_ODDS)))),
        "blocks": holdout is not None and holdout.where is None,
    }
    return (Remark(RemarkKind.OUTSIDE_INTERVAL, values),)
