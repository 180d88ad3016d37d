"""Means over all buildings by indirect inference, for scenes too large to sample every building.

Links dominated by one building share its deviation from the material's mean. An estimate from m links on b buildings is
then as uncertain as one from b links, not from m. The residuals hardly show this, because the estimate follows the
shared deviation. The estimate can also be biased: reflections inside thick walls make path loss oscillate with the
constants, buildings that differ smear the oscillation, and the walls then look lossier than they are.

We use indirect inference (C. Gourieroux, A. Monfort and E. Renault, J. Applied Econometrics 8, 1993): which mean over
all buildings would have given an estimate? Let g(t) be the path loss with equal buildings, and f(x, z) that of
buildings with the constants x exp(spread z), each z standard normal. Least squares with the model g, nuisance columns Z
and data f(x, z) ends in the estimate t with

    J'(g(t) - f(x, z)) + P (t - x) = 0,

where J are the derivatives of g at t together with Z, and P is the precision of a prior that keeps undetermined
parameters within their range. For each draw t of the posterior, with buildings drawn for it, we solve this for x. We
follow the solution from x = t while the deviations z grow from zero: a steep oscillation gives many solutions, and
only the continued one belongs to these buildings. If path loss is linear in the constants, x scatters about t with the
cluster-robust covariance (K.-Y. Liang and S. L. Zeger, Biometrika 73, 1986); we use this linear solution if the
continuation fails.

Oscillations also give many modes, and the deviations of single buildings can favour another mode than the mean would. A
density with equal buildings is too certain about the mode. Let e be the difference in path loss between two modes and r
the change of path loss by the buildings, both in units of the noise and without the part that estimates follow. Along
e, scaled to unit length, the variance is 1 from the noise and (e'r)^2 from the buildings. We divide the log density by
1 + (e'r)^2 before we draw estimates, as for composite likelihoods (F. Pauli, W. Racugno and L. Ventura, Statistica
Sinica 21, 2011).

Differing buildings do not exclude correlated or heavy-tailed errors, so draws of every noise model get a spread. Its
odds follow from the two noise models that differ in nothing else, as far as these explain the data; otherwise the prior
odds apply: that of every departure, and inversely proportional to the spread.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.uncertainty.buildings import BuildingReplay
from calibray.uncertainty.importance_sampling import Draws
from calibray.uncertainty.likelihood import PosteriorDensity
from calibray.uncertainty.linear_theory import WIDE_PRECISION
from calibray.uncertainty.noise_models import DEPARTURE, DIFFERING, GAUSSIAN, NoiseModel

PORTIONS: Final = 8
"""Steps in which the deviations of the buildings grow; each takes one predictor and one corrector."""

LONGEST_STEP: Final = 0.2
"""Longest corrector step, in the unit cube."""

TOLERANCE: Final = 0.02
"""Largest remaining step of a solution that is followed further, in the unit cube."""

DRAWS: Final = (64, 256)
"""Fewest and most draws of the means."""

EVALUATED_INTERACTIONS: Final = 6_000_000
"""Interactions evaluated for these draws; fewer are drawn on larger path programs."""

MODE_DRAWS: Final = 24
"""Draws at which the overconfidence about modes is computed, for each spread."""

OTHER_DRAWS: Final = 64
"""Draws that represent the other modes."""

SLOPE_DRAWS: Final = 48
"""Largest number of draws at which derivatives by each building's constants are computed."""

SLOPE_ENTRIES: Final = 5_000_000
"""Derivatives computed in total; scenes with many buildings or links use fewer draws."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The model with equal buildings, linearised at n estimates. Rows are in units of the noise.

    Attributes:
        estimate: The estimates, in the unit cube [n, d].
        slope: Derivatives of path loss at the estimates [n, m, d].
        design: Columns of the nuisance [m, q].
        precision: Inverse variances of the priors of parameters and nuisance coefficients [n, d + q].
    """

    estimate: NDArray[np.float64]
    slope: NDArray[np.float64]
    design: NDArray[np.float64]
    precision: NDArray[np.float64]

    @cached_property
    def _columns(self) -> NDArray[np.float64]:
        design = np.broadcast_to(self.design, (*self.slope.shape[:2], self.design.shape[1]))
        return np.concatenate([self.slope, design], axis=2)

    @cached_property
    def _normal(self) -> NDArray[np.float64]:
        square = self._columns.transpose(0, 2, 1) @ self._columns
        return square + self.precision[:, None, :] * np.eye(square.shape[1])

    def step(self, gap: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
        """Least-squares step of the parameters from the estimates.

        Args:
            gap: Modelled minus measured path loss [n, m].
            centre: Centre of the priors of the parameters, in the unit cube [n, d].

        Returns:
            The step, in the unit cube [n, d].
        """
        width = self.estimate.shape[1]
        side = np.einsum("nmi,nm->ni", self._columns, gap)
        side[:, :width] += self.precision[:, :width] * (self.estimate - centre)
        return np.linalg.solve(self._normal, side[..., None])[:, :width, 0]

    def unexplained(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """The part of changes in path loss that parameters and nuisance cannot follow.

        Args:
            change: Changes of path loss at every estimate [n, k, m].

        Returns:
            Their residuals [n, k, m].
        """
        followed = np.linalg.solve(self._normal, self._columns.transpose(0, 2, 1) @ change.transpose(0, 2, 1))
        return change - (self._columns @ followed).transpose(0, 2, 1)


def overconfidence(
    linear: LinearModel, by_buildings: NDArray[np.float64], to_others: NDArray[np.float64]
) -> float:
    """Factor by which a density with equal buildings is too certain about the mode.

    Args:
        linear: The linearised model at some draws.
        by_buildings: Change of path loss there by differing buildings [n, m], in units of the noise.
        to_others: Difference in path loss from there to other draws [n, k, m], in units of the noise.

    Returns:
        Variance of noise and buildings over that of the noise, along the difference to other modes; the median over the
        draws. 1 if all draws belong to one mode.

    Example:
        >>> linear = LinearModel(np.array([[0.5]]), np.ones((1, 4, 1)), np.zeros((4, 0)), np.zeros((1, 1)))
        >>> other = np.array([[[2.0, 2.0, -2.0, -2.0]]])
        >>> overconfidence(linear, np.array([[1.0, 1.0, -1.0, -1.0]]), other)  # buildings imitate the other mode
        5.0
        >>> overconfidence(linear, np.array([[1.0, 1.0, 1.0, 1.0]]), other)  # the estimate follows the buildings
        1.0
    """
    difference, remaining = linear.unexplained(to_others), linear.unexplained(by_buildings[:, None, :])[:, 0]
    square = np.sum(difference**2, axis=2)
    other_mode = square > 1.0
    along = np.einsum("nkm,nm->nk", difference, remaining) ** 2 / np.where(other_mode, square, 1.0)
    mean = np.sum(along * other_mode, axis=1) / np.maximum(other_mode.sum(axis=1), 1)
    return 1.0 + float(np.median(mean))


def estimate_response(
    slope: NDArray[np.float64],
    parameter_of: NDArray[np.int64],
    design: NDArray[np.float64],
    precision: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Linear response of estimates to the constants of single buildings.

    The response is that of least squares over all draws together, because reflections inside walls can cancel a
    derivative at a single draw.

    Args:
        slope: Derivatives of path loss by the logarithms of all buildings' constants at some draws, in units of the
            noise [n, m, c].
        parameter_of: Index of the parameter that each constant belongs to [c].
        design: Columns of the nuisance, in units of the noise [m, q].
        precision: Inverse variances of the priors of the parameters' logarithms and of the nuisance coefficients
            [d + q].

    Returns:
        Derivative of the logarithm of each parameter by that of each constant [d, c].

    Example:
        >>> one_building_each = np.eye(4)[None]  # four links
        >>> estimate_response(one_building_each, np.zeros(4, int), np.zeros((4, 0)), np.zeros(1)).tolist()
        [[0.25, 0.25, 0.25, 0.25]]
    """
    width = len(precision) - design.shape[1]
    columns = np.zeros((*slope.shape[:2], len(precision)))
    for index in range(width):
        columns[:, :, index] = slope[:, :, parameter_of == index].sum(axis=2)
    columns[:, :, width:] = design
    rows = columns.reshape(-1, len(precision))
    normal = rows.T @ rows / len(slope) + np.diag(precision)
    side = rows.T @ slope.reshape(len(rows), -1) / len(slope)
    return np.asarray(np.linalg.solve(normal, side)[:width], dtype=np.float64)


def implied_means(
    linear: LinearModel,
    change: Callable[[NDArray[np.float64], float], NDArray[np.float64]],
    linear_means: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Means over all buildings that would have given the estimates.

    Args:
        linear: The linearised model at the estimates.
        change: Maps means [n, d] and a portion of the buildings' deviations to their path loss minus that at the
            estimates [n, m], in units of the noise.
        linear_means: The means if path loss is linear in the constants, in the unit cube [n, d].

    Returns:
        The means, in the unit cube [n, d]; the linear ones if they cannot be followed.

    Example:
        >>> linear = LinearModel(np.array([[0.5]]), np.ones((1, 4, 1)), np.zeros((4, 0)), np.zeros((1, 1)))
        >>> deviation = np.array([0.1, 0.0, 0.0, -0.02])  # four links, each on its own building
        >>> implied_means(linear, lambda x, part: x - 0.5 + part * deviation, np.zeros((1, 1))).round(3).tolist()
        [[0.48]]
    """
    estimate = linear.estimate

    def remaining_step(means: NDArray[np.float64], portion: float) -> NDArray[np.float64]:
        return linear.step(-change(means, portion), means)

    followed, before, means = np.ones(len(estimate), dtype=bool), estimate, estimate
    for portion in np.linspace(0.0, 1.0, PORTIONS + 1)[1:].tolist():
        trial = np.clip(2.0 * means - before, 0.0, 1.0)  # predictor: extrapolate
        step = remaining_step(trial, portion)
        length = np.linalg.norm(step, axis=1)
        corrected = np.clip(
            trial + step * np.minimum(1.0, LONGEST_STEP / np.maximum(length, 1e-12))[:, None], 0.0, 1.0
        )
        corrected_step = remaining_step(corrected, portion)
        better = (np.linalg.norm(corrected_step, axis=1) < length)[:, None]
        trial, step = np.where(better, corrected, trial), np.where(better, corrected_step, step)
        followed &= np.linalg.norm(step, axis=1) <= TOLERANCE
        before, means = means, np.where(followed[:, None], trial, means)
    return np.where(followed[:, None], means, np.clip(linear_means, 0.0, 1.0))


def draw_spreads(
    models: Sequence[NoiseModel], share: NDArray[np.float64], tried: Sequence[NoiseModel], seed: int = 0
) -> NDArray[np.float64]:
    """Draw a between-building spread for every draw of the parameters.

    Args:
        models: The noise models that were not negligible.
        share: Their weights at every draw [n, models].
        tried: All noise models that were tried, with their prior weights.
        seed: Seed of the random numbers.

    Returns:
        The spreads; 0 if buildings do not differ [n].
    """
    random = np.random.default_rng(seed)
    spreads = sorted({model.spread for model in tried if model.kind == DIFFERING})
    if not spreads:
        return np.zeros(len(share))
    choices, mean_share = np.array([0.0, *spreads]), share.mean(axis=0).tolist()
    # The Gaussian model is the one with spread 0; the models compared here differ only in their spread.
    prior_weight, posterior_weight = np.zeros(len(choices)), np.zeros(len(choices))
    for index, spread in enumerate(choices.tolist()):
        prior_weight[index] = sum(model.weight for model in tried if _has_spread(model, spread))
        pairs = zip(models, mean_share, strict=True)
        posterior_weight[index] = sum(weight for model, weight in pairs if _has_spread(model, spread))
    evidence = np.maximum(posterior_weight, 1e-6) / np.where(prior_weight > 0, prior_weight, 1.0)
    inverse = np.array([1.0 / spread for spread in spreads])
    prior = np.concatenate([[float(prior_weight[0] > 0)], DEPARTURE * inverse / inverse.sum()])
    odds = prior * evidence ** min(1.0, float(posterior_weight.sum()))
    # Draws of a model with differing buildings have its spread, the others one by the odds.
    model_index = (random.random((len(share), 1)) > np.cumsum(share, axis=1)[:, :-1]).sum(axis=1)
    by_odds = random.choice(choices, len(share), p=odds / odds.sum())
    by_model = np.array([model.spread for model in models])[model_index]
    differs = np.array([model.kind == DIFFERING for model in models])[model_index]
    return np.where(differs, by_model, by_odds)


def _has_spread(model: NoiseModel, spread: float) -> bool:
    """Whether a model is Gaussian with buildings of this spread, 0 for equal buildings."""
    return model.kind == (DIFFERING if spread else GAUSSIAN) and model.spread == spread


def infer_means(
    density: PosteriorDensity,
    replay: BuildingReplay,
    posterior: Draws,
    log_densities: NDArray[np.float64],
    tried: Sequence[NoiseModel],
) -> Draws:
    """Posterior of the means over all buildings, from a posterior with equal buildings.

    Args:
        density: The posterior density with equal buildings.
        replay: The replay with separate constants for each building.
        posterior: Draws from the density.
        log_densities: Log density of some draws of equal weight under every noise model [k, models].
        tried: All noise models that were tried.

    Returns:
        Draws of the means, of equal weight.
    """
    # Every step of the continuation replays each draw twice.
    count = EVALUATED_INTERACTIONS // (2 * PORTIONS * replay.engine.paths.num_interactions)
    count = int(np.clip(count, *DRAWS))
    share = np.exp(log_densities - np.logaddexp.reduce(log_densities, axis=1)[:, None])
    spread = draw_spreads(density.marginal.models, share[np.arange(count) % len(share)], tried)
    response = _mean_response(density, replay, posterior.resampled(SLOPE_DRAWS))
    judged = _Estimates.at(density, replay, posterior.resampled(MODE_DRAWS), response)
    to_others = judged.differences_to(density.modelled(posterior.resampled(OTHER_DRAWS, seed=1)))
    chosen = posterior.indices(count)
    for size in np.unique(spread[spread > 0]).tolist():
        factors, members = (
            replay.draw_factors(np.full(MODE_DRAWS, size), seed=1),
            np.flatnonzero(spread == size),
        )
        by_buildings = judged.change(judged.means(factors), factors)
        divisor = overconfidence(judged.linear, by_buildings, to_others)
        chosen[members] = posterior.tempered(divisor).indices(len(members))
    estimates = _Estimates.at(density, replay, posterior.point[chosen], response)
    lower, upper = density.problem.parameters.search_bounds
    means, weight = estimates.means(replay.draw_factors(spread)), np.full(count, 1.0 / count)
    return Draws(lower + means * (upper - lower), posterior.density[chosen], weight, posterior.flattened)


def _mean_response(
    density: PosteriorDensity, replay: BuildingReplay, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """`estimate_response` at points of the search space [d, c]."""
    problem, marginal = density.problem, density.marginal
    parameters = problem.parameters
    candidates = parameters.from_search(points)
    count = max(4, min(len(points), SLOPE_ENTRIES // (len(density.scale) * len(replay.parameter_of))))
    slope = replay.slopes(candidates[:: max(1, len(points) // count)])
    slope = slope[:, density.counted] * (density.scale[:, None] / marginal.noise_db)
    width = parameters.upper - parameters.lower
    precision = WIDE_PRECISION * np.square(candidates.mean(axis=0) / width)
    if len(problem.priors):
        precision[list(problem.priors.index)] += 1.0 / np.square(problem.priors.spread)
    return estimate_response(
        np.where(np.isfinite(slope), slope, 0.0),
        replay.parameter_of,
        marginal.design / marginal.noise_db,
        np.concatenate([precision, (marginal.ridge / marginal.noise_db) ** 2]),
    )


@dataclass(frozen=True, eq=False)
class _Estimates:
    """Estimates whose implied means are sought.

    Attributes:
        density: The posterior density with equal buildings.
        replay: The replay with separate constants for each building.
        loss: Path loss at the estimates with equal buildings [n, L], [dB].
        linear: The linearised model at the estimates.
        response: Linear response of estimates to single buildings [d, c].
    """

    density: PosteriorDensity
    replay: BuildingReplay
    loss: NDArray[np.float64]
    linear: LinearModel
    response: NDArray[np.float64]

    @classmethod
    def at(
        cls,
        density: PosteriorDensity,
        replay: BuildingReplay,
        points: NDArray[np.float64],
        response: NDArray[np.float64],
    ) -> _Estimates:
        """Linearise at points of the search space [n, d]."""
        problem, marginal = density.problem, density.marginal
        parameters, scale = problem.parameters, density.scale / marginal.noise_db
        lower, upper = parameters.search_bounds
        candidates = parameters.from_search(points)
        loss, slope = replay.shared.path_loss_and_jacobian(candidates)
        by_unit = parameters.search_slope(candidates) * (upper - lower)
        slope = slope[:, density.counted] * by_unit[:, None, :] * scale[:, None]
        precision = np.full((len(points), len(parameters) + marginal.design.shape[1]), WIDE_PRECISION)
        precision[:, len(parameters) :] = (marginal.ridge / marginal.noise_db) ** 2
        if len(problem.priors):
            prior_slope = problem.priors.jacobian(candidates) * by_unit[:, None, :]
            precision[:, : len(parameters)] += np.square(prior_slope).sum(axis=1)
        linear = LinearModel(
            (points - lower) / (upper - lower),
            np.where(np.isfinite(slope), slope, 0.0),
            marginal.design / marginal.noise_db,
            precision,
        )
        return cls(density, replay, loss, linear, response)

    def means(self, factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Means that imply the estimates for buildings with these factors, in the unit cube [n, d]."""
        parameters = self.density.problem.parameters
        lower, upper = parameters.search_bounds
        value = parameters.from_search(lower + self.linear.estimate * (upper - lower))
        value = value * np.exp(-np.log(factors) @ self.response.T)
        linear_means = parameters.to_search(np.clip(value, parameters.lower, parameters.upper))
        return implied_means(
            self.linear,
            lambda means, portion: self.change(means, factors**portion),
            (linear_means - lower) / (upper - lower),
        )

    def change(self, means: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of buildings about means in the unit cube, minus that at the estimates; by the noise [n, m]."""
        parameters = self.density.problem.parameters
        lower, upper = parameters.search_bounds
        loss = self.replay.path_loss(parameters.from_search(lower + means * (upper - lower)), factors)
        with np.errstate(invalid="ignore"):  # inf - inf for a link without a path
            return self._in_noise_units((loss - self.loss)[:, self.density.counted])

    def differences_to(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of other points [k, m] minus that at the estimates; by the noise [n, k, m]."""
        with np.errstate(invalid="ignore"):  # inf - inf for a link without a path
            return self._in_noise_units(loss - self.loss[:, None, self.density.counted])

    def _in_noise_units(self, difference: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted differences in units of the noise; 0 for a link without a path."""
        scaled = difference * (self.density.scale / self.density.marginal.noise_db)
        return np.where(np.isfinite(scaled), scaled, 0.0)
