"""The planted truth of the simulated campaign: materials of the district and true positions of the antennas.

The world is richer than the model that is calibrated. Every building has its own concrete and glass, surfaces scatter
diffusely, lamp posts stand along the streets, and the recorded positions have errors of about a metre. A calibration
can therefore find at best the means over the buildings, and residuals remain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.scenarios.district import Building, district, lamp_posts, scene_objects
from calibray.scenes import MeshObject

SEED: Final = 1
FREQUENCY: Final = 4e9  # [Hz]
ANTENNA_HEIGHT: Final = 4.0  # [m]
POSITION_ERROR: Final = 0.8  # [m], standard deviation of recorded positions, in x and in y
LEVELS: Final = np.linspace(-2.0, 2.0, 8)
"""Permittivities of buildings, in standard deviations from the mean. They are quantized, because two materials for each
of 196 buildings would slow the ray tracer down."""

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
        """The constants by name for a scene file; a building may have another permittivity than the mean [1]."""
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
