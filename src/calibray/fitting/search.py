"""Choice of the calibration method, and the loop that runs it (paper Fig. 1): propose, run the engine, compare."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray import optimizers
from calibray.engines.ledger.recorded import Recorded
from calibray.engines.protocol import Differentiable, Engine, Responses
from calibray.errors import InputError
from calibray.fitting.problem import Evaluation, Problem
from calibray.optimizers import METHODS, LeastSquares, Optimizer
from calibray.optimizers.protocol import CheapModel
from calibray.parameters import Parameters
from calibray.study import Setup
from calibray.study.model import StudyModel
from calibray.support.memory import single_blas_thread
from calibray.support.messages import did_you_mean
from calibray.support.progress import Progress

AUTO: Final = "auto"

STARTS: Final = (16, 512)
"""Minimum and maximum number of local searches in a multi-start method."""

START_INTERACTIONS: Final = 4_000_000
"""Target for the number of local searches times the number of interactions of the path program. It keeps the duration
of a search similar for small and large programs."""


def check_method(name: str) -> None:
    """Check that a method exists.

    Raises:
        InputError: There is no such method.
    """
    names = (AUTO, *METHODS)
    if name not in names:
        raise InputError(f"method {name!r}: there is no such method; {did_you_mean(name, names)}")


def choose(problem: Problem, model: CheapModel | None = None) -> Optimizer:
    """Make the optimizer that a study names; "auto" chooses the best optimizer for its engine.

    Raises:
        InputError: The method needs derivatives that the engine does not provide, or its options cannot be used.
    """
    engine = problem.engine
    interactions = engine.interactions if isinstance(engine, Differentiable) else None
    return _make(problem.setup.study, problem.parameters, problem.differentiable, interactions, model)


def check_fit(setup: Setup) -> None:
    """Check that a study's method and options suit its engine, before any expensive call or output.

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
    section, name, options = study.method, study.method.name, dict(study.method.options)
    if name == AUTO:
        name = "least-squares" if differentiable else "space-mapping"
    if METHODS[name].needs_derivatives() and not differentiable:
        raise InputError(
            f"method {name!r} needs derivatives, which only the engine 'replay' provides; use method 'auto'"
        )
    try:
        if "x0" in options:
            with suppress(ValueError, TypeError), np.errstate(all="ignore"):  # the method rejects these
                options["x0"] = parameters.to_search(options["x0"])
        return optimizers.make(
            name,
            *parameters.search_bounds,
            section.seed,
            start=parameters.to_search(parameters.start),
            starts=None if interactions is None else local_searches(interactions),
            cheap_model=model,
            options=options,
        )
    except InputError as error:
        raise InputError(f"{study.path}: method.options: {error}") from None


def local_searches(interactions: int) -> int:
    """Number of starting points of a multi-start method, which decreases with the size of the path program."""
    return int(np.clip(START_INTERACTIONS // max(interactions, 1), *STARTS))


Evaluate = Callable[[NDArray[np.float64], bool], Evaluation]
"""Evaluates points [n, d] of the search space; the flag requests derivatives."""

SEARCHES: Final = 64
"""Number of local searches for further minima if the method kept only its best minimum."""

BASINS: Final = 24
"""Maximum number of known minima used as starting points for a changed problem."""

RELEVANT: Final = 20.0
"""Maximum excess of the sum of squares at a relevant minimum over that at the lowest minimum, in noise variances.
This excess corresponds to a likelihood ratio of e^-10."""


def rounds(optimizer: Optimizer, evaluate: Evaluate) -> Iterator[tuple[NDArray[np.float64], Evaluation]]:
    """Run an optimizer until it is done.

    Yields:
        The candidates of every round, as points of the search space [n, d], and their evaluation.
    """
    derivatives = optimizer.needs_derivatives()
    # Surrogates use small matrices, so BLAS threads would cost more time than they save.
    with single_blas_thread():
        while not optimizer.done:
            points = optimizer.ask()
            evaluation = evaluate(points, derivatives)
            optimizer.tell(
                points, evaluation.value, residuals=evaluation.residuals, jacobian=evaluation.jacobian
            )
            yield points, evaluation


def least_squares(problem: Problem, starts: int, x0: NDArray[np.float64], **settings: Any) -> LeastSquares:
    """Run local least-squares searches on a problem, from random starting points and from x0 [k, d]."""
    optimizer = LeastSquares(*problem.parameters.search_bounds, starts=starts, x0=x0, **settings)
    for _ in rounds(optimizer, problem.squares):
        pass
    return optimizer


@dataclass
class Trail:
    """The record of a search: every RT call in order, the best candidate, and the cost of the search.

    Attributes:
        candidates: The candidates in physical units, each [d].
        rmse_db: RMSE of each candidate [dB].
        best_db: RMSE [dB] of the best candidate up to each call.
        iteration: Round of each call, counted from 1.
        seconds: Time from the start to each call [s].
        best: The best candidate [d].
        best_modelled: The engine's values for the best candidate [L].
        best_rmse_db: RMSE of the best candidate [dB].
        best_value: Objective of the best candidate, including priors [dB].
        minima: Minima of the optimizer's searches, as points [k, d] of the search space, best first.
        rt_calls: Number of RT calls of the search, including those answered from the ledger of an earlier run.
        ledger_hits: Number of calls that are answered from the ledger.
        modelled: The engine's values [L] for each candidate; only for an engine without derivatives.
        observed: Further observables [K, L] for each candidate; only for an engine without derivatives.
    """

    candidates: list[NDArray[np.float64]] = field(default_factory=list)
    rmse_db: list[float] = field(default_factory=list)
    best_db: list[float] = field(default_factory=list)
    iteration: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    best: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    best_modelled: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    best_rmse_db: float = np.inf
    best_value: float = np.inf
    minima: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    rt_calls: int = 0
    ledger_hits: int = 0
    modelled: list[NDArray[np.float64]] = field(default_factory=list)
    observed: list[NDArray[np.float64]] = field(default_factory=list)

    def add(
        self, candidates: NDArray[np.float64], evaluation: Evaluation, iteration: int, seconds: float
    ) -> None:
        """Record round `iteration`: candidates in physical units [n, d] and the time since the start [s]."""
        self.candidates += list(candidates)
        self.rmse_db += evaluation.rmse_db.tolist()
        self.iteration += [iteration] * len(evaluation.value)
        self.seconds += [seconds] * len(evaluation.value)
        for row in range(len(candidates)):
            self.compare(candidates, evaluation, row)
            self.best_db.append(self.best_rmse_db)

    def compare(self, candidates: NDArray[np.float64], evaluation: Evaluation, row: int) -> None:
        """Update the best candidate if one of the candidates in physical units [n, d] has a lower objective."""
        if (value := float(evaluation.value[row])) < self.best_value:
            self.best, self.best_modelled = candidates[row], evaluation.modelled[row]
            self.best_value, self.best_rmse_db = value, float(evaluation.rmse_db[row])

    def history(self) -> pd.DataFrame:
        """One row per RT call: number, iteration, RMSE, best RMSE so far, seconds since the start."""
        return pd.DataFrame(
            {
                "call": np.arange(1, len(self.rmse_db) + 1),
                "iteration": self.iteration,
                "rmse_db": self.rmse_db,
                "best_db": self.best_db,
                "seconds": self.seconds,
            }
        )


def search(problem: Problem, optimizer: Optimizer, progress: Progress | None = None) -> Trail:
    """Run an optimizer over the search space of a problem's parameters until it is done.

    The stage of `progress` is "calibrating".

    Raises:
        InputError: No candidate could be evaluated.
    """
    engine, trail = problem.engine, Trail()
    started, calls, hits = time.perf_counter(), engine.calls, _hits(engine)
    # A method that uses residuals but no derivatives models each residual, so it needs the full residuals.
    needs_all_residuals = "residuals" in optimizer.uses and not optimizer.needs_derivatives()
    evaluate = problem.evaluate if needs_all_residuals else problem.squares
    for iteration, (points, evaluation) in enumerate(rounds(optimizer, evaluate), start=1):
        candidates = problem.parameters.from_search(points)
        trail.add(candidates, evaluation, iteration, time.perf_counter() - started)
        if not problem.differentiable:
            trail.modelled += list(evaluation.modelled)
            trail.observed += list(evaluation.observed)
        if progress is not None:
            stage = f"calibrating: best RMSE {trail.best_rmse_db:.2f} dB"
            progress(stage, len(trail.rmse_db), optimizer.budget)
    trail.ledger_hits = _hits(engine) - hits
    # Calls from the ledger count as well, so that a restarted run reports the same cost as an uninterrupted run.
    trail.rt_calls = engine.calls - calls + trail.ledger_hits
    if not (problem.differentiable or problem.observed):
        # The engine was called for the initial values before the search, so these values are compared as well.
        start = problem.parameters.start[None]
        answer = Responses(problem.before[None], np.zeros((1, 0, problem.num_links)))
        trail.compare(start, problem.judge(start, answer), 0)
    if not np.isfinite(trail.best_rmse_db):
        raise InputError(
            "for every candidate, at least one link has no path; exclude such links or use no_path = 'censor'"
        )
    trail.minima = optimizer.minima
    if not len(trail.best_modelled):
        trail.best_modelled = problem.modelled(optimizer.best.x[None])[0]
    return trail


def _hits(engine: Engine) -> int:
    return engine.hits if isinstance(engine, Recorded) else 0


def find_minima(problem: Problem, trail: Trail) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Collect the known minima of a problem; search for further minima if the method kept only its best minimum.

    Returns points [k, d] of the search space, the calibrated point first, and their mean squared residuals [k].
    """
    points = np.concatenate([problem.parameters.to_search(trail.best)[None], trail.minima])
    # The calibrated point and the optimizer's best point are the same minimum.
    if len(points) <= 2:
        points = np.concatenate([points, least_squares(problem, SEARCHES, points).minima])
    return points, problem.squares(points).value ** 2


def relevant_minima(
    minima: NDArray[np.float64], square: NDArray[np.float64], freedom: int
) -> NDArray[np.float64]:
    """Select the minima [k, d] that can contribute to an interval, lowest first [j, d].

    `square` contains the mean squared residual at each minimum [k]; `freedom` is the number of residuals minus the
    number of unknowns.
    """
    order = np.argsort(square, kind="stable")
    # (square - lowest) / lowest x freedom is the excess in noise variances.
    order = order[square[order] <= square.min() * (1.0 + RELEVANT / freedom)]
    return minima[order]
