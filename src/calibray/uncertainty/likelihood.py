"""How well values of the parameters explain a problem's measurements, under every model of the noise that is tried."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.nuisance import CONSTANT
from calibray.fitting.problem import Problem
from calibray.uncertainty.noise_models import DIFFERING, Differing, Marginal, corners, noise_models

CHUNK: Final = 256
"""Points evaluated at once."""

FEWEST: Final = 8
"""Links below which noise is taken as independent and Gaussian, for they cannot tell another."""

FAR: Final = 30.0
"""Points that the other models explain worse than the best point by this, in the logarithm of the density, and by what
heterogeneous ones explain better there, are not asked what buildings that differ would change."""


@dataclass(frozen=True, eq=False)
class Explaining:
    """The density of the measurements at points of the search space.

    Attributes:
        problem: The problem.
        marginal: The density given path loss.
        fixed: What coefficients at their bounds add to path loss [m], [dB].
        scale: Roots of the weights of the links that count, their mean square one [m].
        counted: Places of these links [m].
        least: Density under the other models below which heterogeneous ones are not looked at, in its logarithm.
    """

    problem: Problem
    marginal: Marginal
    fixed: NDArray[np.float64]
    scale: NDArray[np.float64]
    counted: NDArray[np.int64]
    least: float = -np.inf

    @classmethod
    def of(cls, problem: Problem, best: NDArray[np.float64], square: float, freedom: int) -> Explaining:
        """Set up the models of noise that a study leaves open.

        Args:
            problem: The problem.
            best: The optimum, a point of the search space [d].
            square: Mean square of the residuals there [dB^2].
            freedom: Number of links less that of unknowns.
        """
        objective, links, section = problem.objective, problem.setup.links, problem.setup.study.noise
        weight, unheard = _taking_part(problem)
        counted = np.flatnonzero(weight > 0)
        weight, unheard = weight[counted], unheard[counted]
        scale = np.sqrt(weight * len(weight) / weight.sum())
        noise_db = float(np.sqrt(square * (freedom + len(problem.parameters)) / freedom))
        nuisance, position = objective.nuisance, np.hstack([links.rx, links.tx])[counted]
        coefficients = objective.coefficients(problem.modelled(best[None]))[0]
        held = (coefficients <= nuisance.lower) | (coefficients >= nuisance.upper)
        design = nuisance.design[counted].toarray() if nuisance.terms else np.zeros((len(counted), 0))
        used = objective.determined & ~held
        models = noise_models(
            position,
            kind=None if section.kind == "auto" else section.kind,
            # Errors that neighbours share make the probability of not being heard an integral over all of them.
            range_m=0.0 if unheard.any() else None if section.range_m == "auto" else float(section.range_m),
            spread=None if section.heterogeneity == "auto" else float(section.heterogeneity),
            offset=not has_offset(problem),
            unheard=bool(unheard.any()),
        )
        if len(counted) < FEWEST:
            models = noise_models(
                position, kind="gaussian", range_m=0.0, spread=0.0, offset=not has_offset(problem)
            )
        ridge = objective.noise_db / nuisance.prior[used] if nuisance.terms else np.zeros(0)
        marginal = Marginal.of(design[:, used], ridge, scale, position, noise_db, models, unheard)
        return cls(problem, marginal, design[:, held] @ coefficients[held], scale, counted)

    def without_negligible(self, explained: NDArray[np.float64]) -> Explaining:
        """The same without models that explain little at any of some points, as this told of them [k, models]."""
        marginal = self.marginal.reduced(explained)
        apart, least = _differing_models(self.marginal), -np.inf
        if apart.any() and not _differing_models(marginal).all():
            best = float(np.logaddexp.reduce(explained[:, ~apart], axis=1).max())
            least = best - FAR - max(0.0, float(explained[:, apart].max()) - best)
        return replace(self, marginal=marginal, least=least)

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm of the posterior under every model, but for one constant [n, models].

        Args:
            points: Points of the search space [n, d].
        """
        parts = [self._part(points[first : first + CHUNK]) for first in range(0, len(points), CHUNK)]
        return np.concatenate(parts) if parts else np.zeros((0, len(self.marginal.models)))

    def modelled(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of the links that count at points of the search space [n, m], [dB]."""
        return self._loss(self.problem.parameters.from_search(points))

    def gaps(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """What path loss [n, L] leaves unexplained of the links that count, times the roots of weights [n, m], [dB]."""
        return self._gaps(self.problem.objective.capped(loss)[:, self.counted])

    @property
    def replays(self) -> int:
        """Replays that one point takes."""
        return 1 + (len(corners(len(self.problem.parameters))) if self.marginal.spread else 0)

    def kinds(self, share: NDArray[np.float64]) -> dict[str, float]:
        """What speaks for each kind of noise, and for a forgotten offset.

        Args:
            share: Weights of the models at draws of equal weight [n, models].

        Returns:
            Weights by kind, adding up to one, and that of "offset" where one may have been forgotten.
        """
        found: dict[str, float] = {}
        for model, weight in zip(self.marginal.models, share.mean(axis=0).tolist(), strict=True):
            found[model.kind] = found.get(model.kind, 0.0) + weight
            if not has_offset(self.problem):
                found["offset"] = found.get("offset", 0.0) + weight * model.offset
        return found

    def _part(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        candidates = self.problem.parameters.from_search(points)
        loss = self._loss(candidates)
        gap = self._gaps(loss)
        found = np.full((len(points), len(self.marginal.models)), -np.inf)
        apart = _differing_models(self.marginal)
        found[:, ~apart] = _only(self.marginal, ~apart).densities(gap)
        near = np.logaddexp.reduce(found, axis=1) >= self.least
        if apart.any() and near.any():
            changed = self._differing(candidates[near], loss[near])
            found[np.ix_(near, apart)] = _only(self.marginal, apart).densities(gap[near], changed)
        if len(self.problem.priors):
            found -= 0.5 * np.sum(self.problem.priors.residuals(candidates) ** 2, axis=1)[:, None]
        return found

    def _differing(self, candidates: NDArray[np.float64], loss: NDArray[np.float64]) -> Differing:
        """What materials that differ from building to building do to path loss."""
        parameters, spread = self.problem.parameters, self.marginal.spread
        there = np.stack([
            self._loss(np.clip(candidates * np.exp(spread * corner), parameters.lower, parameters.upper))
            for corner in corners(len(parameters))
        ])  # fmt: skip
        with np.errstate(invalid="ignore"):  # Where no path leads to a link that was not heard either.
            return Differing((there.mean(axis=0) - loss) * self.scale, there.var(axis=0) * self.scale**2)

    def _gaps(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        return (self.problem.objective.measured[self.counted] - self.fixed - loss) * self.scale

    def _loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of the links that count [n, m], [dB]."""
        modelled = self.problem.observable.modelled(self.problem.engine, candidates)
        return self.problem.objective.capped(modelled)[:, self.counted]


def _differing_models(marginal: Marginal) -> NDArray[np.bool_]:
    """Which models ask what buildings that differ do to path loss [models]."""
    return np.array([model.kind == DIFFERING for model in marginal.models], dtype=bool)


def _only(marginal: Marginal, wanted: NDArray[np.bool_]) -> Marginal:
    """The density under some of its models [models]."""
    chosen = (model for model, want in zip(marginal.models, wanted.tolist(), strict=True) if want)
    return replace(marginal, models=tuple(chosen))


def _taking_part(problem: Problem) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Weights of the links that tell something of the parameters [L], and which of them were not heard [L].

    Where those that were not heard count, so do those that were though the model hardly expected it: together they
    are no selection by luck.
    """
    objective, links = problem.objective, problem.setup.links
    if links.censored is None or problem.faint is None:
        return objective.weight, np.zeros(len(links), dtype=bool)
    # Where the model hears nothing either, it agrees, and there is nothing to learn.
    there = problem.faint & ~problem.setup.held_out & np.isfinite(problem.before)
    return np.where(there, links.weight, objective.weight), links.censored


def has_offset(problem: Problem) -> bool:
    """Whether the study's model has an offset for all links, or the like."""
    constant = any(
        term.by == CONSTANT and not np.isfinite(term.prior) for term in problem.objective.nuisance.terms
    )
    return problem.setup.study.offset is not None or constant
