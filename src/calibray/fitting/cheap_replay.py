"""The replay of a study's own scene, as the cheap model of an engine that can only be called.

The scene that the study names is traced once, and its paths answer for a candidate in microseconds. What its materials
are taken to be and the study does not calibrate (thickness above all, conductivity, permittivity) are the model's
constants, which space mapping adjusts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Final, Protocol, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.kinds.replay import replay
from calibray.engines.observable import PATH_LOSS
from calibray.errors import EngineError, InputError
from calibray.fitting.methods import AUTO
from calibray.fitting.problem import Problem
from calibray.materials import Material
from calibray.optimizers.multifidelity.cheap_model import CheapAnswer, Constants
from calibray.parameters import Parameter, Parameters
from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.result.remark import Remark, RemarkKind
from calibray.study import Setup
from calibray.support.progress import Progress

SPREAD: Final = {"thickness": 0.5, "conductivity": 0.7, "relative_permittivity": 0.2}
"""Standard deviation of the logarithm of a constant around what the study says."""

FAR: Final = 3.0
"""Standard deviations to the bounds of a constant."""

METAL: Final = 1e4
"""Conductivity from which on a material reflects all, whatever its constants [S/m]."""


class StoredPaths(Protocol):
    """Stored paths, with derivatives."""

    @property
    def parameters(self) -> Parameters:
        """What a candidate's components stand for."""
        ...

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [n, L], [dB], of candidates [n, d]; +inf without a path."""
        ...

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The same, and its derivatives by the parameters [n, L, d]."""
        ...


class Rows(Protocol):
    """How path loss becomes what is compared."""

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Rows [n, m] of candidates [n, d] and their path loss [n, L], [dB]."""
        ...

    def slopes(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], slope: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives of the rows [n, m, k] from those of the path loss [n, L, k]."""
        ...

    @property
    def filling(self) -> NDArray[np.float64]:
        """What stands for the path loss of a link that no path leads to [L], [dB]."""
        ...

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which rows depend on links that are reached [m], of the links that are [L]."""
        ...


@final
@dataclass(eq=False)
class ReplayedModel:
    """Stored paths as a cheap model, of the constants that a study leaves as they are.

    Attributes:
        engine: The paths, over the study's parameters and then the constants.
        count: Number of the study's parameters.
        rows: How their path loss becomes what is compared.
        calls: Candidates evaluated so far.
        seconds: Time that these took [s].
    """

    engine: StoredPaths
    count: int
    rows: Rows
    calls: int = 0
    seconds: float = 0.0
    _reached: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        start = self.engine.parameters.start
        self._reached = np.isfinite(self.engine.path_loss(start[None])[0])

    @property
    def known(self) -> NDArray[np.bool_]:
        """Rows that the paths say something about [m]."""
        return self.rows.known(self._reached)

    @property
    def constants(self) -> Constants:
        """The constants, as logarithms."""
        parameters = self.engine.parameters
        lower, upper = (bound[self.count :] for bound in parameters.search_bounds)
        centre = parameters.to_search(parameters.start)[self.count :]
        return Constants(centre, (upper - lower) / (2.0 * FAR), lower, upper)

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `CheapModel.residuals`."""
        started, candidates = time.perf_counter(), self._candidates(points, constants)
        loss = self._filled(self.engine.path_loss(candidates))
        self._spent(started, len(points))
        return self.rows.residuals(candidates[:, : self.count], loss)

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """See `CheapModel.answer`."""
        started, candidates = time.perf_counter(), self._candidates(points, constants)
        loss, slope = self.engine.path_loss_and_jacobian(candidates)
        self._spent(started, len(points))
        slope = np.where(np.isfinite(slope) & np.isfinite(loss)[:, :, None], slope, 0.0)
        slope = slope * self.engine.parameters.search_slope(candidates)[:, None, :]
        loss, own = self._filled(loss), candidates[:, : self.count]
        slopes = self.rows.slopes(own, loss, slope)
        return CheapAnswer(
            self.rows.residuals(own, loss), slopes[:, :, : self.count], slopes[:, :, self.count :]
        )

    def _candidates(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.engine.parameters.from_search(np.hstack([points, constants]))

    def _filled(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(self._reached, loss, self.rows.filling)

    def _spent(self, started: float, calls: int) -> None:
        self.calls, self.seconds = self.calls + calls, self.seconds + time.perf_counter() - started


@dataclass(frozen=True, eq=False)
class ProblemRows:
    """The rows of a problem: its residuals, those of priors included.

    Attributes:
        problem: The problem.
    """

    problem: Problem

    @property
    def filling(self) -> NDArray[np.float64]:
        """The measured path loss, or the ceiling where one stands for a link without a path [L], [dB]."""
        objective = self.problem.objective
        if objective.ceiling_db is not None:
            return np.full(len(objective.measured), objective.ceiling_db)
        return objective.measured

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See `Rows.known`; a prior needs no model."""
        links = reached[self.problem.objective.weight > 0]
        priors = int((self.problem.objective.nuisance.prior < np.inf).sum()) + len(self.problem.priors)
        return np.append(links, np.zeros(priors, dtype=bool))

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.residuals`."""
        return self.problem.residuals(candidates, path_loss)

    def slopes(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], slope: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.slopes`."""
        return self.problem.slopes(candidates, path_loss, slope)


@dataclass(frozen=True, eq=False)
class Aid:
    """The cheap model of a calibration.

    Attributes:
        model: The model; None where none is wanted, or there is nothing to make one of.
        remark: Why there is none, where one was wanted.
    """

    model: ReplayedModel | None = None
    remark: Remark | None = None


def aid(problem: Problem, progress: Progress | None = None, scene: Setup | None = None) -> Aid:
    """The replay of a problem's own scene, where its method has a use for it.

    Args:
        problem: The problem.
        progress: Called with the stage "tracing" after every launch.
        scene: A study of the same links, whose trace is replayed in place of the problem's own.

    Returns:
        The model, or why there is none.
    """
    setup = problem.setup
    section = setup.study.method
    wanted = section.name in (AUTO, "space-mapping") and section.model == "replay"
    if not wanted or not setup.study.engine.expensive or problem.observable is not PATH_LOSS:
        return Aid()
    try:
        scene = setup if scene is None else scene
        paths = scene.trace(progress=progress)
        parameters = with_constants(problem.parameters, paths.materials, setup.links.frequency is None)
        engine = replay(replace(scene, parameters=parameters), paths)
        model = ReplayedModel(engine, len(problem.parameters), ProblemRows(problem))
    except (InputError, EngineError, ImportError) as error:
        reason = " ".join(str(error).split())
        return Aid(None, _no_model(f"the scene cannot be traced here ({reason})"))
    if not model.known.any():
        return Aid(None, _no_model("the trace of the scene reaches none of the links"))
    return Aid(model)


def _no_model(cause: str) -> Remark:
    return Remark(RemarkKind.NO_CHEAP_MODEL, {"cause": cause})


def with_constants(
    parameters: Parameters, materials: dict[str, Material], one_carrier: bool = True
) -> Parameters:
    """Parameters, and after them the constants that none of them acts on.

    Args:
        parameters: The parameters.
        materials: The materials, as they are believed to be.
        one_carrier: Whether constants hold at all links; else those that follow the frequency are left as they are.

    Returns:
        Both, the constants on a logarithmic scale.
    """
    free = {f"{parameter.material}.{parameter.constant}" for parameter in parameters}
    found = []
    for name, material in materials.items():
        for constant, spread in SPREAD.items():
            value, bound = getattr(material, constant), PARAMETER_BOUNDS[constant]
            lower, upper = (value * float(np.exp(sign * FAR * spread)) for sign in (-1.0, 1.0))
            fixed = f"{name}.{constant}" not in free and value > 0 and material.conductivity < METAL
            if not fixed or upper not in bound or not (one_carrier or constant == "thickness"):
                continue
            if lower not in bound:  # of permittivity, of which none is below 1
                continue
            found.append(Parameter(f"{name}.{constant}", lower, upper, value, "log"))
    return replace(parameters, items=(*parameters.items, *found))
