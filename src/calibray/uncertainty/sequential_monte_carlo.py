"""Draws from the joint posterior by tempered sequential Monte Carlo.

A population drawn from the prior follows the prior times a power of the likelihood, while the power grows to 1 (P. Del
Moral, A. Doucet and A. Jasra, J. Royal Statistical Society B 68, 2006).Each step raises the power until half of the
population is effective, resamples the population, and moves its members:

- One or more parameters move along the difference of two other members (C. J. F. ter Braak, Statistics and Computing
  16, 2006).
- One parameter is redrawn from the population's values of it, smoothed. Reflections inside walls give a permittivity
  several narrow ranges, and members of one range reach the others at once.
- One, two or all buildings are redrawn around their values (S. L. Cotter, G. O. Roberts, A. M. Stuart and D. White,
  Statistical Science 28, 2013).
- The between-building spread is redrawn from its prior, together with all buildings: buildings become alike or differ.
- Means and spread are redrawn given the buildings' constants. The constants, and with them path loss, stay the same,
  so nothing is replayed (interweaving: Y. Yu and X.-L. Meng, J. Computational and Graphical Statistics 20, 2011).
- The noise model is redrawn given the errors.

Two populations are independent. If they disagree, two more are drawn, as far as the budget allows. All populations
count by their estimates of the evidence, which are unbiased.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.uncertainty.draws import Draws, pooled, systematic_resampling
from calibray.uncertainty.joint_model import MEAN_SPREAD, SPREAD_BOUNDS, JointModel

SIZE: Final = (128, 256)
"""Fewest and most members of a population."""

BUDGET: Final = 3_000_000_000
"""Interactions that all populations may evaluate together."""

EVALUATIONS: Final = 100
"""Evaluations that a member takes, about: steps times moves."""

SWEEPS: Final = 4
"""Sweeps per step; a sweep moves every member in each way. The share of one of two distant ranges in five dimensions
then scatters by 0.03 between seeds; with 2 sweeps by 0.08."""

LAST_SWEEPS: Final = 10
"""Sweeps at power 1."""

EFFECTIVE: Final = 0.5
"""Effective share of the population after each step."""

MAX_STEPS: Final = 60
"""Steps after which the population is given up as it stands; most posteriors take 8 to 20."""

APART: Final = 0.2
"""Largest distance between the distribution functions of a parameter in independent populations that agree. Two sets of
256 independent draws differ by up to 0.12 in 19 of 20 cases; members of one population are not quite independent."""

SPREAD_GRID: Final = 64
"""Points of the logarithmic grid that the spread is drawn from."""

ACCEPTANCE: Final = 0.25
"""Target share of accepted moves, which sets their lengths; near the optimal 0.234 of random walks (G. O. Roberts, A.
Gelman and W. R. Gilks, Annals of Applied Probability 7, 1997)."""

JITTER: Final = 1e-4
"""Random addition to moves along differences, so that every point can be reached."""

NEIGHBOURHOOD: Final = 32
"""A kernel is as wide as this part of the population on either side of it."""

TINY: Final = 1e-30
"""Replaces a constant of 0 under the logarithm; its factors have no effect."""

NEVER: Final = -1e300
"""Finite replacement for a log density of minus infinity."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from the joint posterior.

    Attributes:
        means: Draws of the study's parameters: means over all buildings, in its search space.
        seen: The same draws for the buildings that the links meet: the geometric means of their constants.
        joint: Points of the unit cube of all parameters [n, d + k].
        spread: Between-building spread of every draw [n].
        model: Index of the noise model of every draw [n].
        replays: Evaluations of path loss that the draws took.
    """

    means: Draws
    seen: Draws
    joint: NDArray[np.float64]
    spread: NDArray[np.float64]
    model: NDArray[np.int64]
    replays: int = 0


@dataclass(frozen=True, eq=False)
class _Population:
    """Members of a population.

    Attributes:
        point: Points of the unit cube [n, d + k].
        deviation: Standardised deviations z of the buildings' constants [n, c].
        spread: Between-building spread [n].
        model: Index of the noise model [n].
        gap: Measured minus modelled path loss, weighted [n, m], [dB].
        log_likelihood: Log density of the links under that model [n].
        log_prior: Log prior density of the point [n].
    """

    point: NDArray[np.float64]
    deviation: NDArray[np.float64]
    spread: NDArray[np.float64]
    model: NDArray[np.int64]
    gap: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    log_prior: NDArray[np.float64]

    def selected(self, index: NDArray[np.intp]) -> _Population:
        """The members of these indices."""
        return _Population(*(part[index] for part in self._parts()))

    def updated(self, accepted: NDArray[np.bool_], proposal: _Population) -> _Population:
        """The proposal's members where accepted [n], else the present ones."""
        return _Population(
            *(
                np.where(accepted.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
                for old, new in zip(self._parts(), proposal._parts(), strict=True)
            )
        )

    def _parts(self) -> tuple[NDArray, ...]:
        return (
            self.point,
            self.deviation,
            self.spread,
            self.model,
            self.gap,
            self.log_likelihood,
            self.log_prior,
        )


@dataclass(frozen=True)
class _Lengths:
    """Lengths of moves, adapted to their acceptance.

    Attributes:
        buildings: Length of a move of all buildings; 1 draws them independently of their values.
        points: Length of a move along a difference, relative to the optimum for a normal density.
    """

    buildings: float = 0.5
    points: float = 1.0


def joined(posteriors: Sequence[Posterior]) -> Posterior:
    """Draws from the mean of several posteriors with equal weights."""
    return Posterior(
        pooled([each.means for each in posteriors]),
        pooled([each.seen for each in posteriors]),
        np.concatenate([each.joint for each in posteriors]),
        np.concatenate([each.spread for each in posteriors]),
        np.concatenate([each.model for each in posteriors]),
        sum(each.replays for each in posteriors),
    )


def population_size(interactions: int, budget: int = BUDGET) -> int:
    """Members of each of two populations within a budget, from the interactions of one evaluation.

    Example:
        >>> population_size(1_000), population_size(75_000)
        (256, 200)
    """
    return int(np.clip(budget // (2 * EVALUATIONS * interactions), *SIZE))


def draw_posterior(
    model: JointModel, seed: int = 0, progress: Callable[[float], None] | None = None, budget: int = BUDGET
) -> Posterior:
    """Draw from the joint posterior.

    Args:
        model: The joint model.
        seed: Seed of the random numbers.
        progress: Called with the share of the work done after every step.
        budget: Interactions that may be evaluated.

    Returns:
        The draws.
    """
    size, replays = population_size(model.interactions, budget), 0

    def counted(points: NDArray[np.float64], logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal replays
        replays += len(points)
        return gaps(points, logarithms)

    gaps, model = model.gaps, replace(model, gaps=counted)
    populations: list[_Population] = []
    evidences: list[float] = []
    for number in range(4):
        if number == 2:
            spent = 2 * EVALUATIONS * model.interactions * size
            if 2 * spent > budget or _distance(model, populations) < APART:
                break
        random = np.random.default_rng([seed, number])

        def stepped(power: float, number: int = number) -> None:
            if progress is not None:
                progress((number % 2 + power) / 2)

        population, evidence = _anneal(model, size, random, stepped)
        populations.append(population)
        evidences.append(evidence)
    half = len(populations) // 2
    agree = _distance(model, [_together(populations[:half]), _together(populations[half:])]) < APART
    # Populations that disagree count alike: the estimates of their evidence are then unreliable.
    share = _weights(np.array(evidences)) if agree else np.full(len(populations), 1.0 / len(populations))
    posterior = _posterior(model, _together(populations), np.repeat(share, size) / size, agree)
    return replace(posterior, replays=replays)


def _together(populations: Sequence[_Population]) -> _Population:
    return _Population(*map(np.concatenate, zip(*(each._parts() for each in populations), strict=True)))


def _distance(model: JointModel, populations: list[_Population]) -> float:
    """Largest distance between the distribution functions of a study's parameter in two populations."""
    first, second = (each.point[:, : len(model.study)] for each in populations)
    distance = 0.0
    for one, other in zip(first.T, second.T, strict=True):
        every = np.sort(np.concatenate([one, other]))
        shares = (np.searchsorted(np.sort(each), every, side="right") / len(each) for each in (one, other))
        distance = max(distance, float(np.abs(np.subtract(*shares)).max()))
    return distance


def _posterior(
    model: JointModel, members: _Population, weight: NDArray[np.float64], agree: bool
) -> Posterior:
    study, width = model.study, len(model.study)
    values = model.parameters.from_unit(members.point)[:, :width]
    density = members.log_likelihood + members.log_prior
    seen = np.log(np.maximum(values, TINY))
    factors = members.spread[:, None] * members.deviation
    for index in range(width):
        mine = model.parameter_of == index
        if mine.any():
            seen[:, index] += factors[:, mine].mean(axis=1)
    at_seen = np.clip(np.where(values > 0, np.exp(seen), values), study.lower, study.upper)
    return Posterior(
        Draws(study.to_search(values), density, weight, agree),
        Draws(study.to_search(at_seen), density, weight, agree),
        members.point,
        members.spread,
        members.model,
    )


def _anneal(
    model: JointModel, size: int, random: np.random.Generator, stepped: Callable[[float], None]
) -> tuple[_Population, float]:
    """A population that followed the likelihood's power from 0 to 1, and its log evidence."""
    point = model.draw_prior(size, random)
    deviation = random.standard_normal((size, len(model.parameter_of)))
    models = random.integers(0, len(model.marginal.models), size)
    empty = np.zeros(size)
    population = _Population(
        point,
        deviation,
        model.draw_spread(size, random),
        models,
        np.zeros((size, len(model.marginal.column))),
        empty,
        empty,
    )
    population = _evaluated(model, population)
    power, evidence, lengths = 0.0, 0.0, _Lengths()
    for step in range(MAX_STEPS):
        before, power = power, _next_power(population.log_likelihood, power)
        if step == MAX_STEPS - 1:
            power = 1.0
        rise = (power - before) * population.log_likelihood
        evidence += float(np.logaddexp.reduce(rise)) - np.log(size)
        population = population.selected(
            random.permutation(systematic_resampling(_weights(rise), size, random))
        )
        moves = _Moves(model, power, random)
        population = moves.redraw_categories(population)
        for _ in range(SWEEPS if power < 1.0 else LAST_SWEEPS):
            population, lengths = moves.sweep(population, lengths)
        population = moves.redraw_categories(population)
        stepped(power)
        if power == 1.0:
            break
    return population, evidence


def _evaluated(model: JointModel, population: _Population) -> _Population:
    """The population with gaps and densities recomputed."""
    gap = model.gaps(population.point, population.spread[:, None] * population.deviation)
    log_likelihood = model.forms.densities(gap, population.model)
    log_likelihood = np.where(np.isfinite(log_likelihood), log_likelihood, NEVER)
    return replace(
        population, gap=gap, log_likelihood=log_likelihood, log_prior=model.log_prior(population.point)
    )


@dataclass(frozen=True, eq=False)
class _Moves:
    """Moves that leave the prior times a power of the likelihood invariant.

    Attributes:
        model: The joint model.
        power: The power.
        random: Random numbers.
    """

    model: JointModel
    power: float
    random: np.random.Generator

    def sweep(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """Move every member in each way."""
        population, lengths = self._move_points(population, lengths)
        if len(self.model.parameter_of):
            population, lengths = self._move_buildings(population, lengths)
            population = self._interweave(population)
        return self._redraw_coordinate(population), lengths

    def redraw_categories(self, population: _Population) -> _Population:
        """Redraw the noise models, and whether buildings differ."""
        population = self._redraw_models(population)
        if len(self.model.parameter_of) and self.model.spread is None:
            population = self._redraw_all_buildings(population)
        return population

    def _move_points(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """Move along the difference of two other members; a third of the moves take the full difference."""
        random = self.random
        count, width = population.point.shape
        shift = random.choice(np.arange(1, count), 2, replace=False)
        first, second = (np.arange(count) + shift[0]) % count, (np.arange(count) + shift[1]) % count
        moving = random.random((count, width)) < random.choice([0.0, 0.5, 1.0], (count, 1))
        moving[np.arange(count), random.integers(0, width, count)] = True
        # 2.38 / sqrt(2 k) is the optimal length for k moving coordinates of a normal density (ter Braak).
        length = lengths.points * 2.38 / np.sqrt(2.0 * moving.sum(axis=1, keepdims=True))
        length = length * np.exp(0.4 * random.standard_normal((count, 1)))
        full = random.random((count, 1)) < 1 / 3
        step = np.where(full, 1.0, length) * (population.point[first] - population.point[second])
        point = population.point + moving * (step + JITTER * random.standard_normal((count, width)))
        inside = ((point >= 0.0) & (point <= 1.0)).all(axis=1)
        proposal = _evaluated(self.model, replace(population, point=np.clip(point, 0.0, 1.0)))
        accepted = inside & self._accepts(population, proposal)
        points = _adapted(lengths.points, accepted[~full[:, 0]], 2.0)
        return population.updated(accepted, proposal), replace(lengths, points=points)

    def _redraw_coordinate(self, population: _Population) -> _Population:
        """Redraw one parameter from the population's values of it: Gaussian kernels as wide as their neighbourhood."""
        random, (count, width) = self.random, population.point.shape
        chosen, point, log_ratio = random.integers(0, width, count), population.point.copy(), np.zeros(count)
        near = max(2, count // NEIGHBOURHOOD)
        for index in range(width):
            rows = np.flatnonzero(chosen == index)
            centre = np.sort(population.point[:, index])
            low, high = np.arange(count) - near, np.arange(count) + near
            size = (centre[np.minimum(high, count - 1)] - centre[np.maximum(low, 0)]) / 2 + JITTER
            kernel = random.integers(0, count, len(rows))
            value = centre[kernel] + size[kernel] * random.standard_normal(len(rows))
            both = np.concatenate([population.point[rows, index], value])
            density = np.mean(np.exp(-0.5 * ((both[:, None] - centre) / size) ** 2) / size, axis=1)
            with np.errstate(divide="ignore"):
                log_density = np.log(density).reshape(2, -1)
            log_ratio[rows], point[rows, index] = log_density[0] - log_density[1], value
        inside = ((point >= 0.0) & (point <= 1.0)).all(axis=1)
        proposal = _evaluated(self.model, replace(population, point=np.clip(point, 0.0, 1.0)))
        return population.updated(inside & self._accepts(population, proposal, log_ratio), proposal)

    def _move_buildings(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """Redraw one, two or all buildings; sqrt(1 - b^2) z + b xi is standard normal if z and xi are."""
        building_of, random = self.model.building_of, self.random
        count, width = population.deviation.shape
        number = int(building_of.max()) + 1
        one, other = (building_of == random.integers(0, number, (count, 1)) for _ in range(2))
        selected = one | (other & (random.random((count, 1)) < 0.4))
        length = np.where(selected, random.choice([0.5, 1.0], (count, 1)), 0.0)
        all_buildings = random.random(count) < 0.25
        adapted = np.minimum(lengths.buildings * np.exp(0.4 * random.standard_normal((count, 1))), 1.0)
        length = np.where(all_buildings[:, None], adapted, length)
        normal = random.standard_normal((count, width))
        deviation = np.sqrt(1.0 - length**2) * population.deviation + length * normal
        proposal = self._differing(population, replace(population, deviation=deviation))
        accepted = self._accepts(population, proposal)
        buildings = _adapted(lengths.buildings, accepted[all_buildings & (population.spread > 0)], 1.0)
        return population.updated(accepted, proposal), replace(lengths, buildings=buildings)

    def _redraw_all_buildings(self, population: _Population) -> _Population:
        """Propose spread and deviations from their prior: buildings become alike, differ, or differ by more or less."""
        count = len(population.spread)
        proposal = replace(
            population,
            spread=self.model.draw_spread(count, self.random),
            deviation=self.random.standard_normal(population.deviation.shape),
        )
        either = (population.spread > 0) | (proposal.spread > 0)
        proposal = self._evaluated_where(either, population, proposal)
        return population.updated(self._accepts(population, proposal), proposal)

    def _interweave(self, population: _Population) -> _Population:
        """Redraw spread and means given the buildings' constants; path loss does not change."""
        if self.model.spread is None:
            population = _redraw_spread(population, self.random)
        for index in self.model.only_buildings.tolist():
            population = self._redraw_mean(population, index)
        return population

    def _redraw_mean(self, population: _Population, index: int) -> _Population:
        """Given k buildings, log x is normal about their mean logarithm with deviation s / sqrt(k), times the prior."""
        parameters, columns = self.model.parameters, self.model.parameter_of == index
        values, spread = parameters.from_unit(population.point), population.spread
        differing = spread > 0
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
        log_prior = self.model.log_prior(point)
        # A prior flat in the search coordinate u has the density x / (dx / du) in log x.
        slope_after = parameters.search_slope(moved)[:, index]
        slope_before = parameters.search_slope(values)[:, index]
        change = after - before - np.log(slope_after / slope_before) + log_prior - population.log_prior
        accepted = inside & differing & (-self.random.standard_exponential(len(spread)) < change)
        deviation = population.deviation.copy()
        deviation[:, columns] = (constants - after[:, None]) / np.where(differing, spread, 1.0)[:, None]
        return population.updated(
            accepted, replace(population, point=point, deviation=deviation, log_prior=log_prior)
        )

    def _redraw_models(self, population: _Population) -> _Population:
        """Redraw the noise model of every member from its conditional probabilities."""
        by_model = self.model.marginal.densities(population.gap)
        by_model = np.where(np.isfinite(by_model), by_model, NEVER)
        # The largest of log weights plus Gumbel numbers is a draw by these weights.
        model = np.argmax(self.power * by_model + self.random.gumbel(size=by_model.shape), axis=1)
        return replace(population, model=model, log_likelihood=by_model[np.arange(len(model)), model])

    def _differing(self, population: _Population, proposal: _Population) -> _Population:
        """The proposal, evaluated where buildings differ."""
        return self._evaluated_where(population.spread > 0, population, proposal)

    def _evaluated_where(
        self, changed: NDArray[np.bool_], population: _Population, proposal: _Population
    ) -> _Population:
        """The proposal, evaluated for the members whose path loss changes [n]."""
        rows = np.flatnonzero(changed)
        if not len(rows):
            return proposal
        part = _evaluated(self.model, proposal.selected(rows))
        gap, log_likelihood = population.gap.copy(), population.log_likelihood.copy()
        gap[rows], log_likelihood[rows] = part.gap, part.log_likelihood
        return replace(proposal, gap=gap, log_likelihood=log_likelihood)

    def _accepts(
        self, population: _Population, proposal: _Population, log_ratio: float | NDArray[np.float64] = 0.0
    ) -> NDArray[np.bool_]:
        """Metropolis-Hastings rule [n]; minus an exponential number is the logarithm of a uniform one."""
        change = self.power * (proposal.log_likelihood - population.log_likelihood)
        change += proposal.log_prior - population.log_prior + log_ratio
        return np.asarray(-self.random.standard_exponential(len(change)) < change)


def _redraw_spread(population: _Population, random: np.random.Generator) -> _Population:
    """Draw the spread from p(s | s z) = exp(-s / mean) s^-c exp(-(s z)^2 / 2 s^2), on a logarithmic grid."""
    grid = np.geomspace(*SPREAD_BOUNDS, SPREAD_GRID)
    square = np.sum((population.spread[:, None] * population.deviation) ** 2, axis=1)
    width = population.deviation.shape[1]
    # The width of a grid cell adds a factor s.
    log_density = -grid / MEAN_SPREAD - (width - 1) * np.log(grid) - 0.5 * square[:, None] / grid**2
    spread = grid[np.argmax(log_density + random.gumbel(size=log_density.shape), axis=1)]
    spread = np.where(population.spread > 0, spread, 0.0)
    ratio = population.spread / np.where(spread > 0, spread, 1.0)
    deviation = np.where((spread > 0)[:, None], population.deviation * ratio[:, None], population.deviation)
    return replace(population, spread=spread, deviation=deviation)


def _next_power(log_likelihood: NDArray[np.float64], power: float) -> float:
    """The largest power that leaves the share `EFFECTIVE` of the members effective, by bisection."""

    def effective_share(other: float) -> float:
        weight = _weights((other - power) * log_likelihood)
        return float(1.0 / np.sum(weight**2)) / len(log_likelihood)

    if effective_share(1.0) >= EFFECTIVE:
        return 1.0
    low, high = power, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_share(middle) >= EFFECTIVE else (low, middle)
    return max(low, power + 1e-9)


def _weights(logarithm: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = np.exp(logarithm - logarithm.max())
    return weight / weight.sum()


def _adapted(length: float, accepted: NDArray[np.bool_], longest: float) -> float:
    """The length of moves after some were accepted or not."""
    if not len(accepted):
        return length
    return float(np.clip(length * np.exp(0.5 * (accepted.mean() - ACCEPTANCE)), 0.02, longest))
