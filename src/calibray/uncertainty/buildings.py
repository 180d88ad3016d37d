"""Replay with separate constants for each building: path loss if the buildings of one material differ.

The building of every interaction follows from its position and the scene's meshes (`scenes/buildings.py`). Each pair of
building and material becomes a material of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import PATH_LOSS
from calibray.engines.replay import Replay
from calibray.fitting.problem import Problem
from calibray.materials import BOUNDS
from calibray.parameters import Parameters
from calibray.paths import Paths
from calibray.scenes import Scene, building_numbers, read_triangles

MAX_INTERACTIONS: Final = 30_000
"""Largest path program that is split by building: replays with separate constants are expensive."""

BATCH: Final = 96
"""Candidates per replay: the population of the sampler in `between_buildings`."""

DIFFERENCE: Final = 1e-5
"""Relative step of a constant for difference quotients."""


@dataclass(frozen=True, eq=False)
class BuildingReplay:
    """A replay with separate constants for each building.

    Attributes:
        shared: The study's replay, with one constant for all buildings of a material.
        engine: The split replay; its c parameters are the constants of one building each, or of the ground.
        parameter_of: Index of the study's parameter that each constant belongs to [c].
        building_of: Building of each constant, from 0; -1 for objects that are no building, as the ground [c].
    """

    shared: Replay
    engine: Replay
    parameter_of: NDArray[np.int64]
    building_of: NDArray[np.int64]

    def path_loss(self, means: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of buildings that differ.

        Args:
            means: Parameter values, in the fields' units [n, d].
            factors: Factor of every constant [n, c].

        Returns:
            Path loss [n, L], [dB].
        """
        bounds = [BOUNDS[parameter.field] for parameter in self.engine.parameters]
        lower, upper = [bound.lower for bound in bounds], [bound.upper for bound in bounds]
        return self.engine.path_loss(np.clip(means[:, self.parameter_of] * factors, lower, upper))

    def slopes(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of path loss by each building's constants.

        Difference quotients: compiling a reverse pass of the split replay would take longer.

        Args:
            candidates: Parameter values [n, d], in the fields' units, the same for all buildings.

        Returns:
            Derivatives by the logarithm of every constant [n, L, c], [dB].
        """
        count, width = len(candidates), len(self.parameter_of)
        factors = np.concatenate([np.ones((1, width)), 1.0 + DIFFERENCE * np.eye(width)])
        loss = self.path_loss(np.repeat(candidates, width + 1, axis=0), np.tile(factors, (count, 1)))
        loss = loss.reshape(count, width + 1, -1)
        with np.errstate(invalid="ignore"):  # inf - inf for a link without a path
            slope = (loss[:, 1:] - loss[:, :1]) / np.log1p(DIFFERENCE)
        return slope.transpose(0, 2, 1)

    def draw_factors(self, spread: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
        """Draw log-normal factors of the buildings' constants.

        Args:
            spread: Standard deviations of the logarithm of a factor [n].
            seed: Seed of the random numbers.

        Returns:
            Factor of every constant, 1 for objects that are no building [n, c].
        """
        normal = np.random.default_rng(seed).standard_normal((len(spread), len(self.parameter_of)))
        return np.exp(spread[:, None] * np.where(self.building_of >= 0, normal, 0.0))


def split_by_building(problem: Problem) -> BuildingReplay | None:
    """Give each building of a problem's scene its own constants.

    Args:
        problem: The problem.

    Returns:
        The split replay; None if the engine is no replay of one carrier, if the path program is too large, or if the
        paths meet fewer than two buildings.
    """
    engine, study = problem.engine, problem.setup.study
    if not isinstance(engine, Replay) or problem.observable is not PATH_LOSS or engine.parameters.has_laws:
        return None
    paths, parameters = engine.paths, engine.parameters
    if not 0 < paths.num_interactions <= MAX_INTERACTIONS:
        return None
    # One material per pair of building and material, numbered by the sorted pairs.
    names = list(paths.materials)
    interaction_building = _interaction_buildings(paths, problem.setup.scene)
    pairs, split_material = np.unique(
        (interaction_building + 1) * len(names) + paths.material, return_inverse=True
    )
    building, original = (pairs // len(names) - 1).tolist(), [names[k] for k in pairs % len(names)]
    split_names = [f"{name} of {number}" for name, number in zip(original, building, strict=True)]
    items, parameter_of, building_of = [], [], []
    for index, parameter in enumerate(parameters):
        for split_name, name, number in zip(split_names, original, building, strict=True):
            if name == parameter.material:
                items.append(replace(parameter, name=f"{split_name}.{parameter.field}"))
                parameter_of.append(index)
                building_of.append(number)
    if len({number for number in building_of if number >= 0}) < 2:
        return None
    materials = {
        split_name: paths.materials[name] for split_name, name in zip(split_names, original, strict=True)
    }
    split = Replay(
        replace(paths, material=split_material.reshape(-1), materials=materials),
        Parameters(tuple(items), parameters.frequency),
        study.objective.combining,
        study.scene.bandwidth,
        tabulate=False,
        batch=BATCH,
    )
    return BuildingReplay(engine, split, np.array(parameter_of), np.array(building_of))


def _interaction_buildings(paths: Paths, scene: Scene) -> NDArray[np.int64]:
    """Building of every interaction; -1 if its material is that of the ground [I]."""
    triangles = read_triangles(scene)
    ground_names = [list(scene.materials)[k] for k in np.unique(triangles.material[triangles.ground])]
    building = building_numbers(triangles, np.asarray(paths.vertex, dtype=np.float64))
    on_ground = np.isin(paths.material, [k for k, name in enumerate(paths.materials) if name in ground_names])
    return np.where(on_ground, -1, building)
