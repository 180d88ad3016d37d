"""The spread of a population of transmitters, estimated before the calibration by its marginal likelihood.

Expectation maximization with a Gaussian approximation at the optimum (D. Bates and S. DebRoy, J. Multivariate Analysis
91, 2004, section 5): the square of the spread is the mean of the transmitters' squared values plus their variances.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from calibray.fitting.preliminary_fits import SEARCHES, estimate_noise
from calibray.fitting.problem import Problem
from calibray.fitting.search import least_squares
from calibray.study import Study
from calibray.study.population import estimated_fields, with_spreads
from calibray.support.progress import Progress
from calibray.tracing.mounting import NEW, POSE

ROUNDS: Final = 20
"""Largest number of estimates; where links determine most transmitters well, three suffice."""

TOLERANCE: Final = 0.02
"""Relative change of a spread that ends the iteration."""

LEAST: Final = 1e-3
"""Lower limit of a spread, as a share of the width of the bounds, so that priors stay finite."""


def estimate_spreads(problem: Problem, progress: Progress | None = None) -> Problem:
    """Estimate the spread of every population of transmitters whose study leaves it open.

    Args:
        problem: The problem.
        progress: Called with the stage "estimating spreads" after every estimate.

    Returns:
        The problem with these spreads in its study and priors; itself without such a population.
    """
    fields, parameters = estimated_fields(problem.setup.study), problem.parameters
    if not fields or not problem.differentiable:
        return problem
    priors = {name: entry.prior for name, entry in problem.setup.study.parameters.items()}
    shared = [name for name, prior in priors.items() if prior is not None and prior.shared]
    members = {
        field: [
            number
            for number, item in enumerate(parameters)
            if item.name in shared and item.field == field and item.material != POSE + NEW
        ]
        for field in fields
    }
    starts, spreads = parameters.to_search(parameters.start)[None], dict.fromkeys(fields, np.inf)
    if not all(members.values()):
        return problem
    for turn in range(ROUNDS):
        fit = least_squares(problem, SEARCHES if turn == 0 else 1, starts)
        starts, before = fit.minima[:SEARCHES], spreads
        curvature = problem.squares(fit.best.x[None], derivatives=True).curvature[0]
        variance = problem.objective.noise_db**2 * np.diag(np.linalg.pinv(curvature, hermitian=True))
        spreads = {}
        for field, numbers in members.items():
            width = parameters.upper[numbers[0]] - parameters.lower[numbers[0]]
            square = np.mean(fit.best.x[numbers] ** 2 + variance[numbers])
            spreads[field] = float(max(np.sqrt(square), LEAST * width))
        stated = problem.setup.study
        study = Study.from_content(with_spreads(stated, spreads), stated.path)
        problem = replace(problem, setup=replace(problem.setup, study=study), priors=study.priors)
        if progress is not None:
            progress("estimating spreads", turn + 1, ROUNDS)
        if all(abs(spreads[field] / before[field] - 1) <= TOLERANCE for field in fields):
            break
    return estimate_noise(problem, progress)
