"""Load the calibrated scene in plain Sionna RT, and compare its path loss with the reported one, link by link.

Usage: python load_scene.py [ROW ...]

ROW is the row of a link in the measured table; without any, all links are computed, one receiver at a time. Needs
Sionna RT and the other files of this folder; Calibray is not needed.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import sionna.rt as rt
from sionna.rt.radio_materials import scattering_pattern_registry

FOLDER = Path(__file__).resolve().parent
CALIBRATION = json.loads((FOLDER / "calibration.json").read_text(encoding="utf-8"))


def load() -> rt.Scene:
    """The calibrated scene at its carrier, with the antennas of the calibration."""
    scene = rt.load_scene(str(FOLDER / "scene.xml"))
    scene.frequency = CALIBRATION["frequency_hz"]
    for name, pattern in CALIBRATION["scattering_patterns"].items():
        # Scene files can only contain the Lambertian pattern.
        scene.radio_materials[name].scattering_pattern = scattering_pattern_registry.get(pattern.pop("name"))(
            **pattern
        )
    for end in ("tx", "rx"):
        antenna = CALIBRATION["antennas"][end]
        if antenna["pattern"].lower().endswith(".csv"):
            sys.exit(
                f"The gain of the {end} antenna is a table ({antenna['pattern']}): register it as a pattern first."
            )
        array = rt.PlanarArray(
            num_rows=1, num_cols=1, pattern=antenna["pattern"], polarization=antenna["polarization"]
        )
        setattr(scene, f"{end}_array", array)
    return scene


def path_loss(scene: rt.Scene, tx: list[float], rx: list[float]) -> float:
    """Path loss [dB] between two points [m], without offset; infinite without a path."""
    for name in list(scene.transmitters) + list(scene.receivers):
        scene.remove(name)
    antennas = CALIBRATION["antennas"]
    scene.add(rt.Transmitter("tx", tx, orientation=antennas["tx"]["orientation"]))
    scene.add(rt.Receiver("rx", rx, orientation=antennas["rx"]["orientation"]))
    paths = rt.PathSolver()(scene, **CALIBRATION["solver"])
    gain = (paths.a[0].numpy() + 1j * paths.a[1].numpy())[0, :, 0]
    power = received(gain, np.reshape(paths.tau.numpy(), -1)[: gain.shape[-1]])
    return float(-10 * np.log10(power)) if power > 0 else float("inf")


def received(gain: np.ndarray, delay: np.ndarray) -> float:
    """Power gain of path gains [receive ports, transmit ports, paths] with delays [s], combined as in the study."""
    if CALIBRATION["combining"] == "power" or not len(delay):
        return float((np.abs(gain) ** 2).sum() / gain.shape[1])
    offset, weight = np.zeros(1), np.ones(1)
    if CALIBRATION["combining"] == "band":
        band = CALIBRATION["bandwidth_hz"]
        node, weight = np.polynomial.legendre.leggauss(int(np.pi * band * np.ptp(delay)) + 12)
        offset, weight = node * band / 2, weight / 2
    phase = np.exp(-2j * np.pi * delay[:, None] * (CALIBRATION["frequency_hz"] + offset))
    return float((np.abs(gain @ phase) ** 2 * weight).sum() / gain.shape[1])


def main() -> None:
    """Print the reported and the computed path loss of links, and the largest difference."""
    with (FOLDER / "links.csv").open(encoding="utf-8", newline="") as file:
        links = list(csv.DictReader(file))
    wanted = set(sys.argv[1:])
    scene, largest = load(), 0.0
    print("row,reported_db,computed_db")
    for link in links:
        if wanted and link["row"] not in wanted:
            continue
        if float(link.get("frequency") or CALIBRATION["frequency_hz"]) != CALIBRATION["frequency_hz"]:
            print(f"{link['row']}: left out, since its carrier is not that of the scene", file=sys.stderr)
            continue
        tx, rx = ([float(link[f"{end}_{axis}"]) for axis in "xyz"] for end in ("tx", "rx"))
        # The nuisance is what the predictions add to the scene's path loss (calibration.json).
        computed, reported = path_loss(scene, tx, rx) + float(link["nuisance_db"]), float(link["reported_db"])
        print(f"{link['row']},{reported:.4f},{computed:.4f}")
        if np.isfinite(reported):
            largest = max(largest, abs(computed - reported))
    print(f"largest difference: {largest:.4f} dB", file=sys.stderr)


if __name__ == "__main__":
    main()
