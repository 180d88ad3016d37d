"""Fits before the calibration: which links to leave out near the noise floor, and the noise level for priors.

Among links with equal expected power, those near the noise floor are reported only if their error makes them strong.
A selection by measured values keeps these and biases the fit. A selection by predicted values does not, because the
prediction is independent of the link's error (selection on the explanatory variables: J. M. Wooldridge, Econometric
Analysis of Cross Section and Panel Data, 2nd ed., MIT Press 2010, chapter 19). We fit the model to all links above the
floor, then to the links predicted well above it, until the selection is stable.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fitting.group_spread import group_spread
from calibray.fitting.nuisance import Nuisance
from calibray.fitting.objective import Objective
from calibray.fitting.observed import with_errors
from calibray.fitting.problem import Problem
from calibray.fitting.search import least_squares
from calibray.support.progress import Progress

MARGIN: Final = 8.0
"""Required distance of a predicted path loss from the noise floor, in standard deviations of the links' errors.
Position errors make paths appear and vanish, which gives the errors heavy tails: a margin of four leaves some bias."""

SELECTIONS: Final = 4
"""Largest number of selections."""

NOISE_ESTIMATES: Final = 5
"""Largest number of noise estimates, each with the priors weighted by the one before."""

TOLERANCE: Final = 0.02
"""Relative change of the noise estimate that ends the iteration."""

LEAST_NOISE_DB: Final = 1e-3
"""Lower limit of the noise estimate, so that data without noise keep a finite weight of the priors [dB]."""

LEAST_SPREAD_DB: Final = 0.05
"""Lower limit of the spread between groups, so that the prior stays finite [dB per unit of the column]."""

SEARCHES: Final = 32
"""Local searches of the first fit; later fits continue from its minima."""


def leave_out_near_floor(problem: Problem, progress: Progress | None = None) -> Problem:
    """Leave out the links with a predicted path loss near the noise floor.

    Args:
        problem: The problem.
        progress: Called with the stage "choosing links" after every fit.

    Returns:
        The problem with these links at weight 0 and marked in `faint`. It is unchanged without a noise floor, and on an
        engine without derivatives, because its calls are expensive.
    """
    limit, objective = problem.setup.links.limit_db, problem.objective
    if limit is None or not problem.differentiable:
        return problem
    all_weights = objective.weight
    starts = problem.parameters.to_search(problem.parameters.start)[None]
    faint = np.zeros(len(limit), dtype=bool)
    for turn in range(SELECTIONS):
        fit = least_squares(problem, SEARCHES if turn == 0 else 1, starts)
        starts = fit.minima[:SEARCHES]
        rmse_db = float(problem.squares(fit.best.x[None]).rmse_db[0])
        error_db = rmse_db * np.sqrt(objective.num_counted / max(problem.freedom, 1))
        predicted = objective.model(problem.modelled(fit.best.x[None]))[0]
        before, faint = faint, (all_weights > 0) & ~(predicted <= limit - MARGIN * error_db)
        if progress is not None:
            progress("choosing links", turn + 1, SELECTIONS)
        selected = replace(objective, weight=np.where(faint, 0.0, all_weights))
        if np.array_equal(faint, before) or problem.freedom < 1 or not _determines_as_much(problem, selected):
            faint = before
            break
        objective = selected
        problem = replace(problem, objective=objective)
    if problem.faint is not None:
        faint = faint | problem.faint
    return replace(problem, faint=faint) if faint.any() else problem


def _determines_as_much(problem: Problem, selected: Objective) -> bool:
    """Whether the selected links determine the same coefficients as those of the problem."""
    if not (selected.weight > 0).any():
        return False
    has_freedom = replace(problem, objective=selected).freedom >= 1
    return has_freedom and np.array_equal(selected.determined, problem.objective.determined)


def estimate_noise(problem: Problem, progress: Progress | None = None) -> Problem:
    """Estimate the noise level that scales the priors, unless the study declares it, and the spread of random effects.

    Args:
        problem: The problem.
        progress: Called with the stage "estimating noise" after every estimate.

    Returns:
        The problem with the standard deviation of a link's error and the spreads in its objective; unchanged without
        priors.

    Raises:
        InputError: The noise is not declared and cannot be estimated.
    """
    study = problem.setup.study
    stated = study.noise.std_db is not None or study.links.std is not None
    random_effects = any(term.around for term in problem.objective.nuisance.terms)
    unstated = not all(each.stated for each in problem.observed)
    if not problem.has_priors or (stated and not unstated and not random_effects):
        return problem
    if not stated and (not problem.differentiable or problem.freedom < 1):
        cause = (
            "there are too few links" if problem.differentiable else f"the engine is {study.engine.name!r}"
        )
        raise InputError(
            f"{study.path}: noise.std_db: is required, because the study has a prior and {cause} to estimate the "
            "noise; give the standard deviation of a link's error [dB]"
        )
    starts = problem.parameters.to_search(problem.parameters.start)[None]
    noise_db = problem.objective.noise_db if stated else float(problem.squares(starts).rmse_db[0])
    if progress is not None:
        progress("estimating noise", 0, NOISE_ESTIMATES)
    for turn in range(NOISE_ESTIMATES):
        problem = _with_noise(problem, noise_db)
        fit = least_squares(problem, SEARCHES if turn == 0 else 1, starts)
        starts = fit.minima[:SEARCHES]
        if progress is not None:
            progress("estimating noise", turn + 1, NOISE_ESTIMATES)
        before, links, errors = noise_db, problem.objective.num_counted, problem.observed
        old_spreads, point = problem.objective.nuisance.prior, fit.best.x
        problem = with_estimated_errors(problem, point)
        within_db = None
        if random_effects:
            problem, within_db = with_estimated_spreads(problem, point)
        if not stated:
            in_sample = float(
                problem.squares(point[None]).rmse_db[0] * np.sqrt(links / max(problem.freedom, 1))
            )
            noise_db = in_sample if within_db is None else within_db
        changes = [abs(noise_db / before - 1)]
        spreads = problem.objective.nuisance.prior
        changes += np.abs(spreads[spreads < np.inf] / old_spreads[spreads < np.inf] - 1).tolist()
        changes += [abs(each.std / old.std - 1) for each, old in zip(problem.observed, errors, strict=True)]
        if max(changes) <= TOLERANCE:
            break
    return _with_noise(problem, noise_db)


def with_estimated_spreads(problem: Problem, point: NDArray[np.float64]) -> tuple[Problem, float]:
    """The problem with the spreads of its random effects estimated at a point of the search space [d].

    Args:
        problem: The problem.
        point: The point.

    Returns:
        The problem, and the standard deviation of a link's error within the groups of the last effect [dB].
    """
    objective = problem.objective
    counted = np.flatnonzero(objective.weight > 0)
    scale = np.sqrt(objective.weight[counted] * len(counted) / objective.weight.sum())
    terms, within_db = list(objective.nuisance.terms), 0.0
    for index, term in enumerate(terms):
        if not term.around:
            continue
        others = Nuisance(len(objective.weight), (*terms[:index], *terms[index + 1 :]))
        without = replace(problem, objective=replace(objective, nuisance=others))
        evaluation = without.evaluate(point[None], derivatives=problem.differentiable)
        columns = [others.design[counted].toarray() * scale[:, None]]
        if evaluation.jacobian is not None:
            columns.append(evaluation.jacobian[0][: len(counted)])
        between, within_db = group_spread(
            evaluation.residuals[0][: len(counted)],
            np.hstack(columns),
            term.value[counted] * scale,
            term.group[counted],
        )
        terms[index] = replace(term, prior=max(between, LEAST_SPREAD_DB))
    nuisance = Nuisance(len(objective.weight), tuple(terms))
    return replace(problem, objective=replace(objective, nuisance=nuisance)), within_db


def with_estimated_errors(problem: Problem, point: NDArray[np.float64]) -> Problem:
    """The problem with errors of its further observables estimated at a point of the search space [d].

    Args:
        problem: The problem.
        point: The point.

    Returns:
        The problem; unchanged without further observables.
    """
    if not problem.observed:
        return problem
    candidate = problem.parameters.from_search(point[None])
    values = problem.respond(candidate).observed[0]
    return replace(problem, observed=with_errors(problem.observed, values, problem.objective.weight))


def _with_noise(problem: Problem, noise_db: float) -> Problem:
    return replace(problem, objective=replace(problem.objective, noise_db=max(noise_db, LEAST_NOISE_DB)))
