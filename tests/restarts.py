"""Runs of a study that are killed at random moments and started again, until one comes to its end."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import programs
from calibray.engines import LEDGER_FILE, open_ledger
from calibray.engines.ledger import Ledger

# Imports once and then forks a process for each run, which takes hundredths of a second instead of many seconds.
RUNNER = """
import os, sys
from calibray.calibration import calibrate
from calibray.engines import open_executor
from calibray.study import Study
for line in sys.stdin:
    workers, folder = line.strip().split(" ", 1)
    run = os.fork()
    if not run:
        with open_executor(int(workers) or None) as executor:
            calibrate(Study.load(folder + "/study.toml"), out=folder + "/out", executor=executor)
        os._exit(0)
    print(run, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(run, 0)[1]), flush=True)
"""


@dataclass(frozen=True)
class Outcome:
    """What was left when a run came to its end.

    Attributes:
        result: `result.json` and the history, without what is measured by the clock.
        asked: Candidates that the program was started for, in order, as it counted them itself.
        committed: Candidates in the ledger, in order.
        kills: Runs that were killed.
        repeated: Calls for a candidate that was in the ledger already when the run that made them began.
    """

    result: tuple
    asked: list[tuple[float, ...]]
    committed: list[tuple[float, ...]]
    kills: int
    repeated: int


def finish(
    runner: subprocess.Popen, folder: Path, moments: list[int], seed: int = 0, workers: int = 0
) -> Outcome:
    """Run a folder's study; kill it once after each number of calls, and let the last run come to its end.

    Args:
        runner: The process that runs studies, of `open_runner`.
        folder: Folder with `study.toml`, `links.csv` and `model.py`.
        moments: Numbers of calls in all, ascending, after each of which a run is killed within 40 ms.
        seed: Seed of these milliseconds.
        workers: Programs that run at once; 0 for one after the other in the run's own thread.

    Returns:
        What was left.
    """
    rng, kills, repeated, out = random.Random(seed), 0, 0, folder / "out"
    for moment in [*moments, None]:
        known, begun = set(_committed(out)), len(programs.calls(folder))
        runner.stdin.write(f"{workers} {folder}\n")
        runner.stdin.flush()
        run = int(runner.stdout.readline())
        if moment is not None:
            while len(programs.calls(folder)) < moment:
                time.sleep(0.002)
            time.sleep(rng.uniform(0, 0.04))
            os.kill(run, signal.SIGKILL)
        status = int(runner.stdout.readline())
        if status not in (0, -signal.SIGKILL):
            raise RuntimeError(f"the run ended with {status}")
        kills += status != 0
        time.sleep(0.3 if moment is not None else 0.0)  # for programs that outlive the run
        repeated += sum(candidate in known for candidate in programs.calls(folder)[begun:])
    content = json.loads((out / "result.json").read_text())
    kept = {
        name: value
        for name, value in content.items()
        if name not in {"seconds", "trace_seconds", "ledger_hits", "study_file"}
    }
    history = np.genfromtxt(out / "history.csv", delimiter=",", skip_header=1)[:, :4].tolist()
    return Outcome((kept, history), programs.calls(folder), _committed(out), kills, repeated)


@contextmanager
def open_runner() -> Iterator[subprocess.Popen]:
    """A process that runs the study of every folder it is told."""
    command = [sys.executable, "-c", RUNNER]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as runner:
        yield runner
        runner.stdin.close()


def _committed(out: Path) -> list[tuple[float, ...]]:
    if not (out / LEDGER_FILE).is_file():
        return []
    with closing(open_ledger(out)) as ledger:
        return candidates(ledger)


def candidates(ledger: Ledger) -> list[tuple[float, ...]]:
    """The candidates of a ledger of the programs' studies, in order."""
    return [tuple(row) for row in ledger.table().iloc[:, 6:].to_numpy().tolist()]
