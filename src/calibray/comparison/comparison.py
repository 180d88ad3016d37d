"""Methods side by side at equal budgets: every method from many seeds on one problem, best so far by RT call.

An excess is what the best objective so far lies above the global optimum of the same data. The optimum is that of
least squares from very many starts, or of any run that found a lower one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray import optimizers
from calibray.comparison.contestant import MOST, Contender, code, recorded, run_contender
from calibray.comparison.problems import Arena
from calibray.comparison.run_log import MethodRun, Runs
from calibray.comparison.tables import summary
from calibray.errors import InputError
from calibray.optimizers import METHODS, Optimizer
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_folder
from calibray.support.progress import Progress
from calibray.tables import display as glance

CALLS: Final = (30, 60, 225)  # where the excess is tabulated, beside the end
EXCESSES_DB: Final = (0.05, 0.02, 0.01)  # whose first RT call is tabulated
ROUNDING_DB: Final = 1e-7  # below which objectives are taken for equal
OPTIMUM: Final = "optimum"  # the run that finds it, among the runs kept
REFERENCE: Final = "least-squares"  # which finds it
OPTIMUM_STARTS: Final = {False: 2048, True: 64}  # its local searches on small and on large path programs

Open = Callable[[], Arena]


@dataclass(frozen=True, repr=False)
class Comparison:
    """Finished runs of methods on one problem.

    Attributes:
        name: The problem.
        contenders: The methods, in the order asked for.
        runs: Their runs by contender name, one for each seed.
        optimum: Lowest objective known, [dB].
        found_by: What found it.
    """

    name: str
    contenders: tuple[Contender, ...]
    runs: dict[str, tuple[MethodRun, ...]]
    optimum: float
    found_by: str

    def excess(self, name: str, calls: int) -> NDArray[np.float64]:
        """Excess of a contender's runs after some RT calls.

        A run that ended or failed before stays where it was.

        Args:
            name: The contender.
            calls: Number of RT calls.

        Returns:
            Excess [seeds], [dB]; +inf before anything was found.
        """
        return np.array([run.at(calls) for run in self.runs[name]]) - self.optimum

    def quartiles(self, name: str, calls: int) -> tuple[float, float, float]:
        """Quartiles of `excess`.

        Args:
            name: The contender.
            calls: Number of RT calls.

        Returns:
            The lower quartile, the median and the upper one, [dB].
        """
        excess = self.excess(name, calls)
        return quantile(excess, 0.25), quantile(excess, 0.5), quantile(excess, 0.75)

    def calls_to(self, name: str, excess_db: float) -> NDArray[np.float64]:
        """RT calls after which a contender's runs were within some excess.

        Args:
            name: The contender.
            excess_db: The excess [dB].

        Returns:
            RT calls [seeds]; +inf for a run that never was.
        """
        return np.array([run.first(self.optimum + excess_db) for run in self.runs[name]])

    def table(self) -> pd.DataFrame:
        """One row per method: excesses at some RT calls, and RT calls to some excesses.

        Returns:
            Median, quartiles and worst excess after 30, 60 and 225 RT calls and at the end; the median RT calls to
            an excess over all runs, empty where half of them or more never had it, and how many had; failed runs;
            median seconds a run.
        """
        return pd.DataFrame([self._row(contender) for contender in self.contenders])

    def __repr__(self) -> str:
        return glance.text(*summary(self))

    def _repr_html_(self) -> str:
        return glance.html(*summary(self))

    def _row(self, contender: Contender) -> dict[str, Any]:
        runs = self.runs[contender.name]
        row: dict[str, Any] = {
            "method": contender.name,
            "uses": "+".join(
                name for name in ("value", "residuals", "jacobian") if name in METHODS[contender.method].uses
            ),
            "runs": len(runs),
            "failed": sum(bool(run.failure) for run in runs),
            "rt_calls": float(np.median([run.evaluations for run in runs])),
        }
        for calls in (*CALLS, None):
            place = "end" if calls is None else str(calls)
            known = calls is None or contender.endless or calls <= contender.budget
            excess = self.excess(contender.name, 2**62 if calls is None else calls)
            for label, share in (("median", 0.5), ("q25", 0.25), ("q75", 0.75), ("worst", 1.0)):
                row[f"{label}_excess_db_{place}"] = quantile(excess, share) if known else np.nan
        for level in EXCESSES_DB:
            calls_to = self.calls_to(contender.name, level)
            middle = quantile(calls_to, 0.5)
            row[f"calls_to_{level:g}_db"] = middle if np.isfinite(middle) else np.nan
            row[f"reached_{level:g}_db"] = int(np.isfinite(calls_to).sum())
        row["seconds"] = float(np.median([run.seconds for run in runs]))
        row["optimum_db"], row["optimum_by"] = self.optimum, self.found_by
        return row

    def failures(self) -> list[tuple[str, int, str]]:
        """Runs that ended in an error.

        Returns:
            Contender, seed and message of each.
        """
        return [
            (name, run.seed, run.failure) for name, runs in self.runs.items() for run in runs if run.failure
        ]

    def history(self) -> pd.DataFrame:
        """Every improvement of every run, and its end.

        Returns:
            Columns method, seed, call, best_db, failure; one row per improvement, and one for the last RT call.
        """
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


def quantile(values: NDArray[np.float64], share: float) -> float:
    """A quantile that may be infinite.

    Args:
        values: Numbers [n], some of them +inf.
        share: Between 0 and 1.

    Returns:
        Linear interpolation between order statistics, +inf as soon as an infinite one takes part.

    Example:
        >>> import numpy as np
        >>> quantile(np.array([3.0, 1.0, np.inf]), 0.5), quantile(np.array([1.0, np.inf]), 0.5)
        (3.0, inf)
    """
    ordered = np.sort(values)
    place = share * (len(ordered) - 1)
    low, high = ordered[int(np.floor(place))], ordered[int(np.ceil(place))]
    return float(low) if low == high else float(low + (place % 1.0) * (high - low))


def compare(
    open_arena: Open,
    methods: Sequence[str],
    *,
    seeds: int = 25,
    budget: int = 225,
    out: str | Path,
    workers: int = 1,
    progress: Progress | None = None,
) -> Comparison:
    """Run methods from seeds 0, 1, ... on one problem at equal budgets of RT calls.

    Every finished run is appended to `runs.jsonl` in `out` at once; what is found there of the same problem, code of
    the optimizers, method, budget and seed is not run again.

    Args:
        open_arena: Makes the problem; picklable if there are several workers, each of which calls it once.
        methods: Methods, each with the budget or one of its own as in "gwo@600".
        seeds: Number of runs of each method.
        budget: RT calls of a run.
        out: Folder that keeps the runs.
        workers: Processes that run at once.
        progress: Called after every run.

    Returns:
        The comparison.

    Raises:
        InputError: A method, a number or the folder cannot be used.
    """
    for name, value in (("seeds", seeds), ("workers", workers)):
        if not 1 <= value <= MOST[name]:
            raise InputError(f"{name} = {value}; it must be 1 to {MOST[name]:,}")
    contenders = tuple(Contender.parse(name, budget) for name in dict.fromkeys(methods))
    if not contenders:
        raise InputError(f"methods: none is named; {did_you_mean('', METHODS)}")
    check_folder(out)
    arena = open_arena()
    for contender in contenders:
        contender.optimizer(arena, 0)  # refuses what is not installed or does not fit before anything is run
    store = Runs(Path(out) / "runs.jsonl", f"{arena.fingerprint}-{code()}")
    tasks = [(contender, seed) for seed in range(seeds) for contender in contenders]
    missing = [(each, seed) for each, seed in tasks if store.find(*each.key(seed)) is None]
    done = len(tasks) - len(missing)
    for run in _finished(open_arena, arena, missing, workers):
        store.add(run)
        done += 1
        if progress is not None:
            progress("comparing", done, len(tasks))
    best = store.find(OPTIMUM, 0, 0)
    if best is None:
        best = store.add(_optimum(arena))
    found = {
        contender.name: [store.find(*contender.key(seed)) for seed in range(seeds)]
        for contender in contenders
    }
    runs = {name: tuple(run for run in each if run is not None) for name, each in found.items()}
    return Comparison(arena.name, contenders, runs, *_lowest(arena.minimum, best, runs))


def _optimum(arena: Arena) -> MethodRun:
    """Least squares from so many starts that its answer passes for the global optimum."""
    starts = OPTIMUM_STARTS[arena.large]

    def make() -> Optimizer:
        return optimizers.make(REFERENCE, arena.lower, arena.upper, 2**31, start=arena.start, starts=starts)

    return recorded(arena, (OPTIMUM, 0, 0), make)


def _lowest(known: float, best: MethodRun, runs: dict[str, tuple[MethodRun, ...]]) -> tuple[float, str]:
    """The lowest objective of all searches, and the first of them that came there within rounding."""
    found = [(best.at(best.evaluations), "many-start least squares"), (known, "earlier searches")]
    found += [
        (run.at(run.evaluations), f"{name}, seed {run.seed}") for name, each in runs.items() for run in each
    ]
    optimum = min(objective for objective, _ in found)
    return optimum, next(by for objective, by in found if objective <= optimum + ROUNDING_DB)


def _finished(
    open_arena: Open, arena: Arena, tasks: list[tuple[Contender, int]], workers: int
) -> Iterator[MethodRun]:
    """The runs, as they finish."""
    if workers == 1 or len(tasks) < 2:
        yield from (run_contender(arena, contender, seed) for contender, seed in tasks)
        return
    with ProcessPoolExecutor(
        min(workers, len(tasks)), mp_context=get_context("spawn"), initializer=_start, initargs=(open_arena,)
    ) as pool:
        futures = [pool.submit(_work, contender, seed) for contender, seed in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _start(open_arena: Open) -> None:
    global _opened
    _opened = open_arena()


def _work(contender: Contender, seed: int) -> MethodRun:
    return run_contender(_opened, contender, seed)
