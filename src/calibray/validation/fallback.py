"""The fallback: the log-distance model, which predicts links that no path reaches.

It has the study's nuisances and is fitted to the calibration links, like the rival in the validation. Links that no
path reaches are mostly behind obstacles, so their path loss exceeds what this fit gives. Where the study has enough of
them, their mean residual is added, and the fallback's errors are theirs.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.nuisance import CONSTANT
from calibray.fitting.problem import Problem
from calibray.result.held_out import Model
from calibray.result.prediction_model import FittedTerm, PredictionModel
from calibray.validation.baselines import log_distance_objective, without_scene
from calibray.validation.choice import fitted_terms, quantiles
from calibray.validation.variants import add_nuisance

FEWEST: Final = 8
"""Links without a path, or held-out links, from which errors are computed; as for the prediction model."""

WITHOUT_PATH: Final = "without a path"
"""Name of the term with the mean residual of the links without a path."""


def fit_fallback(
    problem: Problem, without_path: NDArray[np.bool_], held_out_db: NDArray[np.float64], basis: str
) -> PredictionModel:
    """Fit the fallback to the calibration links.

    Args:
        problem: The problem.
        without_path: Mask of its links without a path [links].
        held_out_db: Residuals of the log-distance model on held-out links [n], [dB].
        basis: What these links are.

    Returns:
        The log-distance model. Its errors are those of links without a path; of held-out links if there are too few; of
        the calibration links if there are too few of these as well.
    """
    setup, links = problem.setup, problem.setup.links
    objective, known_db = log_distance_objective(links, problem.objective, without_scene(setup.study, links))
    terms = fitted_terms(objective, known_db, setup.study)
    residuals = objective.measured - add_nuisance(objective, known_db)
    usable = without_path & ~setup.held_out
    for excluded in (links.censored, problem.faint):
        usable = usable if excluded is None else usable & ~excluded
    count = int(usable.sum())
    if count >= FEWEST:
        mean_db = float(residuals[usable].mean())
        terms += (FittedTerm(WITHOUT_PATH, CONSTANT, "", {"": mean_db}),)
        # The error of each link if the mean is that of the others.
        errors = (residuals[usable] - mean_db) * count / (count - 1)
        basis = f"errors of {count} links without a path"
    elif len(held_out_db) >= FEWEST:
        errors = held_out_db
    else:
        counted = objective.weight > 0
        count, unknowns = int(counted.sum()), int(objective.determined.sum())
        # In-sample errors are too small by the unknowns that were fitted to them.
        inflation = np.sqrt(count / (count - unknowns)) if count > unknowns else np.nan
        errors = residuals[counted] * inflation
        errors, basis = errors[np.isfinite(errors)], f"errors of {count} calibration links"
    rms_db = float(np.sqrt(np.mean(errors**2))) if len(errors) else None
    absolute_errors = quantiles(np.sort(np.abs(errors)))
    return PredictionModel(
        Model.LOG_DISTANCE,
        None,
        terms,
        rms_db,
        f"{Model.LOG_DISTANCE}, {basis}",
        len(errors),
        absolute_errors,
    )
