"""Paths whose buildings have walls of their own: how path loss follows each building's constants, and what that means.

The building of every interaction follows from where it happens and from the scene's meshes (`scenes/wholes.py`). With a
material for each building, one pass backwards gives the derivatives of every link by the constants of every building.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.calibration.explaining import Explaining
from calibray.calibration.problem import Problem
from calibray.engines.observable import PATH_LOSS
from calibray.engines.replay import Replay
from calibray.inference.clusters import moved, shared_covariance, spreads
from calibray.inference.marginal import NoiseModel
from calibray.inference.posterior import Draws
from calibray.materials import Material
from calibray.parameters import Parameter, Parameters
from calibray.paths import Paths
from calibray.scenes import Scene
from calibray.scenes.triangles import read_triangles
from calibray.scenes.wholes import wholes

INTERACTIONS: Final = 30_000
"""Interactions beyond which buildings are not told apart: derivatives by each one's constants would be dear."""

ANSWERS: Final = 200_000
"""Derivatives of a candidate beyond which they are not."""

FEWEST: Final = 2
"""Buildings below which none differs from another."""


DRAWN: Final = 1000
"""Draws that are moved."""

LINEAR: Final = 48
"""Draws that derivatives are taken at."""


@dataclass(frozen=True, eq=False)
class Buildings:
    """A scene whose buildings have walls of their own.

    Attributes:
        engine: The replay; its parameters are a constant of one building each, or of what is no building.
        owner: Which of the study's parameters each of them stands in for [c].
        building: Its building, from 0; -1 for what is no building, as the ground [c].
    """

    engine: Replay
    owner: NDArray[np.int64]
    building: NDArray[np.int64]

    def slopes(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """How path loss follows each building's constants.

        Args:
            candidates: Parameter values [n, d], in the fields' units, alike at all buildings.

        Returns:
            Derivatives by the logarithm of every constant [n, L, c], [dB].
        """
        own = candidates[:, self.owner]
        return self.engine.path_loss_and_jacobian(own)[1] * own[:, None, :]


def over_buildings(
    explaining: Explaining,
    posterior: Draws,
    point: NDArray[np.float64],
    explained: NDArray[np.float64],
    tried: Sequence[NoiseModel],
) -> Draws:
    """A posterior of what buildings have on the mean, where each of them may differ.

    Args:
        explaining: The density that was drawn from.
        posterior: The draws, of what the buildings seen have.
        point: Some draws of equal weight [k, d].
        explained: What the density told of them, under every model of the noise [k, models].
        tried: All models that were tried.

    Returns:
        Draws further apart; the same where buildings cannot be told apart, or do not differ.
    """
    problem, marginal = explaining.problem, explaining.marginal
    parameters = problem.parameters
    apart = buildings(problem) if any(model.spread for model in tried) else None
    if apart is None:
        return posterior
    candidates = parameters.from_search(point)
    some = candidates[:: max(1, len(candidates) // LINEAR)]
    noise_db, scale = marginal.noise_db, explaining.scale
    slope = apart.slopes(some)[:, explaining.counted] * (scale[:, None] / noise_db)
    # A prior as wide as a third of the range keeps what the data cannot tell within it.
    width = (parameters.upper - parameters.lower) / some.mean(axis=0)
    known = 9.0 / width**2
    if len(problem.priors):
        known[list(problem.priors.index)] += 1.0 / np.square(problem.priors.spread)
    covariance = shared_covariance(
        slope, apart.owner, apart.building, marginal.design / noise_db,
        np.concatenate([known, (marginal.ridge / noise_db) ** 2]),
    )  # fmt: skip
    often, total = np.arange(DRAWN) % len(point), np.logaddexp.reduce(explained, axis=1)
    spread = spreads(marginal.models, np.exp(explained - total[:, None])[often], tried)
    value, far = moved(candidates[often], spread, covariance)
    inside = ((value >= parameters.lower) & (value <= parameters.upper)).all(axis=1)
    count = int(inside.sum())
    return Draws(
        parameters.to_search(value[inside]), (total[often] - far)[inside], np.full(count, 1.0 / count),
        posterior.flattened,
    )  # fmt: skip


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
    if paths.vertex is None or not 0 < paths.num_interactions <= INTERACTIONS:
        return None
    whole = _building(paths, scene)
    known = list(paths.materials)
    key, material = np.unique((whole + 1) * len(known) + paths.material, return_inverse=True)
    place, kind = key // len(known) - 1, key % len(known)
    names = [f"{known[k]} of {b}" for b, k in zip(place.tolist(), kind.tolist(), strict=True)]
    items, owner, building = _parameters(parameters, names, [known[k] for k in kind], place)
    if len(np.unique(building[building >= 0])) < FEWEST or paths.num_links * len(items) > ANSWERS:
        return None
    table: Mapping[str, Material] = {
        name: paths.materials[known[k]] for name, k in zip(names, kind.tolist(), strict=True)
    }
    own = replace(paths, material=material.reshape(-1), materials=dict(table))
    again = Replay(own, Parameters(items, parameters.frequency), combining, bandwidth, tabulate=False)
    return Buildings(again, owner, building)


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
    place = wholes(triangles, np.asarray(paths.vertex, dtype=np.float64))
    ground = np.isin(paths.material, [k for k, name in enumerate(paths.materials) if name in flat])
    return np.where(ground, -1, place)
