"""Speed-up of a batch on a program that sleeps 1 s per call: four threads, and four worker processes of a Dask cluster.

    python benchmarks/parallel.py

The baseline in the same run is the same batch, one call at a time.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import distributed
import numpy as np

import programs
from calibray import engines

CALLS = 12


def seconds(folder: Path, workers: int | None, scheduler: str | None) -> float:
    """Time taken by a batch [s]."""
    study = programs.study(folder, "import time; time.sleep(1)")
    candidates = np.random.default_rng(0).uniform(1.5, 12.0, (CALLS, 3))
    with engines.open_workers(workers, scheduler) as opened:
        engine = engines.make(study, workers=opened)
        started = time.perf_counter()
        engine.path_loss(candidates)
        return time.perf_counter() - started


def main() -> None:
    """Time one batch in all three ways."""
    options: dict[str, Any] = {
        "n_workers": 4,
        "threads_per_worker": 1,
        "dashboard_address": None,
        "processes": True,
    }
    cluster: Any = distributed.LocalCluster(**options)
    with tempfile.TemporaryDirectory() as place, cluster:
        alone = seconds(Path(place), None, None)
        ways = {"four threads": (4, None), "four Dask workers": (None, cluster.scheduler_address)}
        print(f"{CALLS} calls one by one: {alone:.1f} s")
        for name, (workers, scheduler) in ways.items():
            together = seconds(Path(place), workers, scheduler)
            print(f"{name}: {together:.1f} s, {alone / together:.2f} times as fast")


if __name__ == "__main__":
    main()
