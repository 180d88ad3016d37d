"""The simulated measurement campaign: tracing and sounding the true world, and writing the files of a study.

The channel sounder turns paths into a path loss averaged over noisy snapshots. The paper's sounder sends a PN9 sequence
of 511 chips over 200 MHz and records 100 impulse responses at every position (section III). Here a snapshot is a power
delay profile of 511 taps of 5 ns. Between snapshots, traffic and swaying masts change the phases of the paths, so that
paths within a tap fade. The receiver adds noise.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fields import path_gains
from calibray.paths import Kind, Paths
from calibray.scenarios import demo_study_path
from calibray.scenarios.district import lamp_positions, scene_objects
from calibray.scenarios.world import FREQUENCY, PLANTED, SEED, World, world
from calibray.scenes import write_scene
from calibray.support.output_files import write_bytes
from calibray.tracing.default_tracer import trace

BANDWIDTH: Final = 200e6  # [Hz]; a chip and a tap last 1 / BANDWIDTH
TAPS: Final = 511
SNAPSHOTS: Final = 100
NOISE_DB: Final = -143.0
"""Noise of a tap as a path gain [dB]: -174 dBm/Hz over 200 MHz, noise figure 5 dB, PN9 gain 27 dB, 1 W."""
THRESHOLD: Final = 2.0
"""Taps with a mean power below this multiple of the noise count as empty [1]."""


def sounded_path_loss(
    power: NDArray[np.float64],
    delay: NDArray[np.float64],
    is_diffuse: NDArray[np.bool_],
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Sound one link: path loss [dB] of the mean power of the snapshots, and their standard deviation [dB].

    Specular paths keep their amplitude and change their phase between snapshots. The many diffuse paths of a tap make
    its field complex Gaussian. The noise is subtracted; the standard deviation is (10 / ln 10) std / mean.

    Raises:
        InputError: There is no path, or no tap exceeds the noise.
    """
    noise = 10.0 ** (NOISE_DB / 10.0)
    if not len(power):
        raise InputError("no path reaches the receiver; move it")
    tap = np.floor((delay - delay.min()) * BANDWIDTH).astype(np.int64) % TAPS
    diffuse = np.bincount(tap[is_diffuse], power[is_diffuse], TAPS)
    normal = rng.standard_normal((2, SNAPSHOTS, TAPS))
    field = np.sqrt((diffuse + noise) / 2.0) * (normal[0] + 1j * normal[1])
    # Sorted by delay, so that the result does not depend on the order in which paths were found.
    specular = np.flatnonzero(~is_diffuse)
    specular = specular[np.argsort(delay[specular], kind="stable")]
    phase = rng.uniform(0.0, 2.0 * np.pi, (SNAPSHOTS, len(specular)))
    rays = np.sqrt(power[specular]) * np.exp(1j * phase)
    # Unbuffered, since several paths can fall into one tap.
    np.add.at(field.T, tap[specular], rays.T)
    profile = np.abs(field) ** 2
    occupied = profile.mean(axis=0) > THRESHOLD * noise
    received = profile[:, occupied].sum(axis=1) - noise * occupied.sum()
    mean = received.mean()
    if not mean > 0.0:
        raise InputError(
            f"no tap exceeds {THRESHOLD:g} times the noise of {NOISE_DB:g} dB; move the receiver"
        )
    return float(-10.0 * np.log10(mean)), float(10.0 / np.log(10.0) * received.std(ddof=1) / mean)


ANTENNA: Final = {"pattern": "dipole", "polarization": "V"}
SPECULAR: Final[dict[str, Any]] = {"max_depth": 4, "samples": 500_000}
DIFFUSE: Final[dict[str, Any]] = {"max_depth": 3, "samples": 300_000, "diffuse_reflection": True}

MODEL_MATERIALS: Final = {
    "concrete": {"type": "concrete", "thickness": PLANTED["concrete"].thickness},
    "glass": {"type": "glass", "thickness": PLANTED["glass"].thickness},
    "soil": {"relative_permittivity": 2.25, "conductivity": 0.05, "thickness": 2.0},
    "asphalt": {"relative_permittivity": 4.83, "conductivity": 0.075, "thickness": 0.5},
}
"""The materials of the scene that is calibrated: four for the whole district, without scattering."""


def generate(folder: Path, seed: int = SEED) -> None:
    """Write the scene to calibrate, the study file, the measured links and the truth."""
    truth = world(seed)
    write_model(folder, truth)
    table = links_csv(truth, measure(truth, seed))
    write_bytes(folder / "links.csv", table.encode("ascii"))


def write_model(folder: Path, truth: World) -> None:
    """Write the scene to calibrate, the study file and the truth, which need no tracing."""
    study = demo_study_path().read_bytes()
    write_scene(folder / "scene", scene_objects(truth.buildings), MODEL_MATERIALS)
    write_bytes(folder / "study.toml", study)
    write_bytes(folder / "truth.json", truth_json(truth).encode("ascii"))


def measure(truth: World, seed: int = SEED) -> NDArray[np.float64]:
    """Path loss of every link and standard deviation of its snapshots [L, 2], [dB], in the true world.

    Specular paths and paths with a diffuse reflection are traced separately: all of the few specular paths are needed,
    but only a sample of the diffuse ones.
    """
    with TemporaryDirectory() as folder:
        scene = write_scene(Path(folder), truth.scene_objects(), truth.materials())
        specular, mixed = (
            _powers(
                trace(scene, truth, frequency=FREQUENCY, tx_antenna=ANTENNA, rx_antenna=ANTENNA, **settings)
            )
            for settings in (SPECULAR, DIFFUSE)
        )
    link, power, delay, diffuse = np.concatenate([specular, mixed[:, mixed[3] > 0]], axis=1)
    sounded = []
    for index in range(len(truth.tx)):
        mask = link == index
        rng = np.random.Generator(np.random.PCG64([seed, 2, index]))
        sounded.append(sounded_path_loss(power[mask], delay[mask], diffuse[mask] > 0, rng))
    return np.array(sounded)


def links_csv(truth: World, path_loss: NDArray[np.float64]) -> str:
    """The measured links [L, 2], [dB], as a CSV text with the positions that the world records."""
    lines = ["id,tx,rx,tx_x_m,tx_y_m,tx_z_m,rx_x_m,rx_y_m,rx_z_m,path_loss_db,path_loss_std_db"]
    transmitters = list(dict.fromkeys(map(tuple, truth.tx_recorded)))
    for k, (tx, rx, values) in enumerate(
        zip(truth.tx_recorded, truth.rx_recorded, path_loss, strict=True), start=1
    ):
        numbers = ",".join(f"{number:.2f}" for number in (*tx, *rx, *values))
        lines.append(f"{k},TX{transmitters.index(tuple(tx)) + 1},RX{k},{numbers}")
    return "\n".join([*lines, ""])


def truth_json(truth: World) -> str:
    """The planted truth, which a calibration does not know: materials, buildings, links and lamp posts, as JSON."""
    content = {
        "materials": {
            name: {
                "relative_permittivity_mean": planted.relative_permittivity,
                "relative_permittivity_std": planted.spread,
                "conductivity": planted.conductivity,
                "thickness_m": planted.thickness,
                "scattering_coefficient": planted.scattering_coefficient,
            }
            for name, planted in PLANTED.items()
        },
        "buildings": {
            building.name: {
                "concrete.relative_permittivity": float(concrete),
                "glass.relative_permittivity": float(glass),
                "height_m": building.height,
                "footprint_m": building.footprint.tolist(),
            }
            for building, (concrete, glass) in zip(truth.buildings, truth.permittivity, strict=True)
        },
        "links": {
            str(k): {
                "tx_m": np.round(tx, 3).tolist(),
                "rx_m": np.round(rx, 3).tolist(),
                "tx_error_m": np.round(tx_recorded - tx, 3).tolist(),
                "rx_error_m": np.round(rx_recorded - rx, 3).tolist(),
            }
            for k, (tx, rx, tx_recorded, rx_recorded) in enumerate(
                zip(truth.tx, truth.rx, truth.tx_recorded, truth.rx_recorded, strict=True), start=1
            )
        },
        "lamp_posts_m": {str(k): position.tolist() for k, position in enumerate(lamp_positions(), start=1)},
    }
    return "{\n" + ",\n".join(f"{json.dumps(key)}: {_table(rows)}" for key, rows in content.items()) + "\n}\n"


def _table(rows: dict[str, object]) -> str:
    return "{\n" + ",\n".join(f" {json.dumps(key)}: {json.dumps(row)}" for key, row in rows.items()) + "\n}"


def _powers(paths: Paths) -> NDArray[np.float64]:
    """Link, power gain [1], delay [s] and number of diffuse reflections of every path [4, P]."""
    owner = np.repeat(np.arange(paths.num_paths), np.diff(paths.first))
    diffuse = np.bincount(owner, paths.kind == Kind.DIFFUSE, paths.num_paths).astype(np.float64)
    return np.stack([paths.link.astype(np.float64), np.abs(path_gains(paths)) ** 2, paths.delay, diffuse])
