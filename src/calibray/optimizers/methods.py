"""The methods by the names that a study file uses, and an optimizer made by its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike

from calibray.errors import InputError
from calibray.optimizers.cma_es import CMAES
from calibray.optimizers.dfo_ls import DFOLS
from calibray.optimizers.differential_evolution import DifferentialEvolution
from calibray.optimizers.evaluations import Objective
from calibray.optimizers.gaussian_process import GaussianProcess
from calibray.optimizers.gwo import GWO
from calibray.optimizers.least_squares import LeastSquares
from calibray.optimizers.multifidelity.cheap_model import CheapModel
from calibray.optimizers.multifidelity.space_mapping import SpaceMapping
from calibray.optimizers.multifidelity.vector_surrogate import VectorSurrogate
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.sampling import LatinHypercube, RandomSearch, Sobol
from calibray.optimizers.screened import Screen, ScreenedSGWOIM
from calibray.optimizers.sgwoim import SGWOIM
from calibray.support.messages import did_you_mean

METHODS: Final[dict[str, type[Optimizer]]] = {
    "gwo": GWO,
    "sgwo-im": SGWOIM,
    "sgwo-im-screened": ScreenedSGWOIM,
    "space-mapping": SpaceMapping,
    "vector-surrogate": VectorSurrogate,
    "least-squares": LeastSquares,
    "cma-es": CMAES,
    "differential-evolution": DifferentialEvolution,
    "dfo-ls": DFOLS,
    "gaussian-process": GaussianProcess,
    "random": RandomSearch,
    "latin-hypercube": LatinHypercube,
    "sobol": Sobol,
}


def method(name: str) -> type[Optimizer]:
    """Look up a method.

    Args:
        name: Its name.

    Returns:
        Its class, which tells what it uses, its schedule, and whether it takes starting points.

    Raises:
        InputError: There is no such method.

    Example:
        >>> method("least-squares").needs_derivatives()
        True
    """
    if name not in METHODS:
        raise InputError(f"method {name!r}: there is no such method; {did_you_mean(name, METHODS)}")
    return METHODS[name]


def make(
    name: str,
    lower: ArrayLike,
    upper: ArrayLike,
    seed: int = 0,
    *,
    budget: int | None = None,
    start: ArrayLike | None = None,
    starts: int | None = None,
    objective: Objective | None = None,
    screen: Screen | None = None,
    model: CheapModel | None = None,
    options: Mapping[str, Any] | None = None,
) -> Optimizer:
    """Make an optimizer by its method's name; every method takes of this what it declares to take.

    Args:
        name: A method of `METHODS`.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        seed: Seed.
        budget: Number of evaluations to keep to; its own if None. A method that stops by itself is left to it.
        start: Points to start from, [d] or [k, d], for methods that take them.
        starts: Starting points of its own, for the same methods; its default if None.
        objective: The value of residuals, for methods that use them; their root mean square if None.
        screen: The objective of a cheap model, for methods that screen by one.
        model: A cheap model of what is minimised, for methods that take one.
        options: Settings of the method, which go before all of these.

    Returns:
        The optimizer.

    Raises:
        InputError: There is no such method, it has no such setting or refuses a value, the budget is too small, or
            its library is not installed.

    Example:
        >>> make("gwo", [0.0], [1.0], budget=90, start=[0.5]).budget
        90
    """
    kind = method(name)
    settings: dict[str, Any] = {} if budget is None else dict(kind.within(budget))
    if kind.takes_starts:
        settings |= {key: value for key, value in (("x0", start), ("starts", starts)) if value is not None}
    if objective is not None and "residuals" in kind.uses:
        settings["objective"] = objective
    for key, value in (("screen", screen), ("model", model)):
        if value is not None and key in signature(kind).parameters:
            settings[key] = value
    given = dict(options or {})
    known = sorted(
        set(signature(kind).parameters) - {"lower", "upper", "seed", "objective", "screen", "model"}
    )
    for key in sorted(given.keys() - set(known)):
        raise InputError(
            f"method.options of {name!r}: there is no setting {key!r}; {did_you_mean(key, known)}"
        )
    # The constructors differ in their settings, which were looked up above.
    construct = cast(Callable[..., Optimizer], kind)
    return construct(np.asarray(lower), np.asarray(upper), seed=seed, **{**settings, **given})
