"""Checks of a finished calibration that lead to remarks: noise, missed optimum, intervals, undeclared offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, Trail, least_squares
from calibray.result.verdict import CONFIDENCE, Interval, Remark, RemarkKind, Value
from calibray.result.wording import MOST_ODDS
from calibray.uncertainty.draws import Draws
from calibray.uncertainty.joint_model import has_offset
from calibray.uncertainty.noise_models import CORRELATED, DIFFERING, GAUSSIAN, HEAVY, OUT_OF_SIGHT

LIKELY: Final = 0.75
"""Odds of three to one against independent Gaussian errors, or against equal buildings, at which a departure is
reported. A priori, buildings differ with a probability of one half."""

NOTABLE: Final = 0.25
"""Smallest posterior weight of a kind of noise that is reported; several kinds can share the weight."""

SLACK: Final = 0.02
"""Distance of a value from its interval, as a share of the range, above which it is reported."""

MISSED_DB: Final = 0.01
"""Improvement of the objective by a draw above which the method is reported to have missed the optimum [dB]."""

BEST_DRAWS: Final = 16
"""Number of draws of highest density that are checked for a missed optimum."""

STARTS: Final = 16
"""Number of local searches with a free offset, in addition to those from the minima without it."""

OFFSET_DB: Final = 0.1
"""Smallest undeclared offset that is reported [dB]."""

DEPARTURES: Final = {
    CORRELATED: RemarkKind.CORRELATED_NOISE,
    OUT_OF_SIGHT: RemarkKind.ERRORS_OUT_OF_SIGHT,
    HEAVY: RemarkKind.HEAVY_TAILS,
    DIFFERING: RemarkKind.HETEROGENEITY,
}

CAUSES: Final = (CORRELATED, OUT_OF_SIGHT, HEAVY, DIFFERING, GAUSSIAN)


def departures(noise: Mapping[str, float]) -> tuple[Remark, ...]:
    """A remark for each noise model that the data favour over independent Gaussian noise, from their weights."""
    gaussian, remarks = float(noise.get(GAUSSIAN, 0.0)), []
    for kind, remark in DEPARTURES.items():
        weight = float(noise.get(kind, 0.0))
        rival = 1.0 - weight if kind == DIFFERING else gaussian
        if weight > max(NOTABLE, LIKELY * (weight + rival)):
            remarks.append(Remark(remark, {"weight": weight, "gaussian_weight": gaussian}))
    return tuple(remarks)


def missed(problem: Problem, posterior: Draws, trail: Trail) -> tuple[Remark, ...]:
    """A remark if a draw has a lower objective than the best candidate of the method."""
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
    """A remark that names the parameters whose calibrated values lie outside their intervals, and the cause.

    Args:
        problem: The problem.
        optimum: The calibrated values by parameter.
        intervals: The intervals.
        most_probable: The values of the draw of highest density by parameter.
        log_odds: Log density of that draw minus that of the calibrated values.
        noise: Posterior weights of the noise models.
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


class UndeclaredOffset(NamedTuple):
    """An offset for all links, fitted in addition to the study's model.

    Attributes:
        offset_db: The best offset [dB]; None if the study declares one, or if the fit does not change.
        error_db: Its standard error [dB].
        remarks: A warning if it is significant.
    """

    offset_db: float | None = None
    error_db: float | None = None
    remarks: tuple[Remark, ...] = ()


def fit_undeclared_offset(
    problem: Problem, minima: NDArray[np.float64], square: float, freedom: int
) -> UndeclaredOffset:
    """Fit an offset for all links if the study declares none, and test its significance.

    Args:
        problem: The problem.
        minima: Its minima, the lowest first [k, d].
        square: Mean square of the residuals at the lowest [dB^2].
        freedom: Number of residuals minus unknowns.

    Returns:
        The offset.
    """
    objective = problem.objective
    if has_offset(problem) or freedom < 2:
        return UndeclaredOffset()
    terms = (*objective.nuisance.terms, make_term(problem.setup.links, "free offset"))
    trial = replace(problem, objective=replace(objective, nuisance=Nuisance(len(objective.weight), terms)))
    best = least_squares(trial, STARTS, minima[:BASINS]).minima
    value = trial.squares(best).value
    lowest = int(np.argmin(value))
    loss, remaining = trial.modelled(best[lowest : lowest + 1]), float(value[lowest] ** 2)
    offset = float(trial.objective.coefficients(loss)[0, -1])
    # F statistic of one further column: the square of the offset over its standard error.
    ratio = (square - remaining) / remaining * (freedom - 1) if remaining > 0 else np.inf
    if not ratio > 0 or not np.isfinite(ratio):
        return UndeclaredOffset()
    error = abs(offset) / float(np.sqrt(ratio))
    if ratio <= fdtri(1, freedom - 1, CONFIDENCE) or abs(offset) < OFFSET_DB:
        return UndeclaredOffset(offset, error)
    rmse = {"rmse_db": float(np.sqrt(remaining)), "rmse_without_db": float(np.sqrt(square))}
    remark = Remark(RemarkKind.UNDECLARED_OFFSET, {"offset_db": offset, "error_db": error, **rmse})
    return UndeclaredOffset(offset, error, (remark,))
