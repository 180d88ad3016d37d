"""The size of the noise that priors are weighed against: as the study states it, else what the links scatter by."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.fitting.search import rounds
from calibray.optimizers import LeastSquares
from calibray.support.progress import Progress

ROUNDS: Final = 5
"""Estimates of the noise, each with priors weighed against the one before."""

SETTLED: Final = 0.02
"""Relative change of the estimate that ends them."""

SEARCHES: Final = 32
"""Local searches of the first estimate; the others go on from its minima."""


def weighed(problem: Problem, progress: Progress | None = None) -> Problem:
    """The problem, its priors weighed against the noise; without priors it stays as it is.

    Args:
        problem: The problem.
        progress: Called with the stage "weighing" after every estimate.

    Returns:
        The problem with the standard deviation of a link's error in its objective.

    Raises:
        InputError: The noise is neither stated nor can it be estimated.
    """
    study = problem.setup.study
    if not problem.weighs_priors or study.noise.std_db is not None or study.links.std is not None:
        return problem
    if not problem.differentiable or problem.freedom < 1:
        cause = (
            "there are too few links" if problem.differentiable else f"the engine is {study.engine.name!r}"
        )
        raise InputError(
            f"{study.path}: noise.std_db: is required, as something has a prior and {cause} to estimate the noise; "
            "give the standard deviation of a link's error [dB]"
        )
    bounds = problem.parameters.search_bounds
    start = problem.parameters.to_search(problem.parameters.start)[None]
    noise = float(problem.squares(start).rmse_db[0])
    for turn in range(ROUNDS):
        problem = replace(problem, objective=replace(problem.objective, noise_db=max(noise, 1e-3)))
        search = LeastSquares(*bounds, starts=SEARCHES if turn == 0 else 1, x0=start)
        for _ in rounds(search, problem.squares):
            pass
        start = search.minima[:SEARCHES]
        if progress is not None:
            progress("weighing", turn + 1, ROUNDS)
        before, links = noise, problem.objective.num_counted
        noise = float(problem.squares(search.best.x[None]).rmse_db[0] * np.sqrt(links / problem.freedom))
        if abs(noise - before) <= SETTLED * before:
            break
    return replace(problem, objective=replace(problem.objective, noise_db=max(noise, 1e-3)))
