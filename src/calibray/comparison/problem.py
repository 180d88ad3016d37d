"""The problem on which methods are compared; a study on stored paths is one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from calibray import engines
from calibray.engines.make_engine import fingerprint
from calibray.errors import InputError
from calibray.fitting.methods import local_searches
from calibray.fitting.preliminary_fits import estimate_noise
from calibray.fitting.problem import Problem
from calibray.fitting.search import Evaluate
from calibray.optimizers.multifidelity.cheap_model import CheapModel
from calibray.study import Setup, Study


@dataclass(frozen=True, eq=False)
class ComparisonProblem:
    """A problem on which any method can be run.

    Attributes:
        name: Its name.
        fingerprint: Digest of everything that an evaluation depends on.
        lower: Lower bounds of the search space [d].
        upper: Upper bounds [d].
        start: Starting point given by the user [d]; None without one.
        starts: Number of further starting points of methods that use several; None for their default.
        large: Whether evaluations are too expensive for a reference search with many starts.
        minimum: Lowest objective known in advance; +inf if unknown.
        evaluate: The function to minimise.
        cheap_model: Makes a cheap model of the function; None without one.
        wrong_constants: Whether the cheap model has wrong constants.
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
    cheap_model: Callable[[], CheapModel] | None = None
    wrong_constants: bool = False


def study_problem(path: str | Path) -> ComparisonProblem:
    """Make a problem of a study file on its stored paths, which are traced if they are not in the cache.

    Raises:
        InputError: The study cannot be used, or its engine is an external program.
    """
    study = Study.load(path)
    if study.engine.external:
        raise InputError(
            f"{path}: the engine {study.engine.name!r} is too expensive for hundreds of runs; set engine.name to "
            "'replay' to compare methods on stored paths"
        )
    setup = Setup.open(study.replace(engine="replay"))
    # The replay engine always gives derivatives.
    engine = cast(engines.Differentiable, engines.make(setup))
    problem = estimate_noise(Problem.of(setup, engine))
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
    return ComparisonProblem(
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
