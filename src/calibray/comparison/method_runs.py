"""Runs of methods on one problem at equal budgets, and the file that stores their records."""

from __future__ import annotations

import hashlib
import json
import time
from bisect import bisect_right
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from calibray import engines, optimizers
from calibray.engines.make_engine import fingerprint
from calibray.errors import InputError
from calibray.fitting.preliminary_fits import with_preliminary_fits
from calibray.fitting.problem import Problem
from calibray.fitting.search import Evaluate, local_searches, rounds
from calibray.optimizers import METHODS, Optimizer
from calibray.optimizers.protocol import CheapModel
from calibray.study import Setup, Study
from calibray.support.output_files import append_text, exists


@dataclass(frozen=True, eq=False)
class ComparisonProblem:
    """A problem on which any method can be run.

    Attributes:
        name: Name of the problem.
        fingerprint: Digest of everything that determines an evaluation.
        lower: Lower bounds of the search space [d].
        upper: Upper bounds [d].
        start: Starting point given by the user [d]; None if the user gave no starting point.
        starts: Number of further starting points for methods that use several; None for a method's default.
        large: Whether evaluations are too expensive for a reference search with many starts.
        minimum: Lowest objective known in advance; +inf if unknown.
        evaluate: The function to minimize.
        cheap_model: Function that makes a cheap model of `evaluate`; None if there is none.
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
    """Make a problem from a study file and its paths, which are traced if the cache does not contain them.

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
    # The replay engine always provides derivatives.
    engine = cast(engines.Differentiable, engines.make(setup))
    problem = with_preliminary_fits(Problem.of(setup, engine))
    objective, parameters = problem.objective, problem.parameters
    lower, upper = parameters.search_bounds
    # Record everything that affects an evaluation: the study without its method, the files, and data derived from both.
    content = {key: section for key, section in problem.setup.study.content().items() if key != "method"}
    record = (
        fingerprint(setup),
        content,
        sorted(setup.files.values()),
        setup.tracer_versions,
        objective.noise_db,
    )
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    digest.update(repr(setup.links.frame.to_dict("split")).encode())
    values = (objective.measured, objective.weight, *(each.measured for each in problem.observed))
    for part in (*values, objective.nuisance.prior):
        digest.update(part.astype("<f8").tobytes())
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


LIMITS: Final = {"seeds": 10_000, "workers": 1_000, "budget": 1_000_000}
"""Maximum accepted values; a comparison with larger values would take impractically long."""

RunKey = tuple[str, int, int]
"""Method, budget and seed, which identify a run on a problem."""


@dataclass(frozen=True)
class BudgetedMethod:
    """A method with its budget.

    Attributes:
        name: Name of the method in tables, as requested by the user.
        method: Name of the method in `METHODS`.
        budget: Maximum number of RT calls.
    """

    name: str
    method: str
    budget: int

    @property
    def stops_by_itself(self) -> bool:
        """Whether the method ignores the budget."""
        return METHODS[self.method].schedule is None

    @staticmethod
    def parse(name: str, budget: int) -> BudgetedMethod:
        """Parse a method name such as "gwo@600"; `budget` [RT calls] applies if the name contains no budget.

        Raises:
            InputError: The method is unknown or has no budget, or the budget is not a whole number in the accepted
                range.

        Example:
            >>> BudgetedMethod.parse("gwo@600", 225)
            BudgetedMethod(name='gwo@600', method='gwo', budget=600)
        """
        method, at, calls = name.partition("@")
        schedule = optimizers.method(method).schedule
        if at and schedule is None:
            raise InputError(f"method {name!r}: {method} stops by itself and has no budget; omit @{calls}")
        if calls:
            with suppress(ValueError):
                budget = int(calls)
        least = 1 if schedule is None else schedule.least
        # Python also reads 6_00, +600 and " 600" as numbers; a run's name must state its budget in only one way.
        if (at and calls != str(budget)) or not least <= budget <= LIMITS["budget"]:
            raise InputError(
                f"method {name!r}: the budget {calls if at else budget} must be a whole number of RT calls from "
                f"{least} to {LIMITS['budget']:,}"
            )
        return BudgetedMethod(name, method, budget)

    def key(self, seed: int) -> RunKey:
        """The key of the run with the given seed; the key's budget is 0 if the method stops by itself."""
        return self.method, 0 if self.stops_by_itself else self.budget, seed

    def optimizer(self, problem: ComparisonProblem, seed: int) -> Optimizer:
        """Make the optimizer of a run, which respects the budget or stops by itself.

        Raises:
            InputError: The method is not suitable for the problem, or its library is not installed.
        """
        return optimizers.make(
            self.method,
            problem.lower,
            problem.upper,
            seed,
            budget=self.budget,
            start=problem.start,
            starts=problem.starts,
            cheap_model=None if problem.cheap_model is None else problem.cheap_model(),
        )

    def run(self, problem: ComparisonProblem, seed: int) -> MethodRun:
        """Run the method; if an error ends the run, the error message is recorded."""
        return run_optimizer(problem, self.key(seed), lambda: self.optimizer(problem, seed))


@dataclass(frozen=True)
class MethodRun:
    """One run of a method.

    Attributes:
        method: The method.
        budget: Maximum number of RT calls; 0 if the method stops by itself.
        seed: Seed of the run.
        evaluations: Number of RT calls in the run.
        calls: Indices, counted from 1, of the RT calls with a lower objective than all earlier calls.
        best: Objectives of these calls [dB].
        seconds: Duration [s].
        failure: The error that ended the run; empty if the run finished.
    """

    method: str
    budget: int
    seed: int
    evaluations: int
    calls: tuple[int, ...]
    best: tuple[float, ...]
    seconds: float
    failure: str = ""

    def at(self, calls: int) -> float:
        """The best objective [dB] after a number of RT calls; +inf before the first RT call."""
        index = bisect_right(self.calls, calls)
        return self.best[index - 1] if index else np.inf

    def first(self, objective: float) -> float:
        """Index, counted from 1, of the first RT call that reached an objective [dB]; +inf if no call did."""
        return next(
            (float(call) for call, value in zip(self.calls, self.best, strict=True) if value <= objective),
            np.inf,
        )


def run_optimizer(problem: ComparisonProblem, key: RunKey, make: Callable[[], Optimizer]) -> MethodRun:
    """Run an optimizer to its end; if an error ends the run, the error message is recorded."""
    calls: list[int] = []
    best: list[float] = []
    evaluations, failure, started = 0, "", time.perf_counter()
    try:
        optimizer = make()
        for _, evaluation in rounds(optimizer, problem.evaluate):
            for value in evaluation.value.tolist():
                evaluations += 1
                if value < (best[-1] if best else np.inf):
                    calls.append(evaluations)
                    best.append(value)
    except Exception as error:  # a failed run is a result too
        failure = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - started
    return MethodRun(*key, evaluations, tuple(calls), tuple(best), seconds, failure)


class RunFile:
    """Finished runs of one problem, in a JSON Lines file that can also contain runs of other problems.

    Runs are appended one by one, so that an interrupted comparison continues where it stopped. Failed runs in the file
    are ignored, so they are repeated. The file is created when the first run is added. `problem` is a digest of
    everything that determines a run, except for the method, budget and seed.

    Raises:
        InputError: The file contains anything other than runs.
    """

    def __init__(self, path: Path, problem: str) -> None:
        self._path, self._problem = path, problem
        self._runs: dict[RunKey, MethodRun] = {}
        other = InputError(f"{path}: contains something other than finished runs; choose another folder")
        try:
            text = path.read_text(encoding="utf-8") if exists(path) else ""
        except UnicodeDecodeError:
            raise other from None
        # A killed process may have left an incomplete last line.
        self._torn = bool(text) and not text.endswith("\n")
        for line in text.splitlines():
            try:
                record = json.loads(line)
            except ValueError:  # an incomplete line of a killed process
                continue
            try:
                if record.pop("problem") == problem and not record["failure"]:
                    run = MethodRun(
                        **{**record, "calls": tuple(record["calls"]), "best": tuple(record["best"])}
                    )
                    self._runs[run.method, run.budget, run.seed] = run
            except (AttributeError, KeyError, TypeError):
                raise other from None

    def find(self, key: RunKey) -> MethodRun | None:
        """The finished run with the given key, or None."""
        return self._runs.get(key)

    def add(self, run: MethodRun) -> MethodRun:
        """Append a run to the file, and return it."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        line = json.dumps({"problem": self._problem, **asdict(run)})
        append_text(self._path, "\n" * self._torn + line + "\n")
        self._torn = False
        self._runs[run.method, run.budget, run.seed] = run
        return run


@cache
def code_fingerprint() -> str:
    """Digest of the optimizers' code; runs with different code are not comparable."""
    digest = hashlib.sha256()
    for path in sorted(Path(optimizers.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
