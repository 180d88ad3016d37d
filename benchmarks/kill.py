"""A calibration on an external program, killed with SIGKILL at random moments and started again each time.

Run with: python benchmarks/kill.py [KILLS] [SEED]
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import restarts
from test_ledger import study_file

OPTIONS = "{ population = 10, iterations = 14, full_iterations = 5, elites = 3 }"


def main(kills: int, seed: int) -> None:
    """Run a study undisturbed and with kills, one program at a time and four at once, and compare."""
    print(
        "workers  kills  calls  committed  calls under way when killed  committed calls repeated  same result"
    )
    with restarts.open_runner() as runner, tempfile.TemporaryDirectory() as place:
        for workers in (0, 4):
            folders = [Path(place) / f"{name}{workers}" for name in ("undisturbed", "killed")]
            for folder in folders:
                folder.mkdir()
                study_file(folder, "import time; time.sleep(0.02)", options=OPTIONS)
            undisturbed = restarts.finish(runner, folders[0], [], workers=workers)
            last = len(undisturbed.asked) - max(workers, 1)
            moments = sorted(random.Random(seed).sample(range(1, last), kills))
            killed = restarts.finish(runner, folders[1], moments, seed, workers)
            same = killed.result == undisturbed.result and set(killed.committed) == set(undisturbed.committed)
            again = len(killed.asked) - len(set(killed.asked))
            print(
                f"{workers:7}{killed.kills:7}{len(killed.asked):7}{len(killed.committed):11}{again:29}"
                f"{killed.repeated:26}  {'yes' if same else 'NO'}",
                flush=True,
            )


if __name__ == "__main__":
    main(*(int(argument) for argument in (*sys.argv[1:], *("20", "0")[len(sys.argv) - 1 :])))
