"""Time and memory per interaction, for program sizes from 1e4 to 1e7 interactions.

    python benchmarks/interactions.py
    python benchmarks/interactions.py --compiling

Path programs are drawn at random (three materials, three interactions per path, three hundred links), in single
precision like all large programs. The rival in the same run is the slab formula of ITU-R P.2040 evaluated at every
interaction, as in replay without tables; the difference between their path losses is printed next to the times.

With `--compiling`, small programs are measured: the processor time of their compilation and the time per candidate, in
batches of 32, compiled for fast runs and compiled quickly.
"""

from __future__ import annotations

import argparse
import os
import time

import numpy as np
from scipy.constants import speed_of_light

from calibray import Material
from calibray.engines import Replay
from calibray.engines.replay import Computation
from calibray.fields import layout
from calibray.fields import program as programs
from calibray.parameters import Parameter, Parameters
from calibray.paths import Diffuse, Kind, Paths
from timing import seconds

MATERIALS = {
    "walls": Material(5.3, 0.1, 0.2, 0.3),
    "glass": Material(6.3, 0.02, 0.01, 0.2),
    "ground": Material(3.0, 0.05, 0.5, 0.4),
}
DEPTH, LINKS, FREQUENCY = 3, 300, 28e9


def program(interactions: int, diffuse: bool, seed: int = 0) -> Paths:
    """A random path program.

    Args:
        interactions: Number of interactions.
        diffuse: Whether the last interaction of every path is a diffuse reflection.
        seed: Seed of the random numbers.

    Returns:
        The program.
    """
    random = np.random.default_rng(seed)
    paths = interactions // DEPTH
    count = paths * DEPTH
    kind = np.full((paths, DEPTH), Kind.SPECULAR, dtype=np.uint8)
    if diffuse:
        kind[:, -1] = Kind.DIFFUSE
    rows = paths if diffuse else 0
    length = random.uniform(20, 200, paths)
    return Paths(
        frequency=FREQUENCY,
        materials=MATERIALS,
        tx_position=np.zeros((LINKS, 3)),
        rx_position=np.ones((LINKS, 3)),
        link=np.sort(random.integers(LINKS, size=paths)).astype(np.int32),
        delay=length / speed_of_light,
        spreading=1 / length,
        departure=np.zeros((paths, 2)),
        arrival=np.zeros((paths, 2)),
        tx_field=random.normal(size=(paths, 1, 2)) + 1j * random.normal(size=(paths, 1, 2)),
        rx_field=random.normal(size=(paths, 1, 2)) + 1j * random.normal(size=(paths, 1, 2)),
        first=np.arange(0, count + 1, DEPTH),
        kind=kind.ravel(),
        material=random.integers(3, size=count).astype(np.int32),
        cos_incidence=random.random(count),
        rotation=rotations(random, count),
        vertex=np.zeros((count, 3), np.float32),
        diffuse=Diffuse(
            rotations(random, rows), random.uniform(1, 6, rows), *(random.random(rows) for _ in range(3))
        ),
    )


def rotations(random: np.random.Generator, count: int) -> np.ndarray:
    """Random rotations (cos, sin) [count, 2]."""
    angle = random.uniform(0, 2 * np.pi, count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def parameters() -> Parameters:
    """Six parameters: permittivity and conductivity of three materials."""
    return Parameters(
        tuple(
            Parameter(f"{name}.{field}", 0.5 * value if field == "conductivity" else 1.5, 2 * value, value)
            for name, material in MATERIALS.items()
            for field in ("relative_permittivity", "conductivity")
            for value in [getattr(material, field)]
        )
    )


def main() -> None:
    """Measure and print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--largest", type=float, default=1e7, help="largest number of interactions")
    options.add_argument(
        "--compiling", action="store_true", help="measure small programs and their compilation"
    )
    chosen = options.parse_args()
    if chosen.compiling:
        return measure_compiling()
    largest = chosen.largest
    print(f"{'interactions':>12} {'kind':>9} {'table [ns]':>11} {'formula [ns]':>13} {'Jacobian [ns]':>14} "
          f"{'ratio':>6} {'bytes':>6} {'difference [dB]':>16}")  # fmt: skip
    for diffuse in (False, True):
        size = 10_000
        while size <= largest:
            paths = program(size, diffuse)
            measure(paths, "diffuse" if diffuse else "specular")
            size *= 10


def measure_compiling() -> None:
    """Measure and print the table of small programs; compiled programs are not stored."""
    os.environ["CALIBRAY_CACHE"] = ""
    print(
        f"{'interactions':>12} {'compiled':>12} {'compiling [s]':>14} {'path loss [us]':>15} {'Jacobian [us]':>14}"
    )
    chosen = parameters()
    unit = np.random.default_rng(1).random((32, len(chosen)))
    points = chosen.lower + unit * (chosen.upper - chosen.lower)
    for size in (60, 120, 300, 960):
        for small, name in ((0, "to run fast"), (size, "fast")):
            programs.SMALL = small
            engine = Replay(program(size, False), chosen, computation=Computation(np.float64))
            started = time.process_time()
            engine.path_loss(points)
            engine.path_loss_and_jacobian(points)
            compiling = time.process_time() - started
            value, slope = (
                1e6 / len(points) * seconds(lambda f=function: f(points), 100)
                for function in (engine.path_loss, engine.path_loss_and_jacobian)
            )
            print(f"{size:12,} {name:>12} {compiling:14.2f} {value:15.1f} {slope:14.1f}", flush=True)


def measure(paths: Paths, kind: str) -> None:
    """Measure one program and print its row."""
    chosen = parameters()
    unit = np.random.default_rng(1).random((8, len(chosen)))
    points = chosen.lower + unit * (chosen.upper - chosen.lower)
    turn = iter(np.tile(points, (1000, 1)))
    engine = Replay(paths, chosen, computation=Computation(np.float32, True))
    repeats = max(5, min(100, 10_000_000 // paths.num_interactions))
    value = seconds(lambda: engine.path_loss(next(turn)[None]), repeats)
    slope = seconds(lambda: engine.path_loss_and_jacobian(next(turn)[None]), repeats)
    stored = layout(paths, np.float32, 256, phases=False).program.nbytes
    tabulated = engine.path_loss(points[:1])
    formula, difference = float("nan"), float("nan")
    if paths.num_interactions <= 1_000_000:
        rival = Replay(paths, chosen, computation=Computation(np.float32, False))
        formula = seconds(lambda: rival.path_loss(next(turn)[None]), max(3, repeats // 5))
        difference = np.abs(rival.path_loss(points[:1]) - tabulated).max()
    per = 1e9 / paths.num_interactions
    print(f"{paths.num_interactions:12,} {kind:>9} {value * per:11.2f} {formula * per:13.1f} {slope * per:14.2f} "
          f"{slope / value:6.2f} {stored / paths.num_interactions:6.1f} {difference:16.5f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
