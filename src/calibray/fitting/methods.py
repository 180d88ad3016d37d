"""Choice of the calibration method and its settings."""

from __future__ import annotations

from typing import Final

import numpy as np

from calibray import optimizers
from calibray.engines.protocol import Differentiable
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.optimizers import METHODS, Optimizer
from calibray.optimizers.multifidelity.cheap_model import CheapModel
from calibray.parameters import Parameters
from calibray.study import Setup
from calibray.study.model import StudyModel
from calibray.support.messages import did_you_mean

AUTO: Final = "auto"

STARTS: Final = (16, 512)
"""Smallest and largest number of local searches of a multi-start method."""

START_INTERACTIONS: Final = 4_000_000
"""Target for local searches times interactions of the path program, which keeps the time of a search constant."""


def check_method(name: str) -> None:
    """Check that a method exists.

    Raises:
        InputError: There is no such method.
    """
    names = (AUTO, *METHODS)
    if name not in names:
        raise InputError(f"method {name!r}: there is no such method; {did_you_mean(name, names)}")


def choose(problem: Problem, model: CheapModel | None = None) -> Optimizer:
    """Make the optimizer that a study names; "auto" chooses the best one for its engine.

    Raises:
        InputError: The method needs derivatives that the engine does not provide, or its options cannot be used.
    """
    engine = problem.engine
    interactions = engine.interactions if isinstance(engine, Differentiable) else None
    return _make(problem.setup.study, problem.parameters, problem.differentiable, interactions, model)


def check_fit(setup: Setup) -> None:
    """Check that a study's method and options work on its engine, before any expensive call or output.

    Raises:
        InputError: The method does not exist, needs derivatives that the engine does not provide, or its options cannot
            be used.
    """
    check_method(setup.study.method.name)
    differentiable = not setup.study.engine.expensive
    _make(setup.study, setup.parameters, differentiable, 1 if differentiable else None)


def _make(
    study: StudyModel,
    parameters: Parameters,
    differentiable: bool,
    interactions: int | None,
    model: CheapModel | None = None,
) -> Optimizer:
    section, name = study.method, study.method.name
    if name == AUTO:
        name = "least-squares" if differentiable else "space-mapping"
    if METHODS[name].needs_derivatives() and not differentiable:
        raise InputError(
            f"method {name!r} needs derivatives, which only the engine 'replay' provides; use method 'auto'"
        )
    try:
        return optimizers.make(
            name,
            *parameters.search_bounds,
            section.seed,
            start=parameters.to_search(parameters.start),
            starts=None if interactions is None else local_searches(interactions),
            cheap_model=model,
            options=section.options,
        )
    except InputError as error:
        raise InputError(f"{study.path}: method.options: {error}") from None


def local_searches(interactions: int) -> int:
    """Number of starting points of a multi-start method: fewer on larger path programs."""
    return int(np.clip(START_INTERACTIONS // max(interactions, 1), *STARTS))
