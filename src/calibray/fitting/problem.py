"""A calibration problem: an opened study, its engine, its objective and its search space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import (
    PATH_LOSS,
    Chunked,
    Differentiable,
    Engine,
    Observable,
    Observing,
    Reduced,
    Responses,
)
from calibray.errors import EngineError, InputError
from calibray.fitting.nuisance import study_nuisance
from calibray.fitting.objective import Objective, Share, make_objective, rows, total
from calibray.fitting.observed import Observed, observed
from calibray.measurements import Measurements
from calibray.measurements.observables import Statistic
from calibray.parameters import NO_PRIOR, LogNormal, Parameters
from calibray.study import Setup
from calibray.study.model import StudyModel


class Evaluation(NamedTuple):
    """A problem evaluated at n points of the search space.

    Attributes:
        value: The objective, including priors [n].
        residuals: Weighted residuals [n, m], followed by one row per prior.
        jacobian: Derivatives [n, m, d] of the residuals with respect to the search coordinates; None if not requested.
        modelled: The engine's values [n, L]; [n, 0] if the engine returned only sums.
        rmse_db: The RMSE of the links only (paper eq. 1) [n].
        represents: Number of full residuals that the m compressed residuals represent; both have the same mean squares
            and products. None if they are not compressed.
        observed: Further observables [n, K, L], in SI units; empty if the engine returned only sums.
    """

    value: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64] | None
    modelled: NDArray[np.float64]
    rmse_db: NDArray[np.float64]
    represents: int | None = None
    observed: NDArray[np.float64] = np.empty((0, 0, 0))

    @property
    def num_rows(self) -> int:
        """Number of full residuals."""
        return self.residuals.shape[1] if self.represents is None else self.represents

    @property
    def curvature(self) -> NDArray[np.float64]:
        """Products J'J [n, d, d] of the derivatives, summed over all full residuals."""
        slopes = self.slopes
        return np.einsum("nmi,nmj->nij", slopes, slopes) * (self.num_rows / slopes.shape[1])

    @property
    def slopes(self) -> NDArray[np.float64]:
        """The Jacobian [n, m, d].

        Raises:
            ValueError: The Jacobian was not requested.
        """
        if self.jacobian is None:
            raise ValueError("the Jacobian was not requested; evaluate with derivatives=True")
        return self.jacobian


@dataclass(frozen=True, eq=False)
class Problem:
    """A calibration problem.

    Attributes:
        setup: The opened study.
        engine: The engine for all links of the study.
        objective: The objective over the calibration links.
        before: The engine's values for the initial parameters [L].
        observable: The quantity that is measured and modelled.
        priors: Priors of the parameters.
        faint: Mask [L] of the links that are left out because they are censored or predicted near the noise floor; None
            if no link is left out.
        observed: Further observables of the links; their residuals follow the residuals of path loss.
    """

    setup: Setup
    engine: Engine
    objective: Objective
    before: NDArray[np.float64]
    observable: Observable = PATH_LOSS
    priors: LogNormal = NO_PRIOR
    faint: NDArray[np.bool_] | None = None
    observed: tuple[Observed, ...] = ()

    @classmethod
    def of(cls, setup: Setup, engine: Engine, observable: Observable = PATH_LOSS) -> Problem:
        """Set up a study's problem. The engine is run once, for the initial parameters.

        Raises:
            InputError: No calibration link is left, or a group has only held-out links.
            EngineError: The engine did not return one value per link.
        """
        setup = setup.with_position_noise()
        study, links, held_out = setup.study, setup.links, setup.held_out
        further = observed(setup, engine) if observable is PATH_LOSS else ()
        if further and isinstance(engine, Observing):
            # A call can be expensive, so a single call returns path loss and all observables.
            statistics = tuple(observable.statistic for observable in further)
            before = engine.respond(engine.parameters.start[None], statistics).path_loss[0]
        else:
            before = observable.modelled(engine, engine.parameters.start[None])[0]
        if before.shape != (len(links),):
            raise EngineError(
                f"the engine {type(engine).__name__} returned path loss for {before.size} links, but must return it "
                f"for all {len(links)} links of the study, including held-out links"
            )
        censored = np.zeros(len(links), dtype=bool) if links.censored is None else links.censored
        objective = make_objective(
            links,
            np.isfinite(before),
            ~(held_out | censored),
            nuisance=study_nuisance(study, links),
            ceiling_db=study.objective.ceiling_db,
            noise_db=1.0,
        )
        noise_db = _noise(study, objective.weight[objective.weight > 0])
        objective = replace(objective, measured=observable.measured(links), noise_db=noise_db)
        _check_groups(links, objective, held_out & ~censored & np.isfinite(objective.capped(before)))
        faint = censored if censored.any() else None
        return cls(setup, engine, objective, before, observable, study.priors, faint, further)

    @property
    def has_priors(self) -> bool:
        """Whether the optimum depends on the noise level, for example because of a prior or a further observable."""
        of_coefficients = np.isfinite(self.objective.nuisance.prior).any()
        return bool(len(self.priors)) or bool(of_coefficients) or bool(self.observed)

    @property
    def statistics(self) -> tuple[Statistic, ...]:
        """Statistics that the engine must compute for the further observables."""
        return tuple(observable.statistic for observable in self.observed)

    @property
    def num_links(self) -> int:
        """Number of links L."""
        return len(self.objective.measured)

    @property
    def parameters(self) -> Parameters:
        """The parameters, which define the search space."""
        return self.engine.parameters

    @property
    def unknowns(self) -> int:
        """Number of unknowns that are fitted to the links: parameters and determined coefficients of the nuisance."""
        return len(self.parameters) + int(self.objective.determined.sum())

    @property
    def freedom(self) -> float:
        """Degrees of freedom: calibration links minus fitted unknowns; if below 1, the noise cannot be estimated."""
        return self.objective.num_counted - len(self.parameters) - self.objective.fitted

    @cached_property
    def differentiable(self) -> bool:
        """Whether the engine provides derivatives of the observable."""
        return isinstance(self.engine, Differentiable) and self.observable.derivatives is not None

    def evaluate(self, points: NDArray[np.float64], derivatives: bool = False) -> Evaluation:
        """Run the engine on points [n, d] of the search space."""
        return self.evaluate_candidates(self.parameters.from_search(points), derivatives)

    def evaluate_candidates(self, candidates: NDArray[np.float64], derivatives: bool = False) -> Evaluation:
        """Like `evaluate`, but for candidates in physical units [n, d], which avoids rounding in the conversion."""
        with_slopes = derivatives and self.differentiable
        answer = self.respond(candidates, with_slopes)
        evaluation = self.judge(candidates, answer)
        if with_slopes and answer.loss_slope is not None:
            # By the chain rule, convert derivatives from physical units to the search coordinates.
            unit = self.parameters.search_slope(candidates)
            further = (
                None if answer.observed_slope is None else answer.observed_slope * unit[:, None, None, :]
            )
            slope = answer.loss_slope * unit[:, None, :]
            return evaluation._replace(jacobian=self.slopes(candidates, answer.path_loss, slope, further))
        return evaluation

    def judge(self, candidates: NDArray[np.float64], answer: Responses) -> Evaluation:
        """Evaluate candidates in physical units [n, d] from the engine's response, without derivatives."""
        residuals = self.residuals(candidates, answer.path_loss, answer.observed)
        rmse_db = np.sqrt(np.mean(residuals[:, : self.objective.num_counted] ** 2, axis=1))
        value = np.sqrt(np.mean(residuals**2, axis=1))
        return Evaluation(value, residuals, None, answer.path_loss, rmse_db, observed=answer.observed)

    def respond(self, candidates: NDArray[np.float64], derivatives: bool = False) -> Responses:
        """The engine's response to candidates in physical units [n, d]: the links' values and further observables.

        If derivatives are requested, the engine must provide derivatives with respect to the parameters.
        """
        if self.observed:
            return self._observing.respond(candidates, self.statistics, derivatives)
        none = np.zeros((len(candidates), 0, self.num_links))
        with_slopes = self.observable.derivatives
        if derivatives and with_slopes is not None and isinstance(self.engine, Differentiable):
            modelled, slope = with_slopes(self.engine, candidates)
            return Responses(modelled, none, slope)
        return Responses(self.observable.modelled(self.engine, candidates), none)

    def squares(self, points: NDArray[np.float64], derivatives: bool = False) -> Evaluation:
        """Like `evaluate`, for methods that use only squares and products of the residuals.

        If the engine divides the links into chunks, each chunk returns sums, and d + 1 compressed residuals represent
        all links. Otherwise, the residuals are not compressed.
        """
        if self._chunks is None:
            return self.evaluate(points, derivatives)
        reduced, shares = self._chunks
        parameters, objective = self.parameters, self.objective
        candidates = parameters.from_search(points)
        sums = total(reduced(candidates, derivatives), shares, len(objective.nuisance.columns))
        products, links = objective.products(sums)
        count, width = objective.num_rows, products.shape[1]
        unit = np.ones((len(points), width))
        if derivatives:
            unit[:, :-1] = parameters.search_slope(candidates)
        products = products * unit[:, :, None] * unit[:, None, :]
        if len(self.priors):
            # The columns are in the order of the sums: derivatives, then the gap, which is minus the residual.
            prior_rows = -objective.noise_db * self.priors.residuals(candidates)[..., None]
            if derivatives:
                slopes = objective.noise_db * self.priors.jacobian(candidates) * unit[:, None, :-1]
                prior_rows = np.concatenate([slopes, prior_rows], axis=2)
            products = products + prior_rows.transpose(0, 2, 1) @ prior_rows
            count += prior_rows.shape[1]
        if self.observed:
            answer = self.respond(candidates, derivatives)
            further = -np.concatenate(self._further(answer.observed), axis=1)[..., None]
            if derivatives and answer.observed_slope is not None:
                slopes = answer.observed_slope * unit[:, None, None, :-1]
                further = np.concatenate(
                    [np.concatenate(self._further_slopes(slopes), axis=1), further], axis=2
                )
            products = products + further.transpose(0, 2, 1) @ further
            count += further.shape[1]
        lost = ~np.isfinite(products[:, -1, -1])
        # The mean square over `width` compressed rows equals the mean square over all `count` rows.
        compressed = rows(np.where(lost[:, None, None], 0.0, products)) * np.sqrt(width / count)
        value = np.sqrt(np.maximum(products[:, -1, -1], 0.0) / count)
        rmse_db = np.sqrt(np.maximum(links, 0.0) / objective.num_counted)
        return Evaluation(
            value=np.where(lost, np.inf, value),
            residuals=-compressed[:, :, -1],
            jacobian=compressed[:, :, :-1] if derivatives else None,
            modelled=np.empty((len(points), 0)),
            rmse_db=np.where(lost, np.inf, rmse_db),
            represents=count,
        )

    def modelled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The engine's values [n, L] for all links at points [n, d] of the search space."""
        return self.respond(self.parameters.from_search(points)).path_loss

    @cached_property
    def _chunks(self) -> tuple[Reduced, list[Share]] | None:
        """The engine that returns sums over chunks, and the objective's share for each chunk; None without chunks."""
        if not isinstance(self.engine, Chunked) or self.observable is not PATH_LOSS:
            return None
        shares = self.objective.shares(self.engine.chunks)
        return self.engine.reducing(shares), shares

    def residuals(
        self,
        candidates: NDArray[np.float64],
        modelled: NDArray[np.float64],
        observed: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Weighted residuals [n, m] of modelled values [n, L], followed by those of priors and further observables.

        Candidates [n, d] are in physical units, and further observables [n, K, L] are in SI units.
        """
        parts = [self.objective.residuals(modelled)]
        if len(self.priors):
            parts.append(self.objective.noise_db * self.priors.residuals(candidates))
        if observed is not None:
            parts += self._further(observed)
        return np.concatenate(parts, axis=1)

    def slopes(
        self,
        candidates: NDArray[np.float64],
        modelled: NDArray[np.float64],
        slope: NDArray[np.float64],
        observed_slope: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Derivatives [n, m, k] of `residuals` with respect to k variables: the d search coordinates, then any others.

        The inputs are the derivatives of the modelled values [n, L, k] and of further observables [n, K, L, k].
        """
        parts = [self.objective.jacobian(modelled, slope)]
        if len(self.priors):
            unit = self.parameters.search_slope(candidates)[:, None, :]
            rows = self.objective.noise_db * self.priors.jacobian(candidates) * unit
            others = np.zeros((*rows.shape[:2], slope.shape[2] - rows.shape[2]))
            parts.append(np.concatenate([rows, others], axis=2))
        if observed_slope is not None:
            parts += self._further_slopes(observed_slope)
        return np.concatenate(parts, axis=1)

    def _further(self, observed: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Residuals [n, m] of each further observable, scaled to the standard deviation of path loss errors."""
        weight, noise_db = self.objective.weight, self.objective.noise_db
        return [
            noise_db / observable.std * observable.residuals(observed[:, index], weight)[0]
            for index, observable in enumerate(self.observed)
        ]

    def _further_slopes(self, slope: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Derivatives [n, m, k] of the residuals in `_further`, from derivatives [n, K, L, k] of the observables."""
        weight, noise_db = self.objective.weight, self.objective.noise_db
        return [
            noise_db / observable.std * observable.slopes(slope[:, index], weight)
            for index, observable in enumerate(self.observed)
        ]

    @property
    def _observing(self) -> Observing:
        """The engine, which computes further observables.

        Raises:
            InputError: The engine computes only path loss.
        """
        if not isinstance(self.engine, Observing):
            raise InputError(
                f"{self.setup.study.path}: [observables]: the engine {self.setup.study.engine.name!r} computes only "
                f"path loss; use 'replay' or 'command'"
            )
        return self.engine


def _noise(study: StudyModel, weight: NDArray[np.float64]) -> float:
    """Declared standard deviation [dB] of a link's error at the mean weight; 1 until it is estimated.

    The weights are those of the calibration links [m].
    """
    if study.links.position_error_m is None:
        if study.noise.std_db is not None:
            return study.noise.std_db
        if study.links.std is None:
            return 1.0
    # Weights are inverse variances [1/dB^2] if the errors of individual links are known.
    return float(1.0 / np.sqrt(weight.mean()))


def _check_groups(links: Measurements, objective: Objective, judged: NDArray[np.bool_]) -> None:
    """Reject held-out links that depend on nuisance coefficients that no calibration link determines."""
    unknown = np.flatnonzero(judged & ~objective.supported)
    if len(unknown):
        needed = objective.nuisance.design[unknown[:1]].toarray()[0] != 0
        name = objective.nuisance.columns[int(np.argmax(needed & ~objective.determined))]
        raise InputError(
            f"{links.source}: held-out links need {name}, which no calibration link determines; change [holdout], "
            "[offset] or [nuisance]"
        )
