"""Errors of further observables on held-out links, next to two rivals without a scene: the mean and a law of distance.

The law of distance is linear in the distance for times of flight, and linear in its logarithm for all others. Models
and rivals have the same biases of devices, which the other links determine.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.observed import Observed
from calibray.fitting.problem import Problem
from calibray.measurements import Measurements
from calibray.measurements.observables import ROUND_TRIP, TIME_OF_FLIGHT
from calibray.result.held_out import ObservableErrors
from calibray.study import Study

MODELS: Final = ("calibrated", "mean", "law of distance")
"""What is compared on held-out links."""


def held_out_gaps(
    problem: Problem, best: NDArray[np.float64], held_out: NDArray[np.bool_]
) -> dict[str, NDArray[np.float64]]:
    """Predicted minus measured values of every observable on held-out links.

    Args:
        problem: The problem; its links without a weight are predicted from the others.
        best: Its optimum, in the fields' units [d].
        held_out: Which links are held out [L].

    Returns:
        Gaps of `MODELS` by name of the observable [3, L], in its unit; NaN where a link is not judged.
    """
    if not problem.observed:
        return {}
    modelled = problem.respond(best[None]).observed[0]
    weight, links, gaps = problem.objective.weight, problem.setup.links, {}
    for each, values in zip(problem.observed, modelled, strict=True):
        features = [values / each.scale, np.zeros(len(links)), _law(each, links)]
        predicted = [
            _with_biases(each, feature, weight, slope=index == 2) for index, feature in enumerate(features)
        ]
        judged = held_out & np.isfinite(each.measured) & np.isfinite(values)
        gaps[each.name] = np.where(judged, np.stack(predicted) - each.measured, np.nan)
    return gaps


def observable_errors(gaps: Mapping[str, NDArray[np.float64]], study: Study) -> dict[str, ObservableErrors]:
    """Root mean squares of gaps [3, L] by name of the observable; none without a judged link."""
    found = {}
    for name, gap in gaps.items():
        judged = gap[:, np.isfinite(gap).all(axis=0)]
        if judged.shape[1]:
            rms = np.sqrt(np.mean(judged**2, axis=1)).tolist()
            found[name] = ObservableErrors(study.observables[name].unit, judged.shape[1], *rms)
    return found


def _law(each: Observed, links: Measurements) -> NDArray[np.float64]:
    distance = np.linalg.norm(links.tx - links.rx, axis=1)
    if each.statistic.kind in (TIME_OF_FLIGHT, ROUND_TRIP):
        return distance
    return np.log10(np.maximum(distance, 1e-3))


def _with_biases(
    each: Observed, feature: NDArray[np.float64], weight: NDArray[np.float64], *, slope: bool
) -> NDArray[np.float64]:
    """The feature, or its best multiple, plus the biases of the links with a weight; a new group gets their mean."""
    used = each.used(weight)
    used = used[np.isfinite(feature[used])]
    # The model has a bias only where the study states one; the mean and the law always have a constant.
    constant = slope or not np.any(feature)
    if each.labels:
        groups = np.unique(each.group[used])
        design = (each.group[:, None] == groups).astype(np.float64)
        design[design.sum(axis=1) == 0] = 1.0 / max(len(groups), 1)
    else:
        design = np.ones((len(feature), 1 if constant else 0))
    if slope:
        columns = np.column_stack([design, feature])
        return columns @ np.linalg.lstsq(columns[used], each.measured[used], rcond=None)[0]
    bias = np.linalg.lstsq(design[used], (each.measured - feature)[used], rcond=None)[0]
    return feature + design @ bias
