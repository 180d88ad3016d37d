"""The problem that methods are compared on: a study on its stored paths."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from calibray import engines
from calibray.engines.problem_fingerprint import fingerprint
from calibray.errors import InputError
from calibray.fitting.methods import local_searches
from calibray.fitting.noise_level import weighed
from calibray.fitting.problem import Problem
from calibray.fitting.search import Evaluate
from calibray.optimizers.multifidelity.cheap_model import CheapModel
from calibray.optimizers.screened import Screen
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
