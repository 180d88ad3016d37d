"""Draws from the joint posterior by tempered sequential Monte Carlo.

A population is drawn from the prior, and follows the prior times a power of the likelihood as this power grows from 0
to 1 (P. Del Moral, A. Doucet and A. Jasra, J. Royal Statistical Society B 68, 2006). Each step raises the power until
the effective size of the population falls to half of its members, resamples the population, and moves its members
(`population_moves.py`).

We start with two independent populations, and double their number as long as one half of the populations disagrees with
the other and the budget permits. If the halves agree, each population is weighted by its estimate of the evidence,
which is unbiased. Small populations that disagree are replaced by larger ones if the calibration made enough RT calls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.uncertainty.draws import Draws, pooled, systematic_resampling
from calibray.uncertainty.joint_model import JointModel
from calibray.uncertainty.population_moves import TINY, Lengths, Moves, Population, evaluated

SIZE: Final = (64, 256)
"""Minimum and maximum number of members of a population."""

BUDGET: Final = 1_100_000_000
"""Number of interactions that may be evaluated for all populations together. With a budget 10 % smaller, the draws in
Auckland correspond to 392 to 422 independent draws (`benchmarks/certainty_cost.py --seeds 3`)."""

EVALUATIONS: Final = 100
"""Approximate number of evaluations per member: the number of steps times the number of moves per step."""

POPULATIONS: Final = (2, 4, 8)
"""Possible numbers of independent populations; the number is increased as long as the two halves disagree. If several
slab resonances fit the data, the mean of a population of 256 members varies by 0.2 posterior standard deviations. In
three development districts, two or four populations suffice for agreement in half of the true scenes."""

SWEEPS: Final = 4
"""Number of sweeps per step; a sweep applies each kind of move to every member. In a five-dimensional test with two
distant ranges, the weight of one range then varies by 0.03 between seeds, compared with 0.08 for 2 sweeps."""

LAST_SWEEPS: Final = (8, 48)
"""Minimum and maximum number of further sweeps at power 1. A population that the budget makes smaller gets more sweeps,
so that it provides as many draws as a larger one. For a small path program, the number of sweeps is as large as the
budget permits. The reference is a posterior from a million draws from the prior (`benchmarks/simulation_based.py
--reference`). In districts with 300 to 800 interactions, distribution functions after 8, 24 and 48 sweeps differ from
this reference by 0.053, 0.043 and 0.036. In Auckland, the widths of intervals differ between seeds by up to 13 % with 8
sweeps of 104 members, and by up to 8 % with 16 sweeps (`benchmarks/certainty_cost.py --seeds 3`)."""

KEPT: Final = 2
"""Number of sweeps at power 1 between two states of a member that are kept as draws."""

EFFECTIVE: Final = 0.5
"""Fraction of the population that stays effective when a step raises the power."""

MAX_STEPS: Final = 60
"""Maximum number of steps; the last step raises the power to 1, and most posteriors require 8 to 20 steps."""

APART: Final = 0.2
"""Independent populations agree if, for every parameter, their distribution functions differ by at most this distance.
Two sets of 256 independent draws differ by up to 0.12 in 19 of 20 cases; the members of one population are not quite
independent."""

APART_BY_CHANCE: Final = 2.0
"""Factor for the limit that replaces `APART` if populations are small: for halves with n members each, the limit is
this factor times sqrt(2 / n). For independent draws, a factor of 1.36 would give the 95 % point (Kolmogorov and
Smirnov)."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from the joint posterior.

    Attributes:
        means: Draws of the study's parameters in the search space; each value is the mean over all buildings.
        seen: The same draws for the buildings with which the paths interact: the geometric means of the constants of
            these buildings.
        joint: Points of the unit cube of all parameters [n, d + k].
        spread: Between-building spread [n] of every draw.
        model: Index [n] of the noise model of every draw.
        replays: Number of evaluations of path loss for the draws.
        shape: Number of populations, number of states per member kept as draws, and number of members per population.
        log_evidence: Logarithm of the probability density of the measurements averaged over the prior.
    """

    means: Draws
    seen: Draws
    joint: NDArray[np.float64]
    spread: NDArray[np.float64]
    model: NDArray[np.int64]
    replays: int = 0
    shape: tuple[int, int, int] = (0, 0, 0)
    log_evidence: float = 0.0


def joined(posteriors: Sequence[Posterior]) -> Posterior:
    """Draws from a mixture of several posteriors with equal weights."""
    return Posterior(
        pooled([each.means for each in posteriors]),
        pooled([each.seen for each in posteriors]),
        np.concatenate([each.joint for each in posteriors]),
        np.concatenate([each.spread for each in posteriors]),
        np.concatenate([each.model for each in posteriors]),
        sum(each.replays for each in posteriors),
        (sum(each.shape[0] for each in posteriors), *posteriors[0].shape[1:]),
        float(np.logaddexp.reduce([each.log_evidence for each in posteriors])) - np.log(len(posteriors)),
    )


def population_size(interactions: int, budget: int = BUDGET, models: int = 1) -> int:
    """Number of members in each of two populations, for a given budget and number of interactions per evaluation.

    Draws of several models are pooled with equal weight, so each model requires fewer members.

    Example:
        >>> population_size(1_000), population_size(50_000), population_size(1_000, models=8)
        (256, 110, 64)
    """
    fewest, most = SIZE[0], max(SIZE[0], SIZE[1] // models)
    return int(np.clip(budget // models // (2 * EVALUATIONS * interactions), fewest, most))


def last_sweeps(interactions: int, budget: int = BUDGET, models: int = 1) -> int:
    """Number of sweeps at power 1 for each population; the arguments are those of `population_size`.

    Example:
        >>> last_sweeps(1_000), last_sweeps(8_000), last_sweeps(50_000), last_sweeps(1_000, models=8)
        (48, 21, 18, 8)
    """
    size, full = population_size(interactions, budget, models), max(SIZE[0], SIZE[1] // models)
    affordable = budget // models / (2 * EVALUATIONS * interactions * size)
    most = max(LAST_SWEEPS[0], LAST_SWEEPS[1] // models)
    return int(np.clip(LAST_SWEEPS[0] * max(full / size, affordable), LAST_SWEEPS[0], most))


def draw_posterior(
    model: JointModel,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    budget: int = BUDGET,
    models: int = 1,
    largest_budget: int = 0,
) -> Posterior:
    """Draw from the joint posterior.

    After every step, `progress` is called with the completed fraction of the work. The budget is the number of
    interactions that may be evaluated. If the draws of several models are pooled, these models share the budget. If
    populations disagree and the budget makes them small, larger populations are drawn with `largest_budget` instead.
    """
    posterior = _draw_populations(model, seed, progress, budget, models)
    sizes = [population_size(model.interactions, each, models) for each in (budget, largest_budget)]
    if posterior.means.agree or sizes[1] <= sizes[0]:
        return posterior
    larger = _draw_populations(model, seed, progress, largest_budget, models)
    return replace(larger, replays=posterior.replays + larger.replays)


def _draw_populations(
    model: JointModel, seed: int, progress: Callable[[float], None] | None, budget: int, models: int
) -> Posterior:
    size = population_size(model.interactions, budget, models)
    sweeps = last_sweeps(model.interactions, budget, models)
    replays, budget = 0, budget // models

    def counted(points: NDArray[np.float64], logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal replays
        replays += len(points)
        return gaps(points, logarithms)

    gaps, model = model.gaps, replace(model, gaps=counted)
    populations: list[Population] = []
    evidences: list[float] = []
    agree = False
    for total in POPULATIONS:
        if populations and (agree or total * EVALUATIONS * model.interactions * size > budget):
            break
        for number in range(len(populations), total):

            def stepped(share: float, number: int = number) -> None:
                if progress is not None:
                    progress((number % 2 + share) / 2)

            # A population does not depend on the number of other populations.
            random = np.random.default_rng([seed, number])
            population, evidence = _anneal(model, size, sweeps, random, stepped)
            populations.append(population)
            evidences.append(evidence)
        half = total // 2
        distance = _distance(model, [_together(populations[:half]), _together(populations[half:])])
        agree = distance < max(APART, APART_BY_CHANCE * float(np.sqrt(2.0 / (size * half))))
    members = len(populations[0].spread)
    # Populations that disagree are weighted equally, because their estimates of the evidence are unreliable.
    share = _weights(np.array(evidences)) if agree else np.full(len(populations), 1.0 / len(populations))
    posterior = _posterior(model, _together(populations), np.repeat(share, members) / members, agree)
    # Noise models were drawn uniformly, but the likelihood contains their weights.
    log_evidence = float(np.logaddexp.reduce(evidences)) - np.log(len(evidences) / len(model.marginal.models))
    shape = (len(populations), members // size, size)
    return replace(posterior, replays=replays, shape=shape, log_evidence=log_evidence)


def _together(populations: Sequence[Population]) -> Population:
    return Population(*map(np.concatenate, zip(*(each.parts() for each in populations), strict=True)))


def _distance(model: JointModel, populations: list[Population]) -> float:
    """Largest distance, over the study's parameters, between the distribution functions in two populations."""
    first, second = (each.point[:, : len(model.study)] for each in populations)
    distance = 0.0
    for one, other in zip(first.T, second.T, strict=True):
        # This is the Kolmogorov-Smirnov statistic.
        every = np.sort(np.concatenate([one, other]))
        shares = (np.searchsorted(np.sort(each), every, side="right") / len(each) for each in (one, other))
        distance = max(distance, float(np.abs(np.subtract(*shares)).max()))
    return distance


def _posterior(model: JointModel, members: Population, weight: NDArray[np.float64], agree: bool) -> Posterior:
    study, width = model.study, len(model.study)
    values = model.parameters.from_unit(members.point)[:, :width]
    density = members.log_likelihood + members.log_prior
    seen = np.log(np.maximum(values, TINY))
    # The geometric mean over buildings is the mean of all buildings times exp(mean of s z).
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
    model: JointModel, size: int, last: int, random: np.random.Generator, stepped: Callable[[float], None]
) -> tuple[Population, float]:
    """Members of a population after the power of the likelihood has been raised from 0 to 1, and the log evidence.

    The states of the members during `last` sweeps at power 1 are kept. `stepped` is called with the completed fraction
    of the work, which is one half when the power reaches 1.
    """
    point = model.draw_prior(size, random)
    deviation = random.standard_normal((size, len(model.parameter_of)))
    # Draw noise models uniformly: the likelihood contains their weights, so both are raised to the same power.
    models = random.integers(0, len(model.marginal.models), size)
    empty = np.zeros(size)
    population = Population(
        point,
        deviation,
        model.draw_spread(size, random),
        models,
        np.zeros((size, len(model.marginal.column) + sum(count for count, _, _ in model.observed))),
        empty,
        empty,
    )
    population = evaluated(model, population)
    power, evidence, lengths, moves = 0.0, 0.0, Lengths(), Moves(model, 0.0, random)
    for step in range(MAX_STEPS):
        before, power = power, _next_power(population.log_likelihood, power)
        if step == MAX_STEPS - 1:
            power = 1.0
        rise = (power - before) * population.log_likelihood
        # The log evidence grows by the logarithm of the mean of likelihood^rise, the ratio of successive normalizing
        # constants.
        evidence += float(np.logaddexp.reduce(rise)) - np.log(size)
        # Moves use differences between members at fixed index distances, so copies of a member must not be neighbours.
        population = population.selected(
            random.permutation(systematic_resampling(_weights(rise), size, random))
        )
        moves = Moves(model, power, random)
        population = moves.redraw_categories(population)
        for _ in range(SWEEPS):
            population, lengths = moves.sweep(population, lengths)
        population = moves.redraw_categories(population)
        stepped(0.5 * power)
        if power == 1.0:
            break
    kept, groups = [], last // KEPT
    for group in range(groups):
        for _ in range(KEPT):
            population, lengths = moves.sweep(population, lengths)
        population = moves.redraw_categories(population)
        kept.append(population.without_gaps())
        stepped(0.5 + 0.5 * (group + 1) / groups)
    return _together(kept), evidence


def _next_power(log_likelihood: NDArray[np.float64], power: float) -> float:
    """The largest power for which a fraction `EFFECTIVE` of the members stays effective, found by bisection."""

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
