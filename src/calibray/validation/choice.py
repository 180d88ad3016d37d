"""The model that held-out blocks speak for, fitted once more to all links."""

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
from calibray.validation.baselines import fitted_law
from calibray.validation.validation import Validation
from calibray.validation.variants import TX_OFFSET, minima, predicted, twins

SEARCHES: Final = 16
"""Local searches for the model's optimum, beside the one from the calibrated one."""

MOST: Final = 400
"""Errors that are kept with the model."""


def choose_model(
    problem: Problem, validation: Validation, best: NDArray[np.float64]
) -> tuple[PredictionModel, NDArray[np.float64]]:
    """Fit the model that held-out blocks speak for to all links that count.

    Kriging is not among those chosen from: it tells nothing beyond the measured places, which blocks are not about.

    Args:
        problem: The problem.
        validation: Held-out errors of every model.
        best: The calibrated optimum, a point of the search space [d].

    Returns:
        The model, and its path loss at all links [L], [dB].
    """
    name = validation.chosen
    count = int(np.count_nonzero(validation.block >= 0))
    basis = f"{name}, errors on {len(validation.labels)} blocks held out in turn"
    size, sizes = validation.scale(name), _some(validation.sizes(name))
    study, frequency = problem.setup.study, problem.setup.study.scene.frequency
    if name == Model.LOG_DISTANCE:
        law, rise = fitted_law(problem.setup.links, problem.objective, frequency)
        chosen = PredictionModel(name, None, _terms(law, rise[None], study), size, basis, count, sizes)
        return chosen, predicted(law, rise)
    variant, point = twins(problem, best)[name], best
    if name == Model.INITIAL:
        point = problem.parameters.to_search(problem.parameters.start)
    elif name != Model.CALIBRATED:
        point = minima(variant, best[None], SEARCHES)[0]
    told = variant.evaluate(point[None])
    values = problem.parameters.named(problem.parameters.from_search(point))
    chosen = PredictionModel(
        name, values, _terms(variant.objective, told.modelled, study), size, basis, count, sizes
    )
    return chosen, predicted(variant.objective, told.modelled[0])


def _some(sizes: NDArray[np.float64]) -> tuple[float, ...]:
    """Errors that stand for all of them, ascending."""
    if len(sizes) > MOST:
        sizes = np.quantile(sizes, (np.arange(MOST) + 0.5) / MOST)
    return tuple(sizes.tolist())


def _terms(objective: Objective, path_loss: NDArray[np.float64], study: Study) -> tuple[FittedTerm, ...]:
    """Terms and their coefficients where the model gives a path loss [1, L]."""
    coefficients = objective.coefficients(path_loss)
    filled, _ = objective.nuisance.filled(coefficients, objective.weight > 0)
    found, first = [], 0
    for term in objective.nuisance.terms:
        values = filled[0, first : (first := first + len(term.labels))].tolist()
        if term.labels == ("",):
            per = ""
        elif term.name == TX_OFFSET:
            per = "transmitter"
        else:
            per = OFFSET if term.name == OFFSET else str(study.nuisance[term.name].per)
        found.append(
            FittedTerm(term.name, term.by, per, dict(zip(term.labels, values, strict=True)), term.centre)
        )
    return tuple(found)
