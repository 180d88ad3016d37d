"""Whether path loss and further observables contradict each other, beyond their errors.

They may want different parameters. The parameters are fitted to path loss alone, to the further observables alone, and
to both. The increase of both sums of squares at the common fit, in units of the errors' variances, follows Fisher's F
if one set of parameters explains everything.

Another possibility is that no parameters explain an observable, as if it was measured in another scene. Measured values
are regressed on modelled ones: the slope is 1 if the model is right, and near 0 if the two are unrelated.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, ndtri, stdtr

from calibray.fitting.preliminary_fits import with_estimated_errors
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, least_squares
from calibray.result.verdict import Remark, RemarkKind, Value

SIGNIFICANT: Final = 0.005
"""Probability of a larger increase without a conflict, below which a conflict is reported; errors that neighbouring
links share make small probabilities somewhat more frequent."""

UNRELATED: Final = 0.02
"""Probability of a slope, if the model is right, below which an observable does not belong to the scene; shared among
the observables."""

FEWEST: Final = 5
"""Degrees of freedom below which no slope is judged."""

STARTS: Final = 32
"""Number of local searches of the fits to one kind of data."""

DOMINANT: Final = 1e3
"""Weight of the further observables' rows, relative to path loss, in a fit to them alone; its inverse in a fit to path
loss alone. All fits can then use the same compiled program."""


def conflict(problem: Problem, minima: NDArray[np.float64]) -> tuple[Remark, ...]:
    """Compare the parameters that path loss and the further observables of a problem with minima [k, d] require.

    Returns:
        Remarks with both fits and the conflict in standard errors; none without a conflict.
    """
    objective, width = problem.objective, len(problem.parameters)
    starts = minima[:BASINS]
    links = least_squares(_weighted(problem, 1 / DOMINANT), STARTS, starts).best.x
    further = least_squares(_weighted(problem, DOMINANT), STARTS, starts).best.x
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
    """Slope of measured over modelled values of an observable.

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
    """Slopes of the observables at a point of the search space, with a constant or the biases of devices."""
    modelled = problem.respond(problem.parameters.from_search(point[None])).observed[0]
    slopes = []
    for each, values in zip(problem.observed, modelled, strict=True):
        used = each.used(problem.objective.weight)
        used = used[np.isfinite(values[used])]
        x, y = values[used] / each.scale, each.measured[used]
        groups = np.unique(each.group[used], return_inverse=True)[1]
        x, y = (column - (np.bincount(groups, column) / np.bincount(groups))[groups] for column in (x, y))
        left = len(used) - (groups.max(initial=0) + 1) - 1
        # Values that hardly differ from link to link say nothing about a slope.
        if left < FEWEST or np.sum(x**2) <= 1e-12 * np.sum((values[used] / each.scale) ** 2):
            continue
        slope = float(np.sum(x * y) / np.sum(x**2))
        error = float(np.sqrt(max(np.sum((y - slope * x) ** 2), 1e-300) / left / np.sum(x**2)))
        slopes.append(Slope(each.name, slope, error, float(stdtr(left, (slope - 1) / error))))
    return slopes


def _weighted(problem: Problem, weight: float) -> Problem:
    """The problem with the rows of its further observables times a weight."""
    return replace(problem, observed=tuple(replace(each, std=each.std / weight) for each in problem.observed))


def _squares(problem: Problem, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of squares of the links' rows and of the further observables' rows [2]."""
    residuals = problem.evaluate(point[None]).residuals[0]
    further = sum(len(each.used(problem.objective.weight)) for each in problem.observed)
    links = residuals[: problem.objective.num_counted]
    return np.array([np.sum(links**2), np.sum(residuals[len(residuals) - further :] ** 2)])
