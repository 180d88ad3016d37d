"""Posterior density of the parameters under all noise models, for a problem's measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.nuisance import CONSTANT
from calibray.fitting.problem import Problem
from calibray.uncertainty.noise_models import DIFFERING, BuildingEffect, Marginal, corners, noise_models

BATCH: Final = 256
"""Points evaluated at once."""

FEWEST: Final = 8
"""Links below which only independent Gaussian noise is tried; fewer cannot distinguish other noise models."""

FAR: Final = 30.0
"""Heterogeneous models are skipped at points whose log density under the other models is below the best by this, plus
the largest gain by heterogeneous models; e^-30 is negligible in any average."""


@dataclass(frozen=True, eq=False)
class PosteriorDensity:
    """The posterior density at points of the search space, under several noise models.

    Attributes:
        problem: The problem.
        marginal: The density of the measurements given path loss.
        fixed: Contribution to path loss of coefficients at their bounds [m], [dB].
        scale: Square roots of the weights of the m links used, with mean square one [m].
        counted: Indices of these links [m].
        least: Log density under the other models below which heterogeneous models are skipped.
    """

    problem: Problem
    marginal: Marginal
    fixed: NDArray[np.float64]
    scale: NDArray[np.float64]
    counted: NDArray[np.int64]
    least: float = -np.inf

    @classmethod
    def of(cls, problem: Problem, best: NDArray[np.float64], square: float, freedom: int) -> PosteriorDensity:
        """Set up the noise models that a study allows.

        Args:
            problem: The problem.
            best: The optimum, a point of the search space [d].
            square: Mean square of the residuals at the optimum [dB^2].
            freedom: Number of links minus unknowns.
        """
        objective, links, section = problem.objective, problem.setup.links, problem.setup.study.noise
        weight, censored = _weights_and_censoring(problem)
        counted = np.flatnonzero(weight > 0)
        weight, censored = weight[counted], censored[counted]
        scale = np.sqrt(weight * len(weight) / weight.sum())
        noise_db = float(np.sqrt(square * (freedom + len(problem.parameters)) / freedom))
        nuisance, position = objective.nuisance, np.hstack([links.rx, links.tx])[counted]
        coefficients = objective.coefficients(problem.modelled(best[None]))[0]
        at_bound = (coefficients <= nuisance.lower) | (coefficients >= nuisance.upper)
        design = nuisance.design[counted].toarray() if nuisance.terms else np.zeros((len(counted), 0))
        used = objective.determined & ~at_bound
        models = noise_models(
            position,
            kind=None if section.kind == "auto" else section.kind,
            # With correlated errors, the probability of censoring is an integral over all censored links.
            range_m=0.0 if censored.any() else None if section.range_m == "auto" else float(section.range_m),
            spread=None if section.heterogeneity == "auto" else float(section.heterogeneity),
            offset=not has_offset(problem),
            censored=bool(censored.any()),
        )
        if len(counted) < FEWEST:
            models = noise_models(
                position, kind="gaussian", range_m=0.0, spread=0.0, offset=not has_offset(problem)
            )
        ridge = objective.noise_db / nuisance.prior[used] if nuisance.terms else np.zeros(0)
        marginal = Marginal.of(design[:, used], ridge, scale, position, noise_db, models, censored)
        return cls(problem, marginal, design[:, at_bound] @ coefficients[at_bound], scale, counted)

    def without_negligible(self, log_densities: NDArray[np.float64]) -> PosteriorDensity:
        """Drop noise models that are negligible at all points of the given log densities [k, models]."""
        marginal = self.marginal.reduced(log_densities)
        differing, least = _differing_models(self.marginal), -np.inf
        if differing.any() and not _differing_models(marginal).all():
            best = float(np.logaddexp.reduce(log_densities[:, ~differing], axis=1).max())
            least = best - FAR - max(0.0, float(log_densities[:, differing].max()) - best)
        return replace(self, marginal=marginal, least=least)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log posterior under every noise model, up to one constant.

        Args:
            points: Points of the search space [n, d].

        Returns:
            The log densities [n, models].
        """
        parts = [self._batch(points[first : first + BATCH]) for first in range(0, len(points), BATCH)]
        return np.concatenate(parts) if parts else np.zeros((0, len(self.marginal.models)))

    def modelled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of the m links used at points of the search space [n, d]: [n, m], [dB]."""
        return self._loss(self.problem.parameters.from_search(points))

    def gaps(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measured minus modelled path loss [n, m], [dB], times the roots of the weights, for path loss [n, L]."""
        return self._gaps(self.problem.objective.capped(loss)[:, self.counted])

    @property
    def replays(self) -> int:
        """Number of replays per point."""
        return 1 + (len(corners(len(self.problem.parameters))) if self.marginal.spread else 0)

    def noise_weights(self, share: NDArray[np.float64]) -> dict[str, float]:
        """Posterior weight of each kind of noise, and of an undeclared offset.

        Args:
            share: Weights of the models at draws of equal weight [n, models].

        Returns:
            Weights by kind, with sum one, and the weight of "offset" if the study declares none.
        """
        weights: dict[str, float] = {}
        for model, weight in zip(self.marginal.models, share.mean(axis=0).tolist(), strict=True):
            weights[model.kind] = weights.get(model.kind, 0.0) + weight
            if not has_offset(self.problem):
                weights["offset"] = weights.get("offset", 0.0) + weight * model.offset
        return weights

    def _batch(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        candidates = self.problem.parameters.from_search(points)
        loss = self._loss(candidates)
        gap = self._gaps(loss)
        log_density = np.full((len(points), len(self.marginal.models)), -np.inf)
        differing = _differing_models(self.marginal)
        log_density[:, ~differing] = _only(self.marginal, ~differing).densities(gap)
        near = np.logaddexp.reduce(log_density, axis=1) >= self.least
        if differing.any() and near.any():
            effect = self._building_effect(candidates[near], loss[near])
            log_density[np.ix_(near, differing)] = _only(self.marginal, differing).densities(
                gap[near], effect
            )
        if len(self.problem.priors):
            log_density -= 0.5 * np.sum(self.problem.priors.residuals(candidates) ** 2, axis=1)[:, None]
        return log_density

    def _building_effect(self, candidates: NDArray[np.float64], loss: NDArray[np.float64]) -> BuildingEffect:
        """Effect of differing buildings on path loss, from the corners of a factorial design."""
        parameters, spread = self.problem.parameters, self.marginal.spread
        at_corners = np.stack([
            self._loss(np.clip(candidates * np.exp(spread * corner), parameters.lower, parameters.upper))
            for corner in corners(len(parameters))
        ])  # fmt: skip
        shift = at_corners.mean(axis=0)
        with np.errstate(invalid="ignore"):  # inf - inf for a censored link without a path
            return BuildingEffect((shift - loss) * self.scale, at_corners.var(axis=0) * self.scale**2)

    def _gaps(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        return (self.problem.objective.measured[self.counted] - self.fixed - loss) * self.scale

    def _loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of the m links used [n, m], [dB]."""
        modelled = self.problem.observable.modelled(self.problem.engine, candidates)
        return self.problem.objective.capped(modelled)[:, self.counted]


def _differing_models(marginal: Marginal) -> NDArray[np.bool_]:
    """Mask of the models with differing buildings [models]."""
    return np.array([model.kind == DIFFERING for model in marginal.models], dtype=bool)


def _only(marginal: Marginal, mask: NDArray[np.bool_]) -> Marginal:
    """The density under the models of a mask [models]."""
    return replace(marginal, models=tuple(marginal.models[k] for k in np.flatnonzero(mask)))


def _weights_and_censoring(problem: Problem) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Weights of the links in the likelihood [L], and mask of the censored ones [L].

    With censored links in the likelihood, links measured near the noise floor are used as well: both together are no
    selection by measured values.
    """
    objective, links = problem.objective, problem.setup.links
    if links.censored is None or problem.faint is None:
        return objective.weight, np.zeros(len(links), dtype=bool)
    # A censored link without a path agrees with the model whatever the parameters.
    informative = problem.faint & ~problem.setup.held_out & np.isfinite(problem.before)
    return np.where(informative, links.weight, objective.weight), links.censored


def has_offset(problem: Problem) -> bool:
    """Whether the study declares an offset, or a constant term without a prior."""
    constant = any(
        term.by == CONSTANT and not np.isfinite(term.prior) for term in problem.objective.nuisance.terms
    )
    return problem.setup.study.offset is not None or constant
