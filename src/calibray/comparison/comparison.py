"""Comparison of methods at equal budgets: every method runs on the same problem with many seeds.

The result is the excess of every method as a function of the number of RT calls, as arrays, tables, files and a figure.
The excess is the best objective so far minus the global optimum on the same data. The optimum is found by least squares
with many starts, or by another search that reached a lower value.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibray import optimizers
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
from calibray.errors import EngineError, InputError
from calibray.optimizers import METHODS, Optimizer, label
from calibray.support.figure_style import COLORS, PALETTE, logarithmic, plain_figure, styled
from calibray.support.figure_style import write as write_figure
from calibray.support.messages import counted, did_you_mean
from calibray.support.output_files import check_folder, write_table
from calibray.support.progress import Progress
from calibray.tables import Column, Table, numbers, short_html, short_text

CALLS: Final = (30, 60, 225)
"""Numbers of RT calls at which the excess is tabulated, in addition to the end of the run."""

COLUMNS: Final = (
    Column("method"), Column("uses"), numbers("RT calls"),
    numbers("excess at 30", "dB"), numbers("at 60", "dB"), numbers("at 225", "dB"), numbers("at the end", "dB"),
    numbers("quartiles", "dB"), numbers("worst", "dB"),
    numbers("calls to 0.05 dB"), numbers("to 0.02 dB"), numbers("to 0.01 dB"), numbers("failed"), numbers("time", "s"),
)  # fmt: skip

SHORT: Final = ("method", "RT calls", "at the end", "quartiles", "worst", "failed")
"""Columns of the short table that Python and notebooks display."""


@dataclass(frozen=True, repr=False)
class Comparison:
    """Finished runs of methods on one problem.

    Attributes:
        name: Name of the problem.
        methods: The methods, in the order requested.
        runs: Runs by name of the method, one per seed.
        optimum: Lowest known objective [dB].
        found_by: The search that found the optimum.
    """

    name: str
    methods: tuple[BudgetedMethod, ...]
    runs: dict[str, tuple[MethodRun, ...]]
    optimum: float
    found_by: str

    def excess(self, name: str, calls: int) -> NDArray[np.float64]:
        """Excess [seeds], [dB], of every run after `calls` RT calls.

        A run that ended earlier keeps its final excess. The excess is +inf before the first evaluation.
        """
        return np.array([run.at(calls) for run in self.runs[name]]) - self.optimum

    def quartiles(self, name: str, calls: int) -> tuple[float, float, float]:
        """Lower quartile, median and upper quartile of `excess` [dB]."""
        excess = self.excess(name, calls)
        return quantile(excess, 0.25), quantile(excess, 0.5), quantile(excess, 0.75)

    def calls_to(self, name: str, excess_db: float) -> NDArray[np.float64]:
        """Number of RT calls [seeds] after which each run reached an excess; +inf for runs that did not reach it."""
        return np.array([run.first(self.optimum + excess_db) for run in self.runs[name]])

    def table(self) -> pd.DataFrame:
        """One row per method: the excess after given numbers of RT calls, and the RT calls to reach given excesses.

        The table contains the median, the quartiles and the worst excess after 30, 60 and 225 RT calls and at the end.
        For each given excess, the table contains the number of runs that reached it and the median number of RT calls
        needed. The median is empty if at least half of the runs did not reach the excess. Further columns contain the
        number of failed runs and the median duration of a run [s].
        """
        return pd.DataFrame([self._row(method) for method in self.methods])

    def failures(self) -> list[tuple[str, int, str]]:
        """The method, seed and error message of every run that ended in an error."""
        return [
            (name, run.seed, run.failure) for name, runs in self.runs.items() for run in runs if run.failure
        ]

    def history(self) -> pd.DataFrame:
        """One row per improvement, and one for the last RT call of each run: method, seed, call, best_db, failure."""
        parts = [
            pd.DataFrame(
                {
                    "method": name,
                    "seed": run.seed,
                    "call": [*run.calls, run.evaluations],
                    "best_db": [*run.best, run.at(run.evaluations)],
                    "failure": ["" for _ in run.calls] + [run.failure],
                }
            )
            for name, runs in self.runs.items()
            for run in runs
        ]
        return pd.concat(parts, ignore_index=True)

    def __repr__(self) -> str:
        return short_text(*_summary(self))

    def _repr_html_(self) -> str:
        return short_html(*_summary(self))

    def _row(self, method: BudgetedMethod) -> dict[str, Any]:
        runs = self.runs[method.name]
        uses = METHODS[method.method].uses
        row: dict[str, Any] = {
            "method": method.name,
            "uses": "+".join(name for name in ("value", "residuals", "jacobian") if name in uses),
            "runs": len(runs),
            "failed": sum(bool(run.failure) for run in runs),
            "rt_calls": float(np.median([run.evaluations for run in runs])),
        }
        for calls in (*CALLS, None):
            column = "end" if calls is None else str(calls)
            # With a smaller budget, there is no value at this number of calls. The end of the run is represented by
            # 2^62 calls.
            reached = calls is None or method.stops_by_itself or calls <= method.budget
            excess = self.excess(method.name, 2**62 if calls is None else calls)
            for statistic, share in (("median", 0.5), ("q25", 0.25), ("q75", 0.75), ("worst", 1.0)):
                row[f"{statistic}_excess_db_{column}"] = quantile(excess, share) if reached else np.nan
        for level in (0.05, 0.02, 0.01):
            calls_to = self.calls_to(method.name, level)
            median = quantile(calls_to, 0.5)
            row[f"calls_to_{level:g}_db"] = median if np.isfinite(median) else np.nan
            row[f"reached_{level:g}_db"] = int(np.isfinite(calls_to).sum())
        row["seconds"] = float(np.median([run.seconds for run in runs]))
        row["optimum_db"], row["optimum_by"] = self.optimum, self.found_by
        return row


def quantile(values: NDArray[np.float64], share: float) -> float:
    """A quantile of values [n] by linear interpolation; +inf if the interpolation involves an infinite value.

    Example:
        >>> import numpy as np
        >>> quantile(np.array([3.0, 1.0, np.inf]), 0.5), quantile(np.array([1.0, np.inf]), 0.5)
        (3.0, inf)
    """
    ordered = np.sort(values)
    position = share * (len(ordered) - 1)
    # The difference of two infinite values would be NaN.
    low, high = ordered[int(np.floor(position))], ordered[int(np.ceil(position))]
    return float(low) if low == high else float(low + (position % 1.0) * (high - low))


def table(comparison: Comparison) -> Table:
    """One row per method: median excesses, and the RT calls needed to reach given excesses, with the number of runs."""
    records = comparison.table().to_dict("records")
    rows = tuple(_cells({str(key): value for key, value in record.items()}) for record in records)
    return Table("", COLUMNS, rows)


def optimum_text(comparison: Comparison) -> str:
    """A line of text that states the optimum and the search that found it."""
    return f"Optimum {comparison.optimum:.6g} dB, found by {comparison.found_by}"


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    def number(key: str) -> str:
        value = row[key]
        return "-" if pd.isna(value) else f"{value:.4f}" if np.isfinite(value) else "none"

    def calls(level: str) -> str:
        value, count = row[f"calls_to_{level}_db"], row[f"reached_{level}_db"]
        return f"{'-' if pd.isna(value) else f'{value:.0f}'} ({count}/{row['runs']})"

    return (
        label(str(row["method"])),
        str(row["uses"]),
        f"{row['rt_calls']:.0f}",
        *(number(f"median_excess_db_{column}") for column in ("30", "60", "225", "end")),
        f"{number('q25_excess_db_end')} to {number('q75_excess_db_end')}",
        number("worst_excess_db_end"),
        *(calls(level) for level in ("0.05", "0.02", "0.01")),
        str(row["failed"]),
        f"{row['seconds']:.2f}",
    )


def _summary(comparison: Comparison) -> tuple[Table | str, ...]:
    """The problem's name, a short table, and the optimum."""
    whole = table(comparison)
    columns = [k for k, column in enumerate(whole.columns) if column.name in SHORT]
    short = Table(
        "",
        tuple(whole.columns[k] for k in columns),
        tuple(tuple(row[k] for k in columns) for row in whole.rows),
    )
    heading = f"Methods on {comparison.name}: excess over the optimum after all RT calls"
    return heading, short, optimum_text(comparison)


FILES: Final = ("compare.csv", "runs.csv", "compare.png")
FLOOR_DB: Final = 1e-4
"""Lower limit of the excess in the figure [dB]; smaller excesses are drawn at this value."""


def write(comparison: Comparison, folder: Path) -> None:
    """Write a comparison's tables and figure into an existing folder."""
    write_table(folder / FILES[0], comparison.table())
    write_table(folder / FILES[1], comparison.history())
    write_figure(figure(comparison), folder / FILES[2])


@styled()
def figure(comparison: Comparison) -> Figure:
    """Excess versus RT calls: the median of each method, and the band between its quartiles."""
    drawing, axes = plain_figure("RT calls", "Excess RMSE [dB]", width=8.0)
    last = max(method.budget for method in comparison.methods)
    colors = iter(PALETTE * (1 + len(comparison.methods) // len(PALETTE)))
    calls = np.arange(1, last + 1)
    for method in comparison.methods:
        shown = calls if method.stops_by_itself else calls[: method.budget]
        quartiles = [comparison.quartiles(method.name, int(call)) for call in shown]
        low, middle, high = np.maximum(quartiles, FLOOR_DB).T
        color = COLORS.get(method.method) or next(colors)
        dashed = "--" if method.stops_by_itself or method.name != method.method else "-"
        axes.step(shown, middle, where="post", color=color, ls=dashed, lw=1.4, label=label(method.name))
        axes.fill_between(shown, low, high, step="post", color=color, alpha=0.13, lw=0)
    logarithmic(axes, "y")
    axes.set_xlim(0, last)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawing


ROUNDING_DB: Final = 1e-7
"""Difference below which two objectives are considered equal [dB]."""

OPTIMUM: Final[RunKey] = ("optimum", 0, 0)
"""Key of the reference search among the stored runs."""

REFERENCE: Final = "least-squares"
"""Method of the reference search."""

OPTIMUM_STARTS: Final = {False: 2048, True: 64}
"""Number of local searches of the reference search on small (False) and large (True) path programs."""

OpenProblem = Callable[[], ComparisonProblem]


def compare(
    open_problem: OpenProblem,
    methods: Sequence[BudgetedMethod],
    *,
    seeds: int = 25,
    out: str | Path,
    workers: int = 1,
    progress: Progress | None = None,
    announce: Callable[[str], None] | None = None,
) -> Comparison:
    """Run methods with seeds 0, 1, ... on one problem at equal budgets of RT calls.

    Every run is appended to `runs.jsonl` in `out` as soon as it ends. A run is skipped if the file contains a
    successful run with the same problem, optimizer code, method, budget and seed.

    Args:
        open_problem: Function that makes the problem. With several workers, it must be picklable, and is called once by
            each worker.
        methods: Methods with their budgets, as returned by `parse_methods`.
        seeds: Number of runs of each method.
        out: Folder in which the runs are stored.
        workers: Number of processes.
        progress: Called after every run.
        announce: Called before the first run with a text that states the number of runs and of RT calls.

    Raises:
        InputError: A method, the number of seeds, the number of workers, or the folder is invalid.
        EngineError: A worker process died, or no evaluation of any run succeeded.
    """
    for name, value in (("seeds", seeds), ("workers", workers)):
        if not 1 <= value <= LIMITS[name]:
            raise InputError(f"{name} = {value}: must be 1 to {LIMITS[name]:,}")
    check_folder(out)
    problem = open_problem()
    for method in methods:
        method.optimizer(problem, 0)  # refuses missing libraries and unsuitable methods before any run
    file = RunFile(Path(out) / "runs.jsonl", f"{problem.fingerprint}-{code_fingerprint()}")
    tasks = [(method, seed) for seed in range(seeds) for method in methods]
    missing = [(method, seed) for method, seed in tasks if file.find(method.key(seed)) is None]
    done = len(tasks) - len(missing)
    if announce is not None:
        announce(_plan(methods, seeds, out))
    try:
        for run in _finished(open_problem, problem, missing, workers):
            file.add(run)
            done += 1
            if progress is not None:
                progress("comparing", done, len(tasks))
    except BrokenExecutor:
        raise EngineError(
            "a worker process died, perhaps because memory ran out; run the comparison again with fewer --workers "
            f"(finished runs are kept in {out})"
        ) from None
    reference = file.find(OPTIMUM)
    if reference is None:
        reference = file.add(_search_optimum(problem))
    runs: dict[str, tuple[MethodRun, ...]] = {}
    for method in methods:
        finished = [file.find(method.key(seed)) for seed in range(seeds)]
        runs[method.name] = tuple(run for run in finished if run is not None)
    optimum, found_by = _lowest(problem.minimum, reference, runs)
    if optimum == np.inf:
        raise EngineError(
            f"{problem.name}: no evaluation of any run succeeded ({reference.failure or 'the objective is infinite'})"
        )
    if reference.failure:
        found_by += f" (many-start least squares failed: {reference.failure})"
    return Comparison(problem.name, tuple(methods), runs, optimum, found_by)


def _plan(methods: Sequence[BudgetedMethod], seeds: int, out: str | Path) -> str:
    """A text that states the number of runs and of RT calls."""
    calls = seeds * sum(method.budget for method in methods if not method.stops_by_itself)
    free = "".join(f", not counting {method.name}" for method in methods if method.stops_by_itself)
    return (
        f"{counted(seeds * len(methods), 'run')} with at most {calls:,} RT calls in total{free}; "
        f"runs that are already stored in {out} are not repeated"
    )


def parse_methods(names: Sequence[str], budget: int) -> tuple[BudgetedMethod, ...]:
    """Parse method names such as "gwo@600" and omit duplicates; `budget` applies to names without a budget.

    Raises:
        InputError: The list is empty, a method is unknown, or a budget is invalid.
    """
    methods: dict[tuple[str, int], BudgetedMethod] = {}
    for method in (BudgetedMethod.parse(name, budget) for name in names):
        methods.setdefault((method.method, method.budget), method)
    if not methods:
        raise InputError(f"methods: the list is empty; {did_you_mean('', METHODS)}")
    return tuple(methods.values())


def _search_optimum(problem: ComparisonProblem) -> MethodRun:
    """Run least squares from so many starting points that the result can be regarded as the global optimum."""
    starts = OPTIMUM_STARTS[problem.large]

    def make() -> Optimizer:
        return optimizers.make(
            REFERENCE,
            problem.lower,
            problem.upper,
            2**31,  # a seed that no run of a comparison has
            start=problem.start,
            starts=starts,
        )

    return run_optimizer(problem, OPTIMUM, make)


def _lowest(
    earlier: float, reference: MethodRun, runs: dict[str, tuple[MethodRun, ...]]
) -> tuple[float, str]:
    """The lowest objective of all searches, and the name of the first search that reached it within rounding error."""
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
    """Yield the runs as they finish."""
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
    """Open the problem once for all runs of a worker process, and make the process end when its parent ends."""
    global _opened
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    _opened = open_problem()


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _work(method: BudgetedMethod, seed: int) -> MethodRun:
    return method.run(_opened, seed)
