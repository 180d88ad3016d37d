"""Methods on a family of planted problems: how many they solve, with how many RT calls.

A problem is solved to a tolerance when the excess of a run is within it. The share of runs that have solved theirs,
over RT calls, is a data profile: J. J. Moré, S. M. Wild, SIAM J. Optim. 20 (2009) 172. It says what a median over one
problem cannot: how a method fares on problems that nobody chose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.comparison.comparison import quantile
from calibray.comparison.contestant import MOST, Contender, code, run_contender
from calibray.comparison.problems import Arena
from calibray.comparison.run_log import MethodRun, Runs
from calibray.errors import InputError
from calibray.optimizers import METHODS
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_folder
from calibray.support.progress import Progress
from problem_families.arenas import family_arena
from problem_families.family import FamilyKind

CALLS: Final = (8, 15, 30, 60, 120, 225)  # where excesses are tabulated
TOLERANCES_DB: Final = (0.05, 0.02, 0.01)  # of the data profiles


@dataclass(frozen=True, eq=False)
class FamilyComparison:
    """Finished runs of methods on the problems of a family.

    Attributes:
        kind: The family.
        seeds: Seeds of its problems [p].
        contenders: The methods, in the order asked for.
        runs: By contender name, the runs on every problem [p][repeats].
        optimum: Lowest objective known of every problem [p], [dB].
        misinformed: Problems whose cheap model is told wrong constants [p].
        unmade: Problems that could not be made, which nothing else here counts: seed and reason of each.
    """

    kind: str
    seeds: tuple[int, ...]
    contenders: tuple[Contender, ...]
    runs: dict[str, tuple[tuple[MethodRun, ...], ...]]
    optimum: NDArray[np.float64]
    misinformed: NDArray[np.bool_]
    unmade: tuple[tuple[int, str], ...] = ()

    def part(self, chosen: NDArray[np.bool_]) -> FamilyComparison:
        """Some of the problems alone.

        Args:
            chosen: Which [p].

        Returns:
            The comparison on these.
        """
        places = np.flatnonzero(chosen)
        return FamilyComparison(
            self.kind,
            tuple(self.seeds[place] for place in places),
            self.contenders,
            {name: tuple(each[place] for place in places) for name, each in self.runs.items()},
            self.optimum[places],
            self.misinformed[places],
        )

    @staticmethod
    def joined(parts: Sequence[FamilyComparison]) -> FamilyComparison:
        """The problems of several families together.

        Args:
            parts: Comparisons of the same contenders.

        Returns:
            One comparison.
        """
        first = parts[0]
        return FamilyComparison(
            " and ".join(part.kind for part in parts),
            tuple(seed for part in parts for seed in part.seeds),
            first.contenders,
            {name: tuple(each for part in parts for each in part.runs[name]) for name in first.runs},
            np.concatenate([part.optimum for part in parts]),
            np.concatenate([part.misinformed for part in parts]),
            tuple(each for part in parts for each in part.unmade),
        )

    def excess(self, name: str, calls: int) -> NDArray[np.float64]:
        """Excess of a contender's runs after some RT calls.

        Args:
            name: The contender.
            calls: Number of RT calls.

        Returns:
            Excess [p, repeats], [dB]; +inf before anything was found.
        """
        return np.array([[run.at(calls) for run in each] for each in self.runs[name]]) - self.optimum[:, None]

    def solved(self, name: str, calls: int, tolerance_db: float) -> float:
        """The data profile: the share of a contender's runs that are within a tolerance after some RT calls.

        Args:
            name: The contender.
            calls: Number of RT calls.
            tolerance_db: The excess allowed [dB].

        Returns:
            The share [1].
        """
        return float(np.mean(self.excess(name, calls) <= tolerance_db))

    def seconds(self, name: str) -> float:
        """The median time of a contender's runs [s]."""
        return float(np.median([run.seconds for each in self.runs[name] for run in each]))

    def failures(self) -> list[tuple[str, int, str]]:
        """Runs that ended in an error.

        Returns:
            Contender, seed of the problem and message of each.
        """
        return [
            (name, seed, run.failure)
            for name, problems in self.runs.items()
            for seed, each in zip(self.seeds, problems, strict=True)
            for run in each
            if run.failure
        ]

    def table(self) -> pd.DataFrame:
        """One row for each method and number of RT calls within its budget.

        Returns:
            Median, 90th percentile and worst excess [dB], the share solved to every tolerance, how many runs failed,
            and the median seconds of a whole run.
        """
        return pd.DataFrame(
            [
                self._row(contender, calls)
                for contender in self.contenders
                for calls in CALLS
                if calls <= contender.budget
            ]
        )

    def _row(self, contender: Contender, calls: int) -> dict[str, Any]:
        excess = self.excess(contender.name, calls).ravel()
        every = [run for each in self.runs[contender.name] for run in each]
        return {
            "method": contender.name,
            "calls": calls,
            "runs": len(every),
            "median_excess_db": quantile(excess, 0.5),
            "p90_excess_db": quantile(excess, 0.9),
            "worst_excess_db": quantile(excess, 1.0),
            **{
                f"solved_{tolerance:g}_db": self.solved(contender.name, calls, tolerance)
                for tolerance in TOLERANCES_DB
            },
            "failed": sum(bool(run.failure) for run in every),
            "seconds": self.seconds(contender.name),
        }

    def history(self) -> pd.DataFrame:
        """Every improvement of every run.

        Returns:
            Columns method, problem, seed, call, excess_db.
        """
        rows = [
            (name, seed, run.seed, call, best - optimum)
            for name, problems in self.runs.items()
            for seed, optimum, each in zip(self.seeds, self.optimum.tolist(), problems, strict=True)
            for run in each
            for call, best in zip(run.calls, run.best, strict=True)
        ]
        return pd.DataFrame(rows, columns=["method", "problem", "seed", "call", "excess_db"])


def seed_range(text: str) -> range:
    """Read the seeds of a family as they are asked for.

    Args:
        text: "20" for seeds 0 to 19, or "1000:1020" for 1000 to 1019.

    Returns:
        The seeds.

    Raises:
        InputError: It is neither.

    Example:
        >>> seed_range("1000:1020")
        range(1000, 1020)
    """
    first, colon, end = text.strip().partition(":")
    numbers = [first, end] if colon else ["0", first]
    if not all(number.isascii() and number.isdigit() and len(number) < 10 for number in numbers):
        raise InputError(f"seeds = {text!r}; give a number, or a range as '0:20'")
    found = range(int(numbers[0]), int(numbers[1]))
    if not 1 <= len(found) <= MOST["seeds"]:
        raise InputError(f"seeds = {text!r}: {len(found)} of them; it must be 1 to {MOST['seeds']:,}")
    return found


def compare_family(
    kind: str,
    seeds: Sequence[int],
    methods: Sequence[str],
    *,
    budget: int = 225,
    repeats: int = 1,
    out: str | Path,
    workers: int = 1,
    progress: Progress | None = None,
) -> FamilyComparison:
    """Run methods on every problem of a family at equal budgets of RT calls.

    Every finished run is appended to `runs.jsonl` in `out` at once; what is found there of the same problem, code of
    the method, budget and seed is not run again. A problem that cannot be made is left out, and named in `unmade`.

    Args:
        kind: "district" or "office".
        seeds: Seeds of the problems.
        methods: Methods, each with the budget or one of its own as in "gwo@600".
        budget: RT calls of a run.
        repeats: Runs of each method on each problem, from seeds 0, 1, ...
        out: Folder that keeps the runs.
        workers: Processes that run at once.
        progress: Called after every problem made and every run.

    Returns:
        The comparison.

    Raises:
        InputError: A method, a number, the family or the folder cannot be used, or no problem can be made.
    """
    if kind not in get_args(FamilyKind):
        raise InputError(
            f"family {kind!r}: there is no such family; {did_you_mean(kind, get_args(FamilyKind))}"
        )
    for name, value, most in (("repeats", repeats, MOST["seeds"]), ("workers", workers, MOST["workers"])):
        if not 1 <= value <= most:
            raise InputError(f"{name} = {value}; it must be 1 to {most:,}")
    contenders = tuple(Contender.parse(name, budget) for name in dict.fromkeys(methods))
    if not contenders:
        raise InputError(f"methods: none is named; {did_you_mean('', METHODS)}")
    for contender in contenders:
        if METHODS[contender.method].needs_derivatives():
            raise InputError(
                f"method {contender.name!r} needs derivatives, which an engine that is called gives not"
            )
    path = Path(check_folder(out)) / "runs.jsonl"
    with _Pool(workers) as pool:
        prepared = _told(
            pool.run(_prepare, [(kind, seed) for seed in seeds]), "problems", len(seeds), progress
        )
        answers = {task[1]: answer for task, answer in prepared}
        made = {seed: answer for seed, answer in answers.items() if isinstance(answer, _Made)}
        unmade = tuple((seed, answers[seed]) for seed in seeds if seed not in made)
        if not made:
            raise InputError(f"no problem of the family can be made: {unmade[0][1]}")
        seeds = [seed for seed in seeds if seed in made]
        stores = {
            (seed, contender.method): Runs(path, f"{made[seed].fingerprint}-{code(contender.method)}")
            for seed in seeds
            for contender in contenders
        }
        tasks = [
            (kind, seed, contender, repeat)
            for seed in seeds
            for repeat in range(repeats)
            for contender in contenders
        ]
        missing = [
            task for task in tasks if stores[task[1], task[2].method].find(*_key(task[2], task[3])) is None
        ]
        for (_, seed, contender, _), run in _told(
            pool.run(_work, missing), "comparing", len(missing), progress
        ):
            stores[seed, contender.method].add(run)
    runs = {
        contender.name: tuple(
            tuple(
                run
                for repeat in range(repeats)
                if (run := stores[seed, contender.method].find(*_key(contender, repeat))) is not None
            )
            for seed in seeds
        )
        for contender in contenders
    }
    lowest = [
        min([made[seed].minimum, *(run.at(run.evaluations) for each in runs.values() for run in each[place])])
        for place, seed in enumerate(seeds)
    ]
    misinformed = np.array([made[seed].misinformed for seed in seeds])
    return FamilyComparison(kind, tuple(seeds), contenders, runs, np.array(lowest), misinformed, unmade)


Task = tuple[Any, ...]


class _Pool:
    """Processes that work at once; none where one is enough."""

    def __init__(self, workers: int) -> None:
        self._pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn")) if workers > 1 else None

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def run(self, function: Any, tasks: Sequence[Task]) -> Iterator[tuple[Task, Any]]:
        """Each task with its result, as they finish."""
        if self._pool is None:
            yield from ((task, function(*task)) for task in tasks)
            return
        futures = {self._pool.submit(function, *task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _told(
    results: Iterator[tuple[Task, Any]], stage: str, count: int, progress: Progress | None
) -> Iterator[tuple[Task, Any]]:
    for done, result in enumerate(results, start=1):
        if progress is not None:
            progress(stage, done, count)
        yield result


def _key(contender: Contender, seed: int) -> tuple[str, int, int]:
    return contender.method, contender.budget, seed


class _Made(NamedTuple):
    """What is known of a problem before it is searched."""

    fingerprint: str
    minimum: float
    misinformed: bool


def _prepare(kind: str, seed: int) -> _Made | str:
    """A problem, or why it cannot be made."""
    try:
        arena = _opened(kind, seed)
    except (InputError, RuntimeError, OSError) as error:
        return str(error)
    return _Made(arena.fingerprint, arena.minimum, arena.misinformed)


def _work(kind: str, seed: int, contender: Contender, repeat: int) -> MethodRun:
    return run_contender(_opened(kind, seed), contender, repeat)


@lru_cache(maxsize=2)
def _opened(kind: str, seed: int) -> Arena:
    return family_arena(kind, seed)
