"""The simulated measurement campaign: tracing and sounding the true world, and writing the files of a study."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.fields import path_gains
from calibray.paths import Kind, Paths
from calibray.scenarios import demo_study_path
from calibray.scenarios.district import lamp_positions, scene_objects
from calibray.scenarios.sounder import sounded_path_loss
from calibray.scenarios.world import FREQUENCY, PLANTED, SEED, World, world
from calibray.scenes import write_scene
from calibray.support.output_files import write_bytes
from calibray.tracing.default_tracer import trace

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
    """Write the scene to calibrate, the study file, the measured links and the truth.

    Args:
        folder: Folder to write into; created if needed.
        seed: Seed of the world and of the measurement.
    """
    truth = world(seed)
    write_model(folder, truth)
    table = links_csv(truth, measure(truth, seed))
    write_bytes(folder / "links.csv", table.encode("ascii"))


def write_model(folder: Path, truth: World) -> None:
    """Write the scene to calibrate, the study file and the truth, which need no tracing.

    Args:
        folder: Folder to write into; created if needed.
        truth: The world whose buildings the scene contains.
    """
    study = demo_study_path().read_bytes()
    write_scene(folder / "scene", scene_objects(truth.buildings), MODEL_MATERIALS)
    write_bytes(folder / "study.toml", study)
    write_bytes(folder / "truth.json", truth_json(truth).encode("ascii"))


def measure(truth: World, seed: int = SEED) -> NDArray[np.float64]:
    """Measure all links in the true world.

    Specular paths and paths with a diffuse reflection are traced separately: all of the few specular paths are needed,
    but only a sample of the diffuse ones.

    Args:
        truth: The world.
        seed: Seed of fading and noise.

    Returns:
        Path loss of every link and standard deviation of its snapshots [L, 2], [dB].
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
    """The measured links as a table.

    Args:
        truth: The world, whose recorded positions are written.
        path_loss: Path loss of every link and standard deviation of its snapshots [L, 2], [dB].

    Returns:
        Text of the CSV file.
    """
    lines = ["id,tx,rx,tx_x_m,tx_y_m,tx_z_m,rx_x_m,rx_y_m,rx_z_m,path_loss_db,path_loss_std_db"]
    transmitters = list(dict.fromkeys(map(tuple, truth.tx_recorded)))
    for k, (tx, rx, values) in enumerate(
        zip(truth.tx_recorded, truth.rx_recorded, path_loss, strict=True), start=1
    ):
        numbers = ",".join(f"{number:.2f}" for number in (*tx, *rx, *values))
        lines.append(f"{k},TX{transmitters.index(tuple(tx)) + 1},RX{k},{numbers}")
    return "\n".join([*lines, ""])


def truth_json(truth: World) -> str:
    """The planted truth, which a calibration does not know.

    Args:
        truth: The world.

    Returns:
        Text of the JSON file: materials, buildings, links and lamp posts, one per line.
    """
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
