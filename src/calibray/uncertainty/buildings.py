"""Paths whose buildings have walls of their own: what path loss they have, and what that means for estimates.

The building of every interaction follows from where it happens and from the scene's meshes (`scenes/buildings.py`).
With a material for each building, candidates are buildings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.observable import PATH_LOSS
from calibray.engines.replay import Replay
from calibray.fitting.problem import Problem
from calibray.materials import BOUNDS, Material
from calibray.parameters import Parameter, Parameters
from calibray.paths import Paths
from calibray.scenes import Scene, building_numbers, read_triangles
from calibray.uncertainty.hierarchy import Hierarchy, besides, hierarchical
from calibray.uncertainty.importance_sampling import Draws
from calibray.uncertainty.indirect_inference import (
    TRIED,
    Leaning,
    following,
    means_behind,
    overstated,
    spreads,
)
from calibray.uncertainty.likelihood import Explaining
from calibray.uncertainty.noise_models import NoiseModel

INTERACTIONS: Final = 30_000
"""Interactions beyond which buildings are not told apart: replays with constants of each one's own would be dear."""

FEWEST: Final = 2
"""Buildings below which none differs from another."""

DRAWN: Final = (64, 256)
"""Fewest and most draws that are moved."""

EVALUATED: Final = 6_000_000
"""Interactions that are evaluated for these: on larger programs fewer are moved."""

POPULATION: Final = 96
"""Means that are drawn together with what each building has."""

SWEEPS: Final = (4, 11)
"""Fewest and most times that these move at each step, which takes some 10,000 and 25,000 replays in all."""

SWEPT: Final = 100_000_000
"""Interactions that are evaluated while they do, about: of larger scenes they move less often."""

STEPS: Final = 8
"""Steps that it takes, about."""

FEW: Final = 8_300
"""Interactions beyond which even the fewest would be dear."""

JUDGED: Final = 24
"""Draws that tell how much too sure a density is that takes buildings as alike, for each spread."""

OTHERS: Final = 64
"""Other draws that those judged are told apart from."""

DIFFERENCE: Final = 1e-5
"""Relative difference of a constant that derivatives are taken by."""

LINEAR: Final = 48
"""Draws, at most, that derivatives by each building's constants are taken at."""

ANSWERS: Final = 5_000_000
"""Derivatives that are taken in all: of many buildings or links at fewer draws."""

KNOWN: Final = 9.0
"""Inverse variance of a prior as wide as a third of the range: it keeps what the data cannot tell within it."""


@dataclass(frozen=True, eq=False)
class Buildings:
    """A scene whose buildings have walls of their own.

    Attributes:
        alike: The study's own replay.
        engine: The replay; its parameters are a constant of one building each, or of what is no building.
        owner: Which of the study's parameters each of them stands in for [c].
        building: Its building, from 0; -1 for what is no building, as the ground [c].
    """

    alike: Replay
    engine: Replay
    owner: NDArray[np.int64]
    building: NDArray[np.int64]

    def factors(self, spread: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
        """Draw buildings.

        Args:
            spread: Standard deviations of the logarithm of a building's factor [n].
            seed: Seed of the random numbers.

        Returns:
            Factors of every constant, 1 of what is no building [n, c].
        """
        normal = np.random.default_rng(seed).standard_normal((len(spread), len(self.owner)))
        return np.exp(spread[:, None] * np.where(self.building >= 0, normal, 0.0))

    def slopes(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """How path loss follows each building's constants: by differences, for a reverse pass would take compiling.

        Args:
            candidates: Parameter values [n, d], in the fields' units, alike at all buildings.

        Returns:
            Derivatives by the logarithm of every constant [n, L, c], [dB].
        """
        count, width = len(candidates), len(self.owner)
        moved = np.concatenate([np.ones((1, width)), 1.0 + DIFFERENCE * np.eye(width)])
        loss = self.path_loss(np.repeat(candidates, width + 1, axis=0), np.tile(moved, (count, 1)))
        loss = loss.reshape(count, width + 1, -1)
        with np.errstate(invalid="ignore"):  # a link that is lost at both
            slope = (loss[:, 1:] - loss[:, :1]) / np.log1p(DIFFERENCE)
        return slope.transpose(0, 2, 1)

    def path_loss(self, means: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss where buildings differ.

        Args:
            means: Parameter values, in the fields' units [n, d].
            factors: Factors of every constant [n, c].

        Returns:
            Path loss [n, L], [dB].
        """
        possible = [BOUNDS[each.field] for each in self.engine.parameters]
        lower, upper = ([getattr(each, end) for each in possible] for end in ("lower", "upper"))
        return self.engine.path_loss(np.clip(means[:, self.owner] * factors, lower, upper))


@dataclass(frozen=True, eq=False)
class _Asked:
    """Points of the search space that are asked what buildings may have added to them.

    Attributes:
        explaining: The density that they come from.
        apart: The buildings.
        loss: Path loss there where all buildings are alike [n, L], [dB].
        leaning: What links tell there.
        followed: How estimates follow single buildings in straight lines [d, c].
    """

    explaining: Explaining
    apart: Buildings
    loss: NDArray[np.float64]
    leaning: Leaning
    followed: NDArray[np.float64]

    @classmethod
    def at(
        cls,
        explaining: Explaining,
        apart: Buildings,
        point: NDArray[np.float64],
        followed: NDArray[np.float64],
    ) -> _Asked:
        """Ask points [n, d]."""
        problem, marginal = explaining.problem, explaining.marginal
        parameters, rows = problem.parameters, explaining.scale / marginal.noise_db
        lower, upper = parameters.search_bounds
        candidates = parameters.from_search(point)
        loss, slope = apart.alike.path_loss_and_jacobian(candidates)
        by_unit = parameters.search_slope(candidates) * (upper - lower)
        slope = slope[:, explaining.counted] * by_unit[:, None, :] * rows[:, None]
        known = np.full((len(point), len(parameters) + marginal.design.shape[1]), KNOWN)
        known[:, len(parameters) :] = (marginal.ridge / marginal.noise_db) ** 2
        if len(problem.priors):
            stated = problem.priors.jacobian(candidates) * by_unit[:, None, :]
            known[:, : len(parameters)] += np.square(stated).sum(axis=1)
        unit, slope = (point - lower) / (upper - lower), np.where(np.isfinite(slope), slope, 0.0)
        return cls(
            explaining,
            apart,
            loss,
            Leaning(unit, slope, marginal.design / marginal.noise_db, known),
            followed,
        )

    def change(self, place: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """What buildings about means in the unit cube [n, d] change, rows in units of the noise [n, m]."""
        parameters = self.explaining.problem.parameters
        lower, upper = parameters.search_bounds
        there = self.apart.path_loss(parameters.from_search(lower + place * (upper - lower)), factors)
        # A link that is lost at both is infinitely far from itself, which counts as nothing.
        with np.errstate(invalid="ignore"):
            return self._rows((there - self.loss)[:, self.explaining.counted])

    def means(self, factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Means that would have given the points where buildings have these factors, in the unit cube [n, d]."""
        parameters = self.explaining.problem.parameters
        lower, upper = parameters.search_bounds
        value = parameters.from_search(lower + self.leaning.estimate * (upper - lower))
        moved = np.clip(
            value * np.exp(-np.log(factors) @ self.followed.T), parameters.lower, parameters.upper
        )
        straight = (parameters.to_search(moved) - lower) / (upper - lower)
        return means_behind(
            self.leaning, lambda place, portion: self.change(place, factors**portion), straight
        )

    def left(self, factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the points do not explain of buildings about the means that would have given them [n, m]."""
        return self.change(self.means(factors), factors)

    def others(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far the path loss of the links that count at other places [k, m] is from that here [n, k, m]."""
        with np.errstate(invalid="ignore"):
            return self._rows(loss - self.loss[:, None, self.explaining.counted])

    def _rows(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rows in units of the noise, 0 where a link was lost."""
        found = gap * (self.explaining.scale / self.explaining.marginal.noise_db)
        return np.where(np.isfinite(found), found, 0.0)


def over_buildings(
    explaining: Explaining, posterior: Draws, explained: NDArray[np.float64], tried: Sequence[NoiseModel]
) -> Draws:
    """A posterior of what buildings have on the mean, where each of them may differ.

    They are drawn together with what each building has; of larger scenes they are means behind those of a posterior
    that takes buildings as alike.

    Args:
        explaining: The density that was drawn from.
        posterior: The draws, of what the buildings seen have.
        explained: What the density told of some draws of equal weight, under every model of the noise [k, models].
        tried: All models that were tried.

    Returns:
        Draws further apart; the same where buildings cannot be told apart, or do not differ.
    """
    apart = buildings(explaining.problem) if any(model.spread for model in tried) else None
    if apart is None:
        return posterior
    if apart.engine.paths.num_interactions > FEW:
        return _behind(explaining, apart, posterior, explained, tried)
    return _drawn(explaining, apart, posterior, tried)


def _drawn(explaining: Explaining, apart: Buildings, posterior: Draws, tried: Sequence[NoiseModel]) -> Draws:
    """Means drawn together with what each building has of its own."""
    problem, own = explaining.problem, apart.building >= 0
    parameters = problem.parameters

    def gaps(point: NDArray[np.float64], logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
        factors = np.ones((len(point), len(own)))
        factors[:, own] = np.exp(logarithms)
        return explaining.gaps(apart.path_loss(parameters.from_unit(point), factors))

    stated = problem.setup.study.noise.heterogeneity
    hierarchy = Hierarchy(
        parameters,
        apart.owner[own],
        np.unique(apart.building[own], return_inverse=True)[1],
        np.array([own[apart.owner == k].all() and (apart.owner == k).any() for k in range(len(parameters))]),
        gaps,
        replace(explaining.marginal, models=besides(explaining.marginal.models, tried)),
        problem.priors,
        None if stated == "auto" else float(stated),
    )
    # Every sweep replays each draw three times.
    sweeps = SWEPT // (3 * STEPS * POPULATION * apart.engine.paths.num_interactions)
    sweeps = int(np.clip(sweeps, *SWEEPS))
    found = hierarchical(hierarchy, posterior, POPULATION, sweeps, seed=problem.setup.study.method.seed)
    # By what explains the links where buildings are alike; asked for the last of every line of draws, which is enough.
    density = np.full(len(found.point), -np.inf)
    density[-POPULATION:] = np.logaddexp.reduce(explaining(found.point[-POPULATION:]), axis=1)
    return replace(found, density=density)


def _behind(
    explaining: Explaining,
    apart: Buildings,
    posterior: Draws,
    explained: NDArray[np.float64],
    tried: Sequence[NoiseModel],
) -> Draws:
    """Means that would have given draws where buildings differ."""
    count = int(np.clip(EVALUATED // (TRIED * apart.engine.paths.num_interactions), *DRAWN))
    share = np.exp(explained - np.logaddexp.reduce(explained, axis=1)[:, None])
    spread = spreads(explaining.marginal.models, share[np.arange(count) % len(share)], tried)
    followed = _followed(explaining, apart, posterior.resampled(LINEAR))
    some = _Asked.at(explaining, apart, posterior.resampled(JUDGED), followed)
    chosen = posterior.chosen(count)
    others = some.others(explaining.modelled(posterior.resampled(OTHERS, seed=1)))
    for each in np.unique(spread[spread > 0]).tolist():
        own, here = some.left(apart.factors(np.full(JUDGED, each), seed=1)), np.flatnonzero(spread == each)
        chosen[here] = posterior.tempered(overstated(some.leaning, own, others)).chosen(len(here))
    asked = _Asked.at(explaining, apart, posterior.point[chosen], followed)
    lower, upper = explaining.problem.parameters.search_bounds
    found, weight = asked.means(apart.factors(spread)), np.full(count, 1.0 / count)
    return Draws(lower + found * (upper - lower), posterior.density[chosen], weight, posterior.flattened)


def _followed(explaining: Explaining, apart: Buildings, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """How estimates follow single buildings in straight lines, on the mean over points [d, c]."""
    problem, marginal = explaining.problem, explaining.marginal
    parameters = problem.parameters
    candidates = parameters.from_search(point)
    few = max(4, min(len(point), ANSWERS // (len(explaining.scale) * len(apart.owner))))
    slope = apart.slopes(candidates[:: max(1, len(point) // few)])
    slope = slope[:, explaining.counted] * (explaining.scale[:, None] / marginal.noise_db)
    known = KNOWN * np.square(candidates.mean(axis=0) / (parameters.upper - parameters.lower))
    if len(problem.priors):
        known[list(problem.priors.index)] += 1.0 / np.square(problem.priors.spread)
    precision = np.concatenate([known, (marginal.ridge / marginal.noise_db) ** 2])
    return following(
        np.where(np.isfinite(slope), slope, 0.0), apart.owner, marginal.design / marginal.noise_db, precision
    )


def buildings(problem: Problem) -> Buildings | None:
    """Tell a problem's buildings apart.

    Args:
        problem: The problem.

    Returns:
        The same scene with walls of their own; None where the engine replays no paths that tell where interactions
        happen, where the scene has no buildings apart, or where there is too much of it.
    """
    engine, study = problem.engine, problem.setup.study
    if not isinstance(engine, Replay) or problem.observable is not PATH_LOSS or engine.parameters.has_laws:
        return None
    return _apart(engine, problem.setup.scene, study.objective.combining, study.scene.bandwidth)


def _apart(engine: Replay, scene: Scene, combining: str, bandwidth: float | None) -> Buildings | None:
    paths, parameters = engine.paths, engine.parameters
    if not 0 < paths.num_interactions <= INTERACTIONS:
        return None
    whole = _building(paths, scene)
    known = list(paths.materials)
    key, material = np.unique((whole + 1) * len(known) + paths.material, return_inverse=True)
    place, kind = key // len(known) - 1, key % len(known)
    names = [f"{known[k]} of {b}" for b, k in zip(place.tolist(), kind.tolist(), strict=True)]
    items, owner, building = _parameters(parameters, names, [known[k] for k in kind], place)
    if len(np.unique(building[building >= 0])) < FEWEST:
        return None
    table: Mapping[str, Material] = {
        name: paths.materials[known[k]] for name, k in zip(names, kind.tolist(), strict=True)
    }
    own = replace(paths, material=material.reshape(-1), materials=dict(table))
    again = Replay(
        own, Parameters(items, parameters.frequency), combining, bandwidth, tabulate=False, batch=POPULATION
    )
    return Buildings(engine, again, owner, building)


def _parameters(
    parameters: Parameters, names: list[str], materials: list[str], place: NDArray[np.int64]
) -> tuple[tuple[Parameter, ...], NDArray[np.int64], NDArray[np.int64]]:
    """A parameter for each building's constants, what it stands in for, and its building."""
    items, owner, building = [], [], []
    for index, parameter in enumerate(parameters):
        for name, material, number in zip(names, materials, place.tolist(), strict=True):
            if material == parameter.material:
                items.append(replace(parameter, name=f"{name}.{parameter.field}"))
                owner.append(index)
                building.append(number)
    return tuple(items), np.array(owner, dtype=np.int64), np.array(building, dtype=np.int64)


def _building(paths: Paths, scene: Scene) -> NDArray[np.int64]:
    """Building of every interaction, -1 where its material is that of the ground [I]."""
    triangles = read_triangles(scene)
    flat = [list(scene.materials)[k] for k in np.unique(triangles.material[triangles.ground])]
    place = building_numbers(triangles, np.asarray(paths.vertex, dtype=np.float64))
    ground = np.isin(paths.material, [k for k, name in enumerate(paths.materials) if name in flat])
    return np.where(ground, -1, place)
