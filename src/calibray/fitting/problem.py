"""A study ready to be solved: what is minimized, over which search space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.engines.observable import PATH_LOSS, Observable
from calibray.engines.protocol import Chunked, Differentiable, Engine, Reduced
from calibray.errors import InputError
from calibray.fitting.nuisance import OFFSET, Nuisance, make_term
from calibray.fitting.objective import Objective, make_objective
from calibray.fitting.sums_of_squares import Share, rows, total
from calibray.measurements import Measurements
from calibray.parameters import NO_PRIOR, LogNormal, Parameters
from calibray.study import Setup, Study


class Evaluation(NamedTuple):
    """What a problem answers to points of the search space.

    Attributes:
        value: What is minimized [n].
        residuals: Weighted residuals, and a row for every prior [n, m].
        jacobian: Their derivatives by the search coordinates [n, m, d], where asked for.
        modelled: What the engine answered [n, L]; [n, 0] where it gave sums alone.
        rmse_db: The RMSE of the links alone (paper eq. 1) [n].
        stands_for: Number of residuals that those given stand for, with the same mean squares and products; None
            where they are all.
    """

    value: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64] | None
    modelled: NDArray[np.float64]
    rmse_db: NDArray[np.float64]
    stands_for: int | None = None

    @property
    def num_rows(self) -> int:
        """Number of residuals, or of those that the ones given stand for."""
        return self.residuals.shape[1] if self.stands_for is None else self.stands_for

    @property
    def curvature(self) -> NDArray[np.float64]:
        """Products of the derivatives, summed over all residuals [n, d, d]."""
        slopes = self.slopes
        return np.einsum("nmi,nmj->nij", slopes, slopes) * (self.num_rows / slopes.shape[1])

    @property
    def slopes(self) -> NDArray[np.float64]:
        """The Jacobian, where it was asked for.

        Raises:
            ValueError: It was not.
        """
        if self.jacobian is None:
            raise ValueError("the Jacobian was not asked for")
        return self.jacobian


@dataclass(frozen=True, eq=False)
class Problem:
    """A study ready to be solved.

    Attributes:
        setup: The opened study.
        engine: The engine over all its links.
        objective: What is minimized.
        before: What the engine answers to the values before calibration [L].
        observable: What is measured and modelled.
        priors: What is known of the parameters beforehand.
        faint: Links left out because they were not heard, or because the model expects them near the noise floor [L];
            None where none is.
    """

    setup: Setup
    engine: Engine
    objective: Objective
    before: NDArray[np.float64]
    observable: Observable = PATH_LOSS
    priors: LogNormal = NO_PRIOR
    faint: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, setup: Setup, engine: Engine, observable: Observable = PATH_LOSS) -> Problem:
        """Set up a study's problem; runs the engine once, on the values before calibration.

        Args:
            setup: The opened study.
            engine: The engine over all its links.
            observable: What is measured and modelled.

        Returns:
            The problem.

        Raises:
            InputError: No link is left to calibrate on, or none of a group of which links are held out.
        """
        study, links, held_out = setup.study, setup.links, setup.held_out
        before = observable.modelled(engine, engine.parameters.start[None])[0]
        unheard = np.zeros(len(links), dtype=bool) if links.censored is None else links.censored
        objective = make_objective(
            links,
            np.isfinite(before),
            ~(held_out | unheard),
            nuisance=study_nuisance(study, links),
            ceiling_db=study.objective.ceiling_db,
            noise_db=_noise(study, links),
        )
        objective = replace(objective, measured=observable.measured(links))
        _check_groups(links, objective, held_out & ~unheard & np.isfinite(before))
        priors = study.priors
        return cls(setup, engine, objective, before, observable, priors, unheard if unheard.any() else None)

    @property
    def weighs_priors(self) -> bool:
        """Whether the size of the noise matters to the optimum, as it does where anything has a prior."""
        return bool(len(self.priors)) or bool(np.isfinite(self.objective.nuisance.prior).any())

    @property
    def parameters(self) -> Parameters:
        """What a candidate's components stand for; they own the search space."""
        return self.engine.parameters

    @property
    def unknowns(self) -> int:
        """Number of values that the links have to determine: parameters, and coefficients of the nuisance."""
        return len(self.parameters) + int(self.objective.determined.sum())

    @property
    def freedom(self) -> int:
        """Degrees of freedom: links calibrated on, less the unknowns; below 1 they tell nothing of the errors' size."""
        return self.objective.num_counted - self.unknowns

    @property
    def differentiable(self) -> bool:
        """Whether derivatives can be had."""
        return isinstance(self.engine, Differentiable) and self.observable.derivatives is not None

    def evaluate(self, points: NDArray[np.float64], derivatives: bool = False) -> Evaluation:
        """Run the engine on points of the search space.

        Args:
            points: The points [n, d].
            derivatives: Whether the Jacobian is wanted.

        Returns:
            What an optimizer is told, and what the engine answered.
        """
        parameters, objective, jacobian = self.parameters, self.objective, None
        candidates = parameters.from_search(points)
        with_slopes = self.observable.derivatives
        if derivatives and with_slopes is not None and isinstance(self.engine, Differentiable):
            modelled, slope = with_slopes(self.engine, candidates)
            slope = slope * parameters.search_slope(candidates)[:, None, :]
            jacobian = self.slopes(candidates, modelled, slope)
        else:
            modelled = self.observable.modelled(self.engine, candidates)
        residuals = self.residuals(candidates, modelled)
        rmse_db = np.sqrt(np.mean(residuals[:, : objective.num_counted] ** 2, axis=1))
        value = np.sqrt(np.mean(residuals**2, axis=1))
        return Evaluation(value, residuals, jacobian, modelled, rmse_db)

    def squares(self, points: NDArray[np.float64], derivatives: bool = False) -> Evaluation:
        """The same for who asks nothing of residuals but their squares and products.

        Where links are parted into blocks, sums come from these, and as many residuals as there are parameters, and one
        more, stand for those of all links.

        Args:
            points: The points [n, d].
            derivatives: Whether the Jacobian is wanted.

        Returns:
            What an optimizer is told, if it is told no link's own residual.
        """
        if self._blocks is None:
            return self.evaluate(points, derivatives)
        reduced, shares = self._blocks
        parameters, objective = self.parameters, self.objective
        candidates = parameters.from_search(points)
        found = total(reduced(candidates, derivatives), shares, len(objective.nuisance.columns))
        products, links = objective.products(found)
        count, width = objective.num_rows, products.shape[1]
        unit = np.ones((len(points), width))
        if derivatives:
            unit[:, :-1] = parameters.search_slope(candidates)
        products = products * unit[:, :, None] * unit[:, None, :]
        if len(self.priors):
            known = -objective.noise_db * self.priors.residuals(candidates)[..., None]
            if derivatives:
                slopes = objective.noise_db * self.priors.jacobian(candidates) * unit[:, None, :-1]
                known = np.concatenate([slopes, known], axis=2)
            products = products + known.transpose(0, 2, 1) @ known
            count += known.shape[1]
        lost = ~np.isfinite(products[:, -1, -1])
        made = rows(np.where(lost[:, None, None], 0.0, products)) * np.sqrt(width / count)
        value, rmse_db = (
            np.where(lost, np.inf, np.sqrt(np.maximum(square, 0.0) / number))
            for square, number in ((products[:, -1, -1], count), (links, objective.num_counted))
        )
        jacobian = made[:, :, :-1] if derivatives else None
        return Evaluation(value, -made[:, :, -1], jacobian, np.empty((len(points), 0)), rmse_db, count)

    def modelled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the engine answers to points of the search space [n, d]: that of every link [n, L]."""
        return self.observable.modelled(self.engine, self.parameters.from_search(points))

    @cached_property
    def _blocks(self) -> tuple[Reduced, list[Share]] | None:
        """What reduces path loss to sums where it arises, where links are parted into blocks."""
        if not isinstance(self.engine, Chunked) or self.observable is not PATH_LOSS:
            return None
        shares = self.objective.shares(self.engine.chunks)
        return self.engine.reducing(shares), shares

    def residuals(
        self, candidates: NDArray[np.float64], modelled: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Weighted residuals of what is modelled, and a row for every prior.

        Args:
            candidates: Parameter values [n, d], in the fields' units.
            modelled: What is modelled for them [n, L].

        Returns:
            The rows [n, m].
        """
        residuals = self.objective.residuals(modelled)
        if not len(self.priors):
            return residuals
        rows = self.objective.noise_db * self.priors.residuals(candidates)
        return np.concatenate([residuals, rows], axis=1)

    def slopes(
        self,
        candidates: NDArray[np.float64],
        modelled: NDArray[np.float64],
        slope: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Derivatives of `residuals`.

        Args:
            candidates: Parameter values [n, d], in the fields' units.
            modelled: What is modelled for them [n, L].
            slope: Its derivatives by the search coordinates [n, L, k], and after these d by any others.

        Returns:
            Derivatives of the rows by the same [n, m, k].
        """
        jacobian = self.objective.jacobian(modelled, slope)
        if not len(self.priors):
            return jacobian
        unit = self.parameters.search_slope(candidates)
        rows = self.objective.noise_db * self.priors.jacobian(candidates) * unit[:, None, :]
        others = np.zeros((*rows.shape[:2], slope.shape[2] - rows.shape[2]))
        return np.concatenate([jacobian, np.concatenate([rows, others], axis=2)], axis=1)


def study_nuisance(study: Study, links: Measurements) -> Nuisance:
    """What a study lets shift the path loss: its offset, for all links or each group, and its further terms.

    Args:
        study: The study.
        links: All its links.

    Returns:
        The nuisance.

    Raises:
        InputError: A term's column or groups cannot be used.
    """
    terms = []
    if (offset := study.offset) is not None:
        terms.append(
            make_term(links, OFFSET, labels=links.group, bounds=offset.bounds, prior=offset.prior_db)
        )
    for name, term in study.nuisance.items():
        labels = None if term.per is None else links.table.labels(term.per)
        terms.append(make_term(links, name, term.by, labels=labels, bounds=term.bounds, prior=term.prior))
    return Nuisance(len(links), tuple(terms))


def _noise(study: Study, links: Measurements) -> float:
    """Standard deviation of a link's error at the mean weight [dB]: as stated, else 1 until it is estimated."""
    if study.noise.std_db is not None:
        return study.noise.std_db
    return 1.0 if study.links.std is None else float(1.0 / np.sqrt(links.weight.mean()))


def _check_groups(links: Measurements, objective: Objective, judged: NDArray[np.bool_]) -> None:
    """Refuse links held out whose offset no link to calibrate on could tell."""
    unknown = links.group_index[judged & ~objective.supported]
    if len(unknown):
        raise InputError(
            f"{links.source}: group {links.group_names[unknown.min()]!r} is held out but has no link to "
            "calibrate its offset on; change [holdout] or [offset]"
        )
