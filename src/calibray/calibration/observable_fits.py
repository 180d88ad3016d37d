"""How the calibrated model fits the further observables of the links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.problem import Problem
from calibray.result.record import ObservableFit

MOST_DRAWS: Final = 64
"""Most posterior draws for the errors of biases; the error of a standard deviation from them is 9 %."""


def observable_fits(
    problem: Problem, best: NDArray[np.float64], draws: Mapping[str, Sequence[float]]
) -> tuple[dict[str, ObservableFit], dict[str, NDArray[np.float64]]]:
    """The fit of every further observable, and its columns of the table of links.

    Args:
        problem: The problem.
        best: The calibrated values [d].
        draws: Draws from the posterior by name of the parameter; may be empty.

    Returns:
        The fits by name; and measured, initial and calibrated values, and biases [L] in the unit, by column name.
    """
    if not problem.observed:
        return {}, {}
    weight, sections = problem.objective.weight, problem.setup.study.observables
    start = problem.parameters.start
    names = problem.parameters.names
    drawn = np.stack([draws[name] for name in names], axis=1) if draws else np.empty((0, len(names)))
    drawn = drawn[np.linspace(0, len(drawn) - 1, min(len(drawn), MOST_DRAWS)).round().astype(int)]
    before, after, *spread = problem.respond(np.vstack([start, best, drawn])).observed
    fits, columns = {}, {}
    for index, each in enumerate(problem.observed):
        unit, used = sections[each.name].unit, each.used(weight)
        initial, _ = each.residuals(before[index][None], weight)
        residuals, biases = each.residuals(after[index][None], weight)
        groups = np.unique(each.group[used]) if each.labels else np.zeros(0, dtype=np.int64)
        count = np.bincount(each.group[used], minlength=len(each.labels))[groups] if each.labels else groups
        of_draws = (
            each.residuals(np.stack([values[index] for values in spread]), weight)[1] if spread else biases
        )
        # The error of a mean, and that of the parameters.
        errors = np.sqrt(
            each.std**2 / np.maximum(count, 1) + np.mean((of_draws - biases)[:, groups] ** 2, axis=0)
        )
        labels = [each.labels[group] for group in groups]
        fits[each.name] = ObservableFit(
            kind=each.statistic.kind,
            unit=unit,
            links=len(used),
            rmse=_rms(residuals),
            initial_rmse=_rms(initial),
            mean_rmse=float(np.std(each.measured[used])),
            error=each.std,
            biases=dict(zip(labels, biases[0, groups].tolist(), strict=True)),
            bias_errors=dict(zip(labels, errors.tolist(), strict=True)),
        )
        columns |= {
            f"{each.name}_measured_{unit}": each.measured,
            f"{each.name}_before_{unit}": before[index] / each.scale,
            f"{each.name}_after_{unit}": after[index] / each.scale,
        }
        if each.labels:
            known = np.append(np.isin(np.arange(len(each.labels)), groups), False)
            of_links = np.append(biases[0], np.nan)[each.group]
            columns[f"{each.name}_bias_{unit}"] = np.where(known[each.group], of_links, np.nan)
    return fits, columns


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
