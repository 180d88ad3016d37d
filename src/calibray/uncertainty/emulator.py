"""What stands in for an engine without derivatives: its calls, and functions of the parameters that agree with them.

Intervals take thousands of evaluations, and calls are dear. A Gaussian process for the path loss of every link passes
through what was answered (`multifidelity/discrepancy.py`): what the replay of the study's own scene leaves of it, once
corrected, where there is one and it does not mislead; else all of it, around planes. What the process does not know
must not narrow an interval. So whole functions are drawn from it, each as good an engine as the others, and intervals
are those of their posteriors together. Every call is also foretold from all the others: where that fails by more than
the process expects, functions are drawn as much further apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.cheap_replay import ReplayedModel, StoredPaths
from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.materials import Material
from calibray.optimizers.box import Box
from calibray.optimizers.evaluations import merge_repeated
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.correction import Corrected, correct
from calibray.optimizers.multifidelity.sampled_functions import (
    SampledFunction,
    sample_function,
    standardized_error,
)
from calibray.optimizers.multifidelity.space_mapping import CLOUD, JUDGED, MISLED, error_ratio
from calibray.optimizers.regression import Inputs
from calibray.optimizers.sampling import design
from calibray.parameters import Parameters

FUNCTIONS: Final = 8
"""Functions drawn."""

MOST: Final = 200
"""Calls that they pass through, for the matrix is factored some hundred times."""

TRIALS: Final = 8
"""Constants drawn from their prior that the input mapping starts from, beside the believed ones."""

NEAR: Final = 0.005
"""Distance in the unit cube below which one call tells as much as two, where there are more."""


class Ground(Protocol):
    """What is known of the links before any call."""

    def base(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], Inputs]:
        """Path loss [k, m] at points of the unit cube [k, d], and these as the process sees them."""
        ...

    def base_and_slope(
        self, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Inputs, NDArray[np.float64]]:
        """The same with derivatives [k, m, d], and those of the responses [k, r, d]."""
        ...


@dataclass(frozen=True, eq=False)
class Planes:
    """Nothing is known but that links change evenly rather than not.

    Attributes:
        centre: Mean path loss [m], [dB].
    """

    centre: NDArray[np.float64]

    def base(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], Inputs]:
        """See `Ground.base`."""
        return np.tile(self.centre, (len(unit), 1)), Inputs(unit, _steepness(unit) * (unit - 0.5))

    def base_and_slope(
        self, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Inputs, NDArray[np.float64]]:
        """See `Ground.base_and_slope`."""
        (count, d), (base, inputs) = unit.shape, self.base(unit)
        change = np.broadcast_to(_steepness(unit) * np.eye(d), (count, d, d))
        return base, np.zeros((*base.shape, d)), inputs, change


@dataclass(frozen=True, eq=False)
class LossRows:
    """The path loss of the links that count, as a cheap model's rows.

    Attributes:
        objective: What says which count, and what a lost link counts as.
        links: Their places [m].
    """

    objective: Objective
    links: NDArray[np.int64]

    @property
    def filling(self) -> NDArray[np.float64]:
        """The measured path loss, or the ceiling where one stands for a link without a path [L], [dB]."""
        ceiling = self.objective.ceiling_db
        return self.objective.measured if ceiling is None else np.full(len(self.objective.measured), ceiling)

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See `Rows.known`."""
        return reached[self.links]

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.residuals`."""
        return self.objective.capped(path_loss)[:, self.links]

    def slopes(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], slope: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.slopes`."""
        capped = self.objective.capped(path_loss) < path_loss
        return np.where(capped[:, :, None], 0.0, slope)[:, self.links]


class Asked(NamedTuple):
    """What is known of an engine: its calls.

    Attributes:
        unit: Distinct points, in the unit cube [n, d].
        loss: Path loss of the links that count [n, m], [dB].
        value: What was minimized there [n].
    """

    unit: NDArray[np.float64]
    loss: NDArray[np.float64]
    value: NDArray[np.float64]


@dataclass(eq=False)
class StandIn:
    """A function of the parameters that takes an engine's place; it has derivatives.

    Attributes:
        parameters: What a candidate's components stand for.
        materials: The scene's materials before calibration.
        interactions: What a candidate costs, as that many interactions would.
        ground: What it starts from.
        function: What it adds to that.
        links: Places of the links that it is about [m].
        elsewhere: Path loss of all links, kept where it is about others [L], [dB].
        calls: Candidates evaluated so far.
    """

    parameters: Parameters
    materials: dict[str, Material]
    interactions: int
    ground: Ground
    function: SampledFunction
    links: NDArray[np.int64]
    elsewhere: NDArray[np.float64]
    calls: int = 0
    large: bool = False

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Engine.path_loss`."""
        base, inputs = self.ground.base(self._unit(candidates))
        return self._placed(base + self.function.values(inputs))

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `Differentiable.path_loss_and_jacobian`."""
        base, slope, inputs, change = self.ground.base_and_slope(self._unit(candidates))
        box, scale = self._box, self.parameters.search_slope(candidates)
        slope = (slope + self.function.slopes(inputs, change)) / (box.width * scale[:, None, :])
        whole = np.zeros((len(candidates), len(self.elsewhere), box.dimension))
        whole[:, self.links] = slope
        return self._placed(base + self.function.values(inputs)), whole

    @property
    def _box(self) -> Box:
        return Box(*self.parameters.search_bounds)

    def _unit(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        self.calls += len(candidates)
        return self._box.to_unit(self.parameters.to_search(candidates))

    def _placed(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        whole = np.tile(self.elsewhere, (len(loss), 1))
        whole[:, self.links] = loss
        return whole


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Functions that take an engine's place.

    Attributes:
        mean: The mean of all that are possible.
        drawn: Some of them.
        apart_db: Root mean square of what these differ by from it, over the whole range of the parameters [dB].
        error_db: Root mean square of the errors with which the better half of the calls are foretold, each from all
            others [dB].
        calls: Calls that they pass through.
        replayed: The corrected replay that they start from; None where there is none, or it misleads.
    """

    mean: StandIn
    drawn: tuple[StandIn, ...]
    apart_db: float
    error_db: float
    calls: int
    replayed: ReplayedModel | None


def ensemble(problem: Problem, trail: Trail, model: ReplayedModel | None = None) -> Ensemble | None:
    """Functions that agree with all that an engine answered.

    Args:
        problem: The problem.
        trail: Its finished search.
        model: The replay of the study's own scene, if there is one.

    Returns:
        The functions; None where the calls are too few to tell anything.
    """
    objective, parameters, method = problem.objective, problem.parameters, problem.setup.study.method
    box, links = Box(*parameters.search_bounds), np.flatnonzero(objective.weight > 0)
    asked = _asked(problem, trail, box, links)
    random, noisy = np.random.default_rng([method.seed, 8]), bool(method.options.get("noisy", False))
    replayed = None if model is None else _replayed(model, LossRows(objective, links))
    corrected = None
    if replayed is not None and len(asked.unit) > 1:
        corrected = _corrected(replayed, box, asked, random, noisy)
        if len(asked.unit) >= JUDGED and error_ratio(corrected) > MISLED:
            corrected = None
    if corrected is not None:
        ground: Ground = corrected
        process = corrected.discrepancy
    elif len(asked.unit) >= box.dimension + 2:
        ground, replayed = Planes(asked.loss.mean(axis=0)), None
        base, inputs = ground.base(asked.unit)
        scale = float(np.sqrt(np.mean((asked.loss - base) ** 2)))
        process = discrepancy.fit(inputs, asked.loss - base, max(scale, 1e-6), noisy=noisy)
    else:
        return None
    better = np.argsort(asked.value, kind="stable")[: max(2, len(asked.value) // 2)]
    stretch = max(
        1.0, standardized_error(process, better), standardized_error(process, np.arange(len(asked.value)))
    )
    cost = asked.loss.size + (0 if replayed is None else _interactions(replayed.engine))

    functions = [
        sample_function(process, random, 0.0),
        *(sample_function(process, random, stretch) for _ in range(FUNCTIONS)),
    ]
    mean, *others = (
        StandIn(parameters, problem.engine.materials, cost, ground, each, links, problem.before)
        for each in functions
    )
    _, inputs = ground.base(design("sobol", CLOUD, box.dimension, random))
    middle, *apart = (function.values(inputs) for function in functions)
    return Ensemble(
        mean,
        tuple(others),
        float(np.sqrt(np.mean((np.array(apart) - middle) ** 2))),
        float(np.sqrt(np.mean(process.left_out_errors()[better] ** 2))),
        len(asked.unit),
        replayed,
    )


def _asked(problem: Problem, trail: Trail, box: Box, links: NDArray[np.int64]) -> Asked:
    """All calls that gave every link that counts a path loss; of many, those that tell the most."""
    objective, parameters = problem.objective, problem.parameters
    candidates = np.array([*trail.candidates, parameters.start])
    modelled = np.array([*trail.modelled, problem.before])
    loss = objective.capped(modelled)[:, links]
    good = np.isfinite(loss).all(axis=1)
    unit, both = merge_repeated(
        box.to_unit(parameters.to_search(candidates[good])),
        np.column_stack([loss[good], objective.value(modelled[good])]),
    )
    order = np.argsort(both[:, -1], kind="stable")
    if len(order) > MOST:
        kept: list[int] = []
        for place in order.tolist():
            if not kept or np.abs(unit[kept] - unit[place]).max(axis=1).min() > NEAR:
                kept.append(place)
        # The best half, and of the rest some from everywhere.
        far = np.array(kept[MOST // 2 :], dtype=np.int64)
        some = np.unique(np.linspace(0, len(far) - 1, MOST // 2).astype(np.int64)) if len(far) else far
        order = np.concatenate([np.array(kept[: MOST // 2], dtype=np.int64), far[some]])
    return Asked(unit[order], both[order, :-1], both[order, -1])


def _corrected(
    model: ReplayedModel, box: Box, asked: Asked, random: np.random.Generator, noisy: bool
) -> Corrected:
    """The replay, corrected by the calls."""
    given = model.constants
    trials = given.centre + given.spread * random.standard_normal((TRIALS, len(given.centre)))
    trials = np.vstack([given.centre, np.clip(trials, given.lower, given.upper)])
    cloud = design("sobol", CLOUD, box.dimension, random)
    return correct(model, box, asked.unit, asked.loss, cloud, trials, noisy=noisy)


def _replayed(model: ReplayedModel, rows: LossRows) -> ReplayedModel | None:
    found = ReplayedModel(model.engine, model.count, rows)
    return found if found.known.any() else None


def _interactions(engine: StoredPaths) -> int:
    return int(getattr(engine, "interactions", 1))


def _steepness(unit: NDArray[np.float64]) -> float:
    """Factor that gives responses a mean square of one together, over the cube."""
    return float(np.sqrt(12.0 / unit.shape[1]))
