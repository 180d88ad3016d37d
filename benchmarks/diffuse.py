"""Downtown Boulder with diffuse reflection: replay and compressed replay compared with a new trace.

    CALIBRAY_DATA=../shared/data python benchmarks/diffuse.py

The script needs the measured campaign (examples/README.md). One run times Sionna RT (finding the paths and evaluating
the fields again), replay of all paths, and replay of the compressed program, and shows how well their path losses
agree.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibray.engines import Replay
from calibray.engines.compression import compress
from calibray.parameters import Parameter, Parameters
from calibray.study import Setup, Study
from calibray.tracing.sionna import Tracer
from timing import seconds

STUDY = Path(__file__).parents[1] / "examples" / "nist_boulder.toml"
NAMES = ("walls", "ground")


def main() -> None:
    """Measure and print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--samples", type=float, default=7e5, help="rays launched from the transmitter")
    samples = int(options.parse_args().samples)
    data = Path(os.environ.get("CALIBRAY_DATA", STUDY.parent / "../../shared/data"))
    if not (data / "nist_boulder").is_dir():
        print(f"no campaign under {data}: not measured")
        return
    study = Study.load(STUDY)
    setup = Setup.open(study)
    links, scene = setup.links, setup.scene
    rough = {name: replace(scene.materials[name], scattering_coefficient=0.4) for name in NAMES}
    scene = replace(scene, materials={**scene.materials, **rough})
    settings = replace(study.trace, diffuse_reflection=True, max_depth=3, samples=samples)
    tracer = Tracer(scene, study.scene.frequency, settings, *study.antenna_pair)
    parameters = Parameters(
        tuple(
            Parameter(f"{name}.{field}", *bounds, getattr(rough[name], field))
            for name in NAMES
            for field, bounds in (
                ("relative_permittivity", (1.5, 12.0)),
                ("scattering_coefficient", (0.0, 0.9)),
            )
        )
    )
    points = parameters.from_unit(np.random.default_rng(7).random((20, len(parameters))))

    trace = tracer.find_paths(links)
    trace.path_gains()  # compiles the kernels
    start = time.perf_counter()
    trace = tracer.find_paths(links)
    gains = trace.path_gains()
    again = time.perf_counter() - start
    paths = trace.paths()
    link = trace.link()
    traced = -10 * np.log10(np.bincount(link, (np.abs(gains) ** 2).sum(axis=(1, 2)), len(links)))
    del trace, gains
    print(f"{paths.num_links} links, {paths.num_paths:,} paths, {paths.num_interactions:,} interactions")

    full = Replay(paths, parameters)
    gap = np.abs(full.path_loss(parameters.start[None])[0] - traced).max()
    start = time.perf_counter()
    small = compress(paths, parameters)
    compressing = time.perf_counter() - start
    few = Replay(small.paths, parameters)
    difference = np.abs(full.path_loss(points) - few.path_loss(points)).max()
    rows = [("re-trace with Sionna RT", again)]
    for name, engine, count, repeats in (("replay", full, 1, 9), ("compressed replay", few, 20, 30)):
        batch = points[:count]
        for title, call in (("", engine.path_loss), (", with derivatives", engine.path_loss_and_jacobian)):
            call(batch)
            rows.append((name + title, seconds(lambda call=call, batch=batch: call(batch), repeats) / count))
    print(f"\n{'engine':40} {'s per candidate':>16} {'times faster':>14}")
    for name, value in rows:
        print(f"{name:40} {value:16.3g} {again / value:14,.0f}")
    print(f"\nreplay against re-trace: {gap:.5f} dB; {small.paths.num_paths:,} paths left after compressing for "
          f"{compressing:.0f} s, against all paths at {len(points)} fresh candidates: {difference:.4f} dB")  # fmt: skip


if __name__ == "__main__":
    main()
