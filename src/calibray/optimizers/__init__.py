"""Seeded ask/tell optimizers, which minimize a function over a box and do not depend on the radio model.

Every class is an `Optimizer`. Each class declares which parts of an evaluation it uses, how it respects a budget, and
whether it uses starting points. `METHODS` lists the classes by their names in study files; `make` constructs an
optimizer. Optional libraries are imported only when a class that needs them is constructed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike

from calibray.errors import InputError
from calibray.optimizers.derivative_free import POUNDERS, GaussNewton
from calibray.optimizers.evaluations import Best, Objective
from calibray.optimizers.gaussian_process import GaussianProcess
from calibray.optimizers.grey_wolf import GWO, SGWOIM
from calibray.optimizers.least_squares import LeastSquares
from calibray.optimizers.libraries import CMAES, DFOLS, DifferentialEvolution
from calibray.optimizers.multifidelity.space_mapping import SpaceMapping
from calibray.optimizers.protocol import CheapModel, Optimizer
from calibray.optimizers.sampling import LatinHypercube, RandomSearch, Sobol
from calibray.optimizers.vector_surrogate import VectorSurrogate
from calibray.support.messages import did_you_mean

__all__ = [
    "CMAES",
    "DFOLS",
    "GWO",
    "METHODS",
    "POUNDERS",
    "SGWOIM",
    "Best",
    "DifferentialEvolution",
    "GaussNewton",
    "GaussianProcess",
    "LatinHypercube",
    "LeastSquares",
    "Optimizer",
    "RandomSearch",
    "Sobol",
    "SpaceMapping",
    "VectorSurrogate",
    "label",
    "make",
    "method",
]

METHODS: Final[dict[str, type[Optimizer]]] = {
    "gwo": GWO,
    "sgwo-im": SGWOIM,
    "space-mapping": SpaceMapping,
    "vector-surrogate": VectorSurrogate,
    "least-squares": LeastSquares,
    "cma-es": CMAES,
    "differential-evolution": DifferentialEvolution,
    "dfo-ls": DFOLS,
    "pounders": POUNDERS,
    "gauss-newton": GaussNewton,
    "gaussian-process": GaussianProcess,
    "random": RandomSearch,
    "latin-hypercube": LatinHypercube,
    "sobol": Sobol,
}

LABELS: Final = {
    "gwo": "GWO",
    "sgwo-im": "SGWO-IM",
    "space-mapping": "space mapping",
    "pounders": "POUNDERS",
    "gauss-newton": "Gauss-Newton",
    "auto": "auto (least squares)",
}

NO_OPTIONS: Final = {"lower", "upper", "seed", "objective", "cheap_model"}
"""Constructor arguments that other parts of the study set, so `method.options` must not contain them."""


def method(name: str) -> type[Optimizer]:
    """The class of a named method; it declares which parts of an evaluation the method uses, and the method's schedule.

    Raises:
        InputError: There is no such method.

    Example:
        >>> method("least-squares").needs_derivatives()
        True
    """
    if name not in METHODS:
        raise InputError(f"method {name!r}: there is no such method; {did_you_mean(name, METHODS)}")
    return METHODS[name]


def label(name: str) -> str:
    """The label of a method in tables and figures; the name can include a budget (`METHOD@CALLS`).

    Example:
        >>> label("gwo@600")
        'GWO, 600 calls'
    """
    bare, _, calls = name.partition("@")
    text = LABELS.get(bare, bare)
    return f"{text}, {calls} calls" if calls else text


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
    cheap_model: CheapModel | None = None,
    options: Mapping[str, Any] | None = None,
) -> Optimizer:
    """Construct the optimizer of the method with the given name; arguments that the method does not use are ignored.

    Args:
        name: A method of `METHODS`.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        seed: Seed.
        budget: Number of evaluations; the method's default if None. Methods that stop on their own ignore the budget.
        start: Starting points, [d] or [k, d], for methods that use them.
        starts: Number of further starting points that the method adds to `start`; the method's default if None.
        objective: Function that computes the objective from residuals, for methods that use residuals; root mean square
            if None.
        cheap_model: A cheap model of the engine, for methods that use a cheap model.
        options: Settings of the method, which override the arguments above.

    Raises:
        InputError: The method does not exist, a setting is unknown or invalid, the budget is too small, or a required
            library is not installed.

    Example:
        >>> make("gwo", [0.0], [1.0], budget=90, start=[0.5]).budget
        90
    """
    kind = method(name)
    parameters = set(signature(kind).parameters)
    settings: dict[str, Any] = {} if budget is None else dict(kind.within(budget))
    if kind.takes_starts:
        settings |= {key: value for key, value in (("x0", start), ("starts", starts)) if value is not None}
    if objective is not None and "residuals" in kind.uses:
        settings["objective"] = objective
    if cheap_model is not None and "cheap_model" in parameters:
        settings["cheap_model"] = cheap_model
    options, allowed = dict(options or {}), sorted(parameters - NO_OPTIONS)
    for key in sorted(options.keys() - set(allowed)):
        raise InputError(
            f"method.options of {name!r}: there is no setting {key!r}; {did_you_mean(key, allowed)}"
        )
    # The constructors take different settings, which were checked above.
    construct = cast(Callable[..., Optimizer], kind)
    return construct(np.asarray(lower), np.asarray(upper), seed=seed, **{**settings, **options})
