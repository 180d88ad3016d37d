"""Replay with constants that the study does not vary: those of single buildings, and those that the scene fixes.

The building of every interaction follows from its position and the scene's meshes (`scenes/buildings.py`). Each pair of
building and material becomes a separate material.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.compression import strongest
from calibray.engines.protocol import PATH_LOSS, Responses
from calibray.engines.replay import Computation, Replay
from calibray.fitting.problem import Problem
from calibray.measurements.observables import Statistic
from calibray.parameters import Parameters
from calibray.parameters.parameter import PARAMETER_BOUNDS
from calibray.paths import Paths
from calibray.scenes import Scene, building_numbers, read_triangles

BATCHES: Final = (1, 128)
"""Smallest and largest number of candidates per replay."""

BATCH_INTERACTIONS: Final = 400_000
"""Number of interactions per replay, which limits the memory: larger programs use fewer candidates at once."""

MANY: Final = 10_000
"""Number of interactions above which weak paths are left out."""

WEAK: Final = 0.1
"""Share of a link's power that the omitted paths have together, summed over 16 candidates. On an office floor in
Auckland, 71 % of the interactions are left out, and path loss of posterior draws changes by 0.05 dB (RMS), with errors
of 5.3 dB. With 0.03, 61 % are left out, and it changes by 0.02 dB."""


@dataclass(frozen=True, eq=False)
class SplitReplay:
    """A replay whose candidates set more constants than the study's parameters.

    Attributes:
        engine: The replay; its c parameters are the constants of one building each, or of all objects.
        parameter_of: Index of the parameter to which each constant belongs [c].
        building_of: Building of each constant, from 0; -1 for objects that are not buildings, such as the ground [c].
    """

    engine: Replay
    parameter_of: NDArray[np.int64]
    building_of: NDArray[np.int64]

    def path_loss(self, values: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [n, L], [dB] with values of the parameters [n, d] and a factor for every constant [n, c]."""
        return self.engine.path_loss(self._candidates(values, factors))

    def respond(
        self, values: NDArray[np.float64], factors: NDArray[np.float64], wanted: tuple[Statistic, ...]
    ) -> Responses:
        """Path loss and further observables of buildings that differ; arguments as for `path_loss`."""
        return self.engine.respond(self._candidates(values, factors), wanted)

    def _candidates(self, values: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.clip(values[:, self.parameter_of] * factors, *self._bounds)

    @cached_property
    def _bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Smallest and largest possible value of every constant [c]."""
        bounds = [PARAMETER_BOUNDS[parameter.field] for parameter in self.engine.parameters]
        return np.array([bound.lower for bound in bounds]), np.array([bound.upper for bound in bounds])


def can_split(problem: Problem) -> bool:
    """Whether a problem's engine replays one carrier from this process, so that further constants can vary."""
    engine = problem.engine
    return (
        isinstance(engine, Replay)
        and problem.observable is PATH_LOSS
        and not engine.parameters.has_laws
        and engine.paths.num_interactions > 0
    )


def split_replay(problem: Problem, parameters: Parameters, *, by_building: bool) -> SplitReplay:
    """Give a problem's replay further parameters, and each building of its scene its own constants.

    The problem is one that `can_split`; the study's parameters come first. If the paths meet fewer than two buildings,
    no constant belongs to a building.
    """
    study, engine = problem.setup.study, problem.engine
    paths, effects = engine.paths, engine.effects  # type: ignore[attr-defined]
    # Weak paths are late ones, which delay spreads depend on.
    may_drop = study.objective.combining == "power" and not effects and not problem.observed
    if paths.num_interactions > MANY and may_drop:
        paths = strongest(paths, problem.parameters, WEAK)
    names = list(paths.materials)
    building = np.full(paths.num_interactions, -1)
    if by_building:
        building = _interaction_buildings(paths, problem.setup.scene)
        if len(np.unique(building[building >= 0])) < 2:
            building[:] = -1
    # One material per pair of building and material, numbered by the sorted pairs.
    pairs, split_material = np.unique((building + 1) * len(names) + paths.material, return_inverse=True)
    number, original = (pairs // len(names) - 1).tolist(), [names[k] for k in pairs % len(names)]
    split_names = [f"{name} of {of}" for name, of in zip(original, number, strict=True)]
    items, parameter_of, building_of = [], [], []
    for index, parameter in enumerate(parameters):
        if parameter.is_effect:
            items.append(parameter)
            parameter_of.append(index)
            building_of.append(-1)
            continue
        for split_name, name, of in zip(split_names, original, number, strict=True):
            if name == parameter.material:
                items.append(replace(parameter, name=f"{split_name}.{parameter.field}"))
                parameter_of.append(index)
                building_of.append(of)
    materials = {new: paths.materials[name] for new, name in zip(split_names, original, strict=True)}
    batch = int(np.clip(BATCH_INTERACTIONS // paths.num_interactions, *BATCHES))
    split = Replay(
        replace(paths, material=split_material.reshape(-1), materials=materials),
        Parameters(tuple(items), parameters.frequency),
        study.objective.combining,
        study.scene.bandwidth,
        effects,
        Computation(batch=1 << (batch.bit_length() - 1)),
    )
    return SplitReplay(split, np.array(parameter_of), np.array(building_of))


def _interaction_buildings(paths: Paths, scene: Scene) -> NDArray[np.int64]:
    """Building of every interaction; -1 if its material is that of the ground [I]."""
    triangles = read_triangles(scene)
    ground_names = [list(scene.materials)[k] for k in np.unique(triangles.material[triangles.ground])]
    building = building_numbers(triangles, np.asarray(paths.vertex, dtype=np.float64))
    on_ground = np.isin(paths.material, [k for k, name in enumerate(paths.materials) if name in ground_names])
    return np.where(on_ground, -1, building)
