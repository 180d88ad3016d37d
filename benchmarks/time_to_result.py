"""How long a user waits for a calibration, by stage, compared with the time of one trace.

    CALIBRAY_DATA=../shared/data python benchmarks/time_to_result.py

Each study runs in separate processes with a separate cache folder: `cold` starts without compiled functions, `warm`
finds those that `cold` compiled. Both trace. "search" and "inference" include compilation; "compile" is the compilation
time in both, from JAX's own events. "trace" extends from the launches to the path program, with the scene in memory.
The ratio is (search + inference) / trace. Times are wall times on an otherwise idle machine, with processor times in
brackets. The last table repeats the search with other seeds and with all 512 starts; it shows the optimum found and the
number of evaluations.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

STUDIES = ("demo", "nist_boulder", "auckland_tower")
PARTS = ("import", "open", "trace", "compile", "search", "inference")
SEEDS = range(1000, 1025)
"""Seeds that were not used for any design choice."""


def study_path(name: str) -> Path:
    """The study's file."""
    if name != "demo":
        return Path(__file__).parents[1] / "examples" / f"{name}.toml"
    from calibray.scenarios import demo_study_path

    return demo_study_path()


def at_hand(name: str) -> bool:
    """Whether the study's scene is available: measured campaigns are not part of the repository."""
    from calibray.errors import InputError
    from calibray.study import Setup, Study

    try:
        Setup.open(Study.load(study_path(name)))
    except InputError as error:
        print(f"{name} is left out: {error}")
        return False
    return True


class Clock:
    """Wall time and processor time of successive parts."""

    def __init__(self) -> None:
        self.seconds: dict[str, tuple[float, float]] = {}
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def lap(self, part: str) -> None:
        """End the current part, and begin the next one."""
        wall, processor = time.perf_counter(), time.process_time()
        self.seconds[part] = wall - self._wall, processor - self._processor
        self._wall, self._processor = wall, processor


def once(name: str) -> dict[str, object]:
    """Run one calibration in this process; return the seconds of each part, and the outcome."""
    clock = Clock()
    from jax import monitoring

    from calibray.engines.kinds.replay import replay
    from calibray.fitting.preliminary_fits import estimate_noise
    from calibray.fitting.problem import Problem
    from calibray.fitting.search import choose, search
    from calibray.study import Setup, Study
    from calibray.uncertainty.assessment import certainty

    compiled = [0.0]
    monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compiled.append(seconds * ("/jax/core/compile" in event))
    )
    clock.lap("import")
    setup = Setup.open(Study.load(study_path(name)))
    tracer = setup.tracer
    clock.lap("open")
    paths = tracer.trace(setup.links)
    clock.lap("trace")
    compiled.clear()
    problem = estimate_noise(Problem.of(setup, replay(setup, paths)))
    trail = search(problem, choose(problem))
    clock.lap("search")
    timed = certainty(problem, trail)
    clock.lap("inference")
    clock.seconds["compile"] = sum(compiled), 0.0
    return {
        "seconds": clock.seconds,
        "interactions": paths.num_interactions,
        "evaluations": [trail.rt_calls, timed.calls],
        "rmse_db": trail.best_rmse_db,
    }


def seeds(name: str) -> dict[str, object]:
    """Optimum and evaluations of `auto` with other seeds, and of all 512 starts with the first of these seeds."""
    from calibray.engines.kinds.replay import replay
    from calibray.fitting.problem import Problem
    from calibray.fitting.search import choose, rounds, search
    from calibray.optimizers import LeastSquares, least_squares
    from calibray.study import Setup, Study

    setup = Setup.open(Study.load(study_path(name)))
    engine = replay(setup, setup.trace())
    few = []
    for seed in SEEDS:
        problem = Problem.of(setup.replace(seed=seed), engine)
        trail = search(problem, choose(problem))
        few.append((trail.best_rmse_db, trail.rt_calls))
    problem = Problem.of(setup, engine)
    start = problem.parameters.to_search(problem.parameters.start)
    least_squares.RETURNS = sys.maxsize
    every = LeastSquares(*problem.parameters.search_bounds, seed=SEEDS[0], x0=start)
    for _ in rounds(every, problem.evaluate):
        pass
    return {"few": few, "all": (every.best.y, every.evaluations)}


def in_a_process(what: Callable[[str], object], name: str, cache: Path) -> dict:
    """The return value of a function of this file that runs in a separate process."""
    command = [sys.executable, __file__, "--inside", what.__name__, "--studies", name]
    environment = {**os.environ, "CALIBRAY_CACHE": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(ran.stdout.splitlines()[-1])


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description="How long a user waits for a calibration.")
    parser.add_argument("--studies", nargs="+", default=STUDIES, choices=STUDIES)
    parser.add_argument("--inside", choices=("once", "seeds"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.inside:
        print(json.dumps(globals()[given.inside](given.studies[0])))
        return
    studies = [name for name in given.studies if at_hand(name)]
    print(
        f"{'study':15} {'':5}" + "".join(f"{part:>17}" for part in PARTS) + f"{'ratio':>7}  evaluations, RMSE"
    )
    for name in studies:
        with tempfile.TemporaryDirectory() as folder:
            for kind in ("cold", "warm"):
                timed = in_a_process(once, name, Path(folder))
                seconds = timed["seconds"]
                ratio = (seconds["search"][0] + seconds["inference"][0]) / seconds["trace"][0]
                parts = "".join(f"{seconds[part][0]:8.2f} ({seconds[part][1]:6.2f})" for part in PARTS)
                calls = " + ".join(f"{count:,}" for count in timed["evaluations"])
                print(
                    f"{name:15} {kind:5}{parts}{ratio:7.2f}  {calls}, {timed['rmse_db']:.4f} dB", flush=True
                )
    print(f"\n{'study':15} {'all starts':>24} {'until it comes back':>34} {'found within 0.001 dB':>22}")
    for name in studies:
        with tempfile.TemporaryDirectory() as folder:
            timed = in_a_process(seeds, name, Path(folder))
        best, evaluations = timed["all"]
        calls = [count for _, count in timed["few"]]
        hits = sum(rmse <= best + 1e-3 for rmse, _ in timed["few"])
        print(
            f"{name:15} {best:.5f} dB, {evaluations:8,} {min(calls):23,} to {max(calls):6,} {hits:>11} of {len(SEEDS)}"
        )


if __name__ == "__main__":
    main()
