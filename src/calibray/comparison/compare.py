"""Comparison of methods at equal budgets: every method from many seeds on one problem."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Final

from calibray import optimizers
from calibray.comparison.comparison import Comparison
from calibray.comparison.method_runs import (
    LIMITS,
    BudgetedMethod,
    ComparisonProblem,
    MethodRun,
    RunFile,
    RunKey,
    code_fingerprint,
    run_optimizer,
)
from calibray.errors import InputError
from calibray.optimizers import METHODS, Optimizer
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_folder
from calibray.support.progress import Progress

ROUNDING_DB: Final = 1e-7
"""Difference below which two objectives are equal."""

OPTIMUM: Final[RunKey] = ("optimum", 0, 0)
"""Key of the reference search among the runs."""

REFERENCE: Final = "least-squares"
"""Method of the reference search."""

OPTIMUM_STARTS: Final = {False: 2048, True: 64}
"""Number of its local searches on small and on large path programs."""

OpenProblem = Callable[[], ComparisonProblem]


def compare(
    open_problem: OpenProblem,
    names: Sequence[str],
    *,
    seeds: int = 25,
    budget: int = 225,
    out: str | Path,
    workers: int = 1,
    progress: Progress | None = None,
) -> Comparison:
    """Run methods from seeds 0, 1, ... on one problem at equal budgets of RT calls.

    Every finished run is appended to `runs.jsonl` in `out` at once. If the file contains a run of the same problem,
    optimizer code, method, budget and seed, it is not repeated.

    Args:
        open_problem: Makes the problem; picklable for several workers, which call it once each.
        names: Methods, each with the common budget or its own, as in "gwo@600".
        seeds: Number of runs of each method.
        budget: RT calls of a run.
        out: Folder that keeps the runs.
        workers: Number of processes.
        progress: Called after every run.

    Returns:
        The comparison.

    Raises:
        InputError: A method, a number or the folder is invalid.
    """
    for name, value in (("seeds", seeds), ("workers", workers)):
        if not 1 <= value <= LIMITS[name]:
            raise InputError(f"{name} = {value}: must be 1 to {LIMITS[name]:,}")
    methods = parse_methods(names, budget)
    check_folder(out)
    problem = open_problem()
    for method in methods:
        method.optimizer(problem, 0)  # refuses missing libraries and unsuitable methods before any run
    file = RunFile(Path(out) / "runs.jsonl", f"{problem.fingerprint}-{code_fingerprint()}")
    tasks = [(method, seed) for seed in range(seeds) for method in methods]
    missing = [(method, seed) for method, seed in tasks if file.find(method.key(seed)) is None]
    done = len(tasks) - len(missing)
    for run in _finished(open_problem, problem, missing, workers):
        file.add(run)
        done += 1
        if progress is not None:
            progress("comparing", done, len(tasks))
    reference = file.find(OPTIMUM)
    if reference is None:
        reference = file.add(_search_optimum(problem))
    runs: dict[str, tuple[MethodRun, ...]] = {}
    for method in methods:
        finished = [file.find(method.key(seed)) for seed in range(seeds)]
        runs[method.name] = tuple(run for run in finished if run is not None)
    return Comparison(problem.name, methods, runs, *_lowest(problem.minimum, reference, runs))


def parse_methods(names: Sequence[str], budget: int) -> tuple[BudgetedMethod, ...]:
    """Parse methods, as in "gwo@600", or with the common budget; duplicates are left out.

    Raises:
        InputError: The list is empty, a method is unknown, or a budget is invalid.
    """
    methods = tuple(BudgetedMethod.parse(name, budget) for name in dict.fromkeys(names))
    if not methods:
        raise InputError(f"methods: the list is empty; {did_you_mean('', METHODS)}")
    return methods


def _search_optimum(problem: ComparisonProblem) -> MethodRun:
    """Least squares from enough starting points for its result to count as the global optimum."""
    starts = OPTIMUM_STARTS[problem.large]

    def make() -> Optimizer:
        return optimizers.make(
            REFERENCE, problem.lower, problem.upper, 2**31, start=problem.start, starts=starts
        )

    return run_optimizer(problem, OPTIMUM, make)


def _lowest(
    earlier: float, reference: MethodRun, runs: dict[str, tuple[MethodRun, ...]]
) -> tuple[float, str]:
    """The lowest objective of all searches, and the first search that reached it within rounding."""
    ends = [(reference.at(reference.evaluations), "many-start least squares"), (earlier, "earlier searches")]
    for name, finished in runs.items():
        ends += [(run.at(run.evaluations), f"{name}, seed {run.seed}") for run in finished]
    optimum = min(objective for objective, _ in ends)
    return optimum, next(search for objective, search in ends if objective <= optimum + ROUNDING_DB)


def _finished(
    open_problem: OpenProblem,
    problem: ComparisonProblem,
    tasks: list[tuple[BudgetedMethod, int]],
    workers: int,
) -> Iterator[MethodRun]:
    """The runs, as they finish."""
    if workers == 1 or len(tasks) < 2:
        yield from (method.run(problem, seed) for method, seed in tasks)
        return
    with ProcessPoolExecutor(
        min(workers, len(tasks)),
        mp_context=get_context("spawn"),
        initializer=_start,
        initargs=(open_problem,),
    ) as pool:
        futures = [pool.submit(_work, method, seed) for method, seed in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _start(open_problem: OpenProblem) -> None:
    global _opened
    _opened = open_problem()


def _work(method: BudgetedMethod, seed: int) -> MethodRun:
    return method.run(_opened, seed)
