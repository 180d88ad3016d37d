"""Links in chunks: speed-up by a second worker, bytes returned, and memory and time versus the number of links.

    python benchmarks/chunks.py speed-up            # tracing and search in Munich, 2 workers of one thread against 1
    python benchmarks/chunks.py validate            # the same for a validation with two blocks
    python benchmarks/chunks.py bytes               # bytes returned per candidate, by number of links
    python benchmarks/chunks.py links               # memory and time per step, one chunk repeated to a million links
    python benchmarks/chunks.py city --links 100000 # a campaign in Munich end to end, in one process
    python benchmarks/chunks.py draws               # the uncertainty from ten chunks and from all links at once

Each mode has its own processes and cache. Measured values follow a log-distance law with 6 dB of noise, because the fit
does not matter here.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
from distributed import Client, LocalCluster

import calibray as cb
from calibray import engines
from calibray.engines import ChunkedReplay, InProcess, Workers
from calibray.engines.cluster.chunks import chunk_size, cut, seconds_to_trace
from calibray.engines.cluster.dask_workers import DaskWorkers
from calibray.engines.kinds.replay import trace_and_replay
from calibray.engines.protocol import Differentiable
from calibray.fitting.problem import Problem
from calibray.fitting.search import choose, search
from calibray.study import Setup, Study
from calibray.uncertainty.assessment import certainty

MASTS = np.array([[8.5, 21.0, 27.0], [45.0, 90.0, 40.0]])  # [m]
COLUMNS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
STEPS, CANDIDATES = 3, 32  # of a search over repeated chunks
PARAMETERS = ("concrete", "marble", "brick")

Work = Callable[[Setup, "Workers | None"], tuple[float, float]]
"""Function that takes an opened study and its workers, and returns the seconds for tracing and for the rest."""


def study(engine: dict, starts: int, samples: int | str) -> Study:
    """A study of links in Munich that are in no file."""
    return Study.from_content(
        {
            "version": 1,
            "scene": {"file": "sionna:munich", "frequency": 3.5e9},
            "links": {"file": "none.csv", "tx": COLUMNS[:3], "rx": COLUMNS[3:], "value": "path_loss_db"},
            "trace": {"max_depth": 3, "samples": samples},
            "parameters": {f"{name}.relative_permittivity": {"bounds": [1.5, 12.0]} for name in PARAMETERS},
            "offset": {"per": "mast", "bounds": [-60.0, 60.0]},
            "method": {"name": "least-squares", "options": {"starts": starts}},
            "engine": {"name": "replay", **engine},
        }
    )


def campaign(
    count: int, engine: dict, starts: int = 16, seed: int = 0, samples: int | str = 100_000
) -> Setup:
    """Links from two masts to places drawn from a seed; receivers inside buildings have no path and are left out."""
    random = np.random.default_rng(seed)
    mast = random.integers(0, len(MASTS), count)
    rx = np.c_[random.uniform(-300, 300, (count, 2)), np.full(count, 1.5)]
    distance = np.linalg.norm(MASTS[mast] - rx, axis=1)
    loss = 40 + 33 * np.log10(distance) + 6 * random.standard_normal(count)
    links = cb.Measurements(tx=MASTS[mast], rx=rx, path_loss_db=loss, group=mast)
    return Setup.open(study(engine, starts, samples), links=links)


def resident() -> float:
    """Peak memory of this process so far [GiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def searched(setup: Setup, workers: Workers | None) -> tuple[float, float]:
    """Seconds for tracing and for the search."""
    started = time.perf_counter()
    problem = Problem.of(setup, engines.make(setup, workers=workers))
    traced = time.perf_counter()
    search(problem, choose(problem))
    return traced - started, time.perf_counter() - traced


def validated(setup: Setup, workers: Workers | None) -> tuple[float, float]:
    """Seconds for tracing and for validation with two blocks."""
    started, times = time.perf_counter(), []
    cb.validate(setup, blocks=2, workers=workers, progress=lambda *_: times.append(time.perf_counter()))
    traced = times[-3]
    return traced - started, time.perf_counter() - traced


def on_core(core: int) -> None:
    """Pin all threads of this process, and those that they start, to one core if the system supports it."""
    if sys.platform == "linux":
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setaffinity(int(thread.name), {core})


def speed_up(links: int, work: Work) -> None:
    """Trace and search, or validate, with one worker of one core and with two.

    The speed-up is given in wall time and in the processor time of the busiest process. The latter would be the wall
    time on an idle machine with a core for every process.
    """
    alone: tuple[float, float] | None = None
    for workers in (1, 2):
        with (
            tempfile.TemporaryDirectory() as cache,
            pinned(CALIBRAY_CACHE=cache, JAX_COMPILATION_CACHE_DIR=None),
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                memory_limit=0,
            ) as cluster,
            Client(cluster) as client,
        ):
            # Dr.Jit and XLA would otherwise use every core for a single worker.
            for core, worker in enumerate(client.scheduler_info()["workers"]):
                client.run(on_core, core % (os.cpu_count() or 1), workers=[worker])
            opened = DaskWorkers(lambda: client, client.get_executor)
            # Libraries and the scene are loaded before the clock starts.
            engines.make(campaign(2, {"chunk_links": 1}, seed=9), workers=opened)
            before, here = client.run(time.process_time), time.process_time()
            tracing, searching = work(campaign(links, {"chunk_links": -(-links // 8)}), opened)
            after, lead = client.run(time.process_time), time.process_time() - here
            busy = [after[worker] - before[worker] for worker in after]
        together, critical = tracing + searching, max(busy) + lead
        alone = alone or (together, critical)
        print(
            f"{workers} worker(s), {links} links: tracing {tracing:.1f} s, the rest {searching:.1f} s, "
            f"{alone[0] / together:.2f} times as fast as one; processor time of workers "
            f"{', '.join(f'{each:.1f}' for each in busy)} s, and {lead:.1f} s here: {alone[1] / critical:.2f} times",
            flush=True,
        )


class pinned:
    """Set environment variables, and restore them afterwards; None removes a variable."""

    def __init__(self, **values: str | None) -> None:
        self.values, self.before = values, {name: os.environ.get(name) for name in values}

    def __enter__(self) -> None:
        self._put(self.values)

    def __exit__(self, *_: object) -> None:
        self._put(self.before)

    def _put(self, values: dict[str, str | None]) -> None:
        for name, value in values.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def moved(links: int) -> None:
    """Size of the answers to a batch of candidates, as they are sent."""
    import pickle

    for count in (links // 4, links):
        setup = campaign(count, {"chunk_links": -(-count // 4)})
        problem = Problem.of(setup, engines.make(setup))
        engine = cast(ChunkedReplay, problem.engine)
        shares = problem.objective.shares(engine.chunks)
        parts = engine.reducing(shares)(np.repeat(problem.parameters.start[None], 64, axis=0), True)
        size = sum(len(pickle.dumps(part)) for part in parts)
        whole = 64 * count * 8 * (1 + len(problem.parameters))
        print(
            f"{count} links in {len(parts)} chunks: {size / 64:.0f} bytes per candidate are returned with derivatives; "
            f"path loss and derivatives of every link would take {whole / 64:,.0f}"
        )


def repeated(chunks: int, links: int) -> None:
    """Repeat one chunk's links, with two chunks open at once, and time steps of a search over all links."""
    one = campaign(links, {"chunk_links": links})
    tx, rx = (np.tile(end, (chunks, 1)) for end in (one.links.tx, one.links.rx))
    loss, mast = (np.tile(each, chunks) for each in (one.links.path_loss_db, one.links.group_index))
    setup = one.at(cb.Measurements(tx=tx, rx=rx, path_loss_db=loss, group=mast))
    parts = [np.arange(links) + links * k for k in range(chunks)]
    started = time.perf_counter()
    engine = ChunkedReplay(InProcess(at_most=2), setup, parts, partial(trace_and_replay, None))
    problem = Problem.of(setup, engine)
    opened = time.perf_counter() - started
    lower, upper = problem.parameters.search_bounds
    points = lower + np.random.default_rng(0).random((CANDIDATES, len(lower))) * (upper - lower)
    for _ in range(STEPS):
        problem.squares(points, derivatives=True)
    seconds = time.perf_counter() - started - opened
    each = 1e6 * seconds / STEPS / CANDIDATES / chunks / links
    print(
        f"{chunks * links:>9,} links in {chunks:>4} chunks: {opened:.1f} s to open, {seconds:.1f} s for "
        f"{STEPS} batches of {CANDIDATES} candidates with derivatives, {each:.3f} us per link and candidate, "
        f"peak memory {resident():.2f} GiB",
        flush=True,
    )


def city(links: int, samples: int | str) -> None:
    """Calibrate end to end in one process."""
    setup = campaign(links, {"chunk_links": chunk_size(None, links)}, samples=samples)
    chunks = cut(setup.links, chunk_size(None, links))
    print(
        f"{links:,} links in {len(chunks)} chunks; predicted {seconds_to_trace(setup, chunks):.0f} s of tracing"
    )
    with tempfile.TemporaryDirectory() as cache, pinned(CALIBRAY_CACHE=cache):
        started = time.perf_counter()
        result = cb.calibrate(setup)
        taken = time.perf_counter() - started
    print(f"{taken:.0f} s ({result.cost.trace_seconds:.0f} s tracing), peak memory {resident():.2f} GiB")


def draws(links: int) -> None:
    """Assess the uncertainty from links with planted path loss in one process, at once and in ten chunks."""
    base = campaign(links, {})
    loss = engines.make(base).path_loss(np.array([[5.0, 6.0, 4.0]]))[0]
    reached = np.isfinite(loss)
    noise = 6 * np.random.default_rng(1).standard_normal(reached.sum())
    known = replace(base.links.select(reached), path_loss_db=loss[reached] + noise)
    for engine in ({}, {"chunk_links": -(-len(known) // 10)}):
        problem = Problem.of(setup := campaign(links, engine).at(known), engines.make(setup))
        trail = search(problem, choose(problem))
        started = time.process_time()
        found = certainty(problem, trail)
        ends = {
            name: (round(each.lower, 4), round(each.upper, 4))
            for name, each in found.record.intervals.items()
        }
        print(
            f"{len(known)} links, {cast(Differentiable, problem.engine).interactions} interactions, {engine}: "
            f"{time.process_time() - started:.1f} s of processor time for {found.calls} replays; {ends}",
            flush=True,
        )


def main() -> None:
    """Run the requested mode, with a separate process for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("speed-up", "validate", "bytes", "links", "city", "draws"))
    parser.add_argument(
        "--links", type=int, default=None, help="number of links; in the mode `links`, of one chunk"
    )
    parser.add_argument("--chunks", type=int, nargs="+", default=[1, 10, 100])
    parser.add_argument(
        "--samples",
        type=lambda word: word if word == "auto" else int(word),
        default=100_000,
        help="of `city`",
    )
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.what == "links" and not options.child:
        with tempfile.TemporaryDirectory() as cache:
            for chunks in options.chunks:
                words = ["links", "--child", "--chunks", str(chunks), "--links", str(options.links or 10_000)]
                environment = os.environ | {"CALIBRAY_CACHE": cache}
                subprocess.run([sys.executable, Path(__file__), *words], check=True, env=environment)
        return
    {
        "speed-up": lambda: speed_up(options.links or 2000, searched),
        "validate": lambda: speed_up(options.links or 400, validated),
        "bytes": lambda: moved(options.links or 400),
        "links": lambda: repeated(options.chunks[0], options.links),
        "draws": lambda: draws(options.links or 16_000),
        "city": lambda: city(options.links or 100_000, options.samples),
    }[options.what]()


if __name__ == "__main__":
    main()
