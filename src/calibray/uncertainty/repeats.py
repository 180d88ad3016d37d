"""Rows that repeat a link: their mean is one measurement.

Rows at one position share the error of the link. If they counted as independent, intervals would be too narrow by the
square root of their number. Their scatter says nothing about that error either: a noise model with one variance for
both underestimates it if the rows agree closely.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from calibray.fitting.problem import Problem

REPEAT_M: Final = 0.01
"""Distance of the ends up to which rows repeat a link [m]; antennas are larger."""

REPEAT_DB: Final = 0.1
"""Difference of modelled path loss up to which they do [dB]; another antenna or carrier changes it by more."""

REPEAT_UNIT: Final = 1e-3
"""Difference of a nuisance's column up to which they do, in its unit."""


def average_repeats(problem: Problem, best: NDArray[np.float64]) -> Problem:
    """The problem whose rows of one link are replaced by their mean; the problem itself if no row repeats a link.

    Rows repeat a link if their ends are at the same positions, they have the same nuisances and biases, and the model
    gives them the same path loss, with the initial values and with the best ones. The first row gets the mean path
    loss, the mean weight and the means of further observables, the others the weight 0.

    Args:
        problem: The problem.
        best: The best candidate, in the fields' units [d].
    """
    objective, links = problem.objective, problem.setup.links
    counted = np.flatnonzero(objective.weight > 0)
    position = np.hstack([links.tx, links.rx])[counted]
    if len(counted) < 2:
        return problem
    tree = KDTree(position)
    if tree.query(position, k=2)[0][:, 1].min() > REPEAT_M:
        return problem
    parameters = problem.parameters
    candidates = np.stack([parameters.to_search(best), parameters.to_search(parameters.start)])
    terms = objective.nuisance.terms
    columns = np.array([
        *np.nan_to_num(problem.modelled(candidates)[:, counted] / REPEAT_DB),  # inf without a path
        *(term.value[counted] / REPEAT_UNIT for term in terms),
        *(term.group[counted] * 2.0 for term in terms),
        *(observable.group[counted] * 2.0 for observable in problem.observed),
    ])  # fmt: skip
    first = np.full(len(counted), -1)
    for row in range(len(counted)):
        if first[row] < 0:
            near = np.array(tree.query_ball_point(position[row], REPEAT_M))
            equal = (np.abs(columns[:, near] - columns[:, [row]]) <= 1.0).all(axis=0) & (first[near] < 0)
            first[near[equal]] = row
    rows, weights = np.bincount(first), np.bincount(first, weights=objective.weight[counted])
    total = np.bincount(first, weights=(objective.weight * objective.measured)[counted])
    kept = np.flatnonzero(rows)
    measured, weight = objective.measured.copy(), np.zeros(len(links))
    measured[counted[kept]] = total[kept] / weights[kept]
    weight[counted[kept]] = weights[kept] / rows[kept]
    observed = tuple(
        replace(observable, measured=_means(observable.measured, counted, first))
        for observable in problem.observed
    )
    return replace(problem, objective=replace(objective, measured=measured, weight=weight), observed=observed)


def _means(
    values: NDArray[np.float64], counted: NDArray[np.int64], first: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Values [L] with the mean of the known ones of each link in its first row; NaN if none is known.

    `first` is the number of the first row of each counted link's repeats [m].
    """
    known = np.isfinite(values[counted])
    number = np.bincount(first[known], minlength=len(counted))
    total = np.bincount(first[known], values[counted][known], len(counted))
    means = values.copy()
    means[counted] = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return means
