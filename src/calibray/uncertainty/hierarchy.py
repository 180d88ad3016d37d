"""Draws of materials' means together with what every building has of its own, and with how much buildings differ.

Walls of building b have the constants x exp(s z_b): x is the material's mean, z_b normal, and the spread s exponential
beforehand. What links tell of all three at once is drawn by tempering (sequential Monte Carlo: P. Del Moral, A. Doucet
and A. Jasra, J. Royal Statistical Society B 68, 2006): a population of draws of a flat density follows it while the
links count more and more, each time by as much as leaves half of the population effective. In between, draws move:

- buildings, one, two or all of them, are drawn anew about what they were (S. L. Cotter, G. O. Roberts, A. M. Stuart and
  D. White, Statistical Science 28, 2013);
- means and the spread follow from the buildings, whose constants stay as they are, so that path loss does as well and
  nothing is replayed (interweaving: Y. Yu and X.-L. Meng, J. Computational and Graphical Statistics 20, 2011);
- a mean, at times others with it, moves as two others of the population differ (C. J. F. ter Braak, Statistics and
  Computing 16, 2006).

Weights scatter by what buildings have of their own, however good a mean is: chosen by these in full, a large population
that moves little ends in a few narrow places by chance. So a small one moves often, is chosen by the roots of its
weights, the rest being left to moves, and draws are kept while it moves on in the end.

Each draw has a model of the noise of its own, drawn at every step from what the models tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.parameters import NO_PRIOR, LogNormal, Parameters
from calibray.uncertainty.importance_sampling import Draws, systematic
from calibray.uncertainty.noise_models import DIFFERING, GAUSSIAN, Marginal, NoiseModel
from calibray.uncertainty.quadratic_forms import Forms

SPREAD: Final = 0.15
"""Mean of the spread between buildings, beforehand: the middle one of those that models of the noise try."""

LEAST: Final = 0.004
"""The least spread, which is as good as none."""

MOST: Final = 0.8
"""The largest."""

PLACES: Final = 64
"""Spreads between these that are told apart."""

FIRST: Final = 0.1
"""Power of the density that the population starts from."""

EFFECTIVE: Final = 0.5
"""Share of the population that each step is to leave effective."""

STEPS: Final = 30
"""Steps after which the density stays as flat as it is."""

KEPT: Final = 8
"""Sweeps of the last step after which draws are kept."""

POWER: Final = 0.5
"""Power of the weights that the population is chosen by: 1 were right for draws that do not move."""

ACCEPTED: Final = 0.25
"""Share of moves that is to be accepted: their lengths follow it."""

JITTER: Final = 1e-4
"""Size of what is added to differences of others, so that no place is out of reach."""

TINY: Final = 1e-30
"""What stands for a constant of 0, whose factors change nothing."""

NEVER: Final = -1e300
"""Logarithm of a density that is none."""

Gaps = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Points of the unit cube [n, d], and logarithms of the factors of buildings' constants [n, c], to measured minus
modelled path loss, times the roots of the weights [n, m], [dB]."""


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Means, buildings, and what links tell of them.

    Attributes:
        parameters: The parameters d.
        owner: The parameter that each building's constant stands in for [c].
        building: Its building, from 0 [c].
        centred: Parameters whose constants are all those of buildings, so that these tell the mean [d].
        gaps: What path loss is missing where buildings have constants of their own.
        marginal: Density of the gaps, its models those of `besides`.
        priors: Priors of the parameters.
        spread: Spread between buildings where it is known; None where it is not.
    """

    parameters: Parameters
    owner: NDArray[np.int64]
    building: NDArray[np.int64]
    centred: NDArray[np.bool_]
    gaps: Gaps
    marginal: Marginal
    priors: LogNormal = NO_PRIOR
    spread: float | None = None

    @cached_property
    def forms(self) -> Forms:
        """What the models of the noise take for gaps each of which has one of them."""
        return Forms.of(self.marginal)

    def stated(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm of the priors that are stated, at points [n, d], but for a constant [n]."""
        if not len(self.priors):
            return np.zeros(len(point))
        return -0.5 * np.sum(self.priors.residuals(self.parameters.from_unit(point)) ** 2, axis=1)


@dataclass(frozen=True, eq=False)
class _Population:
    """Draws.

    Attributes:
        point: Means, in the unit cube [n, d].
        own: What buildings have of their own, normal beforehand [n, c].
        spread: Spread between buildings [n].
        model: Model of the noise [n].
        gap: Measured minus modelled path loss [n, m], [dB].
        told: Logarithm of the density of the links under that model, and of stated priors [n].
    """

    point: NDArray[np.float64]
    own: NDArray[np.float64]
    spread: NDArray[np.float64]
    model: NDArray[np.int64]
    gap: NDArray[np.float64]
    told: NDArray[np.float64]

    def chosen(self, index: NDArray[np.intp]) -> _Population:
        return _Population(*(part[index] for part in self._parts()))

    def moved(self, accepted: NDArray[np.bool_], other: _Population) -> _Population:
        """Those of another population where its draws are accepted [n]."""
        pairs = zip(self._parts(), other._parts(), strict=True)
        return _Population(
            *(np.where(accepted.reshape(-1, *(1,) * (old.ndim - 1)), new, old) for old, new in pairs)
        )

    def _parts(self) -> tuple[NDArray, ...]:
        return self.point, self.own, self.spread, self.model, self.gap, self.told


@dataclass(frozen=True)
class _Lengths:
    """Lengths of moves, which follow how many are accepted.

    Attributes:
        anew: Share that all buildings are drawn anew by, 1 for all of what they have of their own.
        means: Length of moves of means, by that which is right for a normal density.
    """

    anew: float = 0.5
    means: float = 1.0


def besides(models: Sequence[NoiseModel], tried: Sequence[NoiseModel]) -> tuple[NoiseModel, ...]:
    """What errors may be besides what buildings do.

    Args:
        models: The models of noise that were not negligible where all buildings are alike.
        tried: All models that were tried.

    Returns:
        Those in which materials do not differ, and those of independent errors, for these may explain what is left
        once buildings do the rest.

    Example:
        >>> tried = (NoiseModel("gaussian", 0.2), NoiseModel("student-t", 0.4), NoiseModel("heterogeneous", 0.4))
        >>> [model.kind for model in besides(tried[2:], tried)]
        ['gaussian']
    """
    found = [model for model in models if model.kind != DIFFERING]
    for kind in (GAUSSIAN, DIFFERING):
        for model in tried:
            if model.kind == kind and not any(_plain(other, model.offset) for other in found):
                found.append(NoiseModel(GAUSSIAN, model.weight, offset=model.offset))
    return tuple(found)


def _plain(model: NoiseModel, offset: bool) -> bool:
    """Whether a model is that of independent errors, with an offset or without."""
    return model.kind == GAUSSIAN and model.offset == offset


def hierarchical(hierarchy: Hierarchy, alike: Draws, count: int, sweeps: int, seed: int = 0) -> Draws:
    """Draw means over all buildings, of which the links lean on some.

    Args:
        hierarchy: What links tell of means and buildings.
        alike: Draws of the means, in the search space, where all buildings are alike.
        count: Number of draws that move; each is kept after each of the last sweeps.
        sweeps: Times that every draw is moved in each way, at each step.
        seed: Seed of the random numbers.

    Returns:
        Draws of equal weight; flattened where so many steps did not lead to the posterior itself.
    """
    random, parameters = np.random.default_rng(seed), hierarchy.parameters
    start = alike.tempered(1.0 / FIRST).resampled(count, seed)
    population, weight = _first(hierarchy, parameters.to_unit(parameters.from_search(start)), random)
    power, steps, lengths = FIRST, 0, _Lengths()
    while True:
        population = population.chosen(random.permutation(systematic(weight, count, random)))
        population = _with_models(hierarchy, population, power, random)
        moves, passed = _Moves(hierarchy, power, random), [population]
        for _ in range(sweeps):
            population, lengths = moves.swept(population, lengths)
            passed.append(population)
        steps += 1
        if power == 1.0 or steps == STEPS:
            point, told = (
                np.concatenate([getattr(each, name) for each in passed[-min(KEPT, max(sweeps, 1)) :]])
                for name in ("point", "told")
            )
            point = parameters.to_search(parameters.from_unit(point))
            return Draws(point, told, np.full(len(told), 1.0 / len(told)), power < 1.0)
        before, power = power, _next(population.told, power)
        weight = _weights(POWER * (power - before) * population.told)


def _first(
    hierarchy: Hierarchy, point: NDArray[np.float64], random: np.random.Generator
) -> tuple[_Population, NDArray[np.float64]]:
    """Buildings as they may be beforehand about means that explain links where they are alike, and weights."""
    count, none = len(point), np.zeros((len(point), len(hierarchy.owner)))
    spread = np.full(count, hierarchy.spread or 0.0)
    if hierarchy.spread is None:
        spread = np.clip(random.exponential(SPREAD, count), LEAST, MOST)
    gap = hierarchy.gaps(point, none)
    alike = _Population(point, none, spread, np.zeros(count, dtype=np.int64), gap, np.zeros(count))
    alike = _with_models(hierarchy, alike, FIRST, random)
    population = _asked(hierarchy, replace(alike, own=random.standard_normal(none.shape)))
    return population, _weights(FIRST * (population.told - alike.told))


def _asked(hierarchy: Hierarchy, population: _Population) -> _Population:
    """The same with what links tell of it."""
    gap = hierarchy.gaps(population.point, population.spread[:, None] * population.own)
    told = hierarchy.forms.densities(gap, population.model) + hierarchy.stated(population.point)
    return replace(population, gap=gap, told=np.where(np.isfinite(told), told, NEVER))


def _with_models(
    hierarchy: Hierarchy, population: _Population, power: float, random: np.random.Generator
) -> _Population:
    """A model of the noise for every draw, from what all of them tell."""
    each = hierarchy.marginal.densities(population.gap)
    each = np.where(np.isfinite(each), each, NEVER)
    model = np.argmax(power * each + random.gumbel(size=each.shape), axis=1)
    told = each[np.arange(len(model)), model] + hierarchy.stated(population.point)
    return replace(population, model=model, told=np.maximum(told, NEVER))


@dataclass(frozen=True, eq=False)
class _Moves:
    """Moves of draws that leave their density as it is: what is known beforehand, and of the links to a power.

    Attributes:
        hierarchy: What links tell.
        power: The power.
        random: Random numbers.
    """

    hierarchy: Hierarchy
    power: float
    random: np.random.Generator

    def swept(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """Every draw moved in each way."""
        for move in (self._anew, self._along_others, self._along_others):
            population, lengths = move(population, lengths)
            population = self._centred(population)
        return population, lengths

    def _anew(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """One building, two, or all drawn anew about what they were: sqrt(1 - b^2) z + b xi is as normal as z was."""
        count, width = population.own.shape
        number = int(self.hierarchy.building.max()) + 1
        one, other = (
            self.hierarchy.building == self.random.integers(0, number, (count, 1)) for _ in range(2)
        )
        some = one | (other & (self.random.random((count, 1)) < 0.4))
        share = np.where(some, self.random.choice([0.5, 1.0], (count, 1)), 0.0)
        whole = self.random.random(count) < 0.25
        length = np.minimum(lengths.anew * np.exp(0.4 * self.random.standard_normal((count, 1))), 1.0)
        share = np.where(whole[:, None], length, share)
        own = np.sqrt(1.0 - share**2) * population.own + share * self.random.standard_normal((count, width))
        found = _asked(self.hierarchy, replace(population, own=own))
        accepted = _chance(count, self.random) < self.power * (found.told - population.told)
        anew = _adapted(lengths.anew, accepted[whole], 1.0)
        return population.moved(accepted, found), replace(lengths, anew=anew)

    def _along_others(self, population: _Population, lengths: _Lengths) -> tuple[_Population, _Lengths]:
        """A mean, at times others with it, moved as two others of the population differ; half of the time in full."""
        count, width = population.point.shape
        turn = self.random.choice(np.arange(1, count), 2, replace=False)
        first, second = ((np.arange(count) + each) % count for each in turn)
        moving = self.random.random((count, width)) < self.random.choice([0.0, 0.0, 0.5], (count, 1))
        moving[np.arange(count), self.random.integers(0, width, count)] = True
        size = lengths.means * 2.38 / np.sqrt(2.0 * moving.sum(axis=1, keepdims=True))
        size = size * np.exp(0.4 * self.random.standard_normal((count, 1)))
        full = self.random.random((count, 1)) < 0.5
        apart = np.where(full, 1.0, size) * (population.point[first] - population.point[second])
        place = population.point + moving * (apart + JITTER * self.random.standard_normal((count, width)))
        inside = ((place >= 0.0) & (place <= 1.0)).all(axis=1)
        found = _asked(self.hierarchy, replace(population, point=np.clip(place, 0.0, 1.0)))
        accepted = inside & (_chance(count, self.random) < self.power * (found.told - population.told))
        means = _adapted(lengths.means, accepted[~full[:, 0]], 2.0)
        return population.moved(accepted, found), replace(lengths, means=means)

    def _centred(self, population: _Population) -> _Population:
        """Spread and means drawn from buildings' constants, which stay as they are, and with them path loss."""
        if self.hierarchy.spread is None:
            population = _spread_anew(population, self.random)
        for index in np.flatnonzero(self.hierarchy.centred).tolist():
            population = self._mean_anew(population, index)
        return population

    def _mean_anew(self, population: _Population, index: int) -> _Population:
        """For k buildings log x is normal about the mean of their logarithms, by s / sqrt(k), but for what is known."""
        parameters, mine = self.hierarchy.parameters, self.hierarchy.owner == index
        values, spread = parameters.from_unit(population.point), population.spread
        before = np.log(np.maximum(values[:, index], TINY))
        buildings = before[:, None] + spread[:, None] * population.own[:, mine]
        after = buildings.mean(axis=1) + spread / np.sqrt(mine.sum()) * self.random.standard_normal(
            len(spread)
        )
        moved = values.copy()
        moved[:, index] = np.exp(after)
        inside = (moved[:, index] >= parameters.lower[index]) & (moved[:, index] <= parameters.upper[index])
        moved[:, index] = np.clip(moved[:, index], parameters.lower[index], parameters.upper[index])
        place = population.point.copy()
        place[:, index] = parameters.to_unit(moved)[:, index]
        # Flat in the search space, whose density by log x is x / (dx / du).
        known = self.hierarchy.stated(place) - self.hierarchy.stated(population.point)
        flat = (
            after
            - before
            - np.log(parameters.search_slope(moved)[:, index] / parameters.search_slope(values)[:, index])
        )
        accepted = inside & (_chance(len(spread), self.random) < flat + self.power * known)
        own = population.own.copy()
        own[:, mine] = (buildings - after[:, None]) / spread[:, None]
        return population.moved(
            accepted, replace(population, point=place, own=own, told=population.told + known)
        )


def _spread_anew(population: _Population, random: np.random.Generator) -> _Population:
    """p(s | s z) = exp(-s / mean) s^-c exp(-(s z)^2 / 2 s^2), drawn among places that are as far apart in logarithm."""
    places = np.geomspace(LEAST, MOST, PLACES)
    square = np.sum((population.spread[:, None] * population.own) ** 2, axis=1)
    width = population.own.shape[1]
    density = -places / SPREAD - (width - 1) * np.log(places) - 0.5 * square[:, None] / places**2
    found = places[np.argmax(density + random.gumbel(size=density.shape), axis=1)]
    own = population.own * (population.spread / found)[:, None]
    return replace(population, spread=found, own=own)


def _next(told: NDArray[np.float64], power: float) -> float:
    """The next power: as much more as leaves a share of the draws effective."""

    def effective(other: float) -> float:
        weight = _weights((other - power) * told)
        return float(1.0 / np.sum(weight**2)) / len(told)

    if effective(1.0) >= EFFECTIVE:
        return 1.0
    low, high = power, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= EFFECTIVE else (low, middle)
    return high


def _weights(logarithm: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = np.exp(logarithm - logarithm.max())
    return weight / weight.sum()


def _chance(count: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Logarithms of numbers that are even between 0 and 1 [n]."""
    return -random.standard_exponential(count)


def _adapted(length: float, accepted: NDArray[np.bool_], most: float) -> float:
    """The length of moves, after some of them were accepted."""
    if not len(accepted):
        return length
    return float(np.clip(length * np.exp(0.5 * (accepted.mean() - ACCEPTED)), 0.02, most))
