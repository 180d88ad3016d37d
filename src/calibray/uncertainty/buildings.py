"""Replay in which further constants vary: those of individual buildings, and those fixed by the scene.

The building of every interaction follows from its position and the scene's meshes (`scenes/buildings.py`). Each
combination of a building and a material becomes a separate material.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final, cast, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.cluster.chunks import Chunk
from calibray.engines.compression import strongest
from calibray.engines.protocol import PATH_LOSS, Chunked, Responses, of_links
from calibray.engines.replay import Computation, Replay, ReplayCarriers
from calibray.engines.section import OpenedStudy, RadioSettings
from calibray.fitting.problem import Problem
from calibray.materials import Material
from calibray.measurements.observables import Statistic
from calibray.parameters import Parameters
from calibray.parameters.parameter import LAWS, PARAMETER_BOUNDS
from calibray.paths import Paths
from calibray.scenes import Scene, building_numbers, read_triangles

BATCHES: Final = (1, 128)
"""Minimum and maximum number of candidates per replay."""

BATCH_INTERACTIONS: Final = 400_000
"""Target for the total number of interactions of one replay, summed over its candidates. Larger path programs are
replayed with fewer candidates at a time."""

MANY: Final = 10_000
"""Number of interactions above which weak paths are left out."""

WEAK: Final = 0.1
"""Maximum fraction of a link's power, summed over 16 candidates, that the omitted paths together may carry. On an
office floor in Auckland, 71 % of the interactions are left out, which changes the path loss of posterior draws by 0.05
dB (RMS); the errors are 5.3 dB. With a limit of 0.03, 61 % of the interactions are left out, and the change is 0.02
dB."""

EXPONENTS: Final = {exponent for _, exponent in LAWS.values()}
"""Fields of parameters that are exponents in frequency laws."""


@dataclass(frozen=True, eq=False)
class _Part:
    """The replay of one carrier.

    Attributes:
        engine: The replay; each of its k parameters is a constant of one building or of all objects.
        links: Indices of its links.
        constants: Indices [k] of the part's constants among the constants of all carriers; empty if the paths depend on
            no constant.
    """

    engine: Replay
    links: NDArray[np.intp]
    constants: NDArray[np.intp]

    def respond(self, constants: NDArray[np.float64], wanted: tuple[Statistic, ...]) -> Responses:
        """Path loss and further observables for given constants [n, c], which are clipped to physical bounds."""
        parameters = self.engine.parameters
        candidates = np.tile(parameters.start, (len(constants), 1))
        if len(self.constants):
            bounds = [PARAMETER_BOUNDS[parameter.field] for parameter in parameters]
            lower, upper = [bound.lower for bound in bounds], [bound.upper for bound in bounds]
            candidates = np.clip(constants[:, self.constants], lower, upper)
        if wanted:
            return self.engine.respond(candidates, wanted)
        return Responses(self.engine.path_loss(candidates), np.empty((len(constants), 0, len(self.links))))


@dataclass(frozen=True, eq=False)
class Split(ABC):
    """A replay whose candidates set further constants in addition to the study's parameters.

    Attributes:
        parameter_of: Index [c] of the parameter to which each of the c constants belongs, in ascending order.
        building_of: Index [c] of each constant's building; -1 for other objects, such as the ground.
        met: Indices of the buildings with which the paths interact.
        interactions: Number of interactions evaluated per candidate.
    """

    parameter_of: NDArray[np.int64]
    building_of: NDArray[np.int64]
    met: NDArray[np.int64]
    interactions: int

    @property
    def keys(self) -> NDArray[np.int64]:
        """Numbers [c] that encode the parameter and the building of each constant, in ascending order."""
        # Building -1 comes just before building 0 of the same parameter.
        return (self.parameter_of << 32) + self.building_of

    def path_loss(self, values: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [n, L], [dB], for values of the parameters [n, d] and a factor for every constant [n, c]."""
        return self.respond(values, factors, ()).path_loss

    @abstractmethod
    def respond(
        self, values: NDArray[np.float64], factors: NDArray[np.float64], wanted: tuple[Statistic, ...]
    ) -> Responses:
        """Path loss and the observables in `wanted`; the other arguments are as for `path_loss`."""


@final
@dataclass(frozen=True, eq=False)
class SplitReplay(Split):
    """A split replay in this process.

    Attributes:
        parameters: The parameters; some may be coefficients of frequency laws.
        parts: The replays of the carriers.
    """

    parameters: Parameters
    parts: tuple[_Part, ...]

    def respond(
        self, values: NDArray[np.float64], factors: NDArray[np.float64], wanted: tuple[Statistic, ...]
    ) -> Responses:
        """Path loss and further observables; see `Split.respond`."""
        responses = []
        for part in self.parts:
            at_carrier, _ = self.parameters.constants_and_slopes(values, part.engine.paths.frequency)
            responses.append(part.respond(at_carrier[:, self.parameter_of] * factors, wanted))
        return of_links(responses, [part.links for part in self.parts])


@final
@dataclass(frozen=True, eq=False)
class SplitChunks(Split):
    """A split replay of links in chunks. Every worker splits and stores the replays of its own chunks.

    Attributes:
        engine: The chunks.
        splitting: The settings that the workers use to split the replays.
    """

    engine: Chunked
    splitting: _Splitting

    def respond(
        self, values: NDArray[np.float64], factors: NDArray[np.float64], wanted: tuple[Statistic, ...]
    ) -> Responses:
        """Path loss and further observables; see `Split.respond`."""
        parts = self.engine.ask(_chunk_respond, self.splitting, self.keys, values, factors, wanted)
        return of_links(parts, list(self.engine.chunks))


@dataclass(frozen=True)
class _Splitting:
    """Picklable settings for splitting replays. Equal settings split a replay in the same way.

    Attributes:
        parameters: The study's parameters and further constants.
        drop_weak: Whether weak paths are left out.
        by_building: Whether each building has its own constants.
    """

    parameters: Parameters
    drop_weak: bool
    by_building: bool

    def __call__(self, chunk: Chunk) -> SplitReplay:
        """Split the replay of a chunk."""
        return self.split(chunk.study, cast(Replay | ReplayCarriers, chunk.engine))

    def split(self, study: OpenedStudy, engine: Replay | ReplayCarriers) -> SplitReplay:
        """Split the replay of a study's links."""
        splits, met = [], set()
        for replay, links in engine.parts:
            paths = replay.paths
            if self.drop_weak and not replay.effects and paths.num_interactions:
                paths = strongest(paths, replace(engine.parameters, frequency=paths.frequency), WEAK)
            building = np.full(paths.num_interactions, -1)
            if self.by_building:
                building = _interaction_buildings(paths, study.scene)
            met |= set(building[building >= 0].tolist())
            splits.append((*_split_paths(study.radio, replay, paths, building, self.parameters), links))
        # Sorted by parameter index, then by building.
        constants = sorted({key for _, keys, _ in splits for key in keys})
        number = {key: index for index, key in enumerate(constants)}
        parts = tuple(
            _Part(split, links, np.array([number[key] for key in keys], dtype=np.intp))
            for split, keys, links in splits
        )
        parameter_of, building_of = np.array(constants, dtype=np.int64).reshape(-1, 2).T
        interactions = sum(part.engine.interactions for part in parts)
        return SplitReplay(
            parameter_of,
            building_of,
            np.array(sorted(met), dtype=np.int64),
            interactions,
            self.parameters,
            parts,
        )

    def split_chunks(self, engine: Chunked) -> SplitChunks:
        """Split the replays of all chunks; each worker splits its own chunks."""
        answers = engine.ask(_split_chunk, self)
        constants = np.unique(np.concatenate([key for key, _, _ in answers]), axis=0)
        met = np.unique(np.concatenate([numbers for _, numbers, _ in answers]))
        interactions = sum(count for _, _, count in answers)
        return SplitChunks(constants[:, 0], constants[:, 1], met, interactions, engine, self)


def can_split(problem: Problem) -> bool:
    """Whether a problem's engine replays paths with interactions, so that further constants can vary."""
    engine = problem.engine
    return (
        isinstance(engine, Replay | ReplayCarriers | Chunked)
        and problem.observable is PATH_LOSS
        and engine.interactions > 0
    )


def replayed_materials(problem: Problem) -> list[dict[str, Material]]:
    """The materials in the replay of every carrier; `can_split` must be true for the problem."""
    if isinstance(problem.engine, Chunked):
        return list(chain.from_iterable(problem.engine.ask(_chunk_materials)))
    return [replay.materials for replay, _ in cast(Replay | ReplayCarriers, problem.engine).parts]


def split_replay(problem: Problem, parameters: Parameters, *, by_building: bool) -> Split:
    """Add further parameters to a problem's replay and, if `by_building`, separate constants for each building.

    `can_split` must be true for the problem. The study's parameters come first; each further parameter is a constant
    with one value for all carriers. If the paths interact with fewer than two buildings, buildings get no separate
    constants.
    """
    engine = cast(Replay | ReplayCarriers | Chunked, problem.engine)
    # Weak paths often arrive late, and delay spreads depend on late paths, so further observables need all paths.
    may_drop = problem.setup.study.objective.combining == "power" and not problem.observed
    splitting = _Splitting(parameters, may_drop and engine.interactions > MANY, by_building)
    split = (
        splitting.split_chunks(engine)
        if isinstance(engine, Chunked)
        else splitting.split(problem.setup, engine)
    )
    if by_building and len(split.met) < 2:
        return split_replay(problem, parameters, by_building=False)
    return split


def _split_paths(
    radio: RadioSettings, replay: Replay, paths: Paths, building: NDArray[np.int64], parameters: Parameters
) -> tuple[Replay, list[tuple[int, int]]]:
    """The replay of one carrier with the given paths, and each constant's parameter and building (-1 for none).

    If the paths depend on no constant, the replay is unchanged, and the list is empty.
    """
    names = list(paths.materials)
    # One material per pair of building and material, in the order of the sorted pairs.
    pairs, split_material = np.unique((building + 1) * len(names) + paths.material, return_inverse=True)
    number, original = (pairs // len(names) - 1).tolist(), [names[k] for k in pairs % len(names)]
    split_names = [f"{name} of {of}" for name, of in zip(original, number, strict=True)]
    items, keys = [], []
    at_carrier, constant_of = parameters.at_carrier(paths.frequency)
    for constant_index, constant in enumerate(at_carrier):
        # Both coefficients of a frequency law determine one constant.
        setting = np.flatnonzero(constant_of == constant_index).tolist()
        # A building's factor multiplies the constant or the coefficient of its frequency law; all buildings share the
        # exponent.
        scaling = [index for index in setting if parameters.items[index].field not in EXPONENTS]
        index = (scaling or setting)[0]
        if constant.is_effect:
            items.append(constant)
            keys.append((index, -1))
            continue
        for split_name, name, of in zip(split_names, original, number, strict=True):
            if name == constant.material:
                items.append(replace(constant, name=f"{split_name}.{constant.field}"))
                keys.append((index, of if scaling else -1))
    if not items:
        return replay, []
    materials = {new: paths.materials[name] for new, name in zip(split_names, original, strict=True)}
    batch = int(np.clip(BATCH_INTERACTIONS // max(paths.num_interactions, 1), *BATCHES))
    split = Replay(
        replace(paths, material=split_material.reshape(-1), materials=materials or paths.materials),
        Parameters(tuple(items), paths.frequency),
        radio.combining,
        radio.bandwidth,
        replay.effects,
        Computation(batch=1 << (batch.bit_length() - 1)),
    )
    return split, keys


# Functions that are sent to the workers.


def _chunk_materials(chunk: Chunk) -> list[dict[str, Material]]:
    return [replay.materials for replay, _ in cast(Replay | ReplayCarriers, chunk.engine).parts]


def _split_chunk(chunk: Chunk, splitting: _Splitting) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Parameter and building [c, 2] of each constant in a chunk, buildings on its paths, and interaction count."""
    split = chunk.derived(splitting)
    return np.stack([split.parameter_of, split.building_of], axis=1), split.met, split.interactions


def _chunk_respond(
    chunk: Chunk,
    splitting: _Splitting,
    keys: NDArray[np.int64],
    values: NDArray[np.float64],
    factors: NDArray[np.float64],
    wanted: tuple[Statistic, ...],
) -> Responses:
    """The responses of a chunk; `factors` contains the factors of the constants with the given keys."""
    split = chunk.derived(splitting)
    return split.respond(values, factors[:, np.searchsorted(keys, split.keys)], wanted)


def _interaction_buildings(paths: Paths, scene: Scene) -> NDArray[np.int64]:
    """Building [I] of every interaction; -1 for an interaction with a ground material."""
    triangles = read_triangles(scene)
    ground_names = [list(scene.materials)[k] for k in np.unique(triangles.material[triangles.ground])]
    building = building_numbers(triangles, np.asarray(paths.vertex, dtype=np.float64))
    on_ground = np.isin(paths.material, [k for k, name in enumerate(paths.materials) if name in ground_names])
    return np.where(on_ground, -1, building)
