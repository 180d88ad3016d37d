"""Links that the model expects near the noise floor are left out.

Among links of one expected power those near the floor are heard where chance made them strong. To choose links by what
was measured keeps the lucky ones, and pulls the fit towards them; to choose them by what the model expects of them does
not, since that knows nothing of a link's own error. (Selection on the explanatory variables: J. M. Wooldridge,
Econometric Analysis of Cross Section and Panel Data, 2nd ed., MIT Press 2010, chapter 19.) The model is first fitted to
all links that were heard, then to those it expects to be, until their choice stands.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.fitting.search import rounds
from calibray.optimizers import LeastSquares
from calibray.support.progress import Progress

MARGIN: Final = 8.0
"""How far above the noise floor a link must be expected, in standard deviations of the links' errors.

Errors of position make paths come and go, so that errors have tails: with four, links that luck let be heard remain.
"""

ROUNDS: Final = 4
"""Choices at most; one more or less hardly changes the fit once few links change sides."""

SEARCHES: Final = 32
"""Local searches of the first fit; the others go on from its minima."""


def heard(problem: Problem, progress: Progress | None = None) -> Problem:
    """The problem over the links that are expected to be heard; without a noise floor it stays as it is.

    Args:
        problem: The problem.
        progress: Called with the stage "choosing links" after every fit.

    Returns:
        The problem; the links left out have no weight and are marked in `faint`. A black-box engine, whose calls are
        dear, keeps all.
    """
    limit, objective = problem.setup.links.limit_db, problem.objective
    if limit is None or not problem.differentiable:
        return problem
    bounds, everyone = problem.parameters.search_bounds, objective.weight
    start = problem.parameters.to_search(problem.parameters.start)[None]
    faint = np.zeros(len(limit), dtype=bool)
    for turn in range(ROUNDS):
        search = LeastSquares(*bounds, starts=SEARCHES if turn == 0 else 1, x0=start)
        for _ in rounds(search, problem.squares):
            pass
        start = search.minima[:SEARCHES]
        found = problem.squares(search.best.x[None])
        error = float(found.rmse_db[0]) * np.sqrt(objective.num_counted / max(problem.freedom, 1))
        expected = objective.model(problem.modelled(search.best.x[None]))[0]
        before, faint = faint, (everyone > 0) & ~(expected <= limit - MARGIN * error)
        if progress is not None:
            progress("choosing links", turn + 1, ROUNDS)
        fewer = replace(objective, weight=np.where(faint, 0.0, everyone))
        if np.array_equal(faint, before) or problem.freedom < 1 or not _determines(problem, fewer):
            faint = before
            break
        objective = fewer
        problem = replace(problem, objective=objective)
    if problem.faint is not None:
        faint = faint | problem.faint
    return replace(problem, faint=faint) if faint.any() else problem


def _determines(problem: Problem, objective: Objective) -> bool:
    """Whether the links that are left tell all that those before them told."""
    if not (objective.weight > 0).any():
        return False
    enough = replace(problem, objective=objective).freedom >= 1
    return enough and np.array_equal(objective.determined, problem.objective.determined)
