"""The prediction model that held-out blocks choose, fitted once more to all links."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.nuisance import OFFSET
from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.result.held_out import Model
from calibray.result.prediction_model import FittedTerm, PredictionModel
from calibray.study import Study
from calibray.validation.baselines import log_distance_objective
from calibray.validation.validation import Validation
from calibray.validation.variants import TX_OFFSET, add_nuisance, find_minima, variants

SEARCHES: Final = 16
"""Local searches for the model's optimum, in addition to the one from the calibrated optimum."""

MOST_ERRORS: Final = 400
"""Most absolute errors that are stored with the model; of more, quantiles are stored."""


def choose_model(
    problem: Problem, validation: Validation, best: NDArray[np.float64]
) -> tuple[PredictionModel, NDArray[np.float64]]:
    """Fit the model that held-out blocks choose to all links that have a weight.

    Kriging is never chosen: it knows nothing away from the measured links.

    Args:
        problem: The problem.
        validation: Held-out errors of every model.
        best: The calibrated optimum, a point of the search space [d].

    Returns:
        The model, and its path loss at all links [links], [dB].
    """
    name = validation.chosen
    study = problem.setup.study
    values: dict[str, float] | None = None
    if name == Model.LOG_DISTANCE:
        objective, modelled = log_distance_objective(
            problem.setup.links, problem.objective, study.scene.frequency
        )
    else:
        variant, point = variants(problem, best)[name], best
        if name == Model.INITIAL:
            point = problem.parameters.to_search(problem.parameters.start)
        elif name != Model.CALIBRATED:
            point = find_minima(variant, best[None], SEARCHES)[0]
        objective, modelled = variant.objective, variant.evaluate(point[None]).modelled[0]
        values = problem.parameters.named(problem.parameters.from_search(point))
    model = PredictionModel(
        name,
        values,
        _fitted_terms(objective, modelled, study),
        validation.scale(name),
        f"{name}, errors on {len(validation.labels)} blocks held out in turn",
        int(np.count_nonzero(validation.block >= 0)),
        _quantiles(validation.sizes(name)),
    )
    return model, add_nuisance(objective, modelled)


def _quantiles(absolute_errors: NDArray[np.float64]) -> tuple[float, ...]:
    """All absolute errors, or quantiles of them where there are many, ascending."""
    if len(absolute_errors) > MOST_ERRORS:
        absolute_errors = np.quantile(absolute_errors, (np.arange(MOST_ERRORS) + 0.5) / MOST_ERRORS)
    return tuple(absolute_errors.tolist())


def _fitted_terms(
    objective: Objective, path_loss_db: NDArray[np.float64], study: Study
) -> tuple[FittedTerm, ...]:
    """Nuisance terms with the coefficients that fit best to a path loss without nuisance [links], [dB]."""
    coefficients = objective.coefficients(path_loss_db[None])
    filled, _ = objective.nuisance.filled(coefficients, objective.weight > 0)
    terms, first = [], 0
    for term in objective.nuisance.terms:
        last = first + len(term.labels)
        by_group = dict(zip(term.labels, filled[0, first:last].tolist(), strict=True))
        first = last
        if term.labels == ("",):
            per = ""
        elif term.name == TX_OFFSET:
            per = "transmitter"
        else:
            per = OFFSET if term.name == OFFSET else str(study.nuisance[term.name].per)
        terms.append(FittedTerm(term.name, term.by, per, by_group, term.centre))
    return tuple(terms)
