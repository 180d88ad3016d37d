"""The models that validation compares: baselines without paths, and variants of the study's model that use the scene.

The baselines are the log-distance model, the log-distance model with terms for obstruction of the line of sight, and
kriging.

The variants are the study's own model, the initial materials, the model with a prior around the initial values, and the
model with both this prior and offsets, per transmitter and for non-line-of-sight links. These are the models that an
engineer would try by hand. The best variant differs between campaigns, so the choice is based on held-out links
(`validate.py`). Both offsets have a prior around zero, which keeps the offsets small unless the measurements require
larger ones. A single variant with both offsets is therefore sufficient. Further variants make the choice worse
(docs/measurements/predictions.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from calibray.engines.protocol import Differentiable
from calibray.errors import EngineError, InputError
from calibray.fitting.nuisance import (
    CONSTANT,
    LOG_DISTANCE,
    ROUNDING,
    UNBOUNDED,
    Nuisance,
    Term,
    make_term,
    transmitters,
)
from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.fitting.search import STARTS, least_squares, local_searches
from calibray.measurements import Measurements
from calibray.optimizers.least_squares import CATCH_UP, NEARER
from calibray.parameters import LogNormal
from calibray.result.held_out import AVERAGES, Model
from calibray.scenes.obstruction import OUT_OF_SIGHT, WALLS
from calibray.study import Setup
from calibray.study.calibration_sections import OF_ALL_LINKS, TX_OFFSET
from calibray.study.model import StudyModel
from calibray.study.mounting import direct_gain
from calibray.uncertainty.residual_correlation import fit_correlation

OUT_OF_SIGHT_DB: Final = (10.0, 10.0)
"""Mean and standard deviation [dB] of the prior for the additional loss of non-line-of-sight links. 3GPP TR 38.901
(UMi) gives 10 dB at 20 m and 20 dB at 100 m. If all fitted links have line of sight, only the prior gives information
about this loss."""

WALL_DB: Final = 2.0
"""Standard deviation of the zero-mean prior for the loss per wall crossed [dB]. Indoors, walls dominate path loss,
whatever the prior. Outdoors, waves travel around buildings. With a standard deviation of 5 dB, the error on one
held-out cluster in Boulder was 17 dB."""

ROUNDS: Final = 4
"""Number of rounds; each round fits the losses with their priors and updates the RMS error. Further rounds change
results by 0.01 dB."""

LEAST_NOISE_DB: Final = 1.0
"""Lower limit [dB] on the RMS error of the log-distance model; this error determines the weight of the priors."""

MOST_KRIGED: Final = 1000
"""Maximum number of links from which residuals are kriged. Fitting the correlation factorizes the covariance of these
links a few hundred times."""


def without_scene(study: StudyModel, links: Measurements) -> NDArray[np.float64]:
    """The part of path loss [links], [dB], that requires no scene: the increase with frequency, minus antenna gains.

    Path loss increases by 20 log10(f / f0) from the study's carrier f0, as in free space. The gains are those of the
    stated antennas along the straight line between them; columns of the links state the directions in which they point.

    Raises:
        InputError: A column of the antennas is missing or malformed.
    """
    carrier = study.scene.frequency if links.frequency is None else links.frequency
    rise_db = 20 * np.log10(np.full(len(links), carrier) / study.scene.frequency)
    return rise_db - direct_gain(study, links)


class Baseline(NamedTuple):
    """A model without paths.

    All unknowns are nuisance coefficients, which are determined by the links with nonzero weight.

    Attributes:
        objective: The model as an objective.
        known_db: Known part of the path loss [links], [dB].
    """

    objective: Objective
    known_db: NDArray[np.float64]

    def path_loss_db(self) -> NDArray[np.float64]:
        """Path loss on all links [links], [dB].

        Groups without links of nonzero weight are assigned the mean of other groups.
        """
        return self.objective.with_nuisance(self.known_db)


def log_distance(links: Measurements, objective: Objective, known_db: NDArray[np.float64]) -> Baseline:
    """The log-distance model with the nuisances of the study. An offset per group becomes an intercept per group.

    The weights of `objective`, the objective of the study, select the fitted links. `known_db` is the result of
    `without_scene` [links], [dB].

    Raises:
        EngineError: Fewer than two links have a nonzero weight.
    """
    if np.count_nonzero(objective.weight) < 2:
        raise EngineError("the log-distance model requires at least two calibration links")
    # Bounds and priors of an offset or a slope do not apply to the intercept and slope of the law. Groups may deviate
    # from the intercept and slope as far as the study allows.
    terms = [
        replace(term, bounds=UNBOUNDED, prior=np.inf if term.labels == ("",) else term.prior)
        if term.by in (CONSTANT, LOG_DISTANCE)
        else term
        for term in objective.nuisance.terms
    ]
    present = [(term.by, term.labels) for term in terms]
    for by in (CONSTANT, LOG_DISTANCE):
        if (by, ("",)) not in present:
            terms.append(make_term(links, _free_name(by, terms), by))
    nuisance = Nuisance(len(links), tuple(terms))
    # A model without paths predicts path loss for every link, so the ceiling does not apply.
    return Baseline(replace(objective, nuisance=nuisance, ceiling_db=None), known_db)


def has_obstruction(links: Measurements) -> bool:
    """Whether the links have the columns computed from a scene and at least one line of sight is blocked."""
    return OUT_OF_SIGHT in links.frame and bool(links.table.numbers(OUT_OF_SIGHT).any())


def obstructed(links: Measurements, objective: Objective, known_db: NDArray[np.float64]) -> Baseline:
    """The log-distance model with non-line-of-sight loss and a loss per wall, from columns computed with the scene.

    The non-line-of-sight loss has a prior with a nonzero mean. The mean is part of the known path loss, and the
    deviation from this mean is a coefficient. The arguments are those of `log_distance`.

    Raises:
        EngineError: Fewer than two links have a nonzero weight.
    """
    model, known_db = log_distance(links, objective, known_db)
    terms, present = list(model.nuisance.terms), {term.by for term in model.nuisance.terms}
    for by, prior_db in ((OUT_OF_SIGHT, OUT_OF_SIGHT_DB[1]), (WALLS, WALL_DB)):
        if by not in present:
            terms.append(make_term(links, _free_name(by, terms), by, prior=prior_db))
    if OUT_OF_SIGHT not in present:
        known_db = known_db + OUT_OF_SIGHT_DB[0] * links.table.numbers(OUT_OF_SIGHT)
    nuisance = Nuisance(len(links), tuple(terms))
    model = replace(model, nuisance=nuisance)
    # The RMS error determines the weight of the priors, and the priors change the RMS error, so the fit is repeated.
    for _ in range(ROUNDS):
        model = replace(model, noise_db=max(float(model.rmse(known_db[None])[0]), LEAST_NOISE_DB))
    return Baseline(model, known_db)


def _free_name(by: str, terms: Sequence[Term]) -> str:
    """A name that no other term uses, for a term of the column `by`."""
    names = {term.name for term in terms}
    plain = by.replace("_", " ") if by in (OUT_OF_SIGHT, WALLS) else by
    return next(name for name in (plain, f"{plain} of all", f"{plain} of all links") if name not in names)


def kriging(links: Measurements, objective: Objective, trend_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss of a model on all links [links], [dB], plus residuals kriged from the links with nonzero weight.

    The model was fitted to the links with nonzero weight. Its path loss is `trend_db` [links], [dB].

    Raises:
        InputError: There are too few links or more than `MOST_KRIGED` links, or all links have the same position.
        EngineError: All residuals are zero.
    """
    counted = objective.weight > 0
    count = int(counted.sum())
    if count > MOST_KRIGED:
        raise InputError(f"kriging: too many links ({count}), must be at most {MOST_KRIGED}")
    position = np.hstack([links.rx, links.tx])
    measured, residual = position[counted], (objective.measured - trend_db)[counted]
    # The fit removed an intercept and, unless all distances are equal to within rounding, a slope.
    decades = np.log10(links.distance[counted])
    decades -= decades.mean()
    design = np.ones((count, 1))
    if not np.allclose(decades, 0.0, atol=ROUNDING):
        design = np.column_stack([design, decades / np.abs(decades).max()])
    field = fit_correlation(residual, measured, design=design)
    # This is simple kriging: far from all links, the expected residual is 0.
    weights = np.linalg.solve(field.covariance(measured), residual)
    return trend_db + field.shared_db**2 * np.exp(-cdist(position, measured) / field.range_m) @ weights


def kriged(
    name: Model, links: Measurements, objective: Objective, trend_db: NDArray[np.float64]
) -> dict[Model, NDArray[np.float64]]:
    """The result of `kriging` under the given name; empty if kriging is impossible.

    Kriging is impossible if there are too few or too many links, if all links have the same position, or if all
    residuals are zero.
    """
    try:
        return {name: kriging(links, objective, trend_db)}
    except (InputError, EngineError):
        return {}


def without_paths(setup: Setup, objective: Objective) -> dict[Model, NDArray[np.float64]]:
    """Path loss [links], [dB], of each baseline without paths on all links; links with nonzero weight were fitted."""
    links, known_db = setup.links, without_scene(setup.study, setup.links)
    path_loss_db = {Model.LOG_DISTANCE: log_distance(links, objective, known_db).path_loss_db()}
    if has_obstruction(links):
        path_loss_db[Model.OBSTRUCTION] = obstructed(links, objective, known_db).path_loss_db()
    return path_loss_db | kriged(Model.KRIGING, links, objective, path_loss_db[Model.LOG_DISTANCE])


PRIOR_SPREAD: Final = 0.3
"""Standard deviation of the prior for the logarithm of a parameter around its initial value, in variants with a
prior."""

OFFSET_PRIOR_DB: Final = 10.0
"""Standard deviation [dB] of the zero-mean priors of two offsets: the offset of a transmitter relative to that of all
links, and the offset of non-line-of-sight links. In downtown Boulder, the latter offset is 11.7 dB."""

MOST_STARTS: Final = 4
"""Maximum number of known minima from which searches start."""

NEW_STARTS: Final = 4
"""Maximum number of additional starting points if minima are known."""

MOST_NEW_STARTS: Final = 128
"""Maximum number of starting points if no minimum is known."""

TOLERANCE: Final = 1e-6
"""Relative decrease in the mean square error below which a search is regarded as converged; further iterations hardly
change predictions."""

NO_MINIMA: Final[Mapping[Model, NDArray[np.float64]]] = {}


def fit_variants(
    part: Problem, known_minima: Mapping[Model, NDArray[np.float64]] = NO_MINIMA
) -> dict[Model, tuple[Problem, NDArray[np.float64]]]:
    """Fit every variant to the links with nonzero weight.

    Args:
        part: The problem; held-out links have weight 0.
        known_minima: Minima [k, d] of fits to more links, by variant, used as starting points. If the minima of the
            study's own model are missing, the full ranges of the parameters are searched.

    Returns:
        The problem and the minima [k, d] of each variant, by name; the best minimum comes first.
    """
    if Model.CALIBRATED in known_minima:
        calibrated = find_minima(part, known_minima[Model.CALIBRATED], _new_starts(part))
    else:
        searches = min(_searches(part), MOST_NEW_STARTS)
        calibrated = find_minima(part, np.zeros((0, len(part.parameters))), searches)
    fits: dict[Model, tuple[Problem, NDArray[np.float64]]] = {}
    for name, variant in variants(part, calibrated[0]).items():
        if name == Model.INITIAL:
            minima = part.parameters.to_search(part.parameters.start)[None]
        elif name == Model.CALIBRATED:
            minima = calibrated
        else:
            new_starts = _new_starts(part) if name in known_minima else NEW_STARTS
            minima = find_minima(variant, known_minima.get(name, calibrated), new_starts)
        fits[name] = variant, minima
    return fits


def variants(part: Problem, best: NDArray[np.float64]) -> dict[Model, Problem]:
    """The problems of all variants.

    Args:
        part: The problem; held-out links have weight 0.
        best: The optimum of the problem [d]; the residuals there determine the noise level that scales the priors.

    Returns:
        The problems by name. For `Model.INITIAL`, only the nuisance is fitted.
    """
    setup, objective = part.setup, part.objective
    noise_db = float(part.squares(best[None]).rmse_db[0]) * np.sqrt(
        objective.num_counted / max(part.freedom, 1)
    )
    priors = _priors_around_start(part)
    problems = {
        Model.INITIAL: replace(part, objective=initial_objective(objective, setup)),
        Model.CALIBRATED: part,
        Model.PRIOR: replace(part, priors=priors, objective=replace(objective, noise_db=noise_db)),
    }
    with_both = with_offsets(objective, setup.links)
    if with_both is not None:
        problems[Model.OFFSETS] = replace(
            part, priors=priors, objective=replace(with_both, noise_db=noise_db)
        )
    return problems


def find_minima(problem: Problem, starts: NDArray[np.float64], new_starts: int) -> NDArray[np.float64]:
    """Find minima [m, d] of a problem, best first, by local searches from given and new starting points [k, d]."""
    # If minima are known, the other searches only need to show whether there is a lower minimum.
    catch_up = NEARER if len(starts) else CATCH_UP
    return least_squares(
        problem, new_starts, starts[:MOST_STARTS], tolerance=TOLERANCE, catch_up=catch_up
    ).minima


def averages(path_loss_db: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Path loss [links], [dB], by name, of every average of two models that are both given."""
    return {
        name: average.of(path_loss_db[average.first], path_loss_db[average.second])
        for name, average in AVERAGES.items()
        if {average.first, average.second} <= path_loss_db.keys()
    }


def _searches(problem: Problem) -> int:
    """Number of local searches needed to find the minima of a problem without a known minimum."""
    interactions = problem.engine.interactions if isinstance(problem.engine, Differentiable) else 1
    return local_searches(interactions)


def _new_starts(problem: Problem) -> int:
    """Number of additional starting points if minima of the same variant, fitted to more links, are known.

    A large path program gets fewer points, because its calibration also makes fewer searches. With one point instead of
    four, errors on held-out links in Auckland agree to within 0.001 dB. For small path programs, more points often lead
    to a lower minimum.
    """
    return min(max(_searches(problem) // STARTS[0], 1), NEW_STARTS)


def initial_objective(objective: Objective, setup: Setup) -> Objective:
    """The objective for the initial materials, with an offset common to all links unless the study has an offset."""
    return _with_term(objective, CONSTANT, setup.links)


def with_offsets(objective: Objective, links: Measurements) -> Objective | None:
    """The objective with offsets per transmitter and for non-line-of-sight links, both with priors; None if impossible.

    There are no offsets per transmitter if there is only one transmitter, or if another term already has groups.
    """
    changed, labels = objective, transmitters(links)
    if len(np.unique(labels)) > 1 and all(len(term.labels) == 1 for term in objective.nuisance.terms):
        changed = _with_term(changed, CONSTANT, links)
        deviation = make_term(links, TX_OFFSET, labels=labels, prior=OFFSET_PRIOR_DB)
        changed = replace(changed, nuisance=Nuisance(len(links), (*changed.nuisance.terms, deviation)))
    if has_obstruction(links):
        changed = _with_term(changed, OUT_OF_SIGHT, links, OFFSET_PRIOR_DB)
    return None if changed is objective else changed


def _with_term(
    objective: Objective, by: str, links: Measurements, prior_db: float | None = None
) -> Objective:
    """The objective with one coefficient of the column `by` for all links, unless a term already has this column."""
    if any(term.by == by for term in objective.nuisance.terms):
        return objective
    term = make_term(links, f"{by}{OF_ALL_LINKS}", by, prior=prior_db)
    terms = (*objective.nuisance.terms, term)
    return replace(objective, nuisance=Nuisance(len(links), terms))


def _priors_around_start(problem: Problem) -> LogNormal:
    """The priors of the study, and a prior around the initial value for every positive parameter without a prior."""
    parameters, priors = problem.parameters, problem.priors
    added = [
        index
        for index, parameter in enumerate(parameters)
        if index not in priors.index and parameter.lower > 0 and parameter.start > 0
    ]
    return priors.extended(added, [float(parameters.start[index]) for index in added], PRIOR_SPREAD)
