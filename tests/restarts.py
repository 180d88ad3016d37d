"""Runs of a study that are harmed at random moments and started again, until one comes to its end."""

from __future__ import annotations

import json
import os
import random
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import programs
from calibray.engines import LEDGER_FILE, open_ledger
from calibray.engines.ledger.ledger import Ledger

# Imports once and then forks a process for each run, which takes hundredths of a second instead of many seconds.
# Exits as the command line does. The re-tracing engine writes down what it is asked, as the programs do themselves.
RUNNER = """
import json, os, signal, sys, traceback
from pathlib import Path
from calibray.calibration.calibrate import calibrate
from calibray.engines import Retrace, open_workers
from calibray.errors import EngineError, InputError
from calibray.study import Study
from calibray.uncertainty import sequential_monte_carlo as sampler
# Else every child would import them.
import scipy.stats, trimesh
import calibray.engines.make_engine, calibray.engines.external.program

for name, value in json.loads(sys.argv[1]).items():
    setattr(sampler, name, value)

def run(workers, folder):
    answer = Retrace._trace
    def noted(engine, part, candidate):
        with open(folder + "/calls.log", "a") as log:
            log.write(json.dumps(candidate.tolist()) + "\\n")
        return answer(engine, part, candidate)
    Retrace._trace = noted
    try:
        with open_workers(int(workers) or None) as executor:
            calibrate(Study.load(folder + "/study.toml"), out=folder + "/out", workers=executor)
        return 0
    except (InputError, EngineError) as error:
        Path(folder, "messages.log").open("a").write(f"{error}\\n")
        return 2 if isinstance(error, InputError) else 1
    except KeyboardInterrupt:
        return 130
    except BaseException:
        traceback.print_exc()
        return 70

for line in sys.stdin:
    child = os.fork()
    if not child:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os._exit(run(*line.strip().split(" ", 1)))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
SIGNALS = {"kill": signal.SIGKILL, "terminate": signal.SIGTERM, "interrupt": signal.SIGINT}
# A disk that is full before the ledger is opened is bad input; one that fills up later is a failure.
ENDS = {
    "kill": {-signal.SIGKILL},
    "terminate": {-signal.SIGTERM},
    "interrupt": {130},
    "full": {1, 2},
    "read-only": {2},
}
GRACE = 60.0  # for a run to end after its disk is full [s]


@dataclass(frozen=True)
class Harm:
    """What is done to a run.

    Attributes:
        kind: "kill", "terminate" or "interrupt", a signal; "full", the disk of the output; "read-only", that disk from
            before the run.
        calls: Done within 40 ms after so many calls in all.
        seconds: Done so long after the start instead [s], for engines whose calls nobody counts.
    """

    kind: str
    calls: int | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What was left when a run came to its end.

    Attributes:
        result: `result.json` and the history, without what is measured by the clock.
        asked: Candidates that the engine was asked for, in order.
        committed: Candidates in the ledger, in order.
        kills: Runs that did not come to their end.
        repeated: Calls for a candidate that was in the ledger already when the run that made them began.
        lost: Candidates that were in the ledger once and then no more.
    """

    result: tuple
    asked: list[tuple[float, ...]]
    committed: list[tuple[float, ...]]
    kills: int
    repeated: int
    lost: int = 0


def finish(
    runner: subprocess.Popen,
    folder: Path,
    harms: Sequence[Harm | int],
    seed: int = 0,
    workers: int = 0,
) -> Outcome:
    """Run a folder's study, once for each harm that is done to it, and let the last run come to its end.

    Args:
        runner: The process that runs studies, of `open_runner`.
        folder: Folder with `study.toml`, `links.csv` and `model.py`; for a full or read-only disk, `out` is a mount.
        harms: The harms, or numbers of calls after each of which a run is killed; ascending.
        seed: Seed of the milliseconds in between.
        workers: Programs that run at once; 0 for one after the other in the run's own thread.

    Returns:
        What was left.

    Raises:
        RuntimeError: A run ended otherwise than its harm makes it end.
    """
    rng, kills, repeated, lost, out = random.Random(seed), 0, 0, 0, folder / "out"
    committed: set[tuple[float, ...]] = set()
    for harm in [*harms, None]:
        each = Harm("kill", harm) if isinstance(harm, int) else harm
        known, begun = set(_committed(out)), len(programs.calls(folder))
        lost += len(committed - known)
        committed = known
        run = Run(runner, folder, workers, each)
        if each is not None:
            run.harm(rng.uniform(0, 0.04))
        status = run.end()
        kills += status != 0
        repeated += sum(candidate in known for candidate in programs.calls(folder)[begun:])
        if status not in ({0} if each is None else {0, *ENDS[each.kind]}):
            raise RuntimeError(f"{folder.name}: after {each} the run ended with {status}")
    left = _committed(out)
    lost += len(committed - set(left))
    return Outcome(result(folder), programs.calls(folder), left, kills, repeated, lost)


class Run:
    """A run under way.

    Args:
        runner: The process that runs studies.
        folder: The study's folder.
        workers: Programs that run at once.
        harm: What shall be done to it.
    """

    def __init__(
        self, runner: subprocess.Popen, folder: Path, workers: int = 0, harm: Harm | None = None
    ) -> None:
        self._runner, self._folder, self._harm = runner, folder, harm
        if harm is not None and harm.kind == "read-only":
            _remount(folder / "out", "ro")
        runner.stdin.write(f"{workers} {folder}\n".encode())
        self._pid = int(runner.stdout.readline())

    @property
    def ended(self) -> bool:
        """Whether it is over."""
        return bool(select.select([self._runner.stdout], [], [], 0)[0])

    def harm(self, delay: float) -> None:
        """Wait for the moment, and do it."""
        harm, started = self._harm, time.monotonic()
        while not self.ended and (
            len(programs.calls(self._folder)) < harm.calls
            if harm.calls is not None
            else time.monotonic() - started < harm.seconds
        ):
            time.sleep(0.002)
        time.sleep(delay)
        if harm.kind in SIGNALS and not self.ended:
            os.kill(self._pid, SIGNALS[harm.kind])
        elif harm.kind == "full":
            _fill(self._folder / "out" / "filler")

    def end(self) -> int:
        """Wait for its end, and undo what was done to its disk."""
        status = int(self._runner.stdout.readline())
        if self._harm is not None and self._harm.kind == "read-only":
            _remount(self._folder / "out", "rw")
        if self._harm is not None and self._harm.kind == "full":
            (self._folder / "out" / "filler").unlink(missing_ok=True)
        return status


def _fill(file: Path) -> None:
    """Write a file until its disk is full."""
    for size in (1 << 16, 1 << 12, 1):
        try:
            with file.open("ab", buffering=0) as stream:
                while True:
                    stream.write(b"x" * size)
        except OSError:
            continue


def _remount(folder: Path, mode: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{mode}", str(folder)], check=True)


def result(folder: Path) -> tuple:
    """Result and history of a run, without times."""
    content = json.loads((folder / "out" / "result.json").read_text())
    # The digest of the history changes with the times in it.
    del content["study_file"], content["files"]
    clock = {
        "seconds",
        "trace_seconds",
        "uncertainty_seconds",
        "cheap_seconds",
        "total_seconds",
        "ledger_hits",
    }
    content["cost"] = {name: value for name, value in content["cost"].items() if name not in clock}
    history = np.genfromtxt(folder / "out" / "result-history.csv", delimiter=",", skip_header=1)[
        :, :4
    ].tolist()
    return content, history


@contextmanager
def open_runner(draws: Mapping[str, object] | None = None) -> Iterator[subprocess.Popen]:
    """A process that runs the study of every folder it is told.

    Args:
        draws: Constants of `calibray.uncertainty.sequential_monte_carlo` that replace its own.
    """
    command = [sys.executable, "-c", RUNNER, json.dumps(draws or {})]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0) as runner:
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
