"""Moves of a population's members that leave the prior times a power of the likelihood invariant.

- One or more parameters move along the difference between two other members (C. J. F. ter Braak, Statistics and
  Computing 16, 2006).
- One parameter is redrawn from the smoothed density of its values in the population. Because of reflections inside
  walls, several narrow ranges of permittivity can fit, and this move can take a member to any of them.
- The constants of one, two or all buildings are redrawn around their current values (S. L. Cotter, G. O. Roberts, A. M.
  Stuart and D. White, Statistical Science 28, 2013).
- The between-building spread and the constants of all buildings are redrawn from their prior. The buildings then become
  equal or different.
- Means and spread are redrawn given the buildings' constants. The constants and therefore path loss stay the same, so
  no replay is needed (interweaving: Y. Yu and X.-L. Meng, J. Computational and Graphical Statistics 20, 2011).
- The noise model is redrawn given the errors.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.uncertainty.joint_model import MEAN_SPREAD, SPREAD_BOUNDS, JointModel

SPREAD_GRID: Final = 64
"""Number of points of the logarithmic grid from which the spread is drawn."""

ACCEPTANCE: Final = 0.25
"""Target acceptance rate, which determines the lengths of moves. It is near 0.234, the optimum for random walks
(G. O. Roberts, A. Gelman and W. R. Gilks, Annals of Applied Probability 7, 1997)."""

JITTER: Final = 1e-4
"""Standard deviation of the random displacement that is added to moves along differences so that every point can be
reached."""

NEIGHBOURHOOD: Final = 32
"""On average, the range of one kernel width on either side contains a fraction 1 / `NEIGHBOURHOOD` of the
population."""

TINY: Final = 1e-30
"""Value that replaces a constant of 0 in logarithms; multiplying a constant of 0 by a factor has no effect."""

NEVER: Final = -1e300
"""Finite replacement for a log density of minus infinity."""


@dataclass(frozen=True, eq=False)
class Population:
    """Members of a population.

    Attributes:
        point: Points of the unit cube [n, d + k].
        deviation: Standardized deviations z [n, c] of the buildings' constants.
        spread: Between-building spread [n].
        model: Index of the noise model [n].
        gap: Weighted difference between measured and modelled path loss [n, m], [dB].
        log_likelihood: Log density [n] of the links under the noise model.
        log_prior: Log prior density [n] of the points.
    """

    point: NDArray[np.float64]
    deviation: NDArray[np.float64]
    spread: NDArray[np.float64]
    model: NDArray[np.int64]
    gap: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    log_prior: NDArray[np.float64]

    def selected(self, index: NDArray[np.intp]) -> Population:
        """The members with these indices."""
        return Population(*(part[index] for part in self.parts()))

    def updated(self, accepted: NDArray[np.bool_], proposal: Population) -> Population:
        """The population after accepted proposals, marked by a mask [n], have replaced the current members."""
        return Population(
            *(
                np.where(accepted.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
                for old, new in zip(self.parts(), proposal.parts(), strict=True)
            )
        )

    def without_gaps(self) -> Population:
        """The members without the gaps, which occupy most of the memory."""
        return replace(self, gap=self.gap[:, :0])

    def parts(self) -> tuple[NDArray, ...]:
        """The members' arrays, in the order of the attributes."""
        return tuple(getattr(self, attribute.name) for attribute in fields(self))


@dataclass(frozen=True)
class Lengths:
    """Lengths of moves, adapted to their acceptance rates.

    Attributes:
        buildings: Length of a move of all buildings; if 1, the draws are independent of the current values.
        points: Length of a move along a difference, relative to the optimum for a normal density.
    """

    buildings: float = 0.5
    points: float = 1.0


def evaluated(model: JointModel, population: Population) -> Population:
    """The population with recomputed gaps and densities."""
    gap = model.gaps(population.point, population.spread[:, None] * population.deviation)
    log_likelihood = model.densities(gap, population.model)
    log_likelihood = np.where(np.isfinite(log_likelihood), log_likelihood, NEVER)
    return replace(
        population, gap=gap, log_likelihood=log_likelihood, log_prior=model.log_prior(population.point)
    )


@dataclass(frozen=True, eq=False)
class Moves:
    """Moves that leave the prior times a power of the likelihood invariant.

    Attributes:
        model: The joint model.
        power: The power.
        random: The random number generator.
    """

    model: JointModel
    power: float
    random: np.random.Generator

    def sweep(self, population: Population, lengths: Lengths) -> tuple[Population, Lengths]:
        """Apply each kind of move to every member, except the moves of `redraw_categories`."""
        population, lengths = self._move_points(population, lengths)
        if len(self.model.parameter_of):
            population, lengths = self._move_buildings(population, lengths)
            population = self._interweave(population)
        return self._redraw_coordinate(population), lengths

    def redraw_categories(self, population: Population) -> Population:
        """Redraw the noise models, and whether buildings differ."""
        population = self._redraw_models(population)
        if len(self.model.parameter_of) and self.model.spread is None:
            population = self._redraw_all_buildings(population)
        return population

    def _move_points(self, population: Population, lengths: Lengths) -> tuple[Population, Lengths]:
        """Move along the difference between two other members; one move in three uses the full difference."""
        random = self.random
        count, width = population.point.shape
        shift = random.choice(np.arange(1, count), 2, replace=False)
        first, second = (np.arange(count) + shift[0]) % count, (np.arange(count) + shift[1]) % count
        moving = random.random((count, width)) < random.choice([0.0, 0.5, 1.0], (count, 1))
        moving[np.arange(count), random.integers(0, width, count)] = True
        # 2.38 / sqrt(2 k) is the optimal length for k moving coordinates of a normal density (ter Braak).
        length = lengths.points * 2.38 / np.sqrt(2.0 * moving.sum(axis=1, keepdims=True))
        length = length * np.exp(0.4 * random.standard_normal((count, 1)))
        # The full difference between two modes moves a member from one to the other.
        full = random.random((count, 1)) < 1 / 3
        step = np.where(full, 1.0, length) * (population.point[first] - population.point[second])
        point = population.point + moving * (step + JITTER * random.standard_normal((count, width)))
        moved, accepted = self._at_points(population, point)
        points = _adapted(lengths.points, accepted[~full[:, 0]], 2.0)
        return moved, replace(lengths, points=points)

    def _redraw_coordinate(self, population: Population) -> Population:
        """Redraw one parameter from its density in the population, smoothed by Gaussian kernels of adapted width."""
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
            # The acceptance rule needs the proposal density at the current value and at the new value.
            both = np.concatenate([population.point[rows, index], value])
            density = np.mean(np.exp(-0.5 * ((both[:, None] - centre) / size) ** 2) / size, axis=1)
            with np.errstate(divide="ignore"):
                log_density = np.log(density).reshape(2, -1)
            log_ratio[rows], point[rows, index] = log_density[0] - log_density[1], value
        return self._at_points(population, point, log_ratio)[0]

    def _at_points(
        self, population: Population, point: NDArray[np.float64], log_ratio: float | NDArray[np.float64] = 0.0
    ) -> tuple[Population, NDArray[np.bool_]]:
        """The population after the points [n, d + k] were proposed, and the mask [n] of the accepted points."""
        inside = np.asarray(((point >= 0.0) & (point <= 1.0)).all(axis=1))
        proposal = self._evaluated_where(inside, population, replace(population, point=point))
        accepted = inside & self._accepts(population, proposal, log_ratio)
        return population.updated(accepted, proposal), accepted

    def _move_buildings(self, population: Population, lengths: Lengths) -> tuple[Population, Lengths]:
        """Redraw the constants of one, two or all buildings.

        If z and xi are standard normal, sqrt(1 - b^2) z + b xi is standard normal as well.
        """
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
        moved = replace(population, deviation=deviation)
        # If the spread is 0, deviations have no effect, so no replay is needed and every move is accepted.
        proposal = self._evaluated_where(population.spread > 0, population, moved)
        accepted = self._accepts(population, proposal)
        buildings = _adapted(lengths.buildings, accepted[all_buildings & (population.spread > 0)], 1.0)
        return population.updated(accepted, proposal), replace(lengths, buildings=buildings)

    def _redraw_all_buildings(self, population: Population) -> Population:
        """Propose spread and deviations from their prior, so that buildings become equal or differ by more or less."""
        count = len(population.spread)
        proposal = replace(
            population,
            spread=self.model.draw_spread(count, self.random),
            deviation=self.random.standard_normal(population.deviation.shape),
        )
        # The proposal density is the prior, so acceptance depends only on the likelihood.
        either = (population.spread > 0) | (proposal.spread > 0)
        proposal = self._evaluated_where(either, population, proposal)
        return population.updated(self._accepts(population, proposal), proposal)

    def _interweave(self, population: Population) -> Population:
        """Redraw spread and means given the buildings' constants; path loss does not change."""
        if self.model.spread is None:
            population = _redraw_spread(population, self.random)
        for index in self.model.only_buildings.tolist():
            population = self._redraw_mean(population, index)
        return population

    def _redraw_mean(self, population: Population, index: int) -> Population:
        """Redraw the mean x of a parameter over the buildings.

        The density of log x is the prior times a normal density about the mean of k buildings, with deviation s /
        sqrt(k).
        """
        parameters, columns = self.model.parameters, self.model.parameter_of == index
        values, spread = parameters.from_unit(population.point), population.spread
        differing = spread > 0
        before = np.log(np.maximum(values[:, index], TINY))
        # The logarithms of the buildings' constants do not change.
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
        # A prior that is flat in the search coordinate u has the density x / (dx / du) in log x.
        slope_after = parameters.search_slope(moved)[:, index]
        slope_before = parameters.search_slope(values)[:, index]
        change = after - before - np.log(slope_after / slope_before) + log_prior - population.log_prior
        accepted = inside & differing & (-self.random.standard_exponential(len(spread)) < change)
        deviation = population.deviation.copy()
        deviation[:, columns] = (constants - after[:, None]) / np.where(differing, spread, 1.0)[:, None]
        return population.updated(
            accepted, replace(population, point=point, deviation=deviation, log_prior=log_prior)
        )

    def _redraw_models(self, population: Population) -> Population:
        """Redraw the noise model of every member from its conditional probabilities."""
        by_model = self.model.densities_by_model(population.gap)
        by_model = np.where(np.isfinite(by_model), by_model, NEVER)
        # The index of the largest log weight plus Gumbel noise is a draw with these weights.
        model = np.argmax(self.power * by_model + self.random.gumbel(size=by_model.shape), axis=1)
        return replace(population, model=model, log_likelihood=by_model[np.arange(len(model)), model])

    def _evaluated_where(
        self, changed: NDArray[np.bool_], population: Population, proposal: Population
    ) -> Population:
        """The proposal, evaluated for the members in the mask `changed` [n]; the other members keep their densities."""
        rows = np.flatnonzero(changed)
        if not len(rows):
            return proposal
        part = evaluated(self.model, proposal.selected(rows))
        gap, log_likelihood, log_prior = (
            each.copy() for each in (population.gap, population.log_likelihood, population.log_prior)
        )
        gap[rows], log_likelihood[rows], log_prior[rows] = part.gap, part.log_likelihood, part.log_prior
        return replace(proposal, gap=gap, log_likelihood=log_likelihood, log_prior=log_prior)

    def _accepts(
        self, population: Population, proposal: Population, log_ratio: float | NDArray[np.float64] = 0.0
    ) -> NDArray[np.bool_]:
        """Metropolis-Hastings rule [n]; a negated exponential variate is the logarithm of a uniform variate."""
        change = self.power * (proposal.log_likelihood - population.log_likelihood)
        change += proposal.log_prior - population.log_prior + log_ratio
        return np.asarray(-self.random.standard_exponential(len(change)) < change)


def _redraw_spread(population: Population, random: np.random.Generator) -> Population:
    """Draw the spread from p(s | s z) = exp(-s / mean) s^-c exp(-(s z)^2 / 2 s^2), on a logarithmic grid."""
    grid = np.geomspace(*SPREAD_BOUNDS, SPREAD_GRID)
    square = np.sum((population.spread[:, None] * population.deviation) ** 2, axis=1)
    width = population.deviation.shape[1]
    # The width of a logarithmic grid cell adds a factor s.
    log_density = -grid / MEAN_SPREAD - (width - 1) * np.log(grid) - 0.5 * square[:, None] / grid**2
    spread = grid[np.argmax(log_density + random.gumbel(size=log_density.shape), axis=1)]
    spread = np.where(population.spread > 0, spread, 0.0)
    ratio = population.spread / np.where(spread > 0, spread, 1.0)
    deviation = np.where((spread > 0)[:, None], population.deviation * ratio[:, None], population.deviation)
    return replace(population, spread=spread, deviation=deviation)


def _adapted(length: float, accepted: NDArray[np.bool_], longest: float) -> float:
    """The length of moves, adapted to the acceptance rate."""
    if not len(accepted):
        return length
    return float(np.clip(length * np.exp(0.5 * (accepted.mean() - ACCEPTANCE)), 0.02, longest))
