"""Posterior of the means over all buildings, sampled together with every building and the between-building spread.

The walls of building b have the constants x exp(s z_b): x is the material's mean, z_b is standard normal, and the
spread s has an exponential prior. Links dominated by one building share its deviation, so a posterior with equal
buildings is too narrow for the mean.

Sequential Monte Carlo samples all three at once (P. Del Moral, A. Doucet and A. Jasra, J. Royal Statistical Society
B 68, 2006). A population starts from a flattened density and follows it while the power of the likelihood grows to 1.
Each step raises the power until half of the population is effective. Between the steps, draws move:

- One, two or all buildings are redrawn around their values (S. L. Cotter, G. O. Roberts, A. M. Stuart and D. White,
  Statistical Science 28, 2013).
- Means and spread are redrawn given the buildings' constants. The constants, and with them path loss, stay the same,
  so nothing is replayed (interweaving: Y. Yu and X.-L. Meng, J. Computational and Graphical Statistics 20, 2011).
- One or more means move along the difference of two other draws (C. J. F. ter Braak, Statistics and Computing 16,
  2006).

The weights vary with the deviations of the buildings, however good a mean is. With full weights a large population that
moves little would end in a few narrow modes by chance. We therefore use a small population that moves often, resample
it by the square roots of its weights, and keep draws while it moves in the last step.

Every draw has its own noise model, redrawn at every step.

Scenes with too many interactions for these replays use indirect inference (`indirect_inference.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.parameters import NO_PRIOR, LogNormal, Parameters
from calibray.uncertainty.buildings import BATCH, BuildingReplay, split_by_building
from calibray.uncertainty.importance_sampling import Draws, systematic_resampling
from calibray.uncertainty.indirect_inference import infer_means
from calibray.uncertainty.likelihood import PosteriorDensity
from calibray.uncertainty.noise_models import DIFFERING, GAUSSIAN, Marginal, NoiseModel
from calibray.uncertainty.quadratic_forms import QuadraticForms

POPULATION: Final = BATCH
"""Draws that move: one batch of the split replay."""

MAX_INTERACTIONS: Final = 8_300
"""Largest path program whose buildings are sampled; the fewest sweeps of a larger one would be too expensive."""

SWEEPS: Final = (4, 11)
"""Fewest and most sweeps per step: some 10,000 and 25,000 replays in total."""

SWEPT_INTERACTIONS: Final = 100_000_000
"""Approximate number of interactions evaluated; larger scenes take fewer sweeps."""

EXPECTED_STEPS: Final = 8
"""Typical number of steps, for this estimate."""

MEAN_SPREAD: Final = 0.15
"""Mean of the exponential prior of the spread: the middle one of the spreads that noise models try."""

SPREAD_BOUNDS: Final = (0.004, 0.8)
"""Range of the spread; the lower end is as good as none."""

SPREAD_GRID: Final = 64
"""Points of the logarithmic grid that the spread is drawn from."""

FIRST_POWER: Final = 0.1
"""Power of the likelihood at the start."""

EFFECTIVE: Final = 0.5
"""Effective share of the population after each step."""

MAX_STEPS: Final = 30
"""Steps after which the remaining flattening is accepted."""

KEPT_SWEEPS: Final = 8
"""Sweeps of the last step after which draws are kept."""

WEIGHT_POWER: Final = 0.5
"""Power of the resampling weights; 1 would be exact for draws that do not move."""

ACCEPTANCE: Final = 0.25
"""Target share of accepted moves, which sets their lengths; near the optimal 0.234 of random walks (G. O. Roberts, A.
Gelman and W. R. Gilks, Annals of Applied Probability 7, 1997)."""

JITTER: Final = 1e-4
"""Random addition to moves along differences, so that every point can be reached."""

TINY: Final = 1e-30
"""Replaces a constant of 0 under the logarithm; its factors have no effect."""

NEVER: Final = -1e300
"""Finite replacement for a log density of minus infinity."""

Gaps = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Maps points of the unit cube [n, d] and logarithms of the factors of buildings' constants [n, c] to measured minus
modelled path loss, times the square roots of the weights [n, m], [dB]."""


def population_means(
    density: PosteriorDensity,
    posterior: Draws,
    log_densities: NDArray[np.float64],
    tried: Sequence[NoiseModel],
) -> Draws:
    """Posterior of the means over all buildings, of which the links see some.

    Args:
        density: The posterior density with equal buildings.
        posterior: Draws from it.
        log_densities: Log density of some draws of equal weight under every noise model [k, models].
        tried: All noise models that were tried.

    Returns:
        Draws of the means; the posterior itself if buildings do not differ or cannot be separated.
    """
    replay = split_by_building(density.problem) if any(model.spread for model in tried) else None
    if replay is None:
        return posterior
    if replay.engine.paths.num_interactions > MAX_INTERACTIONS:
        return infer_means(density, replay, posterior, log_densities, tried)
    # Every sweep replays each draw three times.
    sweeps = SWEPT_INTERACTIONS // (3 * EXPECTED_STEPS * POPULATION * replay.engine.paths.num_interactions)
    sweeps = int(np.clip(sweeps, *SWEEPS))
    hierarchy, seed = _hierarchy(density, replay, tried), density.problem.setup.study.method.seed
    means = sample_means(hierarchy, posterior, POPULATION, sweeps, seed=seed)
    # The density with equal buildings is needed once per line of draws only, at its last draw.
    last = np.full(len(means.point), -np.inf)
    last[-POPULATION:] = np.logaddexp.reduce(density(means.point[-POPULATION:]), axis=1)
    return replace(means, density=last)


def _hierarchy(density: PosteriorDensity, replay: BuildingReplay, tried: Sequence[NoiseModel]) -> Hierarchy:
    problem, of_building = density.problem, replay.building_of >= 0
    parameters = problem.parameters

    def gaps(points: NDArray[np.float64], logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
        factors = np.ones((len(points), len(of_building)))
        factors[:, of_building] = np.exp(logarithms)
        return density.gaps(replay.path_loss(parameters.from_unit(points), factors))

    constants = [of_building[replay.parameter_of == index] for index in range(len(parameters))]
    spread = problem.setup.study.noise.heterogeneity
    return Hierarchy(
        parameters,
        parameter_of=replay.parameter_of[of_building],
        building_of=np.unique(replay.building_of[of_building], return_inverse=True)[1],
        only_buildings=np.array([mask.all() and mask.any() for mask in constants]),
        gaps=gaps,
        marginal=replace(density.marginal, models=remaining_models(density.marginal.models, tried)),
        priors=problem.priors,
        spread=None if spread == "auto" else float(spread),
    )


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """The model of means, buildings and spread.

    Attributes:
        parameters: The d parameters.
        parameter_of: Index of the parameter that each of the c building constants belongs to [c].
        building_of: Building of each constant, from 0 [c].
        only_buildings: Mask of the parameters whose constants all belong to buildings, so that these determine the
            mean [d].
        gaps: Computes measured minus modelled path loss.
        marginal: Density of the gaps, with the models of `remaining_models`.
        priors: Priors of the parameters.
        spread: The between-building spread if it is declared; else None.
    """

    parameters: Parameters
    parameter_of: NDArray[np.int64]
    building_of: NDArray[np.int64]
    only_buildings: NDArray[np.bool_]
    gaps: Gaps
    marginal: Marginal
    priors: LogNormal = NO_PRIOR
    spread: float | None = None

    @cached_property
    def forms(self) -> QuadraticForms:
        """The density of gaps that have one noise model each."""
        return QuadraticForms.of(self.marginal)

    def log_prior(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm of the declared priors at points of the unit cube [n, d], up to a constant [n]."""
        if not len(self.priors):
            return np.zeros(len(points))
        return -0.5 * np.sum(self.priors.residuals(self.parameters.from_unit(points)) ** 2, axis=1)


def remaining_models(models: Sequence[NoiseModel], tried: Sequence[NoiseModel]) -> tuple[NoiseModel, ...]:
    """Noise models for the errors that differing buildings leave.

    Args:
        models: The noise models that were not negligible with equal buildings.
        tried: All noise models that were tried.

    Returns:
        The models without differing buildings, and always the Gaussian ones, which may suffice once buildings differ.

    Example:
        >>> tried = (NoiseModel("gaussian", 0.2), NoiseModel("student-t", 0.4), NoiseModel("heterogeneous", 0.4))
        >>> [model.kind for model in remaining_models(tried[2:], tried)]
        ['gaussian']
    """
    remaining = [model for model in models if model.kind != DIFFERING]
    for kind in (GAUSSIAN, DIFFERING):
        for model in tried:
            present = any(other.kind == GAUSSIAN and other.offset == model.offset for other in remaining)
            if model.kind == kind and not present:
                remaining.append(NoiseModel(GAUSSIAN, model.weight, offset=model.offset))
    return tuple(remaining)


@dataclass(frozen=True, eq=False)
class _Population:
    """The draws of the sampler.

    Attributes:
        point: Means, in the unit cube [n, d].
        deviation: Standardised deviations z of the buildings' constants [n, c].
        spread: Between-building spread [n].
        model: Index of the noise model [n].
        gap: Measured minus modelled path loss, weighted [n, m], [dB].
        log_density: Log density of the links under that model, plus the log prior [n].
    """

    point: NDArray[np.float64]
    deviation: NDArray[np.float64]
    spread: NDArray[np.float64]
    model: NDArray[np.int64]
    gap: NDArray[np.float64]
    log_density: NDArray[np.float64]

    def selected(self, index: NDArray[np.intp]) -> _Population:
        """The draws of these indices."""
        return _Population(*(part[index] for part in self._parts()))

    def updated(self, accepted: NDArray[np.bool_], proposal: _Population) -> _Population:
        """The proposal's draws where accepted [n], else the present ones."""
        return _Population(
            *(
                np.where(accepted.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
                for old, new in zip(self._parts(), proposal._parts(), strict=True)
            )
        )

    def _parts(self) -> tuple[NDArray, ...]:
        return self.point, self.deviation, self.spread, self.model, self.gap, self.log_density


@dataclass(frozen=True)
class _Lengths:
    """Lengths of moves, adapted to their acceptance.

    Attributes:
        buildings: Length of a move of all buildings; 1 draws them independently of their values.
        means: Length of a move of means, relative to the optimum for a normal density.
    """

    buildings: float = 0.5
    means: float = 1.0


def sample_means(hierarchy: Hierarchy, start: Draws, count: int, sweeps: int, seed: int = 0) -> Draws:
    """Sample the means over all buildings.

    Args:
        hierarchy: The model.
        start: Draws of the means with equal buildings, in the search space.
        count: Size of the population; each draw is kept after each of the last sweeps.
        sweeps: Sweeps per step; a sweep moves every draw in each way.
        seed: Seed of the random numbers.

    Returns:
        Draws of equal weight; flattened if the power did not reach 1.
    """
    random, parameters = np.random.default_rng(seed), hierarchy.parameters
    points = start.tempered(1.0 / FIRST_POWER).resampled(count, seed)
    population, weight = _first(hierarchy, parameters.to_unit(parameters.from_search(points)), random)
    power, steps, lengths = FIRST_POWER, 0, _Lengths()
    while True:
        population = population.selected(random.permutation(systematic_resampling(weight, count, random)))
        population = _with_models(hierarchy, population, power, random)
        moves, passed = _Moves(hierarchy, power, random), [population]
        for _ in range(sweeps):
            population, lengths = moves.sweep(population, lengths)
            passed.append(population)
        steps += 1
        if power == 1.0 or steps == MAX_STEPS:
            kept = passed[-min(KEPT_SWEEPS, max(sweeps, 1)) :]
            point = parameters.to_search(parameters.from_unit(np.concatenate([part.point for part in kept])))
            log_density = np.concatenate([part.log_density for part in kept])
            return Draws(point, log_density, np.full(len(point), 1.0 / len(point)), power < 1.0)
        before, power = power, _next_power(population.log_density, power)
        weight = _weights(WEIGHT_POWER * (power - before) * population.log_density)


def _first(
    hierarchy: Hierarchy, points: NDArray[np.float64], random: np.random.Generator
) -> tuple[_Population, NDArray[np.float64]]:
    """Buildings from their prior about the means [n, d], and resampling weights [n]."""
    count, zeros = len(points), np.zeros((len(points), len(hierarchy.parameter_of)))
    if hierarchy.spread is None:
        spread = np.clip(random.exponential(MEAN_SPREAD, count), *SPREAD_BOUNDS)
    else:
        spread = np.full(count, hierarchy.spread)
    gap = hierarchy.gaps(points, zeros)
    equal = _Population(points, zeros, spread, np.zeros(count, dtype=np.int64), gap, np.zeros(count))
    equal = _with_models(hierarchy, equal, FIRST_POWER, random)
    population = _evaluated(hierarchy, replace(equal, deviation=random.standard_normal(zeros.shape)))
    return population, _weights(FIRST_POWER * (population.log_density - equal.log_density))


def _evaluated(hierarchy: Hierarchy, population: _Population) -> _Population:
    """The population with gaps and log density recomputed."""
    gap = hierarchy.gaps(population.point, population.spread[:, None] * population.deviation)
    log_density = hierarchy.forms.densities(gap, population.model) + hierarchy.log_prior(population.point)
    log_density = np.where(np.isfinite(log_density), log_density, NEVER)
    return replace(population, gap=gap, log_density=log_density)


def _with_models(
    hierarchy: Hierarchy, population: _Population, power: float, random: np.random.Generator
) -> _Population:
    """The population with the noise model of every draw redrawn from its conditional probabilities."""
    by_model = hierarchy.marginal.densities(population.gap)
    by_model = np.where(np.isfinite(by_model), by_model, NEVER)
    # The largest of log weights plus Gumbel numbers is a draw by these weights.
    model = np.argmax(power * by_model + random.gumbel(size=by_model.shape), axis=1)
    log_density = by_model[np.arange(len(model)), model] + hierarchy.log_prior(population.point)
    return replace(population, model=model, log_density=np.maximum(log_density, NEVER))


@dataclass(frozen=True, eq=False)
class _Moves:
    """Moves that leave the prior times a power of the likelihood invariant.

    Attributes:
        hierarchy: The model.
        power: The power.
        random: Random numbers.
    """

    hierarchy: Hierarchy
    power: float
    random: np.random.Generator

    def sweep(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """Move every draw in each way."""
        for move in (self._move_buildings, self._move_means, self._move_means):
            population, lengths = move(population, lengths)
            population = self._interweave(population)
        return population, lengths

    def _move_buildings(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """Redraw one, two or all buildings; sqrt(1 - b^2) z + b xi is standard normal if z and xi are."""
        hierarchy, random = self.hierarchy, self.random
        count, width = population.deviation.shape
        number = int(hierarchy.building_of.max()) + 1
        one, other = (hierarchy.building_of == random.integers(0, number, (count, 1)) for _ in range(2))
        selected = one | (other & (random.random((count, 1)) < 0.4))
        length = np.where(selected, random.choice([0.5, 1.0], (count, 1)), 0.0)
        all_buildings = random.random(count) < 0.25
        adapted = np.minimum(lengths.buildings * np.exp(0.4 * random.standard_normal((count, 1))), 1.0)
        length = np.where(all_buildings[:, None], adapted, length)
        normal = random.standard_normal((count, width))
        deviation = np.sqrt(1.0 - length**2) * population.deviation + length * normal
        proposal = _evaluated(hierarchy, replace(population, deviation=deviation))
        accepted = self._accepts(proposal.log_density - population.log_density)
        buildings = _adapted(lengths.buildings, accepted[all_buildings], 1.0)
        return population.updated(accepted, proposal), replace(lengths, buildings=buildings)

    def _move_means(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """Move means along the difference of two other draws; half of the moves take the full difference."""
        random = self.random
        count, width = population.point.shape
        shift = random.choice(np.arange(1, count), 2, replace=False)
        first, second = (np.arange(count) + shift[0]) % count, (np.arange(count) + shift[1]) % count
        moving = random.random((count, width)) < random.choice([0.0, 0.0, 0.5], (count, 1))
        moving[np.arange(count), random.integers(0, width, count)] = True
        # 2.38 / sqrt(2 k) is the optimal length for k moving coordinates of a normal density (ter Braak).
        length = lengths.means * 2.38 / np.sqrt(2.0 * moving.sum(axis=1, keepdims=True))
        length = length * np.exp(0.4 * random.standard_normal((count, 1)))
        full = random.random((count, 1)) < 0.5
        step = np.where(full, 1.0, length) * (population.point[first] - population.point[second])
        point = population.point + moving * (step + JITTER * random.standard_normal((count, width)))
        inside = ((point >= 0.0) & (point <= 1.0)).all(axis=1)
        proposal = _evaluated(self.hierarchy, replace(population, point=np.clip(point, 0.0, 1.0)))
        accepted = inside & self._accepts(proposal.log_density - population.log_density)
        means = _adapted(lengths.means, accepted[~full[:, 0]], 2.0)
        return population.updated(accepted, proposal), replace(lengths, means=means)

    def _interweave(self, population: _Population) -> _Population:
        """Redraw spread and means given the buildings' constants; path loss does not change."""
        if self.hierarchy.spread is None:
            population = _redraw_spread(population, self.random)
        for index in np.flatnonzero(self.hierarchy.only_buildings).tolist():
            population = self._redraw_mean(population, index)
        return population

    def _redraw_mean(self, population: _Population, index: int) -> _Population:
        """Given k buildings, log x is normal about their mean logarithm with deviation s / sqrt(k), times the prior."""
        parameters, columns = self.hierarchy.parameters, self.hierarchy.parameter_of == index
        values, spread = parameters.from_unit(population.point), population.spread
        before = np.log(np.maximum(values[:, index], TINY))
        constants = before[:, None] + spread[:, None] * population.deviation[:, columns]
        normal = self.random.standard_normal(len(spread))
        after = constants.mean(axis=1) + spread / np.sqrt(columns.sum()) * normal
        moved, lower, upper = values.copy(), parameters.lower[index], parameters.upper[index]
        moved[:, index] = np.exp(after)
        inside = (moved[:, index] >= lower) & (moved[:, index] <= upper)
        moved[:, index] = np.clip(moved[:, index], lower, upper)
        point = population.point.copy()
        point[:, index] = parameters.to_unit(moved)[:, index]
        prior_change = self.hierarchy.log_prior(point) - self.hierarchy.log_prior(population.point)
        # A prior flat in the search coordinate u has the density x / (dx / du) in log x.
        slope_after = parameters.search_slope(moved)[:, index]
        slope_before = parameters.search_slope(values)[:, index]
        flat_change = after - before - np.log(slope_after / slope_before)
        accepted = inside & (
            -self.random.standard_exponential(len(spread)) < flat_change + self.power * prior_change
        )
        deviation = population.deviation.copy()
        deviation[:, columns] = (constants - after[:, None]) / spread[:, None]
        log_density = population.log_density + prior_change
        return population.updated(
            accepted, replace(population, point=point, deviation=deviation, log_density=log_density)
        )

    def _accepts(self, change: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Metropolis rule for changes of the log density [n]; minus an exponential number is the log of a uniform."""
        return -self.random.standard_exponential(len(change)) < self.power * change


def _redraw_spread(population: _Population, random: np.random.Generator) -> _Population:
    """Draw the spread from p(s | s z) = exp(-s / mean) s^-c exp(-(s z)^2 / 2 s^2), on a logarithmic grid."""
    grid = np.geomspace(*SPREAD_BOUNDS, SPREAD_GRID)
    square = np.sum((population.spread[:, None] * population.deviation) ** 2, axis=1)
    width = population.deviation.shape[1]
    # The width of a grid cell adds a factor s.
    log_density = -grid / MEAN_SPREAD - (width - 1) * np.log(grid) - 0.5 * square[:, None] / grid**2
    spread = grid[np.argmax(log_density + random.gumbel(size=log_density.shape), axis=1)]
    deviation = population.deviation * (population.spread / spread)[:, None]
    return replace(population, spread=spread, deviation=deviation)


def _next_power(log_density: NDArray[np.float64], power: float) -> float:
    """The largest power that leaves the share `EFFECTIVE` of the draws effective, by bisection."""

    def effective_share(other: float) -> float:
        weight = _weights((other - power) * log_density)
        return float(1.0 / np.sum(weight**2)) / len(log_density)

    if effective_share(1.0) >= EFFECTIVE:
        return 1.0
    low, high = power, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        if effective_share(middle) >= EFFECTIVE:
            low = middle
        else:
            high = middle
    return high


def _weights(logarithm: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = np.exp(logarithm - logarithm.max())
    return weight / weight.sum()


def _adapted(length: float, accepted: NDArray[np.bool_], longest: float) -> float:
    """The length of moves after some were accepted or not."""
    if not len(accepted):
        return length
    return float(np.clip(length * np.exp(0.5 * (accepted.mean() - ACCEPTANCE)), 0.02, longest))
