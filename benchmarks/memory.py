"""Memory of tracing, and a check that splitting receivers over launches does not change the result.

    python benchmarks/memory.py             # 2,000 receivers and 2 transmitters in Munich
    python benchmarks/memory.py --lanes     # bytes per lane, for calibray.tracing.trace_plan.LANE_BYTES
    python benchmarks/memory.py --paths     # bytes per path, for calibray.tracing.trace_plan.PATH_BYTES

Each run has its own process, whose peak resident memory is printed.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np

from calibray.fields import path_loss
from calibray.scenes import read_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer, tracer

FREQUENCY = 3.5e9
MASTS = np.array([[8.5, 21.0, 27.0], [45.0, 90.0, 40.0]])  # [m]
CANYON = "sionna:simple_street_canyon"
ROUGH = {name: {"scattering_coefficient": 0.5} for name in ("glass", "wood", "marble", "brick", "concrete")}


def resident() -> float:
    """Peak memory of this process so far [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def make_tracer(scene: str, materials: dict | None = None, **settings: int | bool) -> Tracer:
    """A tracer of a bundled scene."""
    return Tracer(
        read_scene(scene, FREQUENCY, materials), FREQUENCY, TraceSettings(**settings), Antenna(), Antenna()
    )


def outdoors(at: Tracer, count: int, seed: int = 0) -> np.ndarray:
    """Positions in the streets, 1.5 m high [count, 3], [m]."""
    random = np.random.default_rng(seed)
    found = np.zeros((0, 3))
    while len(found) < count:
        points = np.c_[random.uniform(-400, 400, (count, 2)), np.full(count, 1.5)]
        found = np.vstack([found, points[~at.enclosed(points)]])
    return found[:count]


def campaign(receivers: int, samples: int, depth: int, compared: int) -> None:
    """Trace a large campaign, and a sample of its links one by one."""
    munich = make_tracer("sionna:munich", samples=samples, max_depth=depth)
    rx = outdoors(munich, receivers)
    links = SimpleNamespace(tx=np.repeat(MASTS, len(rx), axis=0), rx=np.tile(rx, (len(MASTS), 1)))
    start = time.perf_counter()
    trace = munich.find_paths(links)
    traced = time.perf_counter() - start
    paths = trace.paths()
    compiled = time.perf_counter() - start - traced
    loss = path_loss(paths)
    peak, planned = resident(), munich.plan(links)
    print(f"links                {paths.num_links:,} ({receivers:,} receivers, {len(MASTS)} transmitters)")
    print(f"samples, max_depth   {samples:,}, {depth}")
    print(f"paths                {paths.num_paths:,}; {len(paths.links_without_path):,} links without one")
    print(f"launches             {len(planned.launches)} of up to {planned.lanes:,} lanes")
    print(f"tracing, compiling   {traced:.1f} s, {compiled:.1f} s")
    print(f"peak memory          {peak / 2**30:.2f} GiB")
    # Half of the compared links have a path: most receivers see neither a mast nor a wall that a mast sees.
    random, reached = np.random.default_rng(1), np.isfinite(loss)
    sample = np.concatenate(
        [
            random.choice(np.flatnonzero(reached == has), min(compared // 2, (reached == has).sum()), False)
            for has in (True, False)
        ]
    )
    alone = np.array([path_loss(munich.trace(one(links, link)))[0] for link in sample])
    same = np.isinf(alone) & np.isinf(loss[sample])
    change = np.abs(np.where(same, 0, alone) - np.where(same, 0, loss[sample]))
    print(
        f"one by one           {len(sample)} links, {(~same).sum()} of them with a path: "
        f"largest difference {change.max():.2g} dB"
    )


def one(links: SimpleNamespace, link: int) -> SimpleNamespace:
    """One of the given links."""
    return SimpleNamespace(tx=links.tx[link : link + 1], rx=links.rx[link : link + 1])


def canyon_links(count: int) -> SimpleNamespace:
    """Links in a street canyon."""
    rx = np.random.default_rng(0).uniform((-8, -8, 1.5), (8, 8, 1.5), (count, 3))
    return SimpleNamespace(tx=np.tile([-20.0, 2.0, 15.0], (count, 1)), rx=rx)


def lanes(samples: int, depth: int, receivers: int) -> None:
    """Trace in one launch."""
    tracer.LANES = samples * depth * receivers
    make_tracer(CANYON, samples=1000, max_depth=depth).trace(canyon_links(1))
    before = resident()
    make_tracer(CANYON, samples=samples, max_depth=depth).trace(canyon_links(receivers))
    taken = (resident() - before) / tracer.LANES
    print(f"{samples:>11,} rays x {depth} interactions x {receivers:>2} receivers: {taken:.0f} bytes a lane")


def paths(samples: int, depth: int, receivers: int) -> None:
    """Trace and compile a very large number of paths."""
    rough = make_tracer(CANYON, ROUGH, samples=samples, max_depth=depth, diffuse_reflection=True)
    before = resident()
    found = rough.trace(canyon_links(receivers))
    taken = (resident() - before) / found.num_paths
    print(f"depth {depth}, {found.num_paths:>9,} paths: {taken:.0f} bytes a path")


def main() -> None:
    """Run the requested measurements, each in a separate process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lanes", action="store_true", help="measure the bytes per lane")
    parser.add_argument("--paths", action="store_true", help="measure the bytes per path")
    parser.add_argument("--receivers", type=int, default=2000)
    parser.add_argument("--samples", type=int, default=200_000)
    parser.add_argument("--depth", type=int, default=3)
    parser.add_argument(
        "--compared", type=int, default=50, help="number of links that are also traced one by one"
    )
    parser.add_argument("--child", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        {"campaign": campaign, "lanes": lanes, "paths": paths}[options.child[0]](*map(int, options.child[1:]))
        return
    runs: list[tuple[object, ...]] = []
    if options.lanes:
        runs += [("lanes", *run) for run in ((4_000_000, 1, 1), (1_000_000, 1, 20), (4_000_000, 5, 1))]
        runs += [("lanes", 16_000_000, 3, 1)]
    if options.paths:
        runs += [("paths", 1_000_000, 2, 20), ("paths", 1_000_000, 5, 8)]
    default = ("campaign", options.receivers, options.samples, options.depth, options.compared)
    for run in runs or [default]:
        subprocess.run([sys.executable, __file__, "--child", *map(str, run)], check=True)


if __name__ == "__main__":
    main()
