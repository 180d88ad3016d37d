"""Finished runs of a comparison in a file of JSON lines, appended one by one, so that a killed one goes on."""

from __future__ import annotations

import json
from bisect import bisect_right
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from calibray.errors import InputError
from calibray.support.output_files import exists


@dataclass(frozen=True)
class MethodRun:
    """One run of a method.

    Attributes:
        method: The method.
        budget: RT calls that it might use.
        seed: Its seed.
        evaluations: RT calls that it used.
        calls: RT calls that improved on all before them.
        best: Objectives there, [dB].
        seconds: Time that it took [s].
        failure: What it ended with; empty if it came to its own end.
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
        """The best objective after some RT calls.

        Args:
            calls: How many.

        Returns:
            The objective [dB]; +inf if there was none yet.
        """
        place = bisect_right(self.calls, calls)
        return self.best[place - 1] if place else np.inf

    def first(self, objective: float) -> float:
        """The first RT call with an objective as low as some value.

        Args:
            objective: The value [dB].

        Returns:
            Its number; +inf if there was none.
        """
        return next(
            (float(call) for call, value in zip(self.calls, self.best, strict=True) if value <= objective),
            np.inf,
        )


class Runs:
    """Runs of one problem in a file that may hold runs of others.

    Args:
        path: The file; made when the first run is added.
        problem: Fingerprint of all that a run depends on besides method, budget and seed.

    Raises:
        InputError: The file is of another kind.
    """

    def __init__(self, path: Path, problem: str) -> None:
        self._path, self._problem = path, problem
        self._runs: dict[tuple[str, int, int], MethodRun] = {}
        text = path.read_text(encoding="utf-8") if exists(path) else ""
        self._torn = bool(text) and not text.endswith("\n")
        for line in text.splitlines():
            try:
                record = json.loads(line)
            except ValueError:  # the line that a killed process was writing
                continue
            if not isinstance(record, dict) or "problem" not in record:
                raise InputError(f"{path}: holds something else than finished runs; name another folder")
            if record.pop("problem") == problem:
                run = MethodRun(**{**record, "calls": tuple(record["calls"]), "best": tuple(record["best"])})
                self._runs[run.method, run.budget, run.seed] = run

    def find(self, method: str, budget: int, seed: int) -> MethodRun | None:
        """A run that was finished before.

        Args:
            method: Its method.
            budget: Its budget.
            seed: Its seed.

        Returns:
            The run, or None.
        """
        return self._runs.get((method, budget, seed))

    def add(self, run: MethodRun) -> MethodRun:
        """Keep a run.

        Args:
            run: The run.

        Returns:
            The same.
        """
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as file:
            file.write("\n" * self._torn + json.dumps({"problem": self._problem, **asdict(run)}) + "\n")
        self._torn = False
        self._runs[run.method, run.budget, run.seed] = run
        return run
