"""Which method solves a problem, and with what settings."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from calibray.calibration.problem import Problem
from calibray.engines.protocol import Differentiable
from calibray.errors import InputError
from calibray.optimizers import METHODS, Optimizer
from calibray.parameters import Parameters
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
    if "jacobian" in METHODS[name].uses and not problem.differentiable:
        raise InputError(f"method {name!r} needs derivatives, which only the replay engine gives")
    interactions = problem.engine.interactions if isinstance(problem.engine, Differentiable) else 0
    usual = usual_options(name, problem.parameters, interactions)
    return make_optimizer(name, problem.parameters, section.seed, **{**usual, **section.options})


def make_optimizer(name: str, parameters: Parameters, seed: int, **options: object) -> Optimizer:
    """An optimizer over the search space of some parameters.

    Args:
        name: A method of `METHODS`.
        parameters: The parameters.
        seed: Seed.
        **options: Settings of the method.

    Returns:
        The optimizer.

    Raises:
        InputError: The method has no such setting, or refuses a value.
    """
    try:
        return METHODS[name](*parameters.search_bounds, seed=seed, **options)
    except TypeError as error:
        raise InputError(f"method.options of {name!r}: {error}") from None


def usual_options(name: str, parameters: Parameters, interactions: int) -> dict[str, Any]:
    """Settings of a method that follow from what is calibrated; a study's own replace them.

    Args:
        name: A method of `METHODS`.
        parameters: The parameters.
        interactions: Interactions that a candidate is evaluated at, 0 where that is no matter.

    Returns:
        The settings; none for most methods.
    """
    if name == "least-squares":
        starts = int(np.clip(START_INTERACTIONS // max(interactions, 1), *STARTS))
        return {"x0": parameters.to_search(parameters.start), "starts": starts}
    return {}
