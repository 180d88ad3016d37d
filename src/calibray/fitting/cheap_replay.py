"""Cheap model of an engine without derivatives: a replay of the study's scene.

We trace the study's scene once. Evaluating a candidate on the stored paths then takes microseconds. The engine may
find paths that the study's settings leave out. We therefore trace the scene once more, with more interactions and with
diffraction. These further paths form layers. The power of a layer is multiplied by an unknown gain. The constants of
the cheap model are the material constants that the study does not calibrate: thickness, conductivity and permittivity,
in order of importance. Space mapping adjusts these constants.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Protocol, cast, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.kinds.replay import replay
from calibray.engines.protocol import PATH_LOSS, Observing, Responses
from calibray.engines.rays.compile import powers
from calibray.engines.replay import Replay
from calibray.errors import EngineError, InputError
from calibray.fitting.problem import Problem
from calibray.fitting.search import AUTO
from calibray.materials import Material
from calibray.measurements.observables import Statistic
from calibray.optimizers.protocol import CheapAnswer, Constants
from calibray.parameters import Parameter, Parameters
from calibray.parameters.parameter import PARAMETER_BOUNDS
from calibray.paths import Kind, Paths, join_links, take
from calibray.result.verdict import Remark, RemarkKind
from calibray.study import Setup
from calibray.support.progress import Progress, with_stage

SPREAD: Final = {"thickness": 0.5, "conductivity": 0.7, "relative_permittivity": 0.2}
"""Standard deviation of the logarithm of a constant around its declared value."""

BOUND: Final = 3.0
"""Distance from a constant's declared value to its bounds, in standard deviations."""

GAIN: Final = (-1.2, 1.2)
"""Mean and standard deviation of the logarithm of a layer's gain, the factor on the power of its paths. The gain is
about 1 for an engine that finds these paths and near 0 for an engine that does not. The bounds are 0.008 and 11."""

DEEPER: Final = 2
"""Number of interactions by which further paths may exceed the study's limit. The planted engines exceed it by up to
two (`benchmarks/problem_families/family.py`)."""

LONGEST_TRACE: Final = 60.0
"""Estimated duration of a trace above which no further paths are traced [s]."""

WEAK: Final = 1e-2
"""Share of a link's power below which a further path is left out. In development offices 1018 and 63, with 297 and 449
interactions, a limit of 0.1 % adds 1,357 and 2,091 interactions, 0.3 % adds 923 and 1,298, and 1 % adds 451 and 583."""

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
        """Path loss [n, L], [dB], and its derivatives [n, L, d] with respect to the parameters."""
        ...


class Rows(Protocol):
    """Converts path loss and further observables to the residuals that a cheap model predicts."""

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
        """Derivatives [n, m, k] of the residuals, from those of path loss [n, L, k] and of observables [n, K, L, k]."""
        ...

    @property
    def filling(self) -> NDArray[np.float64]:
        """Path loss assigned to links without a path [L], [dB]."""
        ...

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask [m] of the residuals of links with a path; `reached` [L] marks these links."""
        ...


@final
@dataclass(eq=False)
class ReplayedModel:
    """A replay used as a cheap model; its constants are the material constants that the study does not calibrate.

    Attributes:
        engine: The replay; its parameters are those of the study, followed by the material constants. Its links are
            the study's L links, repeated for each layer of further paths [(1 + layers) L].
        count: Number of the study's parameters.
        rows: Converts path loss to residuals.
        layers: Number of layers of further paths; the gain of each layer is one more constant.
        calls: Number of candidates evaluated so far.
        seconds: Time taken by their evaluation [s].
    """

    engine: StoredPaths
    count: int
    rows: Rows
    layers: int = 0
    calls: int = 0
    seconds: float = 0.0
    _reached: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        start = self.engine.parameters.start
        # All candidates share the stored paths, so a link without a path here has no path for any candidate.
        loss = self.engine.path_loss(start[None]).reshape(1 + self.layers, -1)
        self._reached = np.asarray(np.isfinite(loss).any(axis=0))

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask [m] of the residuals that the replay predicts."""
        return self.rows.known(self._reached)

    @property
    def constants(self) -> Constants:
        """The constants on a logarithmic scale."""
        parameters = self.engine.parameters
        lower, upper = (bound[self.count :] for bound in parameters.search_bounds)
        # The bounds are `BOUND` standard deviations from the centre, in logarithms.
        centre = parameters.to_search(parameters.start)[self.count :]
        mean, spread = (np.full(self.layers, value) for value in GAIN)
        return Constants(
            np.hstack([centre, mean]),
            np.hstack([(upper - lower) / (2.0 * BOUND), spread]),
            np.hstack([lower, mean - BOUND * spread]),
            np.hstack([upper, mean + BOUND * spread]),
        )

    def residuals(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `CheapModel.residuals`."""
        started, candidates = time.perf_counter(), self._candidates(points, constants)
        answer = self._respond(candidates, constants[:, constants.shape[1] - self.layers :], False)
        self._count(started, len(points))
        loss = self._filled(answer.path_loss)
        return self.rows.residuals(candidates[:, : self.count], loss, answer.observed)

    def answer(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> CheapAnswer:
        """See `CheapModel.answer`."""
        started, candidates = time.perf_counter(), self._candidates(points, constants)
        answer = self._respond(candidates, constants[:, constants.shape[1] - self.layers :], True)
        self._count(started, len(points))
        unit = self.engine.parameters.search_slope(candidates)
        # Gains are logarithms in the search space and in the answer.
        unit = np.hstack([unit, np.ones((len(unit), self.layers))])
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

    def _respond(
        self, candidates: NDArray[np.float64], log_gain: NDArray[np.float64], derivatives: bool
    ) -> Responses:
        """Responses to candidates [n, d] with log gains [n, layers]; derivatives include those for the log gains."""
        if self.rows.wanted:
            return cast(Observing, self.engine).respond(candidates, self.rows.wanted, derivatives)
        none = np.zeros((len(candidates), 0, len(self._reached)))
        if not derivatives:
            return Responses(self._total(self.engine.path_loss(candidates), log_gain)[0], none)
        loss, slope = self.engine.path_loss_and_jacobian(candidates)
        total, share = self._total(loss, log_gain)
        slope = slope.reshape(*share.shape, -1)
        by_parameter = np.sum(share[..., None] * np.where(share[..., None] > 0, slope, 0.0), axis=1)
        by_gain = -10.0 / np.log(10.0) * np.moveaxis(share[:, 1:], 1, 2)
        return Responses(total, none, np.concatenate([by_parameter, by_gain], axis=2))

    def _total(
        self, loss: NDArray[np.float64], log_gain: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss [n, L], [dB], of all layers together, and the share of each layer in the power [n, 1 + layers, L].

        `loss` is the path loss of the study's paths and of each layer [n, (1 + layers) L].
        """
        power = 10.0 ** (-loss.reshape(len(loss), 1 + self.layers, -1) / 10.0)
        power[:, 1:] *= np.exp(log_gain)[:, :, None]
        total = power.sum(axis=1)
        with np.errstate(divide="ignore"):
            return -10.0 * np.log10(total), power / np.maximum(total, np.finfo(float).tiny)[:, None]

    def _candidates(self, points: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        material = constants[:, : constants.shape[1] - self.layers]
        return self.engine.parameters.from_search(np.hstack([points, material]))

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
        """The path loss ceiling [L], [dB]; the measured path loss if there is no ceiling."""
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
    """The cheap model of a calibration, or the reason why there is none.

    Attributes:
        model: The model; None if the study requests no model or the model cannot be made.
        remark: The reason why the model cannot be made.
    """

    model: ReplayedModel | None = None
    remark: Remark | None = None


def make_cheap_replay(
    problem: Problem, progress: Progress | None = None, scene: Setup | None = None
) -> CheapReplay:
    """Trace a problem's scene for a cheap model if the method uses one; if tracing fails, report the reason.

    If another study of the same links is given as `scene`, that study's scene is traced instead. The stages of
    `progress` are "tracing" and "tracing more paths".
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
        scene = replace(scene, parameters=parameters)
        layers = _further_paths(problem, scene, paths, progress)
        engine = Replay(with_layers(paths, layers), parameters) if layers else replay(scene, paths)
        model = ReplayedModel(engine, len(problem.parameters), ProblemRows(problem), len(layers))
    except (InputError, EngineError, ImportError) as error:
        reason = " ".join(str(error).split())
        return CheapReplay(None, _no_model(f"the scene cannot be traced here ({reason})"))
    if not model.known.any():
        return CheapReplay(None, _no_model("no link has a path in the traced scene"))
    return CheapReplay(model)


def _further_paths(
    problem: Problem, scene: Setup, paths: Paths, progress: Progress | None
) -> tuple[Paths, ...]:
    """Layers of paths that the study's trace leaves out; none unless a link's power is the sum of its paths' powers."""
    study, trace = scene.study, scene.study.trace
    one_carrier = scene.links.frequency is None and not scene.parameters.has_laws
    summed = study.objective.combining == "power" and one_carrier and not scene.effects(paths)
    if not summed or problem.statistics or study.rays_path is not None or study.engine.exports_rays:
        return ()
    try:
        richer = scene.with_trace(replace(trace, max_depth=trace.max_depth + DEEPER, diffraction=True))
        if richer.tracer.plan(richer.links).seconds > LONGEST_TRACE:
            return ()
        further = richer.trace(progress=with_stage(progress, "tracing more paths"))
    except (InputError, EngineError):  # for example too many paths; the study's own paths are sufficient
        return ()
    return further_layers(further, trace.max_depth, trace.diffraction)


def further_layers(paths: Paths, max_depth: int, diffraction: bool) -> tuple[Paths, ...]:
    """The paths that a trace of at most `max_depth` interactions, with or without diffraction, leaves out.

    There are up to three layers: paths with one interaction more than `max_depth`, paths with at least two more, and
    paths with diffraction if the trace excludes diffraction. Weak paths and empty layers are left out.
    """
    interactions, power = np.diff(paths.first), powers(paths)
    strong = power >= WEAK * np.bincount(paths.link, power, paths.num_links)[paths.link]
    diffracted = np.zeros(paths.num_paths, dtype=bool)
    if not diffraction:
        diffracted[np.repeat(np.arange(paths.num_paths), interactions)[paths.kind == Kind.DIFFRACTION]] = True
    more = np.where(diffracted, 0, interactions - max_depth)
    masks = (strong & (more == 1), strong & (more > 1), strong & diffracted)
    return tuple(take(paths, mask) for mask in masks if mask.any())


def with_layers(paths: Paths, layers: Sequence[Paths]) -> Paths:
    """The study's paths and the layers of further paths, joined; the links are repeated for each layer."""
    links = np.arange(paths.num_links)
    return join_links([(links + k * len(links), part) for k, part in enumerate((paths, *layers))])


def _no_model(cause: str) -> Remark:
    return Remark(RemarkKind.NO_CHEAP_MODEL, {"cause": cause})


def with_constants(
    parameters: Parameters, materials: dict[str, Material], one_carrier: bool = True
) -> Parameters:
    """Add the uncalibrated material constants to the parameters, on a logarithmic scale.

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
