"""How long `calibray --version` and `--help` take, compared with a Python process that does nothing.

    python benchmarks/start_up.py [--repeats 9]

The smallest processor time of several whole processes is used, so that other work on the machine hardly affects it.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys


def seconds(words: list[str], repeats: int) -> float:
    """Smallest processor time of a command [s]."""
    times = []
    for _ in range(repeats + 1):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(times[1:])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=9)
    repeats = parser.parse_args().repeats
    nothing = seconds(["-c", "pass"], repeats)
    print(f"python -c pass: {nothing:.3f} s")
    for option in ("--version", "--help"):
        taken = seconds(["-c", "from calibray.cli import main; main()", option], repeats)
        print(f"calibray {option}: {taken:.3f} s, {taken / nothing:.1f} times as long")
