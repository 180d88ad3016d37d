"""Checks of a finished calibration that lead to remarks: noise, missed optimum, intervals, undeclared offset, conflict.

Path loss and further observables may contradict each other by more than their errors explain. In this case, path loss
and the observables require different parameter values. The parameters are fitted to path loss alone, to the further
observables alone, and to both. The test statistic is the increase in both sums of squares from the separate fits to the
common fit, divided by the variances of the errors and by the number of parameters. This statistic follows an F
distribution if one set of parameters explains all data. It is also possible that no parameter values explain an
observable, for example because it was measured in a different scene. Measured values are therefore regressed on
modelled values. The slope is 1 if the model is right, and near 0 if measured and modelled values are unrelated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, fdtri, ndtri, stdtr

from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.preliminary_fits import with_estimated_errors
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, least_squares
from calibray.result.verdict import CONFIDENCE, Interval, Remark, RemarkKind, Value
from calibray.result.wording import MOST_ODDS
from calibray.study.calibration_sections import FREE_OFFSET
from calibray.study.model import StudyModel
from calibray.tracing.settings import RANGES
from calibray.uncertainty.draws import Draws
from calibray.uncertainty.joint_model import has_offset
from calibray.uncertainty.noise_models import CORRELATED, DIFFERING, GAUSSIAN, HEAVY, OFFSET, OUT_OF_SIGHT

SIGNIFICANT: Final = 0.005
"""A conflict is reported if its p-value, the probability of a larger increase without a conflict, is below this value.
Errors shared by neighbouring links make small p-values slightly more common."""

UNRELATED: Final = 0.02
"""An observable is reported as not fitting the scene if the p-value of its slope (the probability, under the model, of
a slope this small) is below this value divided by the number of observables."""

FEWEST: Final = 5
"""Minimum number of degrees of freedom for testing a slope."""

CONFLICT_STARTS: Final = 32
"""Number of local searches per fit."""

DOMINANT: Final = 1e3
"""Factor by which the residuals of the further observables are multiplied in the fit to these observables alone. In the
fit to path loss alone, these residuals are divided by this factor. With this factor, all fits can use the same compiled
program."""


def conflict(problem: Problem, minima: NDArray[np.float64]) -> tuple[Remark, ...]:
    """Compare the parameter values that path loss requires with the values that further observables require.

    The minima of the problem [k, d] are starting points of the fits.

    Returns:
        Remarks that state both fits and the size of the conflict in standard errors; no remarks if there is no
        conflict.
    """
    objective, width = problem.objective, len(problem.parameters)
    starts = minima[:BASINS]
    links = least_squares(_weighted(problem, 1 / DOMINANT), CONFLICT_STARTS, starts).best.x
    further = least_squares(_weighted(problem, DOMINANT), CONFLICT_STARTS, starts).best.x
    freedom = problem.freedom
    of_further = sum(each.freedom(objective.weight) for each in problem.observed) - width
    if freedom < 1 or of_further < 1:
        return ()
    own = with_estimated_errors(problem, further)
    noise_db = float(np.sqrt(_squares(own, links)[0] / freedom))
    own = replace(own, objective=replace(objective, noise_db=noise_db))
    both = least_squares(own, CONFLICT_STARTS, np.vstack([starts, links[None], further[None]])).best.x
    increase = (
        _squares(own, both) - np.array([_squares(own, links)[0], _squares(own, further)[1]])
    ) / noise_db**2
    # The common fit has one set of parameters, and the separate fits have two sets; this gives `width` degrees of
    # freedom.
    statistic = float(increase.sum()) / width
    probability = float(fdtrc(width, freedom + of_further, max(statistic, 0.0)))
    first, second = (problem.parameters.from_search(point) for point in (links, further))
    values: dict[str, Value] = {
        "observables": [each.name for each in problem.observed],
        "names": list(problem.parameters.names),
        "path_loss": first.tolist(),
        "further": second.tolist(),
        "standard_errors": float(-ndtri(max(probability, 1e-15) / 2)),
    }
    remarks = [Remark(RemarkKind.CONFLICT, values)] if probability < SIGNIFICANT else []
    for slope in _slopes(problem, both):
        if slope.probability < UNRELATED / len(problem.observed):
            of_one: dict[str, Value] = {
                "observables": [slope.name],
                "slope": slope.value,
                "slope_error": slope.error,
                "standard_errors": (1 - slope.value) / slope.error,
            }
            remarks.append(Remark(RemarkKind.CONFLICT, values | of_one))
    return tuple(remarks)


class Slope(NamedTuple):
    """Slope of the regression of an observable's measured values on its modelled values.

    Attributes:
        name: The observable.
        value: The slope.
        error: Its standard error.
        probability: Probability of a slope this small if the model is right.
    """

    name: str
    value: float
    error: float
    probability: float


def _slopes(problem: Problem, point: NDArray[np.float64]) -> list[Slope]:
    """Slopes of the observables at a point of the search space, fitted with a constant or the devices' biases."""
    modelled = problem.respond(problem.parameters.from_search(point[None])).observed[0]
    slopes = []
    for each, values in zip(problem.observed, modelled, strict=True):
        used = each.used(problem.objective.weight)
        used = used[np.isfinite(values[used])]
        x, y = values[used] / each.scale, each.measured[used]
        groups = np.unique(each.group[used], return_inverse=True)[1]
        x, y = (column - (np.bincount(groups, column) / np.bincount(groups))[groups] for column in (x, y))
        left = len(used) - (groups.max(initial=0) + 1) - 1
        # Values that hardly vary from link to link do not determine a slope.
        if left < FEWEST or np.sum(x**2) <= 1e-12 * np.sum((values[used] / each.scale) ** 2):
            continue
        slope = float(np.sum(x * y) / np.sum(x**2))
        error = float(np.sqrt(max(np.sum((y - slope * x) ** 2), 1e-300) / left / np.sum(x**2)))
        slopes.append(Slope(each.name, slope, error, float(stdtr(left, (slope - 1) / error))))
    return slopes


def _weighted(problem: Problem, weight: float) -> Problem:
    """The problem, with the rows of its further observables multiplied by a weight."""
    return replace(problem, observed=tuple(replace(each, std=each.std / weight) for each in problem.observed))


def _squares(problem: Problem, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of squares of the links' rows and of the further observables' rows [2]."""
    residuals = problem.evaluate(point[None]).residuals[0]
    further = sum(len(each.used(problem.objective.weight)) for each in problem.observed)
    links = residuals[: problem.objective.num_counted]
    return np.array([np.sum(links**2), np.sum(residuals[len(residuals) - further :] ** 2)])


LIKELY: Final = 0.75
"""Probability above which a departure from independent Gaussian errors or from equal buildings is reported; the odds
are then three to one. A priori, buildings differ with a probability of one half."""

NOTABLE: Final = 0.25
"""Minimum posterior weight of a kind of noise that is reported; several kinds of noise can share the weight."""

SLACK: Final = 0.02
"""A calibrated value outside its interval is reported if its distance from the interval exceeds this fraction of the
search range. The search range is logarithmic for a parameter with a logarithmic scale."""

MISSED_DB: Final = 0.01
"""The method is reported to have missed the optimum if the objective of a draw is lower by at least this much [dB]."""

STARTS: Final = 16
"""Number of local searches with a free offset, in addition to the searches that start from the minima without an
offset."""

OFFSET_DB: Final = 0.1
"""Minimum undeclared offset that is reported [dB]."""

DEPARTURES: Final = {
    CORRELATED: RemarkKind.CORRELATED_NOISE,
    OUT_OF_SIGHT: RemarkKind.ERRORS_OUT_OF_SIGHT,
    HEAVY: RemarkKind.HEAVY_TAILS,
    DIFFERING: RemarkKind.HETEROGENEITY,
}


def departures(noise: Mapping[str, float], study: StudyModel) -> tuple[Remark, ...]:
    """A remark for each noise model that, by its posterior weight, the data favour over independent Gaussian noise.

    Noise that the study states is not reported. A remark about errors out of sight lists tracer settings that add
    paths.
    """
    gaussian, remarks = float(noise.get(GAUSSIAN, 0.0)), []
    stated = {
        HEAVY: study.noise.kind == HEAVY,
        CORRELATED: study.noise.range_m not in ("auto", 0),
        DIFFERING: study.noise.heterogeneity not in ("auto", 0),
    }
    for kind, remark in DEPARTURES.items():
        if stated.get(kind, False):
            continue
        weight = float(noise.get(kind, 0.0))
        # Differing buildings compete with equal buildings; other kinds of noise compete with Gaussian noise.
        rival = 1.0 - weight if kind == DIFFERING else gaussian
        if weight > max(NOTABLE, LIKELY * (weight + rival)):
            values: dict[str, Value] = {"weight": weight, "gaussian_weight": gaussian}
            if remark is RemarkKind.ERRORS_OUT_OF_SIGHT:
                values["lacking"] = _lacking(study)
            remarks.append(Remark(remark, values))
    return tuple(remarks)


def _lacking(study: StudyModel) -> list[str]:
    """Tracer settings that would find more paths, written as in a study file; empty for an external program."""
    if study.engine.external:
        return []
    switches = [f"{name} = true" for name in ("refraction", "diffraction") if not getattr(study.trace, name)]
    depth = study.trace.max_depth + 1
    return switches + [f"max_depth = {depth}"] * (depth <= RANGES["max_depth"][1])


def missed(problem: Problem, posterior: Draws, best_value: float) -> tuple[Remark, ...]:
    """A remark if a draw's objective [dB] is at least `MISSED_DB` below the method's best objective."""
    top = posterior.point[np.argsort(-posterior.density)[:16]]
    lowest = float(problem.squares(top).value.min())
    if lowest > best_value - MISSED_DB:
        return ()
    method = problem.setup.study.method.name
    values: dict[str, Value] = {"draws_db": lowest, "found_db": best_value, "method": method}
    return (Remark(RemarkKind.MISSED_OPTIMUM, values),)


def outside_interval(
    problem: Problem,
    optimum: Mapping[str, float],
    intervals: Mapping[str, Interval],
    most_probable: Mapping[str, float],
    log_odds: float,
    noise: Mapping[str, float],
) -> tuple[Remark, ...]:
    """A remark that names the parameters whose calibrated values are outside their intervals, and states the cause.

    Args:
        problem: The problem.
        optimum: The calibrated values by parameter.
        intervals: The intervals.
        most_probable: The parameter values, by name, of the draw with the highest density at the scene's constants.
        log_odds: Log density of this draw minus the log density of the calibrated values.
        noise: Posterior weights of the noise models.
    """
    parameters, outside = problem.parameters, []
    values_of = np.array([optimum[name] for name in parameters.names])
    for index, name in enumerate(parameters.names):
        ends = np.tile(values_of, (2 * len(intervals[name].pieces) + 1, 1))
        ends[1:, index] = np.ravel(intervals[name].pieces)
        value, *pieces = parameters.to_unit(ends)[:, index]
        below = [
            low - SLACK <= value <= high + SLACK for low, high in zip(pieces[::2], pieces[1::2], strict=True)
        ]
        if below and not any(below):
            outside.append(name)
    if not outside:
        return ()
    values: dict[str, Value] = {
        "names": outside,
        "values": [float(optimum[name]) for name in outside],
        "pieces": [[float(end) for piece in intervals[name].pieces for end in piece] for name in outside],
        "most_probable": [float(most_probable[name]) for name in outside],
        "cause": max((kind for kind in noise if kind != OFFSET), key=lambda kind: noise[kind]),
        "odds": float(np.exp(np.clip(log_odds, 0.0, np.log(MOST_ODDS)))),
        "blocks": problem.setup.study.holds_out_blocks,
    }
    return (Remark(RemarkKind.OUTSIDE_INTERVAL, values),)


class UndeclaredOffset(NamedTuple):
    """An offset for all links, fitted in addition to the study's model.

    Attributes:
        offset_db: The best offset [dB]; None if the study declares an offset, or an offset does not improve the fit.
        error_db: Its standard error [dB].
        remarks: A warning if the offset is significant.
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
        minima: The problem's minima, lowest first [k, d].
        square: Mean square of the residuals at the lowest minimum [dB^2].
        freedom: Number of residuals minus unknowns.

    Returns:
        The offset.
    """
    objective = problem.objective
    if has_offset(problem) or freedom < 2:
        return UndeclaredOffset()
    terms = (*objective.nuisance.terms, make_term(problem.setup.links, FREE_OFFSET))
    trial = replace(problem, objective=replace(objective, nuisance=Nuisance(len(objective.weight), terms)))
    best = least_squares(trial, STARTS, minima[:BASINS]).minima
    value = trial.squares(best).value
    lowest = int(np.argmin(value))
    loss, remaining = trial.modelled(best[lowest : lowest + 1]), float(value[lowest] ** 2)
    offset = float(trial.objective.coefficients(loss)[0, -1])
    # F statistic of one further column: (offset / standard error)^2.
    ratio = (square - remaining) / remaining * (freedom - 1) if remaining > 0 else np.inf
    if not ratio > 0 or not np.isfinite(ratio):
        return UndeclaredOffset()
    error = abs(offset) / float(np.sqrt(ratio))
    if ratio <= fdtri(1, freedom - 1, CONFIDENCE) or abs(offset) < OFFSET_DB:
        return UndeclaredOffset(offset, error)
    rmse = {"rmse_db": float(np.sqrt(remaining)), "rmse_without_db": float(np.sqrt(square))}
    remark = Remark(RemarkKind.UNDECLARED_OFFSET, {"offset_db": offset, "error_db": error, **rmse})
    return UndeclaredOffset(offset, error, (remark,))
