"""Emulators of an engine without derivatives, fitted to its calls.

Intervals require thousands of evaluations, and calls are expensive. A Gaussian process for the path loss of every link
interpolates the calls (`multifidelity/discrepancy.py`). The mean of the process is the corrected replay of the study's
scene if such a replay is available and not misleading; otherwise it is a constant. The uncertainty of the process must
widen the intervals. We therefore draw functions from the process, use each function as an engine, and pool the
resulting posteriors. Each call is also predicted from all other calls. If the errors of these predictions exceed the
expected errors, the spread of the drawn functions is increased by the same factor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import Responses
from calibray.fitting.cheap_replay import ProblemRows, ReplayedModel
from calibray.fitting.observed import Observed
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.materials import Material
from calibray.measurements.observables import Statistic
from calibray.optimizers.arguments import Box
from calibray.optimizers.evaluations import merge_repeated
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.correction import UnitModel, correct
from calibray.optimizers.multifidelity.discrepancy import SampledFunction, sample_function, standardized_error
from calibray.optimizers.multifidelity.space_mapping import CLOUD, JUDGED, MISLED, error_ratio
from calibray.optimizers.regression import Inputs
from calibray.optimizers.sampling import design
from calibray.parameters import Parameters

FUNCTIONS: Final = 8
"""Number of functions drawn."""

MAX_CALLS: Final = 200
"""Maximum number of calls that the process interpolates; the covariance matrix is factored about a hundred times."""

NEAR: Final = 0.005
"""If there are more than `MAX_CALLS` calls and two calls are closer together than this in the unit cube, only the
better call is used."""


class MeanFunction(Protocol):
    """The mean of the Gaussian process: the path loss predicted without calls."""

    def base(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], Inputs]:
        """Path loss [k, m] at points of the unit cube [k, d], and the inputs of the process."""
        ...

    def base_and_slope(
        self, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Inputs, NDArray[np.float64]]:
        """Path loss, its derivatives [k, m, d], the inputs, and the derivatives [k, r, d] of the inputs' responses."""
        ...


@dataclass(frozen=True, eq=False)
class ConstantMean:
    """A constant mean with linear responses, used if there is no replay.

    Attributes:
        centre: Mean of each emulated row over the calls [m], [dB].
    """

    centre: NDArray[np.float64]

    def base(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], Inputs]:
        """See `MeanFunction.base`."""
        return np.tile(self.centre, (len(unit), 1)), Inputs(unit, _steepness(unit) * (unit - 0.5))

    def base_and_slope(
        self, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Inputs, NDArray[np.float64]]:
        """See `MeanFunction.base_and_slope`."""
        (count, d), (base, inputs) = unit.shape, self.base(unit)
        change = np.broadcast_to(_steepness(unit) * np.eye(d), (count, d, d))
        return base, np.zeros((*base.shape, d)), inputs, change


@dataclass(frozen=True, eq=False)
class ResponseRows:
    """The emulated rows, which replace the residuals: path loss of links with nonzero weight, then further observables.

    Further observables are divided by the standard deviation of their error and multiplied by that of path loss, so
    that all rows are comparable.

    Attributes:
        problem: The problem.
        links: Indices of the m links with nonzero weight [m].
    """

    problem: Problem
    links: NDArray[np.int64]

    @property
    def wanted(self) -> tuple[Statistic, ...]:
        """See `Rows.wanted`."""
        return self.problem.statistics

    @property
    def filling(self) -> NDArray[np.float64]:
        """See `Rows.filling`."""
        return ProblemRows(self.problem).filling

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See `Rows.known`."""
        return np.concatenate([reached[self.links], *(reached[used] for used in self.used)])

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], observed: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.residuals`; an observable of a link without a path is replaced by its measured value."""
        rows = [self.problem.objective.capped(path_loss)[:, self.links]]
        for index, (each, used) in enumerate(zip(self.problem.observed, self.used, strict=True)):
            values = observed[:, index, used] / each.scale
            rows.append(np.where(np.isfinite(values), values, each.measured[used]) * self.unit(index))
        return np.concatenate(rows, axis=1)

    def slopes(
        self,
        candidates: NDArray[np.float64],
        path_loss: NDArray[np.float64],
        slope: NDArray[np.float64],
        observed_slope: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """See `Rows.slopes`."""
        capped = self.problem.objective.capped(path_loss) < path_loss
        rows = [np.where(capped[:, :, None], 0.0, slope)[:, self.links]]
        if observed_slope is not None:
            for index, (each, used) in enumerate(zip(self.problem.observed, self.used, strict=True)):
                rows.append(np.nan_to_num(observed_slope[:, index, used]) * self.unit(index) / each.scale)
        return np.concatenate(rows, axis=1)

    @property
    def used(self) -> list[NDArray[np.int64]]:
        """Indices, for each further observable, of the links with a value."""
        return [each.used(self.problem.objective.weight) for each in self.problem.observed]

    def unit(self, index: int) -> float:
        """Factor that converts scaled values of an observable to emulated rows."""
        return self.problem.objective.noise_db / self.problem.observed[index].std


class Calls(NamedTuple):
    """The calls of an engine.

    Attributes:
        unit: Distinct points in the unit cube [n, d].
        rows: Emulated rows [n, m] at the points, as in `ResponseRows`.
        value: Objective [n].
    """

    unit: NDArray[np.float64]
    rows: NDArray[np.float64]
    value: NDArray[np.float64]


@dataclass(eq=False)
class EmulatedEngine:
    """A function of the parameters that replaces an engine, with derivatives.

    Attributes:
        parameters: The parameters of a candidate.
        materials: The scene's initial materials.
        interactions: Cost of a candidate, as an equivalent number of interactions.
        mean: The mean function.
        function: The function added to the mean.
        rows: The definition of the m emulated rows.
        initial_loss: Path loss [L], [dB], of all links at the initial values; returned for links that are not emulated.
        calls: Number of candidates evaluated so far.
    """

    parameters: Parameters
    materials: dict[str, Material]
    interactions: int
    mean: MeanFunction
    function: SampledFunction
    rows: ResponseRows
    initial_loss: NDArray[np.float64]
    calls: int = 0
    large: bool = False

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Engine.path_loss`."""
        return self.respond(candidates, ()).path_loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `Differentiable.path_loss_and_jacobian`."""
        answer = self.respond(candidates, (), derivatives=True)
        return answer.path_loss, cast(NDArray, answer.loss_slope)

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """See `Observing.respond`; the emulator computes all observables of the study, or none if `wanted` is empty."""
        count = len(candidates)
        self.calls += count
        unit = self._box.to_unit(self.parameters.to_search(candidates))
        if not derivatives:
            base, inputs = self.mean.base(unit)
            return Responses(*self._for_all_links(base + self.function.values(inputs), wanted))
        base, slope, inputs, change = self.mean.base_and_slope(unit)
        box, scale = self._box, self.parameters.search_slope(candidates)
        # Convert to derivatives with respect to physical values instead of unit-cube coordinates.
        slope = (slope + self.function.slopes(inputs, change)) / (box.width * scale[:, None, :])
        links, last = self.rows.links, len(self.rows.links)
        loss_slope = np.zeros((count, len(self.initial_loss), box.dimension))
        loss_slope[:, links] = slope[:, :last]
        observed_slope = np.zeros((count, len(wanted), len(self.initial_loss), box.dimension))
        for index, (each, used, part) in enumerate(self._further(slope, wanted)):
            observed_slope[:, index, used] = part * each.scale / self.rows.unit(index)
        values = self._for_all_links(base + self.function.values(inputs), wanted)
        return Responses(*values, loss_slope, observed_slope)

    @property
    def _box(self) -> Box:
        return Box(*self.parameters.search_bounds)

    def _for_all_links(
        self, rows: NDArray[np.float64], wanted: tuple[Statistic, ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss [n, L] and further observables [n, K, L] of emulated rows [n, m]."""
        loss = np.tile(self.initial_loss, (len(rows), 1))
        loss[:, self.rows.links] = rows[:, : len(self.rows.links)]
        observed = np.full((len(rows), len(wanted), len(self.initial_loss)), np.nan)
        for index, (each, used, part) in enumerate(self._further(rows, wanted)):
            observed[:, index, used] = part * each.scale / self.rows.unit(index)
        return loss, observed

    def _further(
        self, rows: NDArray[np.float64], wanted: tuple[Statistic, ...]
    ) -> Iterator[tuple[Observed, NDArray[np.int64], NDArray[np.float64]]]:
        """Yield each further observable, its links with a value, and its part of the emulated rows [n, m, ...]."""
        first = len(self.rows.links)
        every = self.rows.problem.observed if wanted else ()
        for each, used in zip(every, self.rows.used, strict=False):
            yield each, used, rows[:, first : first + len(used)]
            first += len(used)


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Emulators of an engine.

    Attributes:
        mean: The posterior mean of the process.
        drawn: Functions drawn from the process.
        apart_db: RMS difference, over the unit cube, between the drawn functions and the mean [dB].
        error_db: RMS leave-one-out error of the better half of the calls [dB].
        calls: Number of calls that the process interpolates.
        replayed: The corrected replay in the mean function; None if there is no replay or the replay is misleading.
    """

    mean: EmulatedEngine
    drawn: tuple[EmulatedEngine, ...]
    apart_db: float
    error_db: float
    calls: int
    replayed: ReplayedModel | None


def emulate(problem: Problem, trail: Trail, model: ReplayedModel | None = None) -> Ensemble | None:
    """Emulate an engine from its calls and, if available, a replay of the scene; None if there are too few calls."""
    objective, parameters, method = problem.objective, problem.parameters, problem.setup.study.method
    box, rows = Box(*parameters.search_bounds), ResponseRows(problem, np.flatnonzero(objective.weight > 0))
    calls = _calls(problem, trail, box, rows)
    random, noisy = np.random.default_rng([method.seed, 8]), bool(method.options.get("noisy", False))
    # Use the replay with the emulated rows as its residuals, if it predicts any of these rows.
    replayed = None if model is None else ReplayedModel(model.engine, model.count, rows, model.layers)
    replayed = replayed if replayed is not None and replayed.known.any() else None
    corrected = None
    if replayed is not None and len(calls.unit) > 1:
        cloud = design("sobol", CLOUD, box.dimension, random)
        corrected = correct(UnitModel(replayed, box), (calls.unit, calls.rows), cloud, random, noisy=noisy)
        if len(calls.unit) >= JUDGED and error_ratio(corrected, noisy=noisy) > MISLED:
            corrected = None
    if corrected is not None:
        mean: MeanFunction = corrected
        process = corrected.discrepancy
    elif len(calls.unit) >= box.dimension + 2:
        mean, replayed = ConstantMean(calls.rows.mean(axis=0)), None
        base, inputs = mean.base(calls.unit)
        scale = float(np.sqrt(np.mean((calls.rows - base) ** 2)))
        process = discrepancy.fit(inputs, calls.rows - base, max(scale, 1e-6), noisy=noisy)
    else:
        return None
    better = np.argsort(calls.value, kind="stable")[: max(2, len(calls.value) // 2)]
    # If leave-one-out errors exceed the expected errors, increase the spread of the drawn functions by the same factor.
    stretch = max(
        1.0, standardized_error(process, better), standardized_error(process, np.arange(len(calls.value)))
    )
    cost = calls.rows.size + (0 if replayed is None else int(getattr(replayed.engine, "interactions", 1)))
    functions = [
        sample_function(process, random, 0.0),
        *(sample_function(process, random, stretch) for _ in range(FUNCTIONS)),
    ]
    mean_engine, *drawn = (
        EmulatedEngine(parameters, problem.engine.materials, cost, mean, function, rows, problem.before)
        for function in functions
    )
    _, inputs = mean.base(design("sobol", CLOUD, box.dimension, random))
    mean_values, *drawn_values = (function.values(inputs) for function in functions)
    return Ensemble(
        mean_engine,
        tuple(drawn),
        apart_db=float(np.sqrt(np.mean((np.array(drawn_values) - mean_values) ** 2))),
        error_db=float(np.sqrt(np.mean(process.left_out_errors()[better] ** 2))),
        calls=len(calls.unit),
        replayed=replayed,
    )


def _calls(problem: Problem, trail: Trail, box: Box, rows: ResponseRows) -> Calls:
    """The calls with path loss for every link with nonzero weight; a selection of them if there are too many."""
    parameters = problem.parameters
    candidates, modelled = np.array(trail.candidates), np.array(trail.modelled)
    observed = np.array(trail.observed)
    # The problem stores path loss at the initial values, but no observables.
    if not problem.observed:
        candidates = np.vstack([candidates, parameters.start])
        modelled = np.vstack([modelled, problem.before])
        observed = np.zeros((len(candidates), 0, problem.num_links))
    every = rows.residuals(candidates, modelled, observed)
    complete = np.isfinite(every).all(axis=1)
    if problem.observed:
        residuals = problem.residuals(candidates[complete], modelled[complete], observed[complete])
        value = np.sqrt(np.mean(residuals**2, axis=1))
    else:
        value = problem.objective.value(modelled[complete])
    unit, rows_and_value = merge_repeated(
        box.to_unit(parameters.to_search(candidates[complete])), np.column_stack([every[complete], value])
    )
    order = np.argsort(rows_and_value[:, -1], kind="stable")
    if len(order) > MAX_CALLS:
        distinct: list[int] = []
        for index in order.tolist():
            if not distinct or np.abs(unit[distinct] - unit[index]).max(axis=1).min() > NEAR:
                distinct.append(index)
        # Keep the best calls and an evenly spaced selection of the other calls.
        half = MAX_CALLS // 2
        best, others = np.array(distinct[:half], dtype=np.int64), np.array(distinct[half:], dtype=np.int64)
        if len(others):
            others = others[np.unique(np.linspace(0, len(others) - 1, half).astype(np.int64))]
        order = np.concatenate([best, others])
    return Calls(unit[order], rows_and_value[order, :-1], rows_and_value[order, -1])


def _steepness(unit: NDArray[np.float64]) -> float:
    """Factor that scales the responses to a total mean square of one over the cube."""
    # A coordinate that is uniform in the unit cube has variance 1 / 12.
    return float(np.sqrt(12.0 / unit.shape[1]))
