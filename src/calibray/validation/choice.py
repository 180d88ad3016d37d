"""The prediction model, fitted to the calibration links.

Predictions, maps, exports and the report all use this model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.kinds.replay import replay
from calibray.engines.protocol import ReplaysScene
from calibray.fitting.fidelity_loop import path_loss_change, traced_again
from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.materials import Material
from calibray.result.held_out import (
    AVERAGES,
    WITHOUT_MATERIALS,
    BlockErrors,
    FittedTerm,
    Model,
    PredictionModel,
)
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.study.calibration_sections import OFFSET, TX_OFFSET
from calibray.study.displacement import displaces
from calibray.study.model import StudyModel
from calibray.validation import models

SEARCHES: Final = 16
"""Number of local searches for the model's optimum, in addition to the search that starts from the calibrated
optimum."""

MOST_ERRORS: Final = 400
"""Maximum number of absolute errors stored with the model; if there are more errors, quantiles are stored instead."""


@dataclass(frozen=True, eq=False)
class HeldOutResiduals:
    """The residuals from which the intervals of predictions are computed.

    Attributes:
        rms_db: RMS of the residuals [dB]; None if there are too few links.
        basis: Description of the links to which the residuals belong.
        links: Number of these links, or degrees of freedom if they are calibration links.
        errors_db: The residuals on held-out links [n], [dB]; empty if the residuals belong to calibration links.
        blocks: Standard deviations within and between blocks; None if too few or no links were held out.
    """

    rms_db: float | None
    basis: str
    links: int
    errors_db: NDArray[np.float64]
    blocks: BlockErrors | None = None


@dataclass(frozen=True, eq=False)
class FittedModel:
    """The prediction model, with its path loss on the links of the study.

    Attributes:
        model: The model.
        materials: Materials of the scene with the model's parameters; None if the model uses no scene.
        path_loss_db: Path loss of the model, including nuisances [links], [dB].
        scene_db: Path loss [links], [dB], of the scene without nuisances: the model's scene, or the calibrated scene if
            the model uses no scene.
    """

    model: PredictionModel
    materials: dict[str, Material] | None
    path_loss_db: NDArray[np.float64]
    scene_db: NDArray[np.float64]


def fit_prediction_model(
    problem: Problem,
    trail: Trail,
    name: str,
    residuals: HeldOutResiduals,
    retrace_gap_db: NDArray[np.float64] | None = None,
) -> FittedModel:
    """Fit the chosen model to all links that have a nonzero weight.

    An average uses the scene of its first model and also stores the parameters, if any, of its second model.

    Args:
        problem: The problem.
        trail: The search that solved the problem.
        name: Name of the model; see `Model`.
        residuals: Residuals of the model on new links.
        retrace_gap_db: Change in path loss of every link [L], [dB], if the paths of the search are replaced by paths
            traced with the calibrated materials; None if the paths were not traced again.

    Returns:
        The fitted model. Predictions and exports trace with the materials of this model, so its path loss includes this
        change.
    """
    parameters, study = problem.parameters, problem.setup.study
    uses_scene = name not in WITHOUT_MATERIALS
    average = AVERAGES.get(name)
    first = average.first if average else Model(name)
    variant = fit_variant(problem, trail, first if uses_scene else Model.CALIBRATED)
    candidate, objective, modelled = variant.candidate, variant.objective, variant.modelled
    scene_db, averaged = modelled, None
    terms, path_loss_db = variant.predicted(study) if uses_scene else fit_without_materials(problem, first)
    if average is not None:
        if average.second in WITHOUT_MATERIALS:
            second = fit_without_materials(problem, average.second)
        else:
            other = fit_variant(problem, trail, average.second)
            averaged, second = parameters.named(other.candidate), other.predicted(study)
        terms = averaged_terms(terms, second[0], average.weight)
        path_loss_db = average.of(path_loss_db, second[1])
    model = PredictionModel(
        name,
        parameters.named(candidate) if uses_scene else None,
        terms,
        residuals.rms_db,
        residuals.basis,
        residuals.links,
        quantiles(np.sort(np.abs(residuals.errors_db))),
        residuals.blocks,
        averaged,
    )
    materials = parameters.materials(candidate, problem.setup.scene.materials) if uses_scene else None
    # In an exported scene, each mesh has one material, facades have the material of their walls, and links are at the
    # stated positions.
    walls = {name: section.of for name, section in study.facades.items()}
    displaced = [name for name in parameters.names if displaces(name)]
    extra = len(parameters.of_effects) or study.regions or study.roughness_mm
    if displaced:
        stated = problem.setup.placed_at(dict.fromkeys(displaced, 0.0))
        sampled = study.trace.refraction or study.trace.diffuse_reflection
        engine = replay(stated, stated.trace(materials if sampled else None))
        scene_db = engine.scene_path_loss(candidate[None], walls)[0]
    elif (walls or extra) and isinstance(problem.engine, ReplaysScene):
        scene_db = problem.engine.scene_path_loss(candidate[None], walls)[0]
    if retrace_gap_db is not None and (candidate == trail.best).all():
        scene_db = scene_db if displaced else traced_again(scene_db, retrace_gap_db)
        if uses_scene:
            again = objective.capped(traced_again(modelled, retrace_gap_db))
            path_loss_db = path_loss_db + path_loss_change(again, objective.capped(modelled))
    return FittedModel(model, materials, path_loss_db, scene_db)


@dataclass(frozen=True, eq=False)
class FittedVariant:
    """A variant fitted to links with nonzero weight: parameters [d], objective, and path loss without nuisance [L]."""

    candidate: NDArray[np.float64]
    objective: Objective
    modelled: NDArray[np.float64]

    def predicted(self, study: StudyModel) -> tuple[tuple[FittedTerm, ...], NDArray[np.float64]]:
        """The nuisance terms, and path loss with nuisance [L], [dB]."""
        terms = fitted_terms(self.objective, self.modelled, study)
        return terms, self.objective.with_nuisance(self.modelled)


def fit_variant(problem: Problem, trail: Trail, name: Model) -> FittedVariant:
    """Fit a variant. If a search is needed, it starts from the calibrated optimum and from new starting points."""
    if name == Model.INITIAL:
        objective = models.initial_objective(problem.objective, problem.setup)
        return FittedVariant(problem.parameters.start, objective, problem.before)
    if name == Model.CALIBRATED:
        return FittedVariant(trail.best, problem.objective, trail.best_modelled)
    best = problem.parameters.to_search(trail.best)
    variant = models.variants(problem, best)[name]
    point = models.find_minima(variant, best[None], SEARCHES)[0]
    modelled = variant.evaluate(point[None]).modelled[0]
    return FittedVariant(problem.parameters.from_search(point), variant.objective, modelled)


def fit_without_materials(problem: Problem, name: str) -> tuple[tuple[FittedTerm, ...], NDArray[np.float64]]:
    """Terms of a log-distance model fitted to the links with nonzero weight, and path loss of the model [L], [dB]."""
    study, links = problem.setup.study, problem.setup.links
    make = models.log_distance if name == Model.LOG_DISTANCE else models.obstructed
    model = make(links, problem.objective, models.without_scene(study, links))
    terms = fitted_terms(model.objective, model.known_db, study)
    return (with_prior_mean(terms, study) if name == Model.OBSTRUCTION else terms), model.path_loss_db()


def averaged_terms(
    few: tuple[FittedTerm, ...], more: tuple[FittedTerm, ...], weight: float = 0.5
) -> tuple[FittedTerm, ...]:
    """The weighted mean of the terms of two models; the second model has all terms of the first.

    `weight` is that of the first model. If the first model lacks a term, the coefficients and spread of the term are
    multiplied by the weight of the second model. If a group has a coefficient in only one of the models, this
    coefficient is used.
    """
    known, averaged = {term.name: term for term in few}, []
    for term in more:
        spread_db, others = term.spread_db, dict.fromkeys(term.coefficients, 0.0)
        if term.name in known:
            others = known[term.name].coefficients
        elif spread_db is not None:
            spread_db = (1.0 - weight) * spread_db
        # Coefficients missing in one model are taken from the other model.
        first, second = {**term.coefficients, **others}, {**others, **term.coefficients}
        means = {label: weight * first[label] + (1.0 - weight) * second[label] for label in second}
        averaged.append(replace(term, coefficients=means, spread_db=spread_db))
    return tuple(averaged)


def with_prior_mean(terms: tuple[FittedTerm, ...], study: StudyModel) -> tuple[FittedTerm, ...]:
    """The terms of the log-distance model with obstruction, including the prior mean in the non-line-of-sight loss.

    The fit treats the prior mean as known, even if no non-line-of-sight link has a nonzero weight. A nuisance that the
    study declares for the same column does not have this prior.
    """
    if any(term.by == OUT_OF_SIGHT for term in study.nuisance.values()):
        return terms
    name, others = OUT_OF_SIGHT.replace("_", " "), tuple(term for term in terms if term.by != OUT_OF_SIGHT)
    fitted = next(
        (term for term in terms if term.by == OUT_OF_SIGHT), FittedTerm(name, OUT_OF_SIGHT, "", {"": 0.0})
    )
    coefficients = {key: models.OUT_OF_SIGHT_DB[0] + value for key, value in fitted.coefficients.items()}
    return (*others, replace(fitted, coefficients=coefficients))


def quantiles(absolute_errors: NDArray[np.float64]) -> tuple[float, ...]:
    """Absolute errors in the form in which they are stored with a model.

    Args:
        absolute_errors: The errors, ascending [n], [dB].

    Returns:
        All errors in ascending order, or `MOST_ERRORS` quantiles if there are more errors.
    """
    if len(absolute_errors) > MOST_ERRORS:
        absolute_errors = np.quantile(absolute_errors, (np.arange(MOST_ERRORS) + 0.5) / MOST_ERRORS)
    return tuple(absolute_errors.tolist())


def fitted_terms(
    objective: Objective, path_loss_db: NDArray[np.float64], study: StudyModel
) -> tuple[FittedTerm, ...]:
    """Nuisance terms with their best-fit coefficients.

    Args:
        objective: The objective with the terms.
        path_loss_db: Modelled path loss without nuisance [links], [dB].
        study: The study.

    Returns:
        The terms. Groups without fitted links are left out.
    """
    coefficients = objective.completed(path_loss_db[None])[0]
    # The fit returns a coefficient even for a group whose links do not determine it.
    has_links = np.asarray(abs(objective.nuisance.design[objective.weight > 0]).sum(axis=0)).ravel() > 0
    used = objective.determined | has_links & (coefficients != 0)
    by_term, terms = objective.nuisance.by_term(coefficients, used), []
    spreads = {term.around: term.prior for term in objective.nuisance.terms if term.around}
    # A random effect, which has one term for its mean and one for the deviations, becomes a single term with the groups
    # of the deviations.
    grouped = {term.around or term.name: term for term in objective.nuisance.terms}
    for name, term in grouped.items():
        if term.labels == ("",):
            per = ""
        elif name == TX_OFFSET:
            per = "transmitter"
        else:
            per = OFFSET if name == OFFSET else str(study.nuisance[name].per)
        if by_term[name]:
            terms.append(FittedTerm(name, term.by, per, by_term[name], term.centre, spreads.get(name)))
    return tuple(terms)
