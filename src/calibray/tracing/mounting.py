"""Antennas that are mounted in their own direction on every link, applied to paths of isotropic antennas.

Where paths lead does not depend on the antennas. Paths traced with isotropic vertical antennas hold the frame of their
first and last interaction, so that any pattern in any direction gives their fields without a new trace.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.paths import Paths
from calibray.tracing.antennas import SLANTS, AntennaPattern, rotation_matrix
from calibray.tracing.settings import Antenna


class Pose(NamedTuple):
    """Where antennas point, of P paths or L links.

    Attributes:
        yaw: Rotation about z [rad], from the scene's x axis towards its y axis.
        downtilt: Mechanical downtilt [rad]: the antenna leans forward after it was turned by `yaw`.
        electrical_downtilt: Shift of the pattern downwards in the antenna's own frame [rad].
    """

    yaw: Any
    downtilt: Any
    electrical_downtilt: Any


@dataclass(frozen=True, eq=False)
class Mounting:
    """The antennas at one end of L links.

    Attributes:
        antennas: The different antennas; each orientation is that of the antenna in its mount.
        index: Antenna of every link [L].
        pose: Where they point [L].

    Raises:
        InputError: The antennas differ in their number of ports.
    """

    antennas: tuple[Antenna, ...]
    index: NDArray[np.int64]
    pose: Pose

    def __post_init__(self) -> None:
        ports = {antenna.ports: antenna for antenna in self.antennas}
        if len(ports) > 1:
            names = " and ".join(f"{antenna.polarization!r}" for antenna in ports.values())
            raise InputError(
                f"antennas: polarizations {names} have different numbers of ports at one end; give all antennas of an "
                "end one port, or two"
            )

    def of_paths(self, link: NDArray[np.integer]) -> Mounting:
        """The mounting of paths whose links are given [P]."""
        return Mounting(self.antennas, self.index[link], Pose(*(angle[link] for angle in self.pose)))


def mount(paths: Paths, mountings: Mapping[str, Mounting]) -> Paths:
    """Give paths of isotropic vertical antennas the fields of the antennas that are mounted at "tx" or "rx".

    Ends without a mounting keep their fields.
    """
    fields = {}
    for end, mounting in mountings.items():
        on_paths = mounting.of_paths(paths.link)
        angles = paths.departure if end == "tx" else paths.arrival
        jones = np.zeros((paths.num_paths, mounting.antennas[0].ports, 2))
        for number, antenna in enumerate(mounting.antennas):
            chosen = on_paths.index == number
            pose = Pose(*(angle[chosen] for angle in on_paths.pose))
            jones[chosen] = jones_vectors(AntennaPattern.of(antenna), angles[chosen], pose)
        axis = getattr(paths, f"{end}_field").real[:, 0]
        fields[f"{end}_field"] = in_frame(jones, axis, arriving=end == "rx").astype(complex)
    return replace(paths, **fields)


def jones_vectors(pattern: AntennaPattern, angles: Any, pose: Pose, xp: Any = np) -> Any:
    """Jones vectors [P, ports, 2] in the basis (theta, phi) of directions seen from the antenna.

    Directions are zenith and azimuth [P, 2], [rad]; the pose is that of every path. `xp` is the array library: NumPy,
    or `jax.numpy` within a JAX function, which then has derivatives by the pose.
    """
    zenith, azimuth = angles[:, 0], angles[:, 1] - pose.yaw
    sin_z, cos_z, sin_a, cos_a = xp.sin(zenith), xp.cos(zenith), xp.sin(azimuth), xp.cos(azimuth)
    zero = xp.zeros_like(sin_z)
    # The direction and its basis vectors theta and phi [3, P, 3] in the antenna's frame (3GPP TR 38.901, eq. 7.1-15).
    vectors = xp.stack(
        [
            xp.stack([sin_z * cos_a, sin_z * sin_a, cos_z], axis=-1),
            xp.stack([cos_z * cos_a, cos_z * sin_a, -sin_z], axis=-1),
            xp.stack([-sin_a, cos_a, zero], axis=-1),
        ]
    )
    cos_t, sin_t = xp.cos(pose.downtilt), xp.sin(pose.downtilt)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    vectors = xp.stack([x * cos_t - z * sin_t, y, x * sin_t + z * cos_t], axis=-1)
    vectors = vectors @ xp.asarray(rotation_matrix(pattern.antenna.orientation))
    local, theta, phi = vectors
    # A direction along the antenna's own axis has no azimuth; any will do.
    rho_squared = local[:, 0] ** 2 + local[:, 1] ** 2
    axial = rho_squared < 1e-20
    east, rho = xp.where(axial, 1.0, local[:, 0]), xp.sqrt(xp.where(axial, 1.0, rho_squared))
    north = xp.where(axial, 0.0, local[:, 1])
    own_zenith = xp.arctan2(xp.where(axial, 0.0, rho), local[:, 2])
    shifted = xp.clip(own_zenith - pose.electrical_downtilt, 0.0, np.pi)
    amplitude = pattern.amplitude(shifted, xp.arctan2(north, east), xp)
    cos_own, sin_own = east / rho, north / rho
    own_theta = xp.stack([local[:, 2] * cos_own, local[:, 2] * sin_own, -xp.where(axial, 0.0, rho)], axis=-1)
    # The own basis is the one of the path turned about the direction.
    cosine, sine = xp.sum(theta * own_theta, axis=-1), xp.sum(phi * own_theta, axis=-1)
    ports = []
    for slant in SLANTS[pattern.antenna.polarization]:
        a, b = np.cos(slant), np.sin(slant)
        ports.append(xp.stack([a * cosine - b * sine, a * sine + b * cosine], axis=-1))
    return amplitude[:, None, None] * xp.stack(ports, axis=1)


def in_frame(jones: Any, axis: Any, arriving: bool, xp: Any = np) -> Any:
    """Jones vectors [P, ports, 2] in the frame of the interaction next to the antenna.

    `axis` is the unit theta vector in that frame [P, 2]: the field of an isotropic vertical antenna. An arriving wave
    travels against its direction, so that its phi axis is mirrored.
    """
    sign = -1.0 if arriving else 1.0
    phi = sign * xp.stack([-axis[:, 1], axis[:, 0]], axis=-1)
    return jones[..., :1] * axis[:, None] + jones[..., 1:] * phi[:, None]
