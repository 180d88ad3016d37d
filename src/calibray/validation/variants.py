"""Models that know the scene, each a variant of a study's problem, and their fits to the links that count.

Beside the study's own model stand its materials left as they are, priors around them, a slope over distance, and an
offset for every transmitter: what an engineer would try by hand. Which of them predicts best differs from campaign to
campaign, and only links held out tell (`validate.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import Differentiable
from calibray.fitting.methods import local_searches
from calibray.fitting.nuisance import CONSTANT, LOG_DISTANCE, Nuisance, make_term, transmitters
from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.fitting.search import rounds
from calibray.optimizers import LeastSquares
from calibray.optimizers.least_squares import CATCH_UP, NEARER
from calibray.parameters import LogNormal
from calibray.result.held_out import Model
from calibray.study import Setup

SPREAD: Final = 0.3
"""Standard deviation of the logarithm of a parameter around its start, where the model has priors."""

KNOWN: Final = 4
"""Minima known beforehand that a search starts from, beside points of its own."""

SEARCHES: Final = 4
"""Points of its own, where minima are known beforehand."""

MOST: Final = 128
"""Points of its own at most, where none are known."""

TOLERANCE: Final = 1e-6
"""Relative decrease of the mean square below which a search has converged: predictions change by less."""

NOTHING: Final[Mapping[Model, NDArray[np.float64]]] = {}

TX_OFFSET: Final = "offset of the transmitter"
"""Name of the term that gives each transmitter its offset."""


def fitted(
    part: Problem, known: Mapping[Model, NDArray[np.float64]] = NOTHING
) -> dict[str, tuple[Problem, NDArray[np.float64]]]:
    """Every model that knows the scene, fitted to the links that count.

    Args:
        part: The problem, other links without weight.
        known: Minima over more links, by name of the model, that searches start from beside few points of their own
            [k, d]; without any, the study's own model is searched for all over its ranges.

    Returns:
        The problem that each solves, and its minima, the best first [k, d], by name.
    """
    if Model.CALIBRATED in known:
        calibrated = minima(part, known[Model.CALIBRATED])
    else:
        calibrated = minima(part, np.zeros((0, len(part.parameters))), _all_over(part))
    found = {}
    for name, variant in twins(part, calibrated[0]).items():
        if name == Model.INITIAL:
            points = part.parameters.to_search(part.parameters.start)[None]
        elif name == Model.CALIBRATED:
            points = calibrated
        else:
            points = minima(variant, known.get(name, calibrated))
        found[name] = variant, points
    return found


def twins(part: Problem, best: NDArray[np.float64]) -> dict[Model, Problem]:
    """Every model that knows the scene.

    Args:
        part: The problem, links that are held out without weight.
        best: Its optimum, by which the noise is told that priors are weighed against [d].

    Returns:
        The problem that each solves, by its name; of `Model.INITIAL` only the nuisance is to be fitted.
    """
    setup, objective = part.setup, part.objective
    rows = objective.num_counted
    noise = float(part.squares(best[None]).rmse_db[0]) * np.sqrt(rows / max(part.freedom, 1))
    prior = replace(part, priors=_start_priors(part), objective=replace(objective, noise_db=noise))
    found = {
        Model.INITIAL: replace(part, objective=_with_term(objective, CONSTANT, setup)),
        Model.CALIBRATED: part,
        Model.PRIOR: prior,
        Model.SLOPE: replace(part, objective=_with_term(objective, LOG_DISTANCE, setup)),
    }
    if (per_tx := _per_transmitter(objective, setup)) is not None:
        found[Model.PER_TRANSMITTER] = replace(part, objective=per_tx)
        found[Model.PRIOR_PER_TRANSMITTER] = replace(prior, objective=replace(per_tx, noise_db=noise))
    return found


def minima(problem: Problem, known: NDArray[np.float64], searches: int = SEARCHES) -> NDArray[np.float64]:
    """Minima of a problem by local searches.

    Args:
        problem: The problem.
        known: Points that they start from, the most promising first [k, d].
        searches: Points of their own beside them.

    Returns:
        The minima, the best first [k, d].
    """
    bounds = problem.parameters.search_bounds
    behind = NEARER if len(known) else CATCH_UP
    search = LeastSquares(*bounds, starts=searches, x0=known[:KNOWN], tolerance=TOLERANCE, catch_up=behind)
    for _ in rounds(search, problem.squares):
        pass
    return search.minima


def _all_over(problem: Problem) -> int:
    """Local searches that find the minima of a problem of which nothing is known."""
    interactions = problem.engine.interactions if isinstance(problem.engine, Differentiable) else 1
    return min(local_searches(interactions), MOST)


def predicted(objective: Objective, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss with the nuisance fitted to the links that count; a group that has none gets the mean.

    Args:
        objective: What the model is fitted by.
        path_loss: Path loss without it [L], [dB].

    Returns:
        Path loss with it [L], [dB].
    """
    coefficients = objective.coefficients(path_loss[None])
    filled, _ = objective.nuisance.filled(coefficients, objective.weight > 0)
    return objective.capped(path_loss) + objective.nuisance.contribution(filled)[0]


def _per_transmitter(objective: Objective, setup: Setup) -> Objective | None:
    """The objective with an offset for every transmitter, if there are several and it has none such."""
    labels = transmitters(setup.links)
    if len(np.unique(labels)) < 2 or any(len(term.labels) > 1 for term in objective.nuisance.terms):
        return None
    offset = make_term(setup.links, TX_OFFSET, labels=labels)
    kept = [term for term in objective.nuisance.terms if term.by != CONSTANT]
    return replace(objective, nuisance=Nuisance(len(setup.links), (*kept, offset)))


def _with_term(objective: Objective, by: str, setup: Setup) -> Objective:
    """The objective with one coefficient of a kind for all links, if it has none of that kind."""
    if any(term.by == by for term in objective.nuisance.terms):
        return objective
    term = make_term(setup.links, f"{by} of all links", by)
    terms = (*objective.nuisance.terms, term)
    return replace(objective, nuisance=Nuisance(len(setup.links), terms))


def _start_priors(problem: Problem) -> LogNormal:
    """The study's priors, and one around the start of every other parameter that is positive."""
    parameters, given = problem.parameters, problem.priors
    place = [
        k for k, each in enumerate(parameters) if k not in given.index and each.lower > 0 and each.start > 0
    ]
    return LogNormal(
        (*given.index, *place),
        (*given.centre, *(float(parameters.start[k]) for k in place)),
        (*given.spread, *(SPREAD for _ in place)),
    )
