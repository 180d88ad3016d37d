"""Minimizers from other libraries, run as ask/tell searches: CMA-ES, DFO-LS and SciPy's differential evolution.

- CMA-ES, from the author's package `cma`: N. Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv:1604.00772. The
  search starts in the middle of the unit cube with a step size of 0.3.
- DFO-LS, from the authors' package: C. Cartis, J. Fiala, B. Marteau, L. Roberts, "Improving the Flexibility and
  Robustness of Model-Based Derivative-Free Optimization Solvers", ACM Trans. Math. Softw. 45 (2019) 32. DFO-LS is a
  local method: in a trust region, it fits a linear model to every residual, one evaluation at a time.
- Differential evolution: R. Storn, K. Price, J. Global Optim. 11 (1997) 341. Each batch is one generation. SciPy's
  final polishing step, which would need derivatives, is omitted.

All methods start at the best point already passed to `tell`, if any. If a search converges before the budget is used
up, the method restarts from a random point or population.

A minimizer that calls its objective runs in a separate thread; inside the objective, it waits for the evaluation. Only
one of the two threads runs at a time, so a run is as reproducible as the library itself. If a search is dropped before
its end, the objective raises an exception inside the library; this exception ends the thread.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import differential_evolution

from calibray.optimizers.arguments import Box, real, whole
from calibray.optimizers.evaluations import Archive, Evaluations, Objective, root_mean_square
from calibray.optimizers.protocol import Optimizer, Search, Session, first_start, limited
from calibray.support.lazy_imports import library

Evaluate = Callable[[NDArray[np.float64]], Evaluations]
"""The function that a minimizer calls: it maps candidates [n, d] to their evaluations."""


class _AbandonedError(BaseException):
    """Ends a minimizer whose search was dropped; a `BaseException`, because a library might catch an `Exception`."""


def inverted(minimize: Callable[[Evaluate], None]) -> Search:
    """Run a minimizer in a thread, and yield the candidates [n, d] whose evaluations the minimizer requests.

    Raises:
        Exception: Any exception that `minimize` raises.
    """
    questions: SimpleQueue[NDArray[np.float64] | BaseException | None] = SimpleQueue()
    answers: SimpleQueue[Evaluations | None] = SimpleQueue()

    def evaluate(x: NDArray[np.float64]) -> Evaluations:
        questions.put(x)
        answer = answers.get()
        if answer is None:
            answers.put(None)  # for the next call, in case the library catches the exception
            raise _AbandonedError
        return answer

    def work() -> None:
        try:
            minimize(evaluate)
            questions.put(None)
        except _AbandonedError:
            pass
        except BaseException as error:
            questions.put(error)

    thread = Thread(target=work, name="minimizer", daemon=True)
    thread.start()
    try:
        while (question := questions.get()) is not None:
            if isinstance(question, BaseException):
                raise question
            answers.put((yield question))
    finally:
        answers.put(None)
        thread.join()


@final
class CMAES(Optimizer):
    """Covariance matrix adaptation. The method uses only objective values and spends the whole budget.

    The method requires `calibray[optimizers]`.

    Args:
        budget: Number of evaluations.
        population: Number of candidates per generation; 4 + floor(3 ln d) if None.

    Raises:
        InputError: An argument is out of range, or `cma` is not installed.
    """

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int = 225,
        population: int | None = None,
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        default = 4 + int(3 * np.log(self.box.dimension))
        self.population = default if population is None else whole("population", population, at_least=4)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._cma = library("cma", "optimizers")
        self._session = Session(self.box, self.uses, self._search)

    def _search(self, archive: Archive) -> Search:
        return limited(self._generations(archive), self._budget)

    def _generations(self, archive: Archive) -> Search:
        start = first_start(archive)
        options = {
            "bounds": [0.0, 1.0],
            "popsize": self.population,
            "randn": lambda *shape: self._rng.standard_normal(shape),
            "seed": np.nan,  # does not reseed NumPy's global generator
            "verbose": -9,
        }
        if len(start) == 1:
            options["maxstd_boundrange"] = np.inf  # the default limit of cma 4.5 fails in one dimension
        while True:
            strategy = self._cma.CMAEvolutionStrategy(start, 0.3, options)
            while not strategy.stop():
                unit = np.array(strategy.ask())
                answers = yield self.box.from_unit(unit)
                strategy.tell(list(unit), list(archive.imputed(answers).y))
            start = self._rng.random(len(start))


@final
class DFOLS(Optimizer):
    """Derivative-free least squares. The method uses residuals and spends the whole budget.

    The method requires `calibray[optimizers]`.

    Args:
        seed: Seed of the random points at which searches restart.
        budget: Number of evaluations.
        radius: Initial trust-region radius, as a fraction of the box width.
        tolerance: Trust-region radius at which a search has converged, as a fraction of the box width.

    Raises:
        InputError: An argument is out of range, or `DFO-LS` is not installed.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value", "residuals"})

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int = 225,
        radius: float = 0.2,
        tolerance: float = 1e-4,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        self.radius = real("radius", radius, at_least=1e-6, at_most=0.5)
        # DFO-LS requires an initial radius that is larger than the final radius.
        self.tolerance = real("tolerance", tolerance, at_least=1e-12, at_most=0.5 * self.radius)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._dfols = library("dfols", "optimizers")
        self._session = Session(self.box, self.uses, self._search, objective)

    def _search(self, archive: Archive) -> Search:
        # The thread holds no reference to this object, so the thread ends when this object is dropped.
        solve, radii = self._dfols.solve, (self.radius, self.tolerance)
        minimize = partial(_minimize_residuals, solve, radii, self._budget, archive, self._rng)
        return limited(inverted(minimize), self._budget)


def _minimize_residuals(
    solve: Callable[..., Any],
    radii: tuple[float, float],
    budget: int,
    archive: Archive,
    rng: np.random.Generator,
    evaluate: Evaluate,
) -> None:
    """Minimize from one starting point after another; the caller ends the loop."""
    box = archive.box
    d = box.dimension

    def residuals(unit: NDArray[np.float64]) -> NDArray[np.float64]:
        return archive.imputed(evaluate(box.from_unit(unit[None]))).errors[0]

    start = first_start(archive)
    while True:
        before = len(archive)
        outcome = solve(
            residuals,
            start,
            bounds=(np.zeros(d), np.ones(d)),
            rhobeg=radii[0],
            rhoend=radii[1],
            maxfun=budget + d + 2,  # `limited` enforces the budget, and DFO-LS warns if it is small
            do_logging=False,
            # Coordinate directions are used, because random directions would be drawn from NumPy's global generator.
            user_params={"init.random_initial_directions": False},
        )
        if len(archive) == before:
            raise RuntimeError(f"DFO-LS ended without an evaluation: {outcome.msg}")
        start = rng.random(d)


@final
class DifferentialEvolution(Optimizer):
    """Differential evolution. The method uses only objective values and spends the whole budget.

    Args:
        budget: Number of evaluations.
        population: Number of candidates per generation, as a multiple of d; SciPy uses at least five candidates.

    Raises:
        InputError: An argument is out of range.
    """

    def __init__(
        self, lower: ArrayLike, upper: ArrayLike, *, seed: int = 0, budget: int = 225, population: int = 5
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        self.population = whole("population", population, at_least=1)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    def _search(self, archive: Archive) -> Search:
        # The thread holds no reference to this object, so the thread ends when this object is dropped.
        minimize = partial(_evolve, self.population, archive, self._rng)
        return limited(inverted(minimize), self._budget)


def _evolve(population: int, archive: Archive, rng: np.random.Generator, evaluate: Evaluate) -> None:
    """Minimize with one population after another; the caller ends the loop."""
    box = archive.box

    def objective(unit: NDArray[np.float64]) -> NDArray[np.float64]:  # [d, n], SciPy's vectorized form
        return archive.imputed(evaluate(box.from_unit(unit.T))).y

    # With bounds other than the unit cube, SciPy's rounding may move a starting point on a face out of bounds.
    start = box.to_unit(archive.best.x) if len(archive) else None
    while True:
        differential_evolution(
            objective,
            [(0.0, 1.0)] * box.dimension,
            popsize=population,
            x0=start,
            tol=0.0,
            polish=False,
            vectorized=True,
            updating="deferred",
            rng=rng,
        )
        start = None
