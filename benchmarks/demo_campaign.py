"""The demo's simulated measurement campaign: trace the true world, simulate the sounder, and write a study's files.

    python benchmarks/demo_campaign.py FOLDER

The channel sounder turns paths into a path loss averaged over noisy snapshots. The paper's sounder sends a PN9 sequence
of 511 chips over 200 MHz and records 100 impulse responses at every position (section III). Here a snapshot is a power
delay profile of 511 taps of 5 ns. Between snapshots, traffic and swaying masts change the phases of the paths, so that
the taps fade. The receiver adds noise.

The true world is more detailed than the calibrated model. Every building has its own concrete and glass, surfaces
scatter diffusely, lamp posts stand along the streets, and the recorded positions have errors of about a metre. A
calibration can therefore at best find the means over the buildings, and residuals remain.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray import trace
from calibray.errors import InputError
from calibray.fields import path_gains
from calibray.paths import Kind, Paths
from calibray.scenarios import demo_study_path
from calibray.scenes import MeshObject, read_scene, write_scene
from calibray.support.output_files import write_bytes
from coastal_district import Building, district, lamp_positions, lamp_posts, scene_objects

SEED: Final = 1
FREQUENCY: Final = 4e9  # [Hz]
ANTENNA_HEIGHT: Final = 4.0  # [m]
POSITION_ERROR: Final = 0.8  # [m], standard deviation of recorded positions, in x and in y
LEVELS: Final = np.linspace(-2.0, 2.0, 8)
"""Permittivities of buildings, in standard deviations from the mean. They are quantized, because two materials for each
of 196 buildings would slow down the ray tracer."""

TRANSMITTERS: Final = ((-381.5, 140.0), (153.5, -330.0))
"""Planned positions of the transmitter, x and y [m]."""

RECEIVERS: Final = (
    ((-380, 185), (-414, 262), (-466, 262), (-313, 261), (-380, 489), (-452, 495), (-483, 497), (-568, 498),
     (-636, 496), (-653, 495), (-686, 497), (-648, 560), (-646, 611), (-646, 624), (-645, 644), (-647, 541),
     (-648, 457), (-647, 403), (-645, 320), (-604, 261), (-536, 260), (-451, 262), (-380, 20), (-450, 26),
     (-645, -123), (155, 184), (153, 202)),
    ((155, -274), (110, -220), (59, -220), (25, -218), (348, 26), (417, 28), (484, 26), (535, 27), (424, -54),
     (423, 65), (299, -457), (10, -458), (-8, -457)),
)  # fmt: skip
"""Planned positions of the receiver for each transmitter, x and y [m]: 27 and 13 as in the paper, with high loss at
positions 10 to 16 and 25 to 27."""


@dataclass(frozen=True)
class Planted:
    """Constants of a material in the true world.

    Attributes:
        relative_permittivity: Mean over the buildings [1].
        spread: Standard deviation between buildings [1].
        conductivity: [S/m].
        thickness: [m].
        scattering_coefficient: Scattering coefficient S [1].
    """

    relative_permittivity: float
    spread: float
    conductivity: float
    thickness: float
    scattering_coefficient: float

    def constants(self, relative_permittivity: float) -> dict[str, float]:
        """The constants by name for a scene file; a building's permittivity may differ from the mean [1]."""
        return {
            "relative_permittivity": relative_permittivity,
            "conductivity": self.conductivity,
            "thickness": self.thickness,
            "scattering_coefficient": self.scattering_coefficient,
        }


PLANTED: Final = {
    "concrete": Planted(5.8, 1.2, 0.1, 0.3, 0.3),
    "glass": Planted(4.65, 0.7, 0.022, 0.022, 0.15),
    "soil": Planted(4.2, 0.0, 0.05, 2.0, 0.2),
    "asphalt": Planted(4.83, 0.0, 0.075, 0.5, 0.1),
    "steel": Planted(1.0, 0.0, 1e7, 0.01, 1.0),  # thin posts scatter in all directions
}
"""The materials of the true world; the means of concrete, glass and soil are close to those of the paper."""


@dataclass(frozen=True)
class World:
    """The true world of a campaign.

    Attributes:
        buildings: The buildings.
        level: Index into `LEVELS` of each building's concrete and glass [buildings, 2].
        permittivity: Relative permittivity of each building's concrete and glass [buildings, 2], [1].
        tx_recorded: Transmitter of every link as recorded [L, 3], [m].
        rx_recorded: Receiver of every link as recorded [L, 3], [m].
        tx: True position of the transmitter of every link [L, 3], [m].
        rx: True position of the receiver of every link [L, 3], [m].
    """

    buildings: tuple[Building, ...]
    level: NDArray[np.int64]
    permittivity: NDArray[np.float64]
    tx_recorded: NDArray[np.float64]
    rx_recorded: NDArray[np.float64]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]

    def scene_objects(self) -> list[MeshObject]:
        """The objects of the true world: buildings joined by level, and the lamp posts."""
        level = {building.name: pair for building, pair in zip(self.buildings, self.level, strict=True)}
        objects = scene_objects(
            self.buildings,
            lambda building: f"concrete_{level[building.name][0]}",
            lambda building: f"glass_{level[building.name][1]}",
        )
        return [*objects, MeshObject("lamp_posts", "steel", lamp_posts())]

    def materials(self) -> dict[str, dict[str, float]]:
        """Constants of the materials of `scene_objects`, by name."""
        constants = {
            name: PLANTED[name].constants(PLANTED[name].relative_permittivity)
            for name in ("soil", "asphalt", "steel")
        }
        for column, name in enumerate(("concrete", "glass")):
            for level, value in zip(self.level[:, column], self.permittivity[:, column], strict=True):
                constants[f"{name}_{level}"] = PLANTED[name].constants(float(value))
        return constants


def world(seed: int = SEED) -> World:
    """Plant a world; the seed changes permittivities and position errors, but not streets and buildings."""
    rng = np.random.Generator(np.random.PCG64([seed, 1]))
    buildings = district()
    level = np.empty((len(buildings), 2), dtype=np.int64)
    permittivity = np.empty((len(buildings), 2))
    for column, planted in enumerate((PLANTED["concrete"], PLANTED["glass"])):
        drawn = rng.standard_normal(len(buildings))
        level[:, column] = np.abs(drawn[:, None] - LEVELS).argmin(axis=1)
        permittivity[:, column] = planted.relative_permittivity + planted.spread * LEVELS[level[:, column]]
    links = [len(receivers) for receivers in RECEIVERS]
    tx = np.repeat([[*position, ANTENNA_HEIGHT] for position in TRANSMITTERS], links, axis=0)
    rx = np.array(
        [[*position, ANTENNA_HEIGHT] for receivers in RECEIVERS for position in receivers], dtype=float
    )
    rx[:, :2] = np.round(
        rx[:, :2] + rng.uniform(-0.5, 0.5, (len(rx), 2)), 2
    )  # real positions are not on whole metres
    tx_error = np.repeat(rng.standard_normal((len(links), 2)), links, axis=0)
    rx_error = rng.standard_normal((len(rx), 2))
    return World(
        buildings=buildings,
        level=level,
        permittivity=np.round(permittivity, 3),
        tx_recorded=tx,
        rx_recorded=rx,
        tx=_true_positions(tx, tx_error),
        rx=_true_positions(rx, rx_error),
    )


def _true_positions(recorded: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.float64]:
    """True positions [L, 3], [m], from recorded ones and standard normal errors in plan [L, 2]."""
    return recorded - np.pad(np.round(POSITION_ERROR * error, 3), [(0, 0), (0, 1)])


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
    """Simulate the sounder on one link: path loss [dB] of the snapshots' mean power, and their standard deviation [dB].

    Between snapshots, specular paths keep their amplitude and change their phase. The many diffuse paths of a tap make
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

EVERY: Final = slice(None)
"""All links."""

MODEL_MATERIALS: Final = {
    "concrete": {"type": "concrete", "thickness": PLANTED["concrete"].thickness},
    "glass": {"type": "glass", "thickness": PLANTED["glass"].thickness},
    "soil": {"relative_permittivity": 2.25, "conductivity": 0.05, "thickness": 2.0},
    "asphalt": {"relative_permittivity": 4.83, "conductivity": 0.075, "thickness": 0.5},
}
"""The materials of the calibrated scene: four for the whole district, without scattering."""


def generate(folder: Path, seed: int = SEED) -> None:
    """Write the scene for the calibration, the study file, the measured links and the truth."""
    truth = world(seed)
    write_model(folder, truth)
    table = links_csv(truth, measure(truth, seed))
    write_bytes(folder / "links.csv", table.encode("ascii"))


def write_model(folder: Path, truth: World) -> None:
    """Write the scene for the calibration, the study file and the truth, which need no tracing."""
    study = demo_study_path().read_bytes()
    write_scene(folder / "scene", scene_objects(truth.buildings), MODEL_MATERIALS)
    write_bytes(folder / "study.toml", study)
    write_bytes(folder / "truth.json", truth_json(truth).encode("ascii"))


def measure(truth: World, seed: int = SEED, links: slice = EVERY) -> NDArray[np.float64]:
    """Path loss of every link and standard deviation of its snapshots [L, 2], [dB], in the true world.

    Specular paths and paths with a diffuse reflection are traced separately: all of the few specular paths are needed,
    but only a sample of the diffuse ones. A subset of `links` has the same values as in the whole campaign.
    """
    ends = replace(truth, tx=truth.tx[links], rx=truth.rx[links])
    with TemporaryDirectory() as folder:
        scene = read_scene(write_scene(Path(folder), truth.scene_objects(), truth.materials()), FREQUENCY)
        specular, mixed = (
            _powers(
                trace(scene, ends, frequency=FREQUENCY, tx_antenna=ANTENNA, rx_antenna=ANTENNA, **settings)
            )
            for settings in (SPECULAR, DIFFUSE)
        )
    link, power, delay, diffuse = np.concatenate([specular, mixed[:, mixed[3] > 0]], axis=1)
    sounded = []
    for place, index in enumerate(range(len(truth.tx))[links]):
        mask = link == place
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
    """The planted truth, which a calibration does not use: materials, buildings, links and lamp posts, as JSON."""
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


if __name__ == "__main__":
    generate(Path(sys.argv[1]))
