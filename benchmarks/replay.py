"""How much faster replay is than a new run of the ray tracer, and how well their path losses agree.

Everything is measured in one run on one machine, so that only ratios matter:

    python benchmarks/replay.py

Rivals: a new Sionna RT trace for every candidate (the cost of a loop around a ray tracer), and Sionna's own field stage
on stored paths (the cost if the paths are stored).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np

from calibray import engines
from calibray.scenarios import demo_study_path
from calibray.study import Setup, Study
from calibray.tracing.sionna import Trace, Tracer
from timing import seconds


def candidates(engine: engines.Replay, count: int) -> np.ndarray:
    """Random candidates within the bounds [count, d]."""
    parameters = engine.parameters
    unit = np.random.default_rng(0).random((count, len(parameters)))
    return parameters.lower + unit * (parameters.upper - parameters.lower)


def field_stage(trace: Trace, engine: engines.Replay, points: np.ndarray) -> Callable[[], object]:
    """A function that evaluates a different candidate with Sionna's field stage in each call."""
    turn = iter(np.tile(points, (100, 1)))

    def call() -> object:
        return trace.path_gains(engine.parameters.materials(next(turn), engine.materials))

    return call


def main() -> None:
    """Measure and print the table."""
    study = Study.load(demo_study_path())
    replay = cast(engines.Replay, engines.make(study, "replay"))
    retrace = engines.make(study, "retrace")
    points = candidates(replay, 30)
    print(f"demo district: {replay.paths.num_links} links, {replay.paths.num_paths} paths, "
          f"{replay.paths.num_interactions} interactions")  # fmt: skip
    turn = iter(np.tile(points, (10, 1)))
    setup = Setup.open(study)
    stored = Tracer(setup.scene, study.scene.frequency, study.trace, *study.antenna_pair).find_paths(
        setup.links
    )
    rows = [
        ("re-trace with Sionna RT", seconds(lambda: retrace.path_loss(next(turn)[None]), 3)),
        ("Sionna's field stage on stored paths", seconds(field_stage(stored, replay, points), 9)),
        ("replay, one candidate", seconds(lambda: replay.path_loss(points[:1]), 300)),
        ("replay, batch of 30", seconds(lambda: replay.path_loss(points), 100) / 30),
        (
            "replay with derivatives, batch of 30",
            seconds(lambda: replay.path_loss_and_jacobian(points), 50) / 30,
        ),
    ]
    gap = np.abs(replay.path_loss(points[:3]) - retrace.path_loss(points[:3])).max()
    slowest = rows[0][1]
    print(f"\n{'engine':40} {'s per candidate':>16} {'times faster':>14}")
    for name, value in rows:
        print(f"{name:40} {value:16.3g} {slowest / value:14,.0f}")
    print(f"\nlargest difference in path loss, replay against re-trace: {gap:.5f} dB")


if __name__ == "__main__":
    main()
