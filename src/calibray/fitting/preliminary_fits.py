"""Fits before the calibration, to exclude links near the noise floor and to estimate the noise and the spreads.

Near the noise floor, a link is received only if its error is favourable. Selecting links by their measured values keeps
these links and biases the fit. Selecting links by their predicted values causes no bias, because the prediction is
independent of the link's error (selection on the explanatory variables: J. M. Wooldridge, Econometric Analysis of Cross
Section and Panel Data, 2nd ed., MIT Press 2010, chapter 19). We first fit the model to all links above the floor. We
then refit it to the links whose predicted power is well above the floor, until the selection is stable.

Residuals follow y = X b + Z u + e with u ~ N(0, lambda sigma^2) per group and e ~ N(0, sigma^2). X contains the columns
of all other fitted terms. The restricted likelihood (H. D. Patterson and R. Thompson, Biometrika 58, 1971) accounts for
the scatter that fitting b removes; maximum likelihood ignores this scatter and therefore underestimates the spread.

Spreads of transmitters are estimated by expectation maximization with a Gaussian approximation at the optimum (D. Bates
and S. DebRoy, J. Multivariate Analysis 91, 2004, section 5): the squared spread is the mean, over the transmitters, of
the squared value plus the variance of the value.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fitting.nuisance import UNKNOWN_DB, Nuisance
from calibray.fitting.objective import Objective
from calibray.fitting.observed import with_errors
from calibray.fitting.problem import Problem
from calibray.fitting.search import least_squares
from calibray.study import Study
from calibray.study.link_checks import LINKS_PER_UNKNOWN
from calibray.study.mounting import estimated_fields, with_spreads
from calibray.support.messages import MAX_LISTED
from calibray.support.progress import Progress
from calibray.tracing.antennas import NEW, POSE

_LOG: Final = logging.getLogger(__name__)

MARGIN: Final = 8.0
"""Required margin between the predicted path loss and the noise floor, in standard deviations of the links' errors.
Position errors make paths appear and vanish, which gives the errors heavy tails; a margin of four leaves some bias."""

SMALL_MARGIN: Final = 4.0
"""Margin used if `MARGIN` leaves fewer than `LINKS_PER_UNKNOWN` links per unknown, or no links that determine an
offset. For errors of 5.5 dB and path loss over a range of 35 dB, the fitted slope is 12 % too low if all links are
kept, and 2 % too high (standard error 2 %) with this margin."""

SELECTIONS: Final = 4
"""Maximum number of selections."""

NOISE_ESTIMATES: Final = 5
"""Maximum number of noise estimates; each estimate weights the priors by the previous estimate."""

TOLERANCE: Final = 0.02
"""Relative change of the estimates at which the iteration ends."""

LEAST_NOISE_DB: Final = 1e-3
"""Lower limit of the noise estimate [dB], which keeps the weight of the priors above zero for data without noise."""

LEAST_SPREAD_DB: Final = 0.05
"""Lower limit of the spread between groups [dB per unit of the column], which keeps the weight of the prior finite."""

SEARCHES: Final = 32
"""Number of local searches of the first fit; later fits continue from the minima of the first fit."""


def leave_out_near_floor(problem: Problem, progress: Progress | None = None) -> Problem:
    """Give links with predicted power near the noise floor a weight of 0, and mark these links in `faint`.

    The problem is unchanged if there is no noise floor. It is also unchanged if the engine provides no derivatives,
    because calls are then expensive. If the remaining links determine fewer unknowns, the problem is unchanged and a
    warning is logged. The stage of `progress` is "choosing links".
    """
    limit, objective = problem.setup.links.limit_db, problem.objective
    if limit is None or not problem.differentiable:
        return problem
    all_weights = objective.weight
    starts = problem.parameters.to_search(problem.parameters.start)[None]
    faint, margin = np.zeros(len(limit), dtype=bool), MARGIN
    fewest = LINKS_PER_UNKNOWN * (objective.num_counted - problem.freedom)
    if progress is not None:
        progress("choosing links", 0, SELECTIONS)
    for turn in range(SELECTIONS):
        fit = least_squares(problem, SEARCHES if turn == 0 else 1, starts)
        starts = fit.minima[:SEARCHES]
        rmse_db = float(problem.squares(fit.best.x[None]).rmse_db[0])
        # Each unknown removes a degree of freedom, so the RMSE underestimates the standard deviation of a link's error.
        error_db = rmse_db * np.sqrt(objective.num_counted / max(problem.freedom, 1))
        predicted = objective.model(problem.modelled(fit.best.x[None]))[0]
        before, selected = faint, _far_from(limit - margin * error_db, predicted, objective, all_weights)
        if turn == 0 and (selected.num_counted < fewest or not _determines_as_much(problem, selected)):
            margin = SMALL_MARGIN
            selected = _far_from(limit - margin * error_db, predicted, objective, all_weights)
        faint = (all_weights > 0) & (selected.weight == 0)
        if progress is not None:
            progress("choosing links", turn + 1, SELECTIONS)
        if np.array_equal(faint, before) or problem.freedom < 1 or not _determines_as_much(problem, selected):
            if turn == 0 and faint.any():
                _warn_of_bias(problem, selected, faint)
            faint = before
            break
        objective = selected
        problem = replace(problem, objective=objective)
    if problem.faint is not None:
        faint = faint | problem.faint
    return replace(problem, faint=faint) if faint.any() else problem


def _far_from(
    largest_db: NDArray[np.float64],
    predicted_db: NDArray[np.float64],
    objective: Objective,
    weight: NDArray[np.float64],
) -> Objective:
    """The objective with a weight of 0 for links whose predicted path loss exceeds `largest_db` [L]."""
    return objective.reweighted(np.where(predicted_db <= largest_db, weight, 0.0))


def _determines_as_much(problem: Problem, selected: Objective) -> bool:
    """Whether the selected links determine the same coefficients as the links of the problem."""
    if not (selected.weight > 0).any():
        return False
    has_freedom = replace(problem, objective=selected).freedom >= 1
    return has_freedom and np.array_equal(selected.determined, problem.objective.determined)


def _warn_of_bias(problem: Problem, selected: Objective, faint: NDArray[np.bool_]) -> None:
    """Warn of a bias if links near the noise floor are kept because the other links determine fewer unknowns."""
    determined = selected.determined if (selected.weight > 0).any() else np.zeros(1, dtype=bool)
    lost = np.flatnonzero(problem.objective.determined & ~determined)
    names = ", ".join(problem.objective.nuisance.columns[column] for column in lost[:MAX_LISTED])
    _LOG.warning(
        "%s: %s of %s links are expected near the noise floor, but are kept because the other links do not determine "
        "%s; weak links are received only if fading is favourable, so the fitted offsets and path loss are too low; "
        "measure at shorter distances",
        problem.setup.links.source, f"{faint.sum():,}", f"{problem.objective.num_counted:,}",
        names or "all unknowns",
    )  # fmt: skip


def estimate_noise(problem: Problem, progress: Progress | None = None) -> Problem:
    """Estimate the noise level that scales the priors (unless the study declares it) and the spread of random effects.

    Without priors, the problem is unchanged. If the engine provides no derivatives, calls are expensive, so the spread
    is estimated at the initial values. The stage of `progress` is "estimating noise".

    Raises:
        InputError: The noise is not declared and cannot be estimated.
    """
    study = problem.setup.study
    stated = study.noise.std_db is not None or study.links.std is not None
    random_effects = any(term.around for term in problem.objective.nuisance.terms)
    unstated = not all(observable.stated for observable in problem.observed)
    if not problem.has_priors or (stated and not unstated and not random_effects):
        return problem
    if not stated and (not problem.differentiable or problem.freedom < 1):
        engine = f"calls of the engine {study.engine.name!r} are too expensive"
        cause = "there are too few links" if problem.differentiable else engine
        raise InputError(
            f"{study.path}: noise.std_db: is required, because the study has a prior and {cause} to estimate the "
            "noise; give the standard deviation of a link's error [dB]"
        )
    starts = problem.parameters.to_search(problem.parameters.start)[None]
    if not problem.differentiable:
        return with_estimated_spreads(problem, starts[0])[0]
    noise_db = problem.objective.noise_db if stated else float(problem.squares(starts).rmse_db[0])
    if progress is not None:
        progress("estimating noise", 0, NOISE_ESTIMATES)
    for turn in range(NOISE_ESTIMATES):
        problem = _with_noise(problem, noise_db)
        fit = least_squares(problem, SEARCHES if turn == 0 else 1, starts)
        starts = fit.minima[:SEARCHES]
        if progress is not None:
            progress("estimating noise", turn + 1, NOISE_ESTIMATES)
        before, links, errors = problem.objective.noise_db, problem.objective.num_counted, problem.observed
        old_spreads, point = problem.objective.nuisance.prior, fit.best.x
        problem = with_estimated_errors(problem, point)
        within_db = None
        if random_effects:
            problem, within_db = with_estimated_spreads(problem, point)
        if not stated:
            in_sample = float(
                problem.squares(point[None]).rmse_db[0] * np.sqrt(links / max(problem.freedom, 1))
            )
            noise_db = max(in_sample if within_db is None else within_db, LEAST_NOISE_DB)
        changes = [abs(noise_db / before - 1)]
        spreads = problem.objective.nuisance.prior
        changes += np.abs(spreads[spreads < np.inf] / old_spreads[spreads < np.inf] - 1).tolist()
        changes += [
            abs(observable.std / old.std - 1)
            for observable, old in zip(problem.observed, errors, strict=True)
        ]
        if max(changes) <= TOLERANCE:
            break
    return _with_noise(problem, noise_db)


def with_estimated_spreads(problem: Problem, point: NDArray[np.float64]) -> tuple[Problem, float]:
    """Estimate the spreads of a problem's random effects at a point [d] of the search space.

    The first result is the problem with these spreads. The second result is the standard deviation of a link's error
    within the groups of the last effect [dB]. If the engine provides no derivatives, both results are estimated at the
    initial values, for which path loss is known.
    """
    objective = problem.objective
    counted = np.flatnonzero(objective.weight > 0)
    scale = np.sqrt(objective.weight[counted] * len(counted) / objective.weight.sum())
    terms, within_db = list(objective.nuisance.terms), 0.0
    for index, term in enumerate(terms):
        if not term.around:
            continue
        # Without the deviations in the model, their scatter remains in the residuals.
        others = Nuisance(len(objective.weight), (*terms[:index], *terms[index + 1 :]))
        without = replace(problem, objective=replace(objective, nuisance=others))
        jacobian = None
        if problem.differentiable:
            evaluation = without.evaluate(point[None], derivatives=True)
            residuals, jacobian = evaluation.residuals[0], evaluation.slopes[0]
        else:
            residuals = without.objective.residuals(problem.before[None])[0]
        # The rows of the priors follow the rows of the links, so that the other effects are random. As fixed effects,
        # places would explain the differences between the streets that contain these places.
        ridge = objective.noise_db / others.prior
        priors = np.diag(ridge)[ridge > 0]
        columns = [np.vstack([others.design[counted].toarray() * scale[:, None], priors])]
        if jacobian is not None:
            columns.append(jacobian[: len(columns[0])])
        between, within_db = group_spread(
            residuals[: len(columns[0])],
            np.hstack(columns),
            np.append(term.value[counted] * scale, np.zeros(len(priors))),
            np.append(term.group[counted], np.zeros(len(priors), dtype=np.int64)),
        )
        terms[index] = replace(term, prior=max(between, LEAST_SPREAD_DB))
    nuisance = Nuisance(len(objective.weight), tuple(terms))
    return replace(problem, objective=replace(objective, nuisance=nuisance)), within_db


def with_estimated_errors(problem: Problem, point: NDArray[np.float64]) -> Problem:
    """The problem with estimates of the further observables' errors, from the residuals at a point [d]."""
    if not problem.observed:
        return problem
    candidate = problem.parameters.from_search(point[None])
    values = problem.respond(candidate).observed[0]
    return replace(problem, observed=with_errors(problem.observed, values, problem.objective.weight))


def _with_noise(problem: Problem, noise_db: float) -> Problem:
    return replace(problem, objective=replace(problem.objective, noise_db=max(noise_db, LEAST_NOISE_DB)))


RATIOS: Final = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 121)])
"""Ratios lambda of the variance between groups to the variance within groups, at which the likelihood is evaluated."""

SINGULAR: Final = 1e-10
"""Fraction of the design's largest singular value below which columns are treated as linearly dependent."""


class GroupSpread(NamedTuple):
    """Standard deviations between and within groups.

    Attributes:
        between: Standard deviation between groups, in the unit of the residuals per unit of the column; 0 if the groups
            do not differ, and `UNKNOWN_DB` if the links do not determine this value.
        within: Standard deviation of individual links within a group, in the unit of the residuals.
    """

    between: float
    within: float


def group_spread(
    residuals: NDArray[np.float64],
    design: NDArray[np.float64],
    column: NDArray[np.float64],
    group: NDArray[np.int64],
) -> GroupSpread:
    """Estimate the spread of a column's coefficient between groups.

    Args:
        residuals: Residuals of the links [n].
        design: Columns X [n, k] of the other fitted terms, including the derivatives of the model.
        column: The column [n].
        group: Index of each link's group [n].

    Returns:
        The standard deviations.

    Example:
        >>> shift = np.repeat([3.0, -2.0, 0.0, -1.0], 5)
        >>> noise = np.tile([1.0, -1.0, 0.5, -0.5, 0.0], 4)
        >>> found = group_spread(shift + noise, np.ones((20, 1)), np.ones(20), np.repeat(np.arange(4), 5))
        >>> round(found.between, 1), round(found.within, 1)
        (2.1, 0.8)
    """
    left, size, _ = np.linalg.svd(design, full_matrices=False)
    basis = left[:, size > SINGULAR * max(size.max(initial=0.0), 1e-300)]
    freedom = len(residuals) - basis.shape[1]
    if freedom < 2:
        return GroupSpread(UNKNOWN_DB, float(np.std(residuals)))
    all_columns = np.column_stack([basis, residuals])
    products, groups = all_columns.T @ all_columns, int(group.max()) + 1
    sums = np.stack([np.bincount(group, column * values, groups) for values in all_columns.T])
    square = np.bincount(group, column**2, groups)
    # If the design explains the column completely, as with a single group, all ratios are equally likely.
    explained = np.sum(sums[:-1] ** 2, axis=0)
    shown = (square - explained).max() > SINGULAR * square.max()
    best, spread = np.inf, GroupSpread(0.0, 0.0)
    for ratio in RATIOS:
        # V = I + ratio Z Z' has one block per group, whose inverse is a rank-one update (Sherman and Morrison).
        weighted = products - (sums * (ratio / (1.0 + ratio * square))) @ sums.T
        inner, side = weighted[:-1, :-1], weighted[:-1, -1]
        variance = float(weighted[-1, -1] - side @ np.linalg.solve(inner, side)) / freedom
        variance = max(variance, 1e-12)
        # Minus twice the restricted log likelihood; |V| is the product of 1 + ratio x square over the groups.
        deviance = freedom * np.log(variance) + np.log1p(ratio * square).sum() + np.linalg.slogdet(inner)[1]
        if deviance < best:
            best, spread = deviance, GroupSpread(float(np.sqrt(ratio * variance)), float(np.sqrt(variance)))
    return spread if shown else GroupSpread(UNKNOWN_DB, spread.within)


ROUNDS: Final = 20
"""Maximum number of estimates; three suffice if the links determine most transmitters' values well."""

LEAST: Final = 1e-3
"""Lower limit of a spread, as a fraction of the width of the bounds, which keeps the weights of the priors finite."""


def estimate_spreads(problem: Problem, progress: Progress | None = None) -> Problem:
    """Estimate the spread of every population of transmitters for which the study states no spread.

    In the returned problem, the study and the priors contain the spreads. The stage of `progress` is "estimating
    spreads".
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
            # The prior shrinks fitted values towards 0; adding the variances of these values corrects for the
            # shrinkage.
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


def with_preliminary_fits(problem: Problem, progress: Progress | None = None) -> Problem:
    """The problem to calibrate, without links near the noise floor and with estimated noise and spreads."""
    problem = estimate_noise(leave_out_near_floor(problem, progress), progress)
    return estimate_spreads(problem, progress)
