"""Cost of tracing by launches: rays added in rounds or in a fixed number, many receivers, many transmitters.

Everything is measured in one run on one machine, as processor time, so that other work hardly changes the ratios:

    python benchmarks/launches.py            # a few minutes
    python benchmarks/launches.py --full     # 4 million rays on the demo district and 10,000 receivers as well

There are four comparisons: the demo district, where 1 million rays do not find all paths; receivers in the streets of
Munich with one transmitter, traced with a million rays (the default) and with "auto"; many transmitters and few
receivers, as in a flat, and the mirror image; and traces to new numbers of receivers, with a number of rays for which
no kernel was compiled. In the first three, each trace is run once beforehand, so that compilation is not measured; for
the demo district, the first run is printed too.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np

from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.scenarios import demo_study_path
from calibray.scenes import read_scene
from calibray.study import Setup, Study
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer, tracer

FREQUENCY = 3.5e9
MAST = np.array([8.5, 21.0, 27.0])  # [m]
MILLION = 1_000_000


def timed(call: Callable[[], Paths]) -> tuple[Paths, float]:
    """The return value of a call, and its processor time [s]."""
    start = time.process_time()
    return call(), time.process_time() - start


def links(tx: np.ndarray, rx: np.ndarray) -> SimpleNamespace:
    """Links from every transmitter to every receiver."""
    return SimpleNamespace(tx=np.repeat(tx, len(rx), axis=0), rx=np.tile(rx, (len(tx), 1)))


def row(name: str, *cells: object) -> None:
    """Print a row of a table."""
    print(f"{name:<44}" + "".join(f"{cell!s:>14}" for cell in cells), flush=True)


def demo(counts: tuple[int, ...]) -> None:
    """Rays added in rounds compared with fixed numbers of rays, in the demo district."""
    setup = Setup.open(Study.load(demo_study_path()))
    print(f"Demo district, {len(setup.links)} links\n")
    row("samples", "processor [s]", "paths", "missed [dB]")
    found = {}
    for name, samples in (("auto, compiling", "auto"), ("auto", "auto"), *((f"{n:,}", n) for n in counts)):
        at = setup.tracer.with_settings(replace(setup.tracer.settings, samples=samples))
        found[name] = timed(lambda at=at: at.trace(setup.links))
    best = np.min([path_loss(paths) for paths, _ in found.values()], axis=0)
    for name, (paths, seconds) in found.items():
        row(name, f"{seconds:.2f}", paths.num_paths, f"{np.max(path_loss(paths) - best):.4f}")


def streets(receivers: int, compared: int) -> None:
    """Links per second with one transmitter and many receivers."""
    at = Tracer(
        read_scene("sionna:munich", FREQUENCY), FREQUENCY, TraceSettings(samples="auto"), Antenna(), Antenna()
    )
    random, rx = np.random.default_rng(0), np.zeros((0, 3))
    while len(rx) < receivers:
        points = np.c_[random.uniform(-400, 400, (receivers, 2)), np.full(receivers, 1.5)]
        rx = np.vstack([rx, points[~at.enclosed(points)]])[:receivers]
    many = at.with_settings(replace(at.settings, samples=MILLION))
    print(f"\nMunich, depth 3, {receivers:,} receivers on one transmitter\n")
    row("samples", "links", "processor [s]", "links/s")
    at.trace(links(MAST[None], rx[:20]))
    auto, seconds = timed(lambda: at.trace(links(MAST[None], rx)))
    row(f"auto ({auto.settings['rays']:,} rays)", receivers, f"{seconds:.2f}", f"{receivers / seconds:.1f}")
    # Half of the sample is reached: most receivers see neither the mast nor a wall that the mast sees.
    reached = np.isfinite(path_loss(auto))
    some = np.concatenate([np.flatnonzero(reached == each)[: compared // 2] for each in (True, False)])
    many.trace(links(MAST[None], rx[:6]))
    plain, slow = timed(lambda: many.trace(links(MAST[None], rx[some])))
    row(f"{MILLION:,}", len(some), f"{slow:.2f}", f"{len(some) / slow:.1f}")
    one, other = path_loss(auto)[some], path_loss(plain)
    gap = np.where(np.isinf(one) & np.isinf(other), 0, one - np.where(np.isinf(one), 0, other))
    ratio = receivers / seconds / (len(some) / slow)
    print(
        f"auto is {ratio:.0f} times as fast; its path loss minus that of a million rays: "
        f"{gap.min():.4f} to {gap.max():.4f} dB"
    )


def mirrored(many: int, few: int) -> None:
    """Many transmitters and few receivers, and the mirror image, with a fixed number of rays and with "auto"."""
    settings = TraceSettings(max_depth=3, samples=100_000, refraction=True)
    scene = read_scene("sionna:simple_street_canyon", FREQUENCY)
    here, there = Antenna("tr38901", "V", (0.3, 0.1, 0.0)), Antenna("dipole", "V")
    random = np.random.default_rng(1)
    ends = (
        random.uniform((-30, -8, 1), (30, 8, 4), (many, 3)),
        random.uniform((-20, -6, 8), (20, 6, 16), (few, 3)),
    )
    print(f"\nStreet canyon with refraction, {many} transmitters and {few} receivers, and its mirror image\n")
    row("", "launches", "processor [s]", "mirror image", "relative gap")
    for name, samples in (("100,000 samples", 100_000), ("auto", "auto")):
        at = Tracer(scene, FREQUENCY, replace(settings, samples=samples), here, there)
        mirror = Tracer(scene, FREQUENCY, at.settings, there, here)
        forth, back = links(*ends), links(*ends[::-1])
        for each, campaign in ((at, forth), (mirror, back)):
            each.trace(campaign)
        one, first = timed(partial(at.trace, forth))
        other, second = timed(partial(mirror.trace, back))
        gap = np.abs(
            10 ** ((path_loss(one).reshape(many, few) - path_loss(other).reshape(few, many).T) / 20) - 1
        )
        launches = f"{len(at.plan(forth).launches)}, {len(mirror.plan(back).launches)}"
        row(name, launches, f"{first:.2f}", f"{second:.2f}", f"{np.nanmax(gap):.1e}")
    forth, at = links(*ends), Tracer(scene, FREQUENCY, settings, here, there)
    one, forced = at.trace(forth), tracer.starts_at_receivers
    tracer.starts_at_receivers = lambda *_: False
    other, slow = timed(partial(at.trace, forth))
    gap = np.abs(10 ** ((path_loss(one) - path_loss(other)) / 20) - 1)
    row(
        "100,000 samples, from the transmitters",
        len(at.plan(forth).launches),
        f"{slow:.2f}",
        "",
        f"{np.nanmax(gap):.1e}",
    )
    tracer.starts_at_receivers = forced


def first_launches(numbers: tuple[int, ...]) -> None:
    """Traces to the given numbers of receivers in order; their kernels are not on disk, as no run had as many rays."""
    settings = TraceSettings(
        max_depth=2, samples=20_000 + time.time_ns() % 10_000, refraction=True, diffraction=True
    )
    at = Tracer(
        read_scene("sionna:simple_street_canyon", FREQUENCY), FREQUENCY, settings, Antenna(), Antenna()
    )
    rx = np.random.default_rng(6).uniform((-8, -8, 1.5), (8, 8, 2.5), (max(numbers), 3))
    print("\nStreet canyon with refraction and diffraction, compiling\n")
    row("receivers", "processor [s]")
    for number in numbers:
        _, seconds = timed(lambda number=number: at.trace(links(np.array([[-20.0, 2.0, 15.0]]), rx[:number])))
        row(f"{number}", f"{seconds:.2f}")


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--full", action="store_true", help="4 million rays, and 10,000 receivers")
    options = parser.parse_args()
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
    demo((MILLION, 4 * MILLION) if options.full else (MILLION,))
    streets(*((10_000, 40) if options.full else (2_000, 20)))
    mirrored(300, 3)
    first_launches((5, 6, 7, 8, 12, 15))


if __name__ == "__main__":
    main()
