"""Methods on a family of planted problems: how many they solve, with how many RT calls.

A run solves its problem to a tolerance if its excess RMSE is at most this tolerance. The share of solved runs versus
the number of RT calls is a data profile: J. J. Moré, S. M. Wild, SIAM J. Optim. 20 (2009) 172.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray import optimizers
from calibray.comparison.comparison import parse_methods, quantile
from calibray.comparison.method_runs import (
    LIMITS,
    BudgetedMethod,
    ComparisonProblem,
    MethodRun,
    RunFile,
)
from calibray.errors import InputError
from calibray.optimizers import METHODS, label
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_folder
from calibray.support.progress import Progress
from calibray.tables import Column, Table, numbers
from problem_families.family import FamilyKind
from problem_families.problems import planted_problem

CALLS: Final = (8, 15, 30, 60, 120, 225)  # after which the excess is tabulated
TOLERANCES_DB: Final = (0.05, 0.02, 0.01)  # of the data profiles


@dataclass(frozen=True, eq=False)
class FamilyComparison:
    """Finished runs of methods on the problems of a family.

    Attributes:
        kind: The family.
        seeds: Seeds of its problems [p].
        methods: The methods, in the order requested.
        runs: The runs on every problem [p][repeats], by method name.
        optimum: Lowest known objective of every problem [p], [dB].
        wrong_constants: Problems whose cheap model has wrong constants [p].
        failed_problems: Problems that could not be made and are left out: seed and reason of each.
    """

    kind: str
    seeds: tuple[int, ...]
    methods: tuple[BudgetedMethod, ...]
    runs: dict[str, tuple[tuple[MethodRun, ...], ...]]
    optimum: NDArray[np.float64]
    wrong_constants: NDArray[np.bool_]
    failed_problems: tuple[tuple[int, str], ...] = ()

    def part(self, mask: NDArray[np.bool_]) -> FamilyComparison:
        """The comparison on the problems for which `mask` [p] is True."""
        rows = np.flatnonzero(mask)
        return FamilyComparison(
            self.kind,
            tuple(self.seeds[row] for row in rows),
            self.methods,
            {name: tuple(problems[row] for row in rows) for name, problems in self.runs.items()},
            self.optimum[rows],
            self.wrong_constants[rows],
        )

    @staticmethod
    def joined(parts: Sequence[FamilyComparison]) -> FamilyComparison:
        """The problems of several families together, compared with the same methods."""
        first = parts[0]
        return FamilyComparison(
            " and ".join(part.kind for part in parts),
            tuple(seed for part in parts for seed in part.seeds),
            first.methods,
            {name: tuple(runs for part in parts for runs in part.runs[name]) for name in first.runs},
            np.concatenate([part.optimum for part in parts]),
            np.concatenate([part.wrong_constants for part in parts]),
            tuple(failed for part in parts for failed in part.failed_problems),
        )

    def excess(self, name: str, calls: int) -> NDArray[np.float64]:
        """Excess of a method's runs after a number of RT calls [p, repeats], [dB]; +inf before the first."""
        best = np.array([[run.at(calls) for run in runs] for runs in self.runs[name]])
        return best - self.optimum[:, None]

    def solved(self, name: str, calls: int, tolerance_db: float) -> float:
        """The data profile: share of a method's runs within a tolerance [dB] after a number of RT calls."""
        return float(np.mean(self.excess(name, calls) <= tolerance_db))

    def seconds(self, name: str) -> float:
        """The median duration of a method's runs [s]."""
        return float(np.median([run.seconds for runs in self.runs[name] for run in runs]))

    def failures(self) -> list[tuple[str, int, str]]:
        """Runs that ended in an error: method, seed of the problem and message of each."""
        return [
            (name, seed, run.failure)
            for name, problems in self.runs.items()
            for seed, runs in zip(self.seeds, problems, strict=True)
            for run in runs
            if run.failure
        ]

    def table(self) -> pd.DataFrame:
        """One row for each method and number of RT calls within its budget.

        Returns:
            Median, 90th percentile and worst excess [dB], the share solved to every tolerance, failed runs, and the
            median seconds of a run.
        """
        rows = [
            self._row(method, calls) for method in self.methods for calls in CALLS if calls <= method.budget
        ]
        return pd.DataFrame(rows)

    def _row(self, method: BudgetedMethod, calls: int) -> dict[str, Any]:
        excess = self.excess(method.name, calls).ravel()
        solved = {
            f"solved_{tolerance:g}_db": self.solved(method.name, calls, tolerance)
            for tolerance in TOLERANCES_DB
        }
        return {
            "method": method.name,
            "calls": calls,
            "runs": excess.size,
            "median_excess_db": quantile(excess, 0.5),
            "p90_excess_db": quantile(excess, 0.9),
            "worst_excess_db": quantile(excess, 1.0),
            **solved,
            "failed": sum(name == method.name for name, _, _ in self.failures()),
            "seconds": self.seconds(method.name),
        }


def tables(comparison: FamilyComparison) -> tuple[Table, ...]:
    """A table of the median, 90th percentile and worst excess, and one table per tolerance with the data profile."""
    calls = [number for number in CALLS if number <= max(method.budget for method in comparison.methods)]
    problems = f"{comparison.kind}, seeds {comparison.seeds[0]} to {comparison.seeds[-1]}"
    columns = (Column("method"), *(numbers(f"at {number}") for number in calls), numbers("seconds per run"))
    rows = {(row["method"], row["calls"]): row for row in comparison.table().to_dict("records")}

    def cell(name: str, number: int, keys: tuple[str, ...], form: str) -> str:
        if (name, number) not in rows:
            return "-"
        values = [float(rows[name, number][key]) for key in keys]
        return " / ".join(form.format(value) if np.isfinite(value) else "none" for value in values)

    def table(title: str, keys: tuple[str, ...], form: str) -> Table:
        lines = tuple(
            (
                label(method.name),
                *(cell(method.name, number, keys, form) for number in calls),
                f"{comparison.seconds(method.name):.1f}",
            )
            for method in comparison.methods
        )
        return Table(title, columns, lines)

    excess = ("median_excess_db", "p90_excess_db", "worst_excess_db")
    profiles = (
        table(f"Share of runs within {tolerance:g} dB: {problems}", (f"solved_{tolerance:g}_db",), "{:.2f}")
        for tolerance in TOLERANCES_DB
    )
    return (table(f"Excess [dB], median / 90th percentile / worst: {problems}", excess, "{:.4f}"), *profiles)


def seed_range(text: str) -> range:
    """Read a range of seeds.

    Args:
        text: "20" for seeds 0 to 19, or "1000:1020" for 1000 to 1019.

    Returns:
        The seeds.

    Raises:
        InputError: The text is neither.

    Example:
        >>> seed_range("1000:1020")
        range(1000, 1020)
    """
    first, colon, end = text.strip().partition(":")
    ends = [first, end] if colon else ["0", first]
    if not all(number.isascii() and number.isdigit() and len(number) < 10 for number in ends):
        raise InputError(f"seeds = {text!r}; give a number, or a range as '0:20'")
    seeds = range(int(ends[0]), int(ends[1]))
    if not 1 <= len(seeds) <= LIMITS["seeds"]:
        raise InputError(f"seeds = {text!r}: {len(seeds)} of them; it must be 1 to {LIMITS['seeds']:,}")
    return seeds


def method_fingerprint(method: str) -> str:
    """Digest of the code of a method: its module and all optimizer modules that it imports."""
    folder = Path(optimizers.__file__).parent
    files: set[Path] = set()
    waiting = [METHODS[method].__module__]
    while waiting:
        file = folder.joinpath(*waiting.pop().split(".")[2:]).with_suffix(".py")
        if file.is_file() and file not in files:
            files.add(file)
            text = file.read_text("utf-8")
            waiting += re.findall(r"^from (calibray\.optimizers\.[\w.]+) import", text, re.MULTILINE)
            for package, names in re.findall(
                r"^from (calibray\.optimizers[\w.]*) import (\w+)$", text, re.MULTILINE
            ):
                waiting.append(f"{package}.{names}")
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def compare_family(
    kind: str,
    seeds: Sequence[int],
    names: Sequence[str],
    *,
    budget: int = 225,
    repeats: int = 1,
    out: str | Path,
    workers: int = 1,
    progress: Progress | None = None,
    wrong_constants: bool | None = None,
) -> FamilyComparison:
    """Run methods on every problem of a family at equal budgets of RT calls.

    Every finished run is appended to `runs.jsonl` in `out` at once. Runs already in the file with the same problem,
    method code, budget and seed are not repeated.

    Args:
        kind: "district" or "office".
        seeds: Seeds of the problems.
        names: Methods, each with the common budget or its own, as in "gwo@600".
        budget: RT calls per run.
        repeats: Runs of each method on each problem, with seeds 0, 1, ...
        out: Folder of the finished runs.
        workers: Number of processes.
        progress: Called after every problem made and every run.
        wrong_constants: Compare only problems whose cheap model has wrong constants, or only the others; None for all.

    Returns:
        The comparison.

    Raises:
        InputError: A method, a number, the family or the folder cannot be used, or no problem can be made.
    """
    if kind not in get_args(FamilyKind):
        raise InputError(
            f"family {kind!r}: there is no such family; {did_you_mean(kind, get_args(FamilyKind))}"
        )
    for name, value, most in (("repeats", repeats, LIMITS["seeds"]), ("workers", workers, LIMITS["workers"])):
        if not 1 <= value <= most:
            raise InputError(f"{name} = {value}; it must be 1 to {most:,}")
    methods = parse_methods(names, budget)
    for method in methods:
        if METHODS[method.method].needs_derivatives():
            raise InputError(
                f"method {method.name!r} needs derivatives, which a black-box engine does not give"
            )
    path = Path(check_folder(out)) / "runs.jsonl"
    with (
        ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
        if workers > 1
        else nullcontext() as pool
    ):
        prepared: dict[int, _Prepared | str] = {}
        for (_, seed), answer in _spread(
            pool, _prepare, [(kind, seed) for seed in seeds], "problems", progress
        ):
            prepared[seed] = answer
        made = {seed: answer for seed in seeds if isinstance(answer := prepared[seed], _Prepared)}
        failed = tuple((seed, answer) for seed in seeds if isinstance(answer := prepared[seed], str))
        if not made:
            raise InputError(f"no problem of the family can be made: {failed[0][1]}")
        ready = {
            seed: answer for seed, answer in made.items() if wrong_constants in (None, answer.wrong_constants)
        }
        if not ready:
            raise InputError(
                "no problem of these seeds has a cheap model with such constants; use other seeds"
            )
        files = {
            (seed, method.method): RunFile(path, f"{problem.fingerprint}-{method_fingerprint(method.method)}")
            for seed, problem in ready.items()
            for method in methods
        }
        missing = [
            (kind, seed, method, repeat)
            for seed in ready
            for repeat in range(repeats)
            for method in methods
            if files[seed, method.method].find(method.key(repeat)) is None
        ]
        for (_, seed, method, _), run in _spread(pool, _work, missing, "comparing", progress):
            files[seed, method.method].add(run)
    runs = {method.name: tuple(_runs(files, seed, method, repeats) for seed in ready) for method in methods}
    lowest = [
        min([problem.minimum, *(run.at(run.evaluations) for name in runs for run in runs[name][row])])
        for row, problem in enumerate(ready.values())
    ]
    wrong = np.array([problem.wrong_constants for problem in ready.values()])
    return FamilyComparison(kind, tuple(ready), methods, runs, np.array(lowest), wrong, failed)


def _runs(
    files: dict[tuple[int, str], RunFile], seed: int, method: BudgetedMethod, repeats: int
) -> tuple[MethodRun, ...]:
    """The finished runs of a method on a problem."""
    finished = (files[seed, method.method].find(method.key(repeat)) for repeat in range(repeats))
    return tuple(run for run in finished if run is not None)


def _spread(
    pool: ProcessPoolExecutor | None,
    function: Any,
    tasks: Sequence[tuple],
    stage: str,
    progress: Progress | None,
) -> Iterator[tuple[Any, Any]]:
    """Each task with its result, in the order of completion; the processes of a pool run them if there is one."""
    if pool is None:
        results = ((task, function(*task)) for task in tasks)
    else:
        futures = {pool.submit(function, *task): task for task in tasks}
        results = ((futures[future], future.result()) for future in as_completed(futures))
    for done, result in enumerate(results, start=1):
        if progress is not None:
            progress(stage, done, len(tasks))
        yield result


class _Prepared(NamedTuple):
    """Properties of a problem that are needed before the search."""

    fingerprint: str
    minimum: float
    wrong_constants: bool


def _prepare(kind: str, seed: int) -> _Prepared | str:
    """A problem's properties, or the reason why it cannot be made."""
    try:
        problem = _opened(kind, seed)
    except (InputError, RuntimeError, OSError) as error:
        return str(error)
    return _Prepared(problem.fingerprint, problem.minimum, problem.wrong_constants)


def _work(kind: str, seed: int, method: BudgetedMethod, repeat: int) -> MethodRun:
    return method.run(_opened(kind, seed), repeat)


@lru_cache(maxsize=2)
def _opened(kind: str, seed: int) -> ComparisonProblem:
    return planted_problem(kind, seed)
