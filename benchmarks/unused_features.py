"""Does a study without the newer features give the same numbers as an earlier commit, in the same time?

    git worktree add --detach BEFORE COMMIT
    python benchmarks/unused_features.py BEFORE --rounds 3

Both checkouts calibrate the demo study and replay its paths, alternately and in separate processes. The script prints
the parameters, intervals, draws and path losses that differ, and the ratio of processor times (median over the rounds).
Paths are traced once and then read from the cache.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

MEASURED = """
import json, sys, time
import numpy as np
import calibray as cb
from calibray import engines
from calibray.scenarios import demo_study_path
from calibray.study import Setup, Study
study = Study.load(demo_study_path())
started = time.process_time()
result = cb.calibrate(study)
calibration = time.process_time() - started
engine = engines.make(Setup.open(study))
unit = np.random.default_rng(1).random((256, len(engine.parameters)))
candidates = engine.parameters.from_unit(unit)
loss, jacobian = engine.path_loss_and_jacobian(candidates)
engine.path_loss(candidates)
times = []
for _ in range(5):
    started = time.process_time()
    engine.path_loss(candidates)
    engine.path_loss_and_jacobian(candidates)
    times.append(time.process_time() - started)
numbers = dict(result.parameters)
for name, each in result.intervals.items():
    numbers |= {name + " from": each.lower, name + " to": each.upper}
for name, values in result.uncertainty.draws.items():
    numbers |= {f"draw {k} of {name}": value for k, value in enumerate(values)}
numbers |= {f"path loss {k}": value for k, value in enumerate(loss[:, 0].tolist())}
numbers |= {"path loss": float(loss[np.isfinite(loss)].sum()), "derivatives": float(jacobian.sum())}
print(json.dumps({"numbers": numbers, "calibration": calibration, "replay": min(times)}))
"""


def measured(checkout: Path) -> dict:
    """The results of a checkout, from a separate process."""
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve() / "src")}
    answer = subprocess.run(
        [sys.executable, "-c", MEASURED], env=environment, check=True, capture_output=True, text=True
    )
    return json.loads(answer.stdout.splitlines()[-1])


def main() -> None:
    """Run both checkouts alternately, and compare the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("before", type=Path, help="checkout of the earlier commit")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    here = Path(__file__).resolve().parents[1]
    pairs = [(measured(options.before), measured(here)) for _ in range(options.rounds)]
    before, after = (each["numbers"] for each in pairs[-1])
    differing = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    print(f"{len(differing)} of {len(before)} numbers differ")
    drawn = [name for name in differing if name.startswith("draw ") or name.endswith((" from", " to"))]
    print(
        f"  of these {len(drawn)} of intervals and draws, the others are of parameters, path losses and derivatives"
    )
    for name in sorted(set(differing) - set(drawn))[:10]:
        print(f"  {name}: {before.get(name)} -> {after.get(name)}")
    for kind in ("calibration", "replay"):
        ratio = np.median([new[kind] / old[kind] for old, new in pairs])
        print(f"processor time of {kind}, after / before: {ratio:.2f}")


if __name__ == "__main__":
    main()
