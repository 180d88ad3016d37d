"""The one loop (paper Fig. 1): ask for candidates, run the engine, compare with the measurements, tell."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.engines.ledger.recorded import Recorded
from calibray.engines.protocol import Engine
from calibray.errors import InputError
from calibray.fitting.problem import Evaluation, Problem
from calibray.optimizers import Optimizer
from calibray.support.blas_threads import single_blas_thread
from calibray.support.progress import Progress

Evaluate = Callable[[NDArray[np.float64], bool], Evaluation]
"""Points of the search space [n, d], and whether derivatives are wanted, to what an optimizer is told."""


def rounds(optimizer: Optimizer, evaluate: Evaluate) -> Iterator[tuple[NDArray[np.float64], Evaluation]]:
    """Run an optimizer until it is done.

    Args:
        optimizer: The optimizer.
        evaluate: What it searches.

    Yields:
        The candidates of every round [n, d], as points of the search space, and what was told of them.
    """
    derivatives = optimizer.needs_derivatives()
    # Matrices of surrogates are small: threads of the linear algebra cost more there than they give.
    with single_blas_thread():
        while not optimizer.done:
            points = optimizer.ask()
            told = evaluate(points, derivatives)
            optimizer.tell(points, told.value, residuals=told.residuals, jacobian=told.jacobian)
            yield points, told


@dataclass
class Trail:
    """What a search has seen: every RT call in order, what the engine answered to the best, and its count.

    Attributes:
        candidates: The candidates in the fields' units, each [d].
        rmse_db: Their RMSE [dB].
        best_db: The RMSE of the best until then [dB].
        iteration: The round that each belongs to.
        seconds: When each was known, since the start [s].
        best: The best candidate [d].
        best_modelled: What the engine answered to it [L].
        best_rmse_db: Its RMSE [dB].
        best_value: Its objective, which priors are part of [dB].
        minima: Where the optimizer's searches ended, the best first, as points of the search space [k, d].
        rt_calls: RT calls that the search spent, now or in an earlier run that left them in the ledger.
        ledger_hits: How many of them the ledger answered.
        modelled: What the engine answered to each [L], where it gives no derivatives: nothing else tells of it then.
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

    def add(self, candidates: NDArray[np.float64], told: Evaluation, iteration: int, now: float) -> None:
        """Record one round.

        Args:
            candidates: Its candidates in the fields' units [n, d].
            told: What was told of them.
            iteration: Its number, from 1.
            now: Time since the start [s].
        """
        self.candidates += list(candidates)
        self.rmse_db += told.rmse_db.tolist()
        self.iteration += [iteration] * len(told.value)
        self.seconds += [now] * len(told.value)
        for row, value in enumerate(told.value.tolist()):
            if value < self.best_value:
                self.best, self.best_modelled = candidates[row], told.modelled[row]
                self.best_value, self.best_rmse_db = value, float(told.rmse_db[row])
            self.best_db.append(self.best_rmse_db)

    def history(self) -> pd.DataFrame:
        """One row per RT call: number, iteration, RMSE, best so far, seconds since the start."""
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
    """Run an optimizer on a problem until it is done.

    Args:
        problem: The problem.
        optimizer: The optimizer, over the search space of the problem's parameters.
        progress: Called with the stage "calibrating" after every round.

    Returns:
        What it saw.

    Raises:
        InputError: No candidate could be evaluated.
    """
    engine, trail = problem.engine, Trail()
    started, calls, hits = time.perf_counter(), engine.calls, _hits(engine)
    # A method that takes residuals without derivatives makes a model of each.
    each = "residuals" in optimizer.uses and not optimizer.needs_derivatives()
    evaluate = problem.evaluate if each else problem.squares
    for iteration, (points, told) in enumerate(rounds(optimizer, evaluate), start=1):
        trail.add(problem.parameters.from_search(points), told, iteration, time.perf_counter() - started)
        if not problem.differentiable:
            trail.modelled += list(told.modelled)
        if progress is not None:
            progress("calibrating", len(trail.rmse_db), optimizer.budget)
    trail.ledger_hits = _hits(engine) - hits
    # What the ledger answered was paid for before, so that a run ends alike however often it was started again.
    trail.rt_calls = engine.calls - calls + trail.ledger_hits
    if not np.isfinite(trail.best_rmse_db):
        raise InputError(
            "every candidate lost the path of some link; exclude those links or use no_path = 'censor'"
        )
    trail.minima = optimizer.minima
    if not len(trail.best_modelled):
        trail.best_modelled = problem.modelled(optimizer.best.x[None])[0]
    return trail


def _hits(engine: Engine) -> int:
    return engine.hits if isinstance(engine, Recorded) else 0
