"""Which method solves a problem, and with what settings."""

from __future__ import annotations

from typing import Final

import numpy as np

from calibray import optimizers
from calibray.calibration.problem import Problem
from calibray.engines.protocol import Differentiable
from calibray.errors import InputError
from calibray.optimizers import METHODS, Optimizer
from calibray.spelling import did_you_mean

AUTO: Final = "auto"

STARTS: Final = (16, 512)
"""Local searches on the largest and on small programs."""

START_INTERACTIONS: Final = 15_000_000
"""Local searches times interactions between the two."""


def check_method(name: str) -> None:
    """Refuse a method that does not exist.

    Args:
        name: The method.

    Raises:
        InputError: There is no such method.
    """
    known = (AUTO, *METHODS)
    if name not in known:
        raise InputError(f"method {name!r}: there is no such method; {did_you_mean(name, known)}")


def choose(problem: Problem) -> Optimizer:
    """The optimizer of a study's problem: the one it names, or for "auto" the one that serves it best.

    Args:
        problem: The problem.

    Returns:
        The optimizer.

    Raises:
        InputError: The method needs derivatives that the engine does not give, or its options cannot be used.
    """
    section, name = problem.setup.study.method, problem.setup.study.method.name
    if name == AUTO:
        name = "least-squares" if problem.differentiable else "vector-surrogate"
    if METHODS[name].needs_derivatives() and not problem.differentiable:
        raise InputError(f"method {name!r} needs derivatives, which only the replay engine gives")
    engine, parameters = problem.engine, problem.parameters
    try:
        return optimizers.make(
            name,
            *parameters.search_bounds,
            section.seed,
            start=parameters.to_search(parameters.start),
            starts=local_searches(engine.interactions) if isinstance(engine, Differentiable) else None,
            options=section.options,
        )
    except InputError as error:
        raise InputError(f"{problem.setup.study.path}: method.options: {error}") from None


def local_searches(interactions: int) -> int:
    """Starting points of a method that takes them, on paths where they cost what they may.

    Args:
        interactions: Interactions that a candidate is evaluated at.

    Returns:
        Their number.
    """
    return int(np.clip(START_INTERACTIONS // max(interactions, 1), *STARTS))
