"""Replay: evaluates stored paths, with derivatives, for any candidate, with one program per carrier."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from calibray import fields
from calibray.engines.protocol import Responses, check_candidates, joined, of_links
from calibray.fields.program import LARGE
from calibray.materials import Material
from calibray.measurements.observables import Statistic
from calibray.parameters import Parameters
from calibray.paths import Paths

MOST_DERIVATIVES: Final = 2_000_000
"""Maximum number of derivatives with respect to material constants in one call, which limits memory use."""

MAY_TABULATE: Final = 30_000
"""Number of interactions above which interaction coefficients may be read from tables."""

MOST_NODES: Final = 0.25
"""Maximum number of table nodes per interaction; filling more nodes would take longer than the tables save."""

TABLE_TOLERANCE: Final = 1e-4
"""Maximum permitted error of a tabulated coefficient."""

TABLE_CANDIDATES: Final = 32
"""Number of candidates, spread over the bounds, that together with the start values determine the tables'
resolution."""

BATCH: Final = 32
"""Maximum number of candidates in one call."""

OBSERVED_SIZE: Final = 64
"""Maximum number of candidates in one call for further observables; the function is compiled for this number."""


@dataclass(frozen=True)
class Computation:
    """Settings for the evaluation of stored paths.

    Attributes:
        dtype: Precision, `numpy.float64` or `numpy.float32`; None selects single precision for large programs whose
            paths are combined by power, and double precision otherwise.
        tabulate: Whether coefficients are read from tables; None uses tables where they are faster.
        batch: Maximum number of candidates in one call; the program is compiled for this number.
    """

    dtype: type | None = None
    tabulate: bool | None = None
    batch: int = BATCH


@final
class Replay:
    """Stored paths, evaluated for any candidate.

    Args:
        paths: The path program.
        parameters: The parameters whose values a candidate contains.
        combining: How a link's paths are combined: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        effects: Effects on the paths, in which the paths have the same order as in `paths`.
        computation: Precision, tables and batch size.

    Raises:
        InputError: A parameter's material is not in the paths, or the paths cannot be combined in this way.
    """

    def __init__(
        self,
        paths: Paths,
        parameters: Parameters,
        combining: str = "power",
        bandwidth: float | None = None,
        effects: fields.Effects = (),
        computation: Computation | None = None,
    ) -> None:
        computation = computation or Computation()
        dtype, tabulate = computation.dtype, computation.tabulate
        self.paths, self.parameters, self.materials, self.calls = paths, parameters, dict(paths.materials), 0
        self.effects, self._options = effects, (combining, bandwidth)
        if dtype is None:
            dtype = np.float32 if self.large and combining == "power" else np.float64
        self._dtype, self._batch = dtype, computation.batch
        self._combining = fields.Combining.make(combining, paths.link, paths.delay, bandwidth)
        # Row (material) and column (constant) of each parameter in the table of constants. Derivatives are computed for
        # the columns in use and then assigned to the parameters.
        self._rows, self._columns = parameters.matrix_indices(list(paths.materials))
        used_columns, self._used_column = np.unique(self._columns, return_inverse=True)
        self._used_columns = tuple(int(column) for column in used_columns)
        self._base = paths.material_table().astype(dtype)
        self._intervals = (
            None if tabulate is False or effects else self._table_intervals(force=tabulate is True)
        )
        self._program = self._compile()
        self._channels: dict[tuple[Statistic, ...], fields.Channel] = {}

    @property
    def interactions(self) -> int:
        """Number of interactions that are evaluated for a candidate."""
        return self.paths.num_interactions

    @property
    def parts(self) -> tuple[tuple[Replay, NDArray[np.intp]], ...]:
        """The replay of every carrier with the indices of its links; here, only this replay with all links."""
        return ((self, np.arange(self.paths.num_links)),)

    @property
    def large(self) -> bool:
        """Whether there are so many interactions that evaluating a candidate takes milliseconds."""
        return self.interactions > LARGE

    def scene_path_loss(
        self, candidates: NDArray[np.float64], walls: Mapping[str, str]
    ) -> NDArray[np.float64]:
        """Path loss of the scene alone for candidates; see `ReplaysScene.scene_path_loss`."""
        if not self.effects and not walls:
            return self.path_loss(candidates)
        names = list(self.paths.materials)
        # Each facade takes the material of its wall.
        whole = np.array([names.index(walls.get(name, name)) for name in names], self.paths.material.dtype)
        paths = replace(self.paths, material=whole[self.paths.material])
        return Replay(paths, self.parameters, *self._options).path_loss(candidates)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates; see `Engine.path_loss`."""
        (loss,) = self._run(self._path_losses, candidates)
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link and its derivatives; see `Differentiable.path_loss_and_jacobian`."""
        loss, jacobian = self._run(self._path_losses_and_jacobian, candidates)
        return loss, jacobian

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """Path loss and further observables of every link; see `Observing.respond`."""
        values, batches = check_candidates(candidates, len(self.parameters)), []
        channel = self._measuring(wanted)
        function = fields.link_responses_and_slopes if derivatives else fields.link_responses
        for start in range(0, len(values), OBSERVED_SIZE):
            batch = values[start : start + OBSERVED_SIZE]
            padded = np.concatenate([batch, np.repeat(batch[:1], OBSERVED_SIZE - len(batch), axis=0)])
            batches.append(Responses(*function(channel, padded, len(batch))))
        responses = joined(batches)
        if self._combining.kind == "power":
            self.calls += len(values)
            return responses
        # Other ways of combining paths need more than the powers of the paths. The methods called below count the
        # candidates themselves.
        if not derivatives:
            return replace(responses, path_loss=self.path_loss(candidates))
        loss, slope = self.path_loss_and_jacobian(candidates)
        return replace(responses, path_loss=loss, loss_slope=slope)

    def _measuring(self, wanted: tuple[Statistic, ...]) -> fields.Channel:
        if wanted not in self._channels:
            self._channels = {wanted: self._channel.measuring(wanted)}
        return self._channels[wanted]

    @cached_property
    def _channel(self) -> fields.Channel:
        """The paths in the form that the computation of further observables requires."""
        plan = fields.layout(self.paths)
        return fields.Channel(
            plan.program,
            tuple(effect.ordered(plan.order) for effect in self.effects),
            self.paths.material_table(),
            self.paths.departure[plan.order],
            self.paths.arrival[plan.order],
            tuple(
                zip(
                    self.parameters.of_materials.tolist(),
                    self._rows.tolist(),
                    self._columns.tolist(),
                    strict=True,
                )
            ),
            tuple(self.parameters.of_effects.tolist()),
        )

    def _by_parameter(
        self, by_material: NDArray[np.floating], by_effect: NDArray[np.floating]
    ) -> NDArray[np.floating]:
        """Derivatives by parameter [..., d], from derivatives by material constant and by effect parameter."""
        jacobian = np.empty((*by_effect.shape[:-1], len(self.parameters)), by_effect.dtype)
        jacobian[..., self.parameters.of_materials] = by_material[..., self._rows, self._used_column]
        jacobian[..., self.parameters.of_effects] = by_effect
        return jacobian

    def _path_losses(
        self, tables: NDArray[np.floating], values: NDArray[np.floating], count: int
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        if self.effects:
            return fields.path_losses_with_effects(
                self._program, tables, fields.EffectBatch(self._effects, values), self._combining, count
            ), fields.WITHOUT_TABLES
        return fields.path_losses(self._program, tables, self._combining, count)

    def _path_losses_and_jacobian(
        self, tables: NDArray[np.floating], values: NDArray[np.floating], count: int
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
        if self.effects:
            effects = fields.EffectBatch(self._effects, values)
            loss, slope, by_effect = fields.path_losses_and_slopes_with_effects(
                self._program, tables, effects, self._used_columns, self._combining, count
            )
            return loss, self._by_parameter(slope, by_effect), fields.WITHOUT_TABLES
        loss, slope, error = fields.path_losses_and_slopes(
            self._program, tables, self._used_columns, self._combining, count
        )
        # No effect applies to these links, so derivatives with respect to effect parameters are 0.
        by_effect = np.zeros((*loss.shape, len(self.parameters.of_effects)), slope.dtype)
        return loss, self._by_parameter(slope, by_effect), error

    def _run(self, function: Callable, candidates: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        values = check_candidates(candidates, len(self.parameters)).astype(self._dtype)
        batches, start = [], 0
        while start < len(values):
            size = self._batch_size()
            batch = values[start : start + size]
            *answers, table_error = function(*self._arguments(self._base, batch, size), len(batch))
            too_coarse = table_error > TABLE_TOLERANCE
            refused = np.flatnonzero(too_coarse.any(axis=(1, 2)))
            # The results of candidates before the first refused one are accurate. Evaluation resumes at the refused
            # candidate with finer tables.
            done = refused[0] if len(refused) else len(batch)
            batches.append([np.asarray(answer[:done], dtype=float) for answer in answers])
            start += done
            if len(refused):
                self._refine_tables(too_coarse[done])
        self.calls += len(values)
        return tuple(np.concatenate(column) for column in zip(*batches, strict=True))

    def _arguments(
        self, base: NDArray[np.floating], batch: NDArray[np.floating], size: int
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Material constants [size, M, 8] and effect parameters [size, e] of a batch.

        The program is compiled for `size` candidates, so unused rows of the tables are filled with the base values.
        """
        tables = np.repeat(base[None], size, axis=0)
        tables[: len(batch), self._rows, self._columns] = batch[:, self.parameters.of_materials]
        # Unused rows of effect parameters repeat values of the batch; the answers to unused rows are discarded.
        of_effects = np.resize(batch[:, self.parameters.of_effects], (size, len(self.parameters.of_effects)))
        return tables, of_effects

    def _table_intervals(self, force: bool) -> NDArray[np.int64] | None:
        """Number of intervals in each table, by material and mode; None if evaluating the coefficients is faster."""
        if not force and self.interactions <= MAY_TABULATE:
            return None
        from scipy.stats import qmc  # the import takes 0.4 s

        unit = qmc.Sobol(len(self.parameters), rng=0).random(TABLE_CANDIDATES)
        candidates = np.concatenate([self.parameters.start[None], self.parameters.from_unit(unit)])
        tables = self.parameters.constants_of(candidates, self.paths.materials, self.paths.frequency)
        intervals = fields.table_intervals(self.paths, tables, TABLE_TOLERANCE)
        return intervals if force or intervals.sum() <= MOST_NODES * self.interactions else None

    def _refine_tables(self, too_coarse: NDArray[np.bool_]) -> None:
        """Refine the tables selected by a mask [M, 3]; if one would exceed `FINEST` intervals, stop using tables."""
        if self._intervals is not None:
            finer = np.where(too_coarse, 2 * self._intervals, self._intervals)
            self._intervals = finer if finer.max() <= fields.FINEST else None
        self._program = self._compile()

    def _compile(self) -> fields.GroupedProgram:
        plan = fields.layout(self.paths, self._dtype, self._intervals, self._combining.kind != "power")
        self._effects = tuple(effect.ordered(plan.order) for effect in self.effects)
        return plan.program

    def _batch_size(self) -> int:
        """Number of candidates in one call, which is a power of two within the limits on memory and on candidates."""
        per_candidate = self.paths.num_links * len(self.materials) * len(self._used_columns)
        most = max(MOST_DERIVATIVES // max(per_candidate, 1), 1)
        return min(self._batch, 1 << most.bit_length() - 1)


@dataclass(frozen=True, eq=False)
class CarrierPaths:
    """The paths at one carrier.

    Attributes:
        paths: The path program of the links measured at the carrier, with the material constants at this carrier.
        links: Indices of these links among all links [l].
        effects: Effects on the paths.
    """

    paths: Paths
    links: NDArray[np.int64]
    effects: fields.Effects = ()


@final
class ReplayCarriers:
    """Stored paths that are evaluated at several carriers; parameters can be coefficients of frequency laws.

    Args:
        carriers: The paths at each carrier; every link belongs to exactly one carrier.
        parameters: The parameters whose values a candidate contains.
        materials: The scene's materials before calibration, at the carrier of the trace.
        combining: How a link's paths are combined: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".

    Raises:
        InputError: A parameter's material is not in the paths, or the paths cannot be combined in this way.
    """

    def __init__(
        self,
        carriers: Sequence[CarrierPaths],
        parameters: Parameters,
        materials: dict[str, Material],
        combining: str = "power",
        bandwidth: float | None = None,
    ) -> None:
        self.parameters, self.materials, self.calls = parameters, dict(materials), 0
        self.num_links = sum(len(carrier.links) for carrier in carriers)
        # Two coefficients of one frequency law act on the same constant. Each carrier therefore replays only distinct
        # constants, and `_constant` maps every parameter to its constant. The mapping is the same at all carriers.
        constants = [parameters.at_carrier(carrier.paths.frequency) for carrier in carriers]
        self._constant = constants[0][1]
        self._first = np.unique(self._constant, return_index=True)[1]
        self._carriers = [
            (
                Replay(carrier.paths, at_carrier, combining, bandwidth, effects=carrier.effects),
                carrier.paths.frequency,
                carrier.links,
            )
            for carrier, (at_carrier, _) in zip(carriers, constants, strict=True)
        ]

    @property
    def interactions(self) -> int:
        """Number of interactions that are evaluated for a candidate, summed over all carriers."""
        return sum(replay.interactions for replay, _, _ in self._carriers)

    @property
    def parts(self) -> tuple[tuple[Replay, NDArray[np.intp]], ...]:
        """The replay of every carrier with the indices of its links."""
        return tuple((replay, links) for replay, _, links in self._carriers)

    @property
    def large(self) -> bool:
        """Whether one of the carriers has so many interactions that evaluating a candidate takes milliseconds."""
        return any(replay.large for replay, _, _ in self._carriers)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates; see `Engine.path_loss`."""
        return self._by_carrier(candidates, Replay.path_loss)

    def scene_path_loss(
        self, candidates: NDArray[np.float64], walls: Mapping[str, str]
    ) -> NDArray[np.float64]:
        """Path loss of the scene alone for candidates; see `ReplaysScene.scene_path_loss`."""
        return self._by_carrier(candidates, partial(Replay.scene_path_loss, walls=walls))

    def _by_carrier(
        self,
        candidates: NDArray[np.float64],
        path_loss: Callable[[Replay, NDArray[np.float64]], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        candidates = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(candidates), self.num_links))
        for replay, frequency, links in self._carriers:
            values, _ = self.parameters.constants_and_slopes(candidates, frequency)
            loss[:, links] = path_loss(replay, values[:, self._first])
        self.calls += len(candidates)
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link and its derivatives; see `Differentiable.path_loss_and_jacobian`."""
        candidates = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(candidates), self.num_links))
        jacobian = np.empty((*loss.shape, len(self.parameters)))
        for replay, frequency, links in self._carriers:
            values, slopes = self.parameters.constants_and_slopes(candidates, frequency)
            loss[:, links], by_constant = replay.path_loss_and_jacobian(values[:, self._first])
            jacobian[:, links] = by_constant[:, :, self._constant] * slopes[:, None, :]
        self.calls += len(candidates)
        return loss, jacobian

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """Path loss and further observables of every link; see `Observing.respond`."""
        candidates = check_candidates(candidates, len(self.parameters))
        parts = []
        for replay, frequency, _ in self._carriers:
            values, slopes = self.parameters.constants_and_slopes(candidates, frequency)
            part = replay.respond(values[:, self._first], wanted, derivatives)
            if part.loss_slope is not None and part.observed_slope is not None:
                part = replace(
                    part,
                    loss_slope=part.loss_slope[..., self._constant] * slopes[:, None, :],
                    observed_slope=part.observed_slope[..., self._constant] * slopes[:, None, None, :],
                )
            parts.append(part)
        self.calls += len(candidates)
        return of_links(parts, [links for _, _, links in self._carriers])
