"""Suggestions of where to measure next: candidates are ranked by the uncertainty expected after they are measured."""

from __future__ import annotations

from dataclasses import replace
from numbers import Integral
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.engines.kinds.replay import ReplaySection, replay
from calibray.engines.protocol import Differentiable, Observing
from calibray.errors import InputError
from calibray.fitting.nuisance import UNKNOWN_DB, Term
from calibray.fitting.preliminary_fits import (
    LEAST_NOISE_DB,
    MARGIN,
    with_estimated_errors,
    with_estimated_spreads,
)
from calibray.fitting.problem import Evaluation, Problem
from calibray.measurements import Measurements
from calibray.measurements.placement import POSITION_COLUMNS
from calibray.prediction.batches import LOG, announce
from calibray.prediction.experiment_design import (
    UNIFORM_INFORMATION,
    Beliefs,
    Errors,
    Outlook,
    choose_candidates,
    initial_range_probability,
)
from calibray.prediction.observables import Worth, as_measured, worth_measuring
from calibray.prediction.predict import (
    NEIGHBOURS,
    as_links,
    check_inputs,
    refuse_far_links,
    traced_materials,
    warn_of_carriers,
    with_constants,
)
from calibray.result.files import has_links
from calibray.result.record import Record, check_record
from calibray.scenes import read_triangles
from calibray.study import Setup
from calibray.study.calibration_sections import OFFSET
from calibray.support.messages import percent
from calibray.support.progress import Progress, start_stage
from calibray.uncertainty.draws import evenly_spaced
from calibray.uncertainty.noise_models import HEAVY
from calibray.uncertainty.residual_correlation import shared_errors

MOST_DRAWS: Final = 96
"""Maximum number of posterior draws used to rank the candidates."""

VALUES_PER_RANGE: Final = 24
"""Number of values added to each separate range of a parameter; values are added because some ranges contain few
draws."""

LEAST_GAIN: Final = 0.02
"""Smallest relative narrowing of an interval, and smallest gain in probability, that the text reports."""


def suggest(
    result: Record,
    candidates: Measurements | pd.DataFrame,
    count: int = 5,
    progress: Progress | None = None,
    *,
    allow_changed_inputs: bool = False,
    observables: bool = False,
) -> pd.DataFrame:
    """Suggest where to measure next, based on how much each measurement should narrow the parameters' intervals.

    Each candidate is traced and then replayed for draws from the posterior. If all draws predict the same path loss for
    a candidate, measuring it adds no information. If the predictions differ by more than the error of a link, a
    measurement rules out some of the draws. Candidates are chosen one at a time; each is the best addition to those
    already chosen. Candidates whose mean predicted power is too near the study's noise floor are left out, as in a
    calibration. A warning in the log states how many candidates were left out, and the required margin.

    Args:
        result: The calibration, with the engine "replay" or "retrace" and with draws from the posterior.
        candidates: Possible measurements, given as links or as a table, as for `Result.predict`.
        count: Maximum number of suggestions; if there are fewer, a warning is logged.
        progress: Function that is called with the name of each stage, the completed work and the total.
        allow_changed_inputs: If True, continue even if the links, or a scene or antenna file, have changed since the
            calibration.
        observables: If True, also report which further observable is worth measuring at each suggestion.

    Returns:
        A table with one row per suggestion, the best suggestion first. The first columns are the candidate's row, its
        positions [m] and its group. The columns path_loss_db and spread_db are the mean and the standard deviation of
        the draws' predictions [dB]. For every parameter, NAME_width is the expected width of the 95 % interval after
        measuring this candidate and those above it. For a parameter with several separate ranges, NAME_sure is the
        expected probability that the right range is known. The column gain summarizes these gains in words. With
        `observables`, the column observable names the quantity that narrows the intervals most if it is measured in
        addition to path loss at this candidate and those above it. The column observable_gain summarizes in words the
        gain from this observable.

    Raises:
        InputError: `Result.predict` would reject the input for a reason other than unknown groups, the calibration has
            no draws, or no candidate has a path and a predicted power far enough above the study's noise floor.
    """
    check_record(result)
    if isinstance(count, bool) or not (isinstance(count, Integral) and count >= 1):
        raise InputError(f"count = {count!r}: must be a whole number of at least 1")
    study = result.study
    if study.engine.external:
        raise InputError(
            f"{study.path}: the engine {study.engine.name!r} provides no derivatives, which suggestions require; "
            "calibrate with the engine 'replay'"
        )
    if not result.uncertainty.draws:
        raise InputError(
            f"{study.path}: the result has no draws from the posterior; calibrate with the engine 'replay' and with "
            "more links than unknowns"
        )
    start_stage(progress, "reading scene and links")
    links = as_links(result, candidates)
    warn_of_carriers(result, links)
    calibrated = Setup.open(study).placed_at(result.parameters, NEIGHBOURS)
    # The calibration links and the candidates share a single loaded tracer.
    setup = calibrated.at(links)
    check_inputs(result, setup, allow_changed_inputs)
    if not allow_changed_inputs and not has_links(result, calibrated.links):
        raise InputError(
            f"{calibrated.links.source}: the links changed since the calibration, but suggestions need the links that "
            "were calibrated; calibrate again, or give --allow-changed-inputs (allow_changed_inputs=True)"
        )
    if len(result.links) != len(calibrated.links):
        raise InputError(
            f"{calibrated.links.source}: has {len(calibrated.links)} links, but {len(result.links)} were calibrated; "
            "calibrate again"
        )
    refuse_far_links(result, links, read_triangles(setup.scene))
    announce(result, len(links), "candidates")
    setup = with_constants(result, setup)
    model = _ReplayedDraws(result, calibrated.with_parameters(setup.parameters), progress)
    predicted, slope, errors = model.at(setup)
    reached = np.flatnonzero(np.isfinite(predicted).all(axis=0))
    if not len(reached):
        raise InputError(f"{links.source}: no candidate has a path (of {len(links)}); choose other positions")
    margin_db = model.floor_margin_db()
    reached = _received(result, links, predicted[: model.num_draws].mean(axis=0), reached, margin_db)
    errors = replace(errors, common=errors.common[reached], position=errors.position[reached])
    start_stage(progress, "choosing candidates")
    beliefs = model.beliefs()
    outlooks = choose_candidates(beliefs, predicted[:, reached], slope[:, reached], errors, count)
    if len(outlooks) < count:
        LOG.warning(
            "fewer suggestions (%d) than requested (%d): only %d of %s candidates have a path and enough power",
            len(outlooks), count, len(reached), f"{len(links):,}",
        )  # fmt: skip
    outlooks = [replace(outlook, index=int(reached[outlook.index])) for outlook in outlooks]
    draws = len(beliefs.point)
    before = initial_range_probability(beliefs.piece[:draws])
    table = _table(result, links, predicted[:draws], outlooks, before)
    if not observables:
        return table
    index = np.array([outlook.index for outlook in outlooks])
    best = model.worth(setup, index, np.stack([outlook.information for outlook in outlooks]))
    return table.assign(
        observable=[worth.kind for worth in best],
        observable_gain=[_gain(result, worth.narrowed) for worth in best],
    )


def _received(
    result: Record,
    links: Measurements,
    path_loss_db: NDArray[np.float64],
    reached: NDArray[np.int64],
    margin_db: float,
) -> NDArray[np.int64]:
    """Select the candidates in `reached` (those with a path) whose predicted power exceeds the floor by the margin.

    All of `reached` is returned if the study has no noise floor, or if the candidates' transmitted power is unknown.

    Raises:
        InputError: The predicted power of all candidates is too low.
    """
    floor = result.study.links.noise_floor_dbm
    powers = as_measured(result.study, links, pd.DataFrame({"path_loss_db": path_loss_db}))
    if floor is None or not powers:
        return reached
    (power,) = powers.values()
    received = reached[power[reached] > floor + margin_db]
    left_out, highest = len(reached) - len(received), power[reached].max()
    reason = f"not above links.noise_floor_dbm = {floor:g}"
    if margin_db:
        reason = (
            f"less than {margin_db:.1f} dB above links.noise_floor_dbm = {floor:g}, and the calibration uses no links "
            "this close to the floor"
        )
    if not len(received):
        raise InputError(
            f"{links.source}: the predicted power of all {left_out} candidates with a path, at most {highest:.1f} dBm, "
            f"is {reason}; choose positions nearer to the transmitters"
        )
    if left_out:
        LOG.warning(
            "%s of %s candidates left out, because the predicted power is %s",
            f"{left_out:,}", f"{len(links):,}", reason,
        )  # fmt: skip
    return received


class _ReplayedDraws:
    """The draws of a calibration, replayed on the calibration links and on the candidates.

    Args:
        result: The calibration.
        setup: The opened study of the calibration.
        progress: Function that is called with the name of each stage, the completed work and the total.
    """

    def __init__(self, result: Record, setup: Setup, progress: Progress | None) -> None:
        self.result, self.progress = result, progress
        self.engine = self._engine(setup)
        start_stage(progress, "evaluating draws")
        problem = _as_calibrated(result, Problem.of(setup, self.engine))
        parameters, objective = problem.parameters, problem.objective
        # Constants of the scene have tight priors, so they use up no degrees of freedom of the residuals.
        freedom = problem.freedom + len(parameters) - len(result.study.parameters)
        if freedom < 1:
            raise InputError(
                f"{result.study.path}: too few links ({objective.num_counted}) to estimate the size of residuals; "
                "measure more links, or calibrate fewer parameters"
            )
        self.inflation = float(np.sqrt(objective.num_counted / freedom))
        self.noise_db = max(result.rmse_db * self.inflation, LEAST_NOISE_DB)
        self.problem = replace(problem, objective=replace(objective, noise_db=self.noise_db))
        self.lower, upper = parameters.search_bounds
        self.width = upper - self.lower
        all_draws = np.stack([result.uncertainty.draws[name] for name in parameters.names], axis=1)
        chosen = evenly_spaced(len(all_draws), MOST_DRAWS)
        self.num_draws = len(chosen)
        self.values = np.vstack([all_draws[chosen], self._further_values(all_draws)])
        self.evaluation = self.problem.evaluate(parameters.to_search(self.values), derivatives=True)

    def beliefs(self) -> Beliefs:
        """The state of the calibration before any candidate is measured."""
        evaluation, draws = self.evaluation, slice(self.num_draws)
        square = evaluation.value**2 * evaluation.num_rows / self.noise_db**2
        unit = self.problem.parameters.to_unit(self.values[draws])
        information = self._information(evaluation)[draws]
        return Beliefs(unit, information, self._pieces(self.values), square - square.min())

    def at(self, setup: Setup) -> tuple[NDArray[np.float64], NDArray[np.float64], Errors]:
        """Predict the path loss of the candidates and the errors of their measurements.

        The first result is the path loss [m, candidates], [dB], for each draw and each further value. The second
        contains its derivatives [n, candidates, d], [dB], with respect to the coordinates of the unit cube, at the
        draws. The third contains the expected errors of measurements.
        """
        objective, links = self.problem.objective, setup.links
        engine = self._engine(setup)
        start_stage(self.progress, "evaluating candidates")
        loss, slope = self._replay(engine)
        if objective.ceiling_db is not None:
            slope[loss >= objective.ceiling_db] = 0.0
            loss = objective.capped(loss)
        design, common = self._nuisance(links)
        coefficients = objective.completed(self.evaluation.modelled)
        errors = self._errors(links, common)
        coefficient_slopes = objective.coefficient_slopes(*self._replay(self.engine))
        path_loss_db = loss + coefficients @ design.T
        return path_loss_db, (slope + design @ coefficient_slopes)[: self.num_draws], errors

    def floor_margin_db(self) -> float:
        """Margin [dB] above the noise floor within which a calibration leaves out links, judged by predicted path loss.

        The margin is that of `leave_out_near_floor` or, if smaller, the smallest distance of a calibration link from
        the floor. The margin is 0 if there is no noise floor. It is also 0 if links are censored, because the draws
        then use links near the floor.
        """
        links, counted = self.problem.setup.links, self.problem.objective.weight > 0
        if links.limit_db is None or links.censored is not None:
            return 0.0
        distance_db = (links.limit_db - self.result.links["after_db"].to_numpy(float))[counted]
        return float(np.clip(distance_db.min(), 0.0, MARGIN * self.noise_db))

    def worth(self, setup: Setup, index: NDArray[np.int64], information: NDArray[np.float64]) -> list[Worth]:
        """Find the further observables worth measuring at suggested candidates; see `worth_measuring`.

        Raises:
            InputError: The engine computes path loss but no further observables.
        """
        engine, values = self._engine(setup), self.values[: self.num_draws]
        section = setup.study.engine
        if not isinstance(engine, Observing) or getattr(section, "compress_db", None) is not None:
            raise InputError(
                f"{setup.study.path}: further observables require paths that engine.compress_db omits; suggest without "
                "further observables"
            )
        unit_slope = self.problem.parameters.search_slope(values) * self.width
        return worth_measuring(self.result, engine, (values, unit_slope), index, information)

    def _engine(self, setup: Setup) -> Differentiable:
        section = setup.study.engine
        compress_db = section.compress_db if isinstance(section, ReplaySection) else None
        materials = traced_materials(self.result, self.result.materials)
        return replay(setup, setup.trace(materials, self.progress), compress_db)

    def _replay(self, engine: Differentiable) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss [m, links] for all draws and further values, and its derivatives [m, links, d] in the unit cube."""
        loss, slope = engine.path_loss_and_jacobian(self.values)
        return loss, slope * (self.problem.parameters.search_slope(self.values) * self.width)[:, None, :]

    def _information(self, evaluation: Evaluation) -> NDArray[np.float64]:
        """Fisher information [m, d, d] of the links about the parameters in the unit cube, at every evaluated point."""
        slopes = evaluation.slopes * self.width / self.noise_db
        return np.einsum("nmi,nmj->nij", slopes, slopes)

    def _further_values(self, draws: NDArray[np.float64]) -> NDArray[np.float64]:
        """Draw values [k, d] around the draws of every separate range, with the scatter that the curvature implies."""
        parameters, piece = self.problem.parameters, self._pieces(draws)
        members = [
            np.flatnonzero(piece[:, k] == number)
            for k in np.flatnonzero(np.ptp(piece, axis=0))
            for number in np.unique(piece[:, k])
        ]
        if not members:
            return np.empty((0, draws.shape[1]))
        random = np.random.default_rng(self.result.study.method.seed)
        chosen = np.concatenate([random.choice(indices, VALUES_PER_RANGE) for indices in members])
        points = parameters.to_search(draws[chosen])
        information = self._information(self.problem.evaluate(points, derivatives=True))
        prior_information = UNIFORM_INFORMATION * np.eye(draws.shape[1])
        root = np.linalg.cholesky(np.linalg.inv(information + prior_information))
        step = np.einsum("nij,nj->ni", root, random.standard_normal(points.shape)) * self.width
        return parameters.from_search(np.clip(points + step, self.lower, self.lower + self.width))

    def _pieces(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Index [m, d] of the separate range that contains each parameter's value or is nearest to this value."""
        piece = np.zeros(values.shape, dtype=np.int64)
        for k, name in enumerate(self.problem.parameters.names):
            interval = self.result.intervals.get(name)
            if interval is not None and len(interval.pieces) > 1:
                ends = np.array(interval.pieces)
                outside = np.maximum(ends[:, 0, None] - values[:, k], values[:, k] - ends[:, 1, None])
                piece[:, k] = np.argmin(outside, axis=0)
        return piece

    def _nuisance(self, links: Measurements) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Design matrix of the nuisance for the candidates [candidates, q], and the uncertainty of the nuisance.

        The uncertainty [candidates, unknowns], [dB], has a column for each coefficient, computed from the posterior
        given the calibration links, and a column for each group without measurements.
        """
        objective, nuisance = self.problem.objective, self.problem.objective.nuisance
        if not nuisance.terms:
            return np.zeros((len(links), 0)), np.zeros((len(links), 0))
        parts = [self._term(term, links) for term in nuisance.terms]
        design = np.concatenate([columns for columns, _ in parts], axis=1)
        return design, np.concatenate(
            [design @ objective.coefficient_root(), *(unknown for _, unknown in parts)], axis=1
        )

    def _term(self, term: Term, links: Measurements) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Design columns of a term for candidates, and an uncertainty column for each group without measurements."""
        study = self.result.study
        if term.name == OFFSET:
            labels = links.group if study.offset is not None and study.offset.per is not None else None
        else:
            per = study.nuisance[term.around or term.name].per
            labels = None if per is None or term.labels == ("",) else links.table.labels(per)
        coefficients = self.result.nuisance.coefficients.get(term.name, {})
        at_links = term.at(links, labels)
        # A group without measurements is assigned the mean of the other groups; for a random effect, its deviation from
        # the mean is 0.
        others = 0.0 if term.around else 1.0 / len(term.labels)
        share = np.where(at_links.group[:, None] < 0, others, np.eye(len(term.labels))[at_links.group])
        new = np.flatnonzero(at_links.group < 0)
        new_labels = np.asarray([] if labels is None else labels)[new]
        new_groups, group = np.unique(new_labels, return_inverse=True)
        unknown = np.zeros((len(links), len(new_groups)))
        spread = np.std(list(coefficients.values()), ddof=1) if len(coefficients) > 1 else UNKNOWN_DB
        unknown[new, group] = at_links.value[new] * (term.prior if term.around else spread)
        return share * at_links.value[:, None], unknown

    def _errors(self, candidates: Measurements, common: NDArray[np.float64]) -> Errors:
        """Expected errors of candidates. Candidates have no weights, so all calibration links are given equal weight.

        `common` is as in `Errors`. Residuals of neighbouring links may be correlated, unless the study rules this out.
        """
        problem, objective, links = self.problem, self.problem.objective, self.problem.setup.links
        counted, point = objective.weight > 0, _calibrated_point(self.result, problem)
        residuals = (objective.model(problem.modelled(point[None]))[0] - objective.measured)[counted]
        position = np.hstack([candidates.rx, candidates.tx])
        noise, correlation = self.result.study.noise, None
        if noise.range_m != 0 and noise.kind != HEAVY:
            correlation = shared_errors(residuals, np.hstack([links.rx, links.tx])[counted])
        if correlation is None:
            own_db = float(np.sqrt(np.mean(residuals**2))) * self.inflation
            return Errors(max(own_db, LEAST_NOISE_DB), common, position)
        return Errors(correlation.own_db, common, position, correlation.shared_db, correlation.range_m)


def _as_calibrated(result: Record, problem: Problem) -> Problem:
    """The calibration problem, with the estimated spreads and errors, and with priors on the constants in the draws.

    Links near the noise floor are excluded.
    """
    first = len(result.study.parameters)
    constants, priors = problem.parameters.items[first:], problem.priors
    numbers, centres = range(first, first + len(constants)), [item.start for item in constants]
    spread, objective = result.study.noise.constants_spread, problem.objective
    if "faint" in result.links:
        weight = np.where(result.links["faint"].to_numpy(bool), 0.0, objective.weight)
        objective = objective.reweighted(weight)
    problem = replace(problem, priors=priors.extended(numbers, centres, spread), objective=objective)
    point = _calibrated_point(result, problem)
    return with_estimated_spreads(with_estimated_errors(problem, point), point)[0]


def _calibrated_point(result: Record, problem: Problem) -> NDArray[np.float64]:
    """The calibrated values in the search space [d], including the scene's constants that vary in the draws."""
    scene = dict(zip(problem.parameters.names, problem.parameters.start, strict=True))
    return problem.parameters.to_search(np.array([*(scene | result.parameters).values()]))


def _table(
    result: Record,
    candidates: Measurements,
    predicted: NDArray[np.float64],
    outlooks: list[Outlook],
    probability_before: NDArray[np.float64],
) -> pd.DataFrame:
    """The suggestions as a table."""
    index = np.array([outlook.index for outlook in outlooks])
    positions = np.hstack([candidates.tx, candidates.rx])
    table: dict[str, object] = {"row": candidates.row[index]}
    table |= {name: positions[index, k] for k, name in enumerate(POSITION_COLUMNS)}
    if candidates.group is not None:
        table["group"] = candidates.group[index]
    table["path_loss_db"] = predicted[:, index].mean(axis=0)
    table["spread_db"] = predicted[:, index].std(axis=0)
    gains: list[list[str]] = [[] for _ in outlooks]
    for k, name in enumerate(result.study.parameters):
        width_before = _width(result, name, 1.0)
        widths = [_width(result, name, float(outlook.narrowed[k])) for outlook in outlooks]
        table[f"{name}_width"] = widths
        for gain, width, outlook in zip(gains, widths, outlooks, strict=True):
            if outlook.narrowed[k] < 1 - LEAST_GAIN:
                gain.append(f"{name} to a width of {width:.3g} (now {width_before:.3g})")
        before = probability_before[k]
        if before < 1:
            probabilities = [float(outlook.range_probability[k]) for outlook in outlooks]
            table[f"{name}_sure"] = probabilities
            for gain, probability in zip(gains, probabilities, strict=True):
                if probability > before + LEAST_GAIN:
                    gain.append(
                        f"right range of {name} known with probability {percent(probability)} (now {percent(before)})"
                    )
    table["gain"] = [", ".join(gain) or "no interval narrows by more than 2 %" for gain in gains]
    return pd.DataFrame(table)


def _gain(result: Record, narrowed: NDArray[np.float64]) -> str:
    """Describe the gain from an observable in words."""
    gains = [
        f"{name} to {ratio:.2g} of its width"
        for name, ratio in zip(result.study.parameters, narrowed, strict=False)
        if ratio < 1 - LEAST_GAIN
    ]
    return ", ".join(gains) or "no interval narrows by more than 2 %"


def _width(result: Record, name: str, narrowed: float) -> float:
    """Width of a parameter's interval if the scatter of the draws narrows by a factor on the scale used for the search.

    The draws apply only to the buildings on the links' paths. A measurement does not show how much other buildings
    differ, so the part of the width due to them remains.
    """
    section, interval = result.study.parameters[name], result.intervals.get(name)
    ends = np.array(section.bounds if interval is None else (interval.lower, interval.upper), dtype=float)
    seen = ends if interval is None or not interval.seen else np.array(interval.seen).ravel()[[0, -1]]
    log = section.scale == "log"
    middle, half, seen_half = (
        (np.log(ends) if log else ends).mean(),
        *(np.ptp(np.log(bounds) if log else bounds) / 2 for bounds in (ends, seen)),
    )
    # The squares of the two parts of the width add: one part is due to other buildings, and the measurement narrows
    # only the other.
    half = min(float(np.hypot(np.sqrt(max(half**2 - seen_half**2, 0.0)), narrowed * seen_half)), half)
    after = np.array([middle - half, middle + half])
    return float(np.ptp(np.exp(after) if log else after))
