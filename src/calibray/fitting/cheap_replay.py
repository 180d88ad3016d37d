"""A replay of the study's scene, used as a cheap model of an engine without derivatives.

We trace the study's scene once. Evaluating a candidate on the stored paths then takes microseconds. The constants of
the cheap model are the material constants that the study does not calibrate: thickness, conductivity and permittivity,
in order of importance. Space mapping adjusts these constants.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Final, Protocol, cast, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.kinds.replay import replay
from calibray.engines.protocol import PATH_LOSS, Observing, Responses
from calibray.errors import EngineError, InputError
from calibray.fitting.problem import Problem
from calibray.fitting.search import AUTO
from calibray.materials import Material
from calibray.measurements.observables import Statistic
from calibray.optimizers.protocol import CheapAnswer, Constants
from calibray.parameters import Parameter, Parameters
from calibray.parameters.parameter import PARAMETER_BOUNDS
from calibray.result.verdict import Remark, RemarkKind
from calibray.study import Setup
from calibray.support.progress import Progress

SPREAD: Final = {"thickness": 0.5, "conductivity": 0.7, "relative_permittivity": 0.2}
"""Standard deviation of the logarithm of a constant around its declared value."""

BOUND: Final = 3.0
"""Distance from a constant's declared value to its bounds, in standard deviations."""

METAL: Final = 1e4
"""Conductivity [S/m] above which a material reflects almost all power, regardless of its other constants."""


class StoredPaths(Protocol):
    """A replay of stored paths, with derivatives."""

    @property
    def parameters(self) -> Parameters:
        """The parameters of a candidate."""
        ...

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [n, L], [dB], of candidates [n, d]; +inf for a link without a path."""
        ...

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss [n, L], [dB], and its derivatives with respect to the parameters [n, L, d]."""
        ...


class Rows(Protocol):
    """Converts path loss and further observables to the residuals of a cheap model."""

    @property
    def wanted(self) -> tuple[Statistic, ...]:
        """The further observables."""
        ...

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], observed: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Residuals [n, m] of candidates [n, d] with path loss [n, L], [dB], and further observables [n, K, L]."""
        ...

    def slopes(
        self,
        candidates: NDArray[np.float64],
        path_loss: NDArray[np.float64],
        slope: NDArray[np.float64],
        observed_slope: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """Derivatives of the residuals [n, m, k] from those of path loss [n, L, k] and observables [n, K, L, k]."""
        ...

    @property
    def filling(self) -> NDArray[np.float64]:
        """Path loss assigned to links without a path [L], [dB]."""
        ...

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of the residuals that depend on links with a path [m]; `reached` marks these links [L]."""
        ...


@final
@dataclass(eq=False)
class ReplayedModel:
    """A replay used as a cheap model; its constants are those that the study does not calibrate.

    Attributes:
        engine: The replay; its parameters are those of the study, followed by the constants.
        count: Number of the study's parameters.
        rows: Converts path loss to residuals.
        calls: Number of candidates evaluated so far.
        seconds: Time taken by their evaluation [s].
    """

    engine: StoredPaths
    count: int
    rows: Rows
    calls: int = 0
    seconds: float = 0.0
    _reached: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        start = self.engine.parameters.start
        # All candidates share the stored paths, so a link without a path here has no path for any candidate.
        self._reached = np.isfinite(self.engine.path_loss(start[None])[0])

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask of the residuals that the replay predicts [m]."""
        return self.rows.known(self._reached)

    @property
    def constants(self) -> Constants:
        """The constants on a logarithmic scale."""
        parameters = self.engine.parameters
        lower, upper = (bound[self.count :] for bound in parameters.search_bounds)
        # The bounds are `BOUND` standard deviations from the centre, in logarithms.
        centre = parameters.to_search(parameters.start)[self.count :]
        return Constants(centre, (upper - lower) / (2.0 * BOUND), lower, upper)

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `CheapModel.residuals`."""
        started, candidates = time.perf_counter(), self._candidates(points, constants)
        answer = self._respond(candidates, False)
        self._count(started, len(points))
        loss = self._filled(answer.path_loss)
        return self.rows.residuals(candidates[:, : self.count], loss, answer.observed)

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """See `CheapModel.answer`."""
        started, candidates = time.perf_counter(), self._candidates(points, constants)
        answer = self._respond(candidates, True)
        self._count(started, len(points))
        unit = self.engine.parameters.search_slope(candidates)
        slope, observed_slope = cast(NDArray, answer.loss_slope), answer.observed_slope
        slope = np.where(np.isfinite(slope) & np.isfinite(answer.path_loss)[:, :, None], slope, 0.0)
        if observed_slope is not None:
            observed_slope = observed_slope * unit[:, None, None, :]
        loss, studied = self._filled(answer.path_loss), candidates[:, : self.count]
        slopes = self.rows.slopes(studied, loss, slope * unit[:, None, :], observed_slope)
        return CheapAnswer(
            self.rows.residuals(studied, loss, answer.observed),
            slopes[:, :, : self.count],
            slopes[:, :, self.count :],
        )

    def _respond(self, candidates: NDArray[np.float64], derivatives: bool) -> Responses:
        if self.rows.wanted:
            return cast(Observing, self.engine).respond(candidates, self.rows.wanted, derivatives)
        none = np.zeros((len(candidates), 0, len(self._reached)))
        if not derivatives:
            return Responses(self.engine.path_loss(candidates), none)
        loss, slope = self.engine.path_loss_and_jacobian(candidates)
        return Responses(loss, none, slope)

    def _candidates(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.engine.parameters.from_search(np.hstack([points, constants]))

    def _filled(self, loss: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(self._reached, loss, self.rows.filling)

    def _count(self, started: float, calls: int) -> None:
        self.calls += calls
        self.seconds += time.perf_counter() - started


@dataclass(frozen=True, eq=False)
class ProblemRows:
    """The residuals of a problem, including the rows for the priors.

    Attributes:
        problem: The problem.
    """

    problem: Problem

    @property
    def filling(self) -> NDArray[np.float64]:
        """The path loss ceiling or, if there is no ceiling, the measured path loss [L], [dB]."""
        objective = self.problem.objective
        if objective.ceiling_db is not None:
            return np.full(len(objective.measured), objective.ceiling_db)
        return objective.measured

    @property
    def wanted(self) -> tuple[Statistic, ...]:
        """See `Rows.wanted`."""
        return self.problem.statistics

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask as in `Rows.known` [m]; False for the rows of the priors, which the model does not predict."""
        weight = self.problem.objective.weight
        priors = int((self.problem.objective.nuisance.prior < np.inf).sum()) + len(self.problem.priors)
        further = [reached[observable.used(weight)] for observable in self.problem.observed]
        return np.concatenate([reached[weight > 0], np.zeros(priors, dtype=bool), *further])

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], observed: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.residuals`."""
        return self.problem.residuals(candidates, path_loss, observed)

    def slopes(
        self,
        candidates: NDArray[np.float64],
        path_loss: NDArray[np.float64],
        slope: NDArray[np.float64],
        observed_slope: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """See `Rows.slopes`."""
        return self.problem.slopes(candidates, path_loss, slope, observed_slope)


@dataclass(frozen=True, eq=False)
class CheapReplay:
    """The cheap model of a calibration, or the reason why there is no model.

    Attributes:
        model: The model; None if the study does not request a model or the model cannot be made.
        remark: The reason why the model cannot be made.
    """

    model: ReplayedModel | None = None
    remark: Remark | None = None


def make_cheap_replay(
    problem: Problem, progress: Progress | None = None, scene: Setup | None = None
) -> CheapReplay:
    """Trace a problem's scene for a cheap model if the method uses such a model; if tracing fails, report the reason.

    If `scene`, another study of the same links, is given, its scene is traced instead. The stage of `progress` is
    "tracing".
    """
    setup = problem.setup
    section = setup.study.method
    wanted = section.name in (AUTO, "space-mapping") and section.model == "replay"
    exact = problem.differentiable and not setup.study.engine.expensive
    if not wanted or exact or problem.observable is not PATH_LOSS:
        return CheapReplay()
    try:
        scene = setup if scene is None else scene
        paths = scene.trace(progress=progress)
        parameters = with_constants(problem.parameters, paths.materials, setup.links.frequency is None)
        engine = replay(replace(scene, parameters=parameters), paths)
        model = ReplayedModel(engine, len(problem.parameters), ProblemRows(problem))
    except (InputError, EngineError, ImportError) as error:
        reason = " ".join(str(error).split())
        return CheapReplay(None, _no_model(f"the scene cannot be traced here ({reason})"))
    if not model.known.any():
        return CheapReplay(None, _no_model("no link has a path in the traced scene"))
    return CheapReplay(model)


def _no_model(cause: str) -> Remark:
    return Remark(RemarkKind.NO_CHEAP_MODEL, {"cause": cause})


def with_constants(
    parameters: Parameters, materials: dict[str, Material], one_carrier: bool = True
) -> Parameters:
    """Extend the parameters by the uncalibrated material constants, on a logarithmic scale.

    If the links have several carrier frequencies, constants that depend on frequency stay fixed.
    """
    calibrated = {f"{parameter.material}.{parameter.constant}" for parameter in parameters}
    constants = []
    for name, material in materials.items():
        for constant, spread in SPREAD.items():
            value, bound = getattr(material, constant), PARAMETER_BOUNDS[constant]
            lower, upper = (value * float(np.exp(sign * BOUND * spread)) for sign in (-1.0, 1.0))
            adjustable = (
                f"{name}.{constant}" not in calibrated and value > 0 and material.conductivity < METAL
            )
            if not adjustable or not (one_carrier or constant == "thickness"):
                continue
            if lower in bound and upper in bound:  # the lower bound of a permittivity near 1 would be below 1
                constants.append(Parameter(f"{name}.{constant}", lower, upper, value, "log"))
    return replace(parameters, items=(*parameters.items, *constants))
