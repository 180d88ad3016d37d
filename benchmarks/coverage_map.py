"""Cost of a coverage map compared with a trace of as many receivers, and how Sionna's radio map solver differs from it.

    python benchmarks/coverage_map.py [--cells 64 | --whole] [--samples auto] [--solver]

The map has cells of 5 m around one transmitter of the demo district, with the values planted in its world. The time of
the map is compared with that of the same trace alone, both without the cache and after a first run that compiles. With
--solver, Sionna's radio map of the same cells is compared with the map. The radio map counts the rays that cross a
cell, so it averages over the cell and is noisy; the map is a sum of paths to the centre of the cell.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import calibray as cb
from calibray.prediction.coverage_map import CoverageMap
from calibray.prediction.predict import as_links

TX = (-381.5, 140.0, 4.0)
CELL = 5.0


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument(
        "--samples",
        type=lambda text: text if text == "auto" else int(text),
        default=50_000,
        help='rays, or "auto"',
    )
    parser.add_argument("--whole", action="store_true", help="map all cells of the district")
    parser.add_argument("--solver", action="store_true")
    given = parser.parse_args()
    os.environ["CALIBRAY_CACHE"] = ""
    result = _result(given.samples)
    half = CELL * round(np.sqrt(given.cells)) / 2
    bounds = None if given.whole else (TX[0] - half, TX[1] - half, TX[0] + half, TX[1] + half)

    def mapped() -> CoverageMap:
        return cb.coverage_map(result, TX, cell=CELL, bounds=bounds)

    coverage = mapped()
    rows = coverage.table().rename(columns={"x_m": "rx_x", "y_m": "rx_y", "z_m": "rx_z"})
    rows = rows[np.isfinite(rows.rx_x)].assign(**dict(zip(("tx_x", "tx_y", "tx_z"), TX, strict=True)))
    setup = cb.Setup.open(result.study, links=as_links(result, rows))
    whole, trace = _seconds(mapped), _seconds(lambda: setup.at(setup.links).trace(result.materials))
    known = np.isfinite(coverage.path_loss_db)
    print(f"{known.size} cells, {known.sum()} with a path, {given.samples} samples")
    print(f"map {whole:.2f} s of CPU, trace of as many receivers {trace:.2f} s: ratio {whole / trace:.2f}")
    again = np.asarray(result.predict(rows)).reshape(known.shape)
    print(f"largest difference to predict {np.abs(again[known] - coverage.path_loss_db[known]).max():.4f} dB")
    if given.solver:
        _solver(result, coverage)


def _result(samples: int | str) -> cb.Result:
    """A quick calibration of the district, as `auto` finds it."""
    from calibray.scenarios import demo_study_path

    content = cb.Study.load(demo_study_path()).content()
    content["trace"]["samples"] = samples
    # A radio map has no receive antenna.
    content["antennas"]["rx"] = {"pattern": "iso", "polarization": "V"}
    content["method"] = {"name": "auto", "seed": 0, "options": {"starts": 16}}
    return cb.calibrate(cb.Study.from_content(content, demo_study_path()))


def _seconds(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


def _solver(result: cb.Result, coverage: CoverageMap) -> None:
    """Sionna's radio map over the same cells, with the exported scene."""
    import mitsuba as mi
    import sionna.rt as rt

    from calibray.reporting.export import export

    with tempfile.TemporaryDirectory() as folder:
        export(result, folder)
        scene = rt.load_scene(str(Path(folder) / "scene.xml"))
    scene.frequency = result.study.scene.frequency
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="dipole", polarization="V"
    )
    scene.add(rt.Transmitter("tx", mi.Point3f(*TX)))
    middle = [float((axis[0] + axis[-1]) / 2) for axis in (coverage.x, coverage.y)]
    size = [coverage.cell * len(axis) for axis in (coverage.x, coverage.y)]
    for samples in (1_000_000, 10_000_000):
        radio = rt.RadioMapSolver()(
            scene, center=mi.Point3f(*middle, float(coverage.z.mean())), orientation=mi.Point3f(0, 0, 0),
            size=mi.Point2f(*size), cell_size=mi.Point2f(coverage.cell, coverage.cell), samples_per_tx=samples,
            max_depth=result.study.trace.max_depth, refraction=False, diffraction=False,
        )  # fmt: skip
        with np.errstate(divide="ignore"):
            loss = -10 * np.log10(np.array(radio.path_gain)[0])
        both = np.isfinite(loss) & np.isfinite(coverage.path_loss_db)
        off = loss[both] - coverage.path_loss_db[both]
        half, most, worst = np.quantile(np.abs(off), [0.5, 0.9, 1.0])
        print(
            f"radio map, {samples:.0e} rays: {both.sum()} cells in both; difference to the sum of paths: "
            f"mean {off.mean():+.2f}, half within {half:.2f}, 90 % within {most:.2f}, all within "
            f"{worst:.2f} dB; {(np.abs(off) <= 0.05).mean():.0%} within 0.05 dB"
        )


if __name__ == "__main__":
    main()
