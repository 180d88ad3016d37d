"""Speed-up of a batch on a program that sleeps 1 s a call, with four at once against one after the other.

Run with: python benchmarks/parallel.py [SCHEDULER]; with the address of a Dask scheduler its workers run the calls.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np

import programs
from calibray import engines

CALLS = 12


def seconds(folder: Path, workers: int | None, scheduler: str | None) -> float:
    """Time that a batch takes [s]."""
    study = programs.study(folder, "import time; time.sleep(1)")
    candidates = np.random.default_rng(0).uniform(1.5, 12.0, (CALLS, 3))
    with engines.open_executor(workers, scheduler) as executor:
        engine = engines.make(study, executor=executor)
        started = time.perf_counter()
        engine.path_loss(candidates)
        return time.perf_counter() - started


def main(scheduler: str | None) -> None:
    """Time one batch both ways."""
    with tempfile.TemporaryDirectory() as place:
        alone = seconds(Path(place), None, None)
        together = seconds(Path(place), None if scheduler else 4, scheduler)
    print(
        f"{CALLS} calls: {alone:.1f} s one by one, {together:.1f} s at once, {alone / together:.2f} times as fast"
    )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
