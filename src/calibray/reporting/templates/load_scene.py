"""Load the calibrated scene in Sionna RT without Calibray, and compare its path loss with the reported path loss.

Usage: python load_scene.py [ROW ...]

ROW is the row number of a link in the measured table; if no rows are given, all links are computed. This script
requires Sionna RT and the other files of this folder, but not Calibray.
"""

from __future__ import annotations

import csv
import json
import sys
import time
from pathlib import Path

import numpy as np
import sionna.rt as rt
from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator
from sionna.rt.radio_materials import scattering_pattern_registry

# The solver detects repeated paths by their hashes; paths whose hashes collide in its table of a million entries are
# lost.
SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = 67_108_859

FOLDER = Path(__file__).resolve().parent
LANES = 20_000_000  # rays x interactions x receivers of one call, which take about 800 MB
CLOSE_DB = 0.02  # links that differ by more are computed again one at a time
MOST_RECEIVERS = 16  # per call, since they share the solver's buffer of a million paths
CALIBRATION = json.loads((FOLDER / "calibration.json").read_text(encoding="utf-8"))


def load() -> rt.Scene:
    """Load the calibrated scene at its carrier frequency, with the antennas used in the calibration."""
    scene = rt.load_scene(str(FOLDER / "scene.xml"))
    scene.frequency = CALIBRATION["frequency_hz"]
    for name, pattern in CALIBRATION["scattering_patterns"].items():
        # Scene files can state only the Lambertian scattering pattern.
        scene.radio_materials[name].scattering_pattern = scattering_pattern_registry.get(pattern.pop("name"))(
            **pattern
        )
    for end in ("tx", "rx"):
        antenna = CALIBRATION["antennas"][end]
        if "." in antenna["pattern"]:  # a file; Sionna RT's own names have no dot
            sys.exit(
                f"The gain of the {end} antenna is a table ({antenna['pattern']}): register it as a pattern first."
            )
        if antenna["rows"] * antenna["columns"] > 1:
            sys.exit(f"The {end} antenna is an array with one feed: register its pattern first.")
        array = rt.PlanarArray(
            num_rows=1, num_cols=1, pattern=antenna["pattern"], polarization=antenna["polarization"]
        )
        setattr(scene, f"{end}_array", array)
    return scene


def path_losses(scene: rt.Scene, tx: list[float], receivers: list[list[float]]) -> list[float]:
    """Path loss [dB] from one position to several positions [m], without offset; infinite if there is no path."""
    for name in list(scene.transmitters) + list(scene.receivers):
        scene.remove(name)
    antennas = CALIBRATION["antennas"]
    scene.add(rt.Transmitter("tx", tx, orientation=antennas["tx"]["orientation"]))
    for number, rx in enumerate(receivers):
        scene.add(rt.Receiver(f"rx-{number}", rx, orientation=antennas["rx"]["orientation"]))
    paths = rt.PathSolver()(scene, **CALIBRATION["solver"])
    gains = (paths.a[0].numpy() + 1j * paths.a[1].numpy())[:, :, 0]
    delays = paths.tau.numpy().reshape(len(receivers), -1)
    powers = [
        received(gain[..., delay >= 0], delay[delay >= 0]) for gain, delay in zip(gains, delays, strict=True)
    ]
    return [float(-10 * np.log10(power)) if power > 0 else float("inf") for power in powers]


def received(gain: np.ndarray, delay: np.ndarray) -> float:
    """Combine path gains [receive ports, transmit ports, paths] with delays [s] to a power gain, as in the study."""
    if CALIBRATION["combining"] == "power" or not len(delay):
        return float((np.abs(gain) ** 2).sum() / gain.shape[1])
    offset, weight = np.zeros(1), np.ones(1)
    if CALIBRATION["combining"] == "band":
        band = CALIBRATION["bandwidth_hz"]
        node, weight = np.polynomial.legendre.leggauss(int(np.pi * band * np.ptp(delay)) + 12)
        offset, weight = node * band / 2, weight / 2
    phase = np.exp(-2j * np.pi * delay[:, None] * (CALIBRATION["frequency_hz"] + offset))
    return float((np.abs(gain @ phase) ** 2 * weight).sum() / gain.shape[1])


def batches(links: list[dict[str, str]]) -> list[list[dict[str, str]]]:
    """Divide links into batches with the same transmitter; each batch takes one call of the solver."""
    solver = CALIBRATION["solver"]
    lanes = solver["samples_per_src"] * max(solver["max_depth"], 1)
    # Diffuse paths of one receiver can fill the solver's buffer.
    size = 1 if solver["diffuse_reflection"] else min(max(LANES // lanes, 1), MOST_RECEIVERS)
    by_tx: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for link in links:
        by_tx.setdefault(tuple(link[f"tx_{axis}"] for axis in "xyz"), []).append(link)
    return [group[k : k + size] for group in by_tx.values() for k in range(0, len(group), size)]


def main() -> None:
    """Print the reported and the computed path loss of the links, and the largest difference between the two."""
    if CALIBRATION.get("mounted"):
        sys.exit(
            "Antennas differ between the links of this study, so this script can load the scene but cannot compute "
            "path loss for comparison."
        )
    with (FOLDER / "links.csv").open(encoding="utf-8", newline="") as file:
        links = list(csv.DictReader(file))
    wanted = set(sys.argv[1:])
    if absent := wanted - {link["row"] for link in links}:
        sys.exit(f"links.csv has no row {', '.join(sorted(absent))}: use values of the column 'row'")
    links = [link for link in links if not wanted or link["row"] in wanted]
    carrier = CALIBRATION["frequency_hz"]
    for link in [link for link in links if float(link.get("frequency") or carrier) != carrier]:
        print(
            f"row {link['row']}: left out, because the carrier of this link is not that of the scene",
            file=sys.stderr,
        )
        links.remove(link)
    parts = batches(links)
    print(f"links: {len(links)}, calls of the solver: {len(parts)}", file=sys.stderr)
    scene, largest, done, started = load(), 0.0, 0, time.monotonic()
    print("row,reported_db,computed_db")
    for part in parts:
        tx, *receivers = (
            [float(link[f"{end}_{axis}"]) for axis in "xyz"]
            for end, link in [("tx", part[0]), *(("rx", link) for link in part)]
        )
        for link, rx, scene_db in zip(part, receivers, path_losses(scene, tx, receivers), strict=True):
            # Predictions add the nuisance to the scene's path loss (see calibration.json).
            nuisance, reported = float(link["nuisance_db"]), float(link["reported_db"])
            computed = scene_db + nuisance
            if len(part) > 1 and np.isfinite(reported) and not abs(computed - reported) < CLOSE_DB:
                # The solver detects repeated paths by their hashes. The receivers of a call determine which paths
                # collide and are lost.
                computed = path_losses(scene, tx, [rx])[0] + nuisance
            print(f"{link['row']},{reported:.4f},{computed:.4f}")
            if np.isfinite(reported):
                largest = max(largest, abs(computed - reported))
        done += len(part)
        left = (time.monotonic() - started) * (len(links) / done - 1)
        print(f"{done}/{len(links)} links, about {left:.0f} s left", file=sys.stderr)
    print(f"largest difference: {largest:.4f} dB", file=sys.stderr)


if __name__ == "__main__":
    main()
