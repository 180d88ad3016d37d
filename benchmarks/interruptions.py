"""Commands that are interrupted by Ctrl-C (SIGINT) at random times, including during imports.

    python benchmarks/interruptions.py [--commands 60] [--seed 0]

An interruption counts as lost if the command ends with exit status 0 although it was running when the signal was sent.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from rich.console import Console
from rich.progress import track

import kill
from calibray.support.interruption import INTERRUPTED

COMMANDS = {
    "trace --check": ["trace", "study.toml", "--check"],
    "run": ["run", "study.toml", "--out", "out/result", "--overwrite"],
}
ENDED = {INTERRUPTED, -signal.SIGINT}
"""Exit statuses of an interrupted command. Python itself gives the second one, before the command has started."""


def interrupt(folder: Path, words: list[str], after: float | None) -> tuple[bool, int, float]:
    """Run a command and interrupt it after a time, if any [s].

    Returns:
        Whether the signal was sent, the exit status, and the time from the signal, or the start, to the end [s].
    """
    started, sent = time.perf_counter(), False
    with subprocess.Popen(
        [sys.executable, "-m", "calibray", *words],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as command:
        if after is not None:
            try:
                command.wait(after)
            except subprocess.TimeoutExpired:
                started, sent = time.perf_counter(), True
                command.send_signal(signal.SIGINT)
        status = command.wait()
    return sent, status, time.perf_counter() - started


def main() -> int:
    """Interrupt each command at random times; return 0 if it always ends with the status of an interruption."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--commands", type=int, default=60, help="number of runs of each command")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng, well = random.Random(options.seed), True
    print("command        time   interrupted  ended by it  lost  other status  longest time to the end")
    for name, words in COMMANDS.items():
        with tempfile.TemporaryDirectory() as place:
            kill.prepare(Path(place), kill.STUDIES["replay"], mounts=False)
            interrupt(Path(place), words, None)  # fills the caches
            _, status, whole = interrupt(Path(place), words, None)
            if status:
                raise SystemExit(f"{name} without an interruption ended with {status}")
            runs = [
                interrupt(Path(place), words, rng.uniform(0.0, whole))
                for _ in track(range(options.commands), name, console=Console(stderr=True), transient=True)
            ]
        sent = [(status, seconds) for interrupted, status, seconds in runs if interrupted]
        ended = sum(status in ENDED for status, _ in sent)
        lost = sum(status == 0 for status, _ in sent)
        others = sorted({status for status, _ in sent} - {0} - ENDED)
        longest = max((seconds for _, seconds in sent), default=0.0)
        print(
            f"{name:13}{whole:5.1f} s{len(sent):13}{ended:13}{lost:6}  {', '.join(map(str, others)) or '-':12}"
            f"{longest:8.1f} s",
            flush=True,
        )
        well &= ended == len(sent)
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
