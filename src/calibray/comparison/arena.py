"""What methods are compared on: a study on its stored paths, a landscape in closed form, or a planted problem."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from calibray import engines
from calibray.calibration.cheap import ReplayedModel, with_constants
from calibray.calibration.methods import local_searches
from calibray.calibration.problem import Evaluation, Problem
from calibray.calibration.search import Evaluate
from calibray.calibration.weighing import weighed
from calibray.engines.fingerprint import fingerprint
from calibray.errors import InputError
from calibray.optimizers import landscapes
from calibray.optimizers.cheap_model import CheapModel
from calibray.optimizers.screened import Screen
from calibray.scenarios.direct import Direct
from calibray.scenarios.family import PlantedProblem, problem
from calibray.study import Setup, Study


@dataclass(frozen=True, eq=False)
class Arena:
    """A problem that any method can be run on.

    Attributes:
        name: Its name.
        fingerprint: All that an answer depends on.
        lower: Lower bounds of the search space [d].
        upper: Upper bounds [d].
        start: Where a user would start [d]; None if that is nowhere in particular.
        starts: Further starting points for the methods that take them; their own number if None.
        large: Whether an evaluation is so dear that searches from few starts have to do.
        minimum: Lowest objective known beforehand; +inf if none is.
        evaluate: What is searched.
        screen: The objective of a cheap model of it; None where there is none.
        model: Makes that cheap model anew, for methods that correct it; None where there is none.
        misinformed: Whether that cheap model is told wrong constants.
    """

    name: str
    fingerprint: str
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    start: NDArray[np.float64] | None
    starts: int | None
    large: bool
    minimum: float
    evaluate: Evaluate
    screen: Screen | None = None
    model: Callable[[], CheapModel] | None = None
    misinformed: bool = False


def study_arena(path: str | Path) -> Arena:
    """A study on its stored paths, which are traced if they are not in the cache.

    Args:
        path: The study file.

    Returns:
        The arena.

    Raises:
        InputError: The study cannot be used, or its engine is an external program.
    """
    study = Study.load(path)
    if study.engine.external:
        raise InputError(
            f"{path}: engine {study.engine.name!r} is too dear for hundreds of runs; methods are compared on stored "
            "paths: set engine.name to 'replay'"
        )
    setup = Setup.open(study.replace(engine="replay"))
    # A replay gives derivatives.
    engine = cast(engines.Differentiable, engines.make(setup))
    problem = weighed(Problem.of(setup, engine))
    objective, parameters, links = problem.objective, problem.parameters, setup.links
    lower, upper = parameters.search_bounds
    digest = hashlib.sha256(fingerprint(setup).encode())
    nuisance, design = objective.nuisance, objective.nuisance.design
    parts = (design.data, design.indices, design.indptr, nuisance.lower, nuisance.upper, nuisance.prior)
    for part in (lower, upper, objective.measured, objective.weight, *parts):
        digest.update(np.asarray(part, dtype="<f8").tobytes())
    digest.update(repr((nuisance.columns, objective.ceiling_db, objective.noise_db)).encode())
    digest.update(repr(problem.priors).encode() if len(problem.priors) else b"")
    digest.update(b"" if links.frequency is None else links.frequency.astype("<f8").tobytes())
    start = parameters.to_search(parameters.start)
    return Arena(
        Path(path).stem,
        digest.hexdigest(),
        lower,
        upper,
        start,
        local_searches(engine.interactions),
        engine.large,
        np.inf,
        problem.evaluate,
    )


def landscape_arena(name: str) -> Arena:
    """A landscape of `calibray.optimizers.landscapes`.

    Args:
        name: The function that makes it.

    Returns:
        The arena.
    """
    land: landscapes.Landscape = getattr(landscapes, name)()

    def evaluate(points: NDArray[np.float64], derivatives: bool) -> Evaluation:
        value, residuals, jacobian = land.evaluate(points)
        return Evaluation(value, residuals, jacobian if derivatives else None, residuals, value)

    known = float(np.nan_to_num(land.minimum, nan=np.inf))
    middle = 0.5 * (land.lower + land.upper)
    digest = hashlib.sha256(name.encode())
    for part in (land.lower, land.upper, *land.evaluate(middle[None])):
        digest.update(np.round(part, 9).astype("<f8").tobytes())
    return Arena(name, digest.hexdigest(), land.lower, land.upper, None, None, False, known, evaluate)


def family_arena(kind: str, seed: int) -> Arena:
    """A planted problem of `calibray.scenarios.family`, whose lowest objective is known.

    Args:
        kind: "district" or "office".
        seed: Its seed.

    Returns:
        The arena.

    Raises:
        InputError: There is no such family.
    """
    planted = problem(seed, kind)

    def evaluate(points: NDArray[np.float64], derivatives: bool) -> Evaluation:
        told = planted.told(points, derivatives)
        return Evaluation(*told, told.residuals, told.value)

    return Arena(
        f"{kind}-{seed}",
        planted.fingerprint,
        planted.lower,
        planted.upper,
        planted.parameters.to_search(planted.parameters.start),
        None,
        False,
        planted.minimum_rmse_db,
        evaluate,
        planted.cheap_rmse_db,
        lambda: planted_model(planted),
        planted.differences.misinformed,
    )


@dataclass(frozen=True, eq=False)
class PlantedRows:
    """The residuals of a planted problem, each transmitter's offset taken out.

    Attributes:
        planted: The problem.
    """

    planted: PlantedProblem

    @property
    def filling(self) -> NDArray[np.float64]:
        """The measured path loss [L], [dB]."""
        return self.planted.measured

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See `Rows.known`."""
        return reached

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.residuals`."""
        return self.planted.residuals(path_loss)

    def slopes(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], slope: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.slopes`; residuals are linear in what path loss has beyond the measurements."""
        rows = np.moveaxis(slope, 1, -1)
        return np.moveaxis(self.planted.residuals(self.planted.measured + rows), -1, 1)


def planted_model(planted: PlantedProblem) -> ReplayedModel:
    """The cheap model of a planted problem, with the constants that it was told.

    Args:
        planted: The problem.

    Returns:
        The model.
    """
    paths = planted.cheap.paths
    engine = Direct(paths, with_constants(planted.parameters, paths.materials))
    return ReplayedModel(engine, len(planted.parameters), PlantedRows(planted))
