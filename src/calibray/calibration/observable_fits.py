"""How the calibrated model fits the further observables of the links."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.problem import Problem
from calibray.result.record import ObservableFit


def observable_fits(
    problem: Problem, best: NDArray[np.float64]
) -> tuple[dict[str, ObservableFit], dict[str, NDArray[np.float64]]]:
    """The fit of every further observable, and its columns of the table of links.

    Args:
        problem: The problem.
        best: The calibrated values [d].

    Returns:
        The fits by name; and measured, initial and calibrated values [L] in the unit, by column name.
    """
    if not problem.observed:
        return {}, {}
    weight, sections = problem.objective.weight, problem.setup.study.observables
    start = problem.parameters.start
    before, after = problem.replay.observe(np.stack([start, best]), problem.statistics)
    fits, columns = {}, {}
    for index, each in enumerate(problem.observed):
        unit, used = sections[each.name].unit, each.used(weight)
        initial, _ = each.residuals(before[index][None], weight)
        residuals, biases = each.residuals(after[index][None], weight)
        by_group = dict(zip(each.labels, biases[0].tolist(), strict=True))
        fits[each.name] = ObservableFit(
            kind=each.statistic.kind,
            unit=unit,
            links=len(used),
            rmse=_rms(residuals),
            initial_rmse=_rms(initial),
            mean_rmse=float(np.std(each.measured[used])),
            error=each.std,
            biases={label: by_group[label] for k, label in enumerate(each.labels) if k in each.group[used]},
        )
        columns |= {
            f"{each.name}_measured_{unit}": each.measured,
            f"{each.name}_before_{unit}": before[index] / each.scale,
            f"{each.name}_after_{unit}": after[index] / each.scale,
        }
    return fits, columns


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
