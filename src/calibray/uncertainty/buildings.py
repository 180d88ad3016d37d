"""Replay with constants that the study does not vary: those of single buildings, and those that the scene fixes.

The building of every interaction follows from its position and the scene's meshes (`scenes/buildings.py`). Each pair of
building and material becomes a separate material.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.compression import strongest
from calibray.engines.protocol import PATH_LOSS, Responses, of_links
from calibray.engines.replay import Computation, Replay, ReplayCarriers
from calibray.fields import Effects
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
class _Part:
    """The replay of one carrier.

    Attributes:
        engine: The replay; its k parameters are constants of one building each, or of all objects.
        links: Indices of its links.
        constants: Indices of its constants among those of all carriers [k].
    """

    engine: Replay
    links: NDArray[np.intp]
    constants: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class SplitReplay:
    """A replay whose candidates set more constants than the study's parameters.

    Attributes:
        parts: The replay of every carrier; together they set c constants of one building each, or of all objects.
        parameter_of: Index of the parameter to which each constant belongs [c].
        building_of: Building of each constant, from 0; -1 for objects that are not buildings, such as the ground [c].
    """

    parts: tuple[_Part, ...]
    parameter_of: NDArray[np.int64]
    building_of: NDArray[np.int64]

    @property
    def interactions(self) -> int:
        """Number of interactions that are evaluated for a candidate."""
        return sum(part.engine.interactions for part in self.parts)

    def path_loss(self, values: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [n, L], [dB] with values of the parameters [n, d] and a factor for every constant [n, c]."""
        constants = values[:, self.parameter_of] * factors
        loss = np.empty((len(values), sum(len(part.links) for part in self.parts)))
        for part in self.parts:
            loss[:, part.links] = part.engine.path_loss(_possible(part, constants))
        return loss

    def respond(
        self, values: NDArray[np.float64], factors: NDArray[np.float64], wanted: tuple[Statistic, ...]
    ) -> Responses:
        """Path loss and further observables of buildings that differ; arguments as for `path_loss`."""
        constants = values[:, self.parameter_of] * factors
        responses = [part.engine.respond(_possible(part, constants), wanted) for part in self.parts]
        return of_links(responses, [part.links for part in self.parts])


def _possible(part: _Part, constants: NDArray[np.float64]) -> NDArray[np.float64]:
    """The constants of one part [n, k], from those of all [n, c], within their physical bounds."""
    bounds = [PARAMETER_BOUNDS[parameter.field] for parameter in part.engine.parameters]
    lower, upper = [bound.lower for bound in bounds], [bound.upper for bound in bounds]
    return np.clip(constants[:, part.constants], lower, upper)


def can_split(problem: Problem) -> bool:
    """Whether a problem's engine replays from this process, without laws, so that further constants can vary."""
    engine = problem.engine
    return (
        isinstance(engine, Replay | ReplayCarriers)
        and problem.observable is PATH_LOSS
        and not engine.parameters.has_laws
        and all(replay.paths.num_interactions > 0 for replay, _ in engine.parts)
    )


def split_replay(problem: Problem, parameters: Parameters, *, by_building: bool) -> SplitReplay:
    """Give a problem's replay further parameters, and each building of its scene its own constants.

    The problem is one that `can_split`; the study's parameters come first. A further parameter is a constant that is
    equal at all carriers. If the paths meet fewer than two buildings, no constant belongs to a building.
    """
    engine = problem.engine
    replays = engine.parts  # type: ignore[attr-defined]
    many = sum(replay.interactions for replay, _ in replays) > MANY
    # Weak paths are late ones, which delay spreads depend on.
    may_drop = problem.setup.study.objective.combining == "power" and not problem.observed
    programs = [
        strongest(replay.paths, problem.parameters, WEAK)
        if many and may_drop and not replay.effects
        else replay.paths
        for replay, _ in replays
    ]
    buildings = [np.full(paths.num_interactions, -1) for paths in programs]
    if by_building:
        found = [_interaction_buildings(paths, problem.setup.scene) for paths in programs]
        every = np.concatenate(found)
        buildings = buildings if len(np.unique(every[every >= 0])) < 2 else found
    splits = [
        _split_paths(problem, paths, building, parameters, replay.effects)
        for paths, building, (replay, _) in zip(programs, buildings, replays, strict=True)
    ]
    # By the index of its parameter and its building.
    constants = list(dict.fromkeys(key for _, keys in splits for key in keys))
    number = {key: index for index, key in enumerate(constants)}
    parts = tuple(
        _Part(split, links, np.array([number[key] for key in keys], dtype=np.intp))
        for (split, keys), (_, links) in zip(splits, replays, strict=True)
    )
    parameter_of, building_of = np.array(constants, dtype=np.int64).reshape(-1, 2).T
    return SplitReplay(parts, parameter_of, building_of)


def _split_paths(
    problem: Problem,
    paths: Paths,
    building: NDArray[np.int64],
    parameters: Parameters,
    effects: Effects,
) -> tuple[Replay, list[tuple[int, int]]]:
    """The replay of one carrier; for each of its constants the index of its parameter, and its building or -1."""
    names = list(paths.materials)
    # One material per pair of building and material, numbered by the sorted pairs.
    pairs, split_material = np.unique((building + 1) * len(names) + paths.material, return_inverse=True)
    number, original = (pairs // len(names) - 1).tolist(), [names[k] for k in pairs % len(names)]
    split_names = [f"{name} of {of}" for name, of in zip(original, number, strict=True)]
    items, keys = [], []
    for index, parameter in enumerate(parameters):
        if parameter.is_effect:
            items.append(parameter)
            keys.append((index, -1))
            continue
        for split_name, name, of in zip(split_names, original, number, strict=True):
            if name == parameter.material:
                items.append(replace(parameter, name=f"{split_name}.{parameter.field}"))
                keys.append((index, of))
    materials = {new: paths.materials[name] for new, name in zip(split_names, original, strict=True)}
    batch = int(np.clip(BATCH_INTERACTIONS // paths.num_interactions, *BATCHES))
    study = problem.setup.study
    split = Replay(
        replace(paths, material=split_material.reshape(-1), materials=materials),
        Parameters(tuple(items), parameters.frequency),
        study.objective.combining,
        study.scene.bandwidth,
        effects,
        Computation(batch=1 << (batch.bit_length() - 1)),
    )
    return split, keys


def _interaction_buildings(paths: Paths, scene: Scene) -> NDArray[np.int64]:
    """Building of every interaction; -1 if its material is that of the ground [I]."""
    triangles = read_triangles(scene)
    ground_names = [list(scene.materials)[k] for k in np.unique(triangles.material[triangles.ground])]
    building = building_numbers(triangles, np.asarray(paths.vertex, dtype=np.float64))
    on_ground = np.isin(paths.material, [k for k, name in enumerate(paths.materials) if name in ground_names])
    return np.where(on_ground, -1, building)
