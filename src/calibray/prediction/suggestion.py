"""Where to measure next: candidates, ranked by what their measurement would leave open of a finished calibration."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.engines.kinds.replay import ReplaySection, replay
from calibray.engines.protocol import Differentiable
from calibray.errors import InputError
from calibray.fitting.nuisance import OFFSET, UNKNOWN_DB, Term
from calibray.fitting.problem import Evaluation, Problem
from calibray.measurements import Measurements
from calibray.prediction.experiment_design import FLAT, Beliefs, Errors, Outlook, certain, choose
from calibray.prediction.predict import as_links, opened
from calibray.result.record import Record
from calibray.study import Setup
from calibray.support.progress import Progress
from calibray.tables import Column, Table, numbers
from calibray.uncertainty.noise import Correlation
from calibray.uncertainty.residuals import shared_errors

DRAWS: Final = 96
"""Draws from the posterior that candidates are judged by."""

RIVALS: Final = 24
"""Further values in every separate range of a parameter: few draws lie in some."""

SPOKEN: Final = 0.02
"""Narrowing of an interval, of its width, or probability of a range, that words are worth."""

PLACES: Final = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")


def suggest(
    result: Record,
    candidates: Measurements | pd.DataFrame,
    count: int = 5,
    progress: Progress | None = None,
    *,
    allow_changed_inputs: bool = False,
) -> pd.DataFrame:
    """Where to measure next, by how much narrower the parameters' intervals are expected to be.

    Every candidate is traced and replayed by draws from the posterior: where these agree, a measurement tells nothing;
    where they differ by more than the errors of a link, it tells which of them to drop. Points are chosen one after
    another, each as the best beside those before.

    Args:
        result: The calibration; one on the engine "replay" or "retrace", whose draws were kept.
        candidates: Where one could measure: links, or a table, as for `Record.predict`.
        count: How many to suggest.
        progress: Called with the stage "tracing" after every launch.
        allow_changed_inputs: Go on although a file of the scene or an antenna changed since the calibration.

    Returns:
        One row per suggestion, the best first: the candidate's row, its positions [m] and group; path_loss_db and
        spread_db, mean and standard deviation of what the draws predict [dB]; for every parameter its name with
        `_width`, the width of its 95 % interval to be expected once this point and those above are measured, and, where
        several ranges fit, its name with `_sure`, the probability of knowing which is the right one; and all that in
        words as gain.

    Raises:
        InputError: What `Record.predict` refuses but for groups, the calibration has no draws, or no path leads to any
            candidate.
    """
    if count < 1:
        raise InputError(f"count = {count}: must be at least 1")
    study = result.study
    if study.engine.external:
        raise InputError(
            f"{study.path}: the engine {study.engine.name!r} answers path loss without derivatives, and suggestions "
            "need them; calibrate on the engine 'replay'"
        )
    if not result.uncertainty.draws:
        raise InputError(
            f"{study.path}: the calibration kept no draws of what else explains the links: run it again on the engine "
            "'replay', with more links than unknowns"
        )
    candidates = as_links(result, candidates)
    there = opened(result, candidates, allow_changed_inputs=allow_changed_inputs)
    model = _Model(result, Setup.open(study), progress)
    predicted, slope, errors = model.at(there)
    reached = np.flatnonzero(np.isfinite(predicted).all(axis=0))
    if not len(reached):
        raise InputError(
            f"{candidates.source}: no path leads to any of {len(candidates)} candidates; name other places"
        )
    errors = replace(errors, common=errors.common[reached], position=errors.position[reached])
    beliefs = model.beliefs()
    chosen = choose(beliefs, predicted[:, reached], slope[:, reached], errors, count)
    chosen = [replace(each, index=int(reached[each.index])) for each in chosen]
    draws = len(beliefs.point)
    return _table(result, candidates, predicted[:draws], chosen, certain(beliefs.piece[:draws]))


def shown(found: pd.DataFrame) -> tuple[Table, ...]:
    """Suggestions for people.

    Args:
        found: What `suggest` gave.

    Returns:
        A table of places, and one of what each point is expected to gain with those above it.
    """
    grouped = ["group"] if "group" in found else []
    columns = (
        numbers("rank"),
        numbers("row"),
        *(numbers(name, "m") for name in PLACES),
        *map(Column, grouped),
        numbers("path loss", "dB"),
        numbers("draws differ by", "dB"),
    )
    rows, gains = [], []
    for rank, each in enumerate(found.to_dict("records"), start=1):
        losses = (f"{each['path_loss_db']:.1f}", f"{each['spread_db']:.1f}")
        places = (f"{each[name]:.2f}" for name in PLACES)
        rows.append((str(rank), str(each["row"]), *places, *(str(each[name]) for name in grouped), *losses))
        gains.append((str(rank), each["gain"]))
    expected = Table(
        "Expected of the 95 % intervals once it and those above are measured",
        (numbers("rank"), Column("gain")),
        tuple(gains),
    )
    return Table("Where to measure next", columns, tuple(rows)), expected


class _Model:
    """A calibration's draws, replayed at the links that it was fitted to and at candidates.

    Args:
        result: The calibration.
        setup: Its study, opened.
        progress: Called with the stage "tracing" after every launch.
    """

    def __init__(self, result: Record, setup: Setup, progress: Progress | None) -> None:
        self.result, self.progress = result, progress
        self.engine = self._engine(setup)
        problem = Problem.of(setup, self.engine)
        parameters, objective = problem.parameters, problem.objective
        if problem.freedom < 1:
            raise InputError(
                f"{result.study.path}: {objective.num_counted} links are too few to tell the size of errors"
            )
        self.noise_db = max(result.rmse_db * float(np.sqrt(objective.num_counted / problem.freedom)), 1e-3)
        self.problem = replace(problem, objective=replace(objective, noise_db=self.noise_db))
        self.lower, upper = parameters.search_bounds
        self.width = upper - self.lower
        drawn = np.stack([result.uncertainty.draws[name] for name in parameters.names], axis=1)
        draws = drawn[np.linspace(0, len(drawn) - 1, min(len(drawn), DRAWS)).round().astype(int)]
        self.draws, self.values = len(draws), np.vstack([draws, self._rivals(drawn)])
        self.told = self.problem.evaluate(parameters.to_search(self.values), derivatives=True)

    def beliefs(self) -> Beliefs:
        """What the calibration says so far."""
        told, draws = self.told, slice(self.draws)
        square = told.value**2 * told.num_rows / self.noise_db**2
        unit = (self.problem.parameters.to_search(self.values[draws]) - self.lower) / self.width
        return Beliefs(unit, self._information(told)[draws], self._pieces(self.values), square - square.min())

    def at(self, setup: Setup) -> tuple[NDArray[np.float64], NDArray[np.float64], Errors]:
        """Path loss of candidates by every value [m, c], derivatives in the unit cube by draws [n, c, d], errors."""
        objective, links = self.problem.objective, setup.links
        loss, slope = self._replayed(self._engine(setup))
        if objective.ceiling_db is not None:
            slope[loss >= objective.ceiling_db] = 0.0
            loss = objective.capped(loss)
        design, common = self._nuisance(links)
        coefficients, _ = objective.nuisance.filled(
            objective.coefficients(self.told.modelled), objective.weight > 0
        )
        place, shared = np.hstack([links.rx, links.tx]), self._shared()
        errors = Errors(self.noise_db, common, place)
        if shared is not None:
            errors = Errors(shared.own_db, common, place, shared.shared_db, shared.range_m)
        following = objective.coefficient_slopes(*self._replayed(self.engine))
        return loss + coefficients @ design.T, (slope + design @ following)[: self.draws], errors

    def _engine(self, setup: Setup) -> Differentiable:
        section = setup.study.engine
        compress = section.compress_db if isinstance(section, ReplaySection) else None
        # As they were traced for the calibration, so that the cache knows them.
        materials = None if self.result.fit.retrace_gap_db is None else self.result.materials
        return replay(setup, setup.trace(materials, self.progress), compress)

    def _replayed(self, engine: Differentiable) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of an engine's links by every value, and its derivatives by the unit cube's coordinates."""
        loss, slope = engine.path_loss_and_jacobian(self.values)
        return loss, slope * (self.problem.parameters.search_slope(self.values) * self.width)[:, None, :]

    def _information(self, told: Evaluation) -> NDArray[np.float64]:
        """Information of the links in the unit cube [m, d, d]."""
        slopes = told.slopes * self.width / self.noise_db
        return np.einsum("nmi,nmj->nij", slopes, slopes)

    def _rivals(self, drawn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values around the draws in every separate range, as far from them as curvature leaves open."""
        parameters, piece = self.problem.parameters, self._pieces(drawn)
        around = [
            np.flatnonzero(piece[:, k] == which)
            for k in np.flatnonzero(np.ptp(piece, axis=0))
            for which in np.unique(piece[:, k])
        ]
        if not around:
            return np.empty((0, drawn.shape[1]))
        random = np.random.default_rng(self.result.study.method.seed)
        chosen = np.concatenate([random.choice(each, RIVALS) for each in around])
        points = parameters.to_search(drawn[chosen])
        information = self._information(self.problem.evaluate(points, derivatives=True))
        root = np.linalg.cholesky(np.linalg.inv(information + FLAT * np.eye(drawn.shape[1])))
        moved = np.einsum("nij,nj->ni", root, random.standard_normal(points.shape)) * self.width
        return parameters.from_search(np.clip(points + moved, self.lower, self.lower + self.width))

    def _pieces(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Which of its separate ranges every value of a parameter lies in, or nearest to."""
        found = np.zeros(values.shape, dtype=np.int64)
        for k, name in enumerate(self.problem.parameters.names):
            interval = self.result.intervals.get(name)
            if interval is not None and len(interval.pieces) > 1:
                ends = np.array(interval.pieces)
                apart = np.maximum(ends[:, 0, None] - values[:, k], values[:, k] - ends[:, 1, None])
                found[:, k] = np.argmin(apart, axis=0)
        return found

    def _nuisance(self, links: Measurements) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Columns of the nuisance at candidates [c, q], and what of it is unknown there [c, r], [dB]."""
        objective = self.problem.objective
        nuisance, counted = objective.nuisance, objective.weight > 0
        if not nuisance.terms:
            return np.zeros((len(links), 0)), np.zeros((len(links), 0))
        known = nuisance.design[counted].toarray()
        weight = objective.weight[counted] * counted.sum() / objective.weight.sum()
        vague = np.where(objective.determined, np.inf, UNKNOWN_DB)
        gram = known.T @ (weight[:, None] * known)
        gram += np.diag((self.noise_db / nuisance.prior) ** 2 + (self.noise_db / vague) ** 2)
        root = self.noise_db * np.linalg.cholesky(np.linalg.inv(gram))
        parts = [self._columns(term, links) for term in nuisance.terms]
        design = np.concatenate([column for column, _ in parts], axis=1)
        return design, np.concatenate([design @ root, *(extra for _, extra in parts)], axis=1)

    def _columns(self, term: Term, links: Measurements) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Columns of a term at candidates, and one for each group that was never seen."""
        study = self.result.study
        if term.name == OFFSET:
            labels = links.group if study.offset is not None and study.offset.per is not None else None
        else:
            per = study.nuisance[term.name].per
            labels = None if per is None else links.table.labels(per)
        known = self.result.nuisance.coefficients.get(term.name, {})
        there = term.at(links, labels)
        # A group never seen gets the mean of those that were.
        share = np.where(
            there.group[:, None] < 0, 1.0 / len(term.labels), np.eye(len(term.labels))[there.group]
        )
        strange = np.flatnonzero(there.group < 0)
        names, place = np.unique(np.asarray([] if labels is None else labels)[strange], return_inverse=True)
        found = np.zeros((len(links), len(names)))
        size = np.std(list(known.values()), ddof=1) if len(known) > 1 else UNKNOWN_DB
        found[strange, place] = there.value[strange] * size
        return share * there.value[:, None], found

    def _shared(self) -> Correlation | None:
        """What errors of neighbouring links share, where they show it."""
        problem, objective = self.problem, self.problem.objective
        values = np.array([[self.result.parameters[name] for name in problem.parameters.names]])
        told = problem.evaluate(problem.parameters.to_search(values))
        errors = told.residuals[0, : objective.num_counted]
        links = problem.setup.links
        return shared_errors(errors, np.hstack([links.rx, links.tx])[objective.weight > 0])


def _table(
    result: Record,
    candidates: Measurements,
    predicted: NDArray[np.float64],
    chosen: list[Outlook],
    sure: NDArray[np.float64],
) -> pd.DataFrame:
    """The suggestions as a table."""
    index = np.array([each.index for each in chosen])
    table: dict[str, object] = {"row": candidates.row[index]}
    ends = np.hstack([candidates.tx, candidates.rx])
    table |= {name: ends[index, k] for k, name in enumerate(PLACES)}
    if candidates.group is not None:
        table["group"] = candidates.group[index]
    table["path_loss_db"] = predicted[:, index].mean(axis=0)
    table["spread_db"] = predicted[:, index].std(axis=0)
    words: list[list[str]] = [[] for _ in chosen]
    for k, name in enumerate(result.study.parameters):
        now = _width(result, name, 1.0)
        then = [_width(result, name, float(each.narrowed[k])) for each in chosen]
        table[f"{name}_width"] = then
        for said, width, each in zip(words, then, chosen, strict=True):
            if each.narrowed[k] < 1 - SPOKEN:
                said.append(f"{name} to a width of {width:.3g} (now {now:.3g})")
        if sure[k] < 1:
            table[f"{name}_sure"] = [float(each.sure[k]) for each in chosen]
            for said, each in zip(words, chosen, strict=True):
                if each.sure[k] > sure[k] + SPOKEN:
                    said.append(f"{name}'s right range known with {each.sure[k]:.0%} (now {sure[k]:.0%})")
    nothing = "no interval narrower by more than 2 %"
    table["gain"] = [", ".join(said) or nothing for said in words]
    return pd.DataFrame(table)


def _width(result: Record, name: str, narrowed: float) -> float:
    """Width of a parameter's interval once it is narrowed, on the scale of the search."""
    section, interval = result.study.parameters[name], result.intervals.get(name)
    ends = np.array(section.bounds if interval is None else (interval.lower, interval.upper), dtype=float)
    if section.scale == "log":
        middle, half = np.log(ends).mean(), np.ptp(np.log(ends)) / 2
        return float(np.ptp(np.exp([middle - narrowed * half, middle + narrowed * half])))
    return float(narrowed * np.ptp(ends))
