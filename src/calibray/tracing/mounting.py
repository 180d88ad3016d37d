"""Antennas with their own direction on every link, applied to paths of isotropic antennas.

The paths themselves do not depend on the antennas. Paths traced with isotropic vertical antennas store the frame of
their first and last interaction, so any pattern in any direction gives their fields without a new trace.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.paths import Paths
from calibray.tracing.antennas import SLANTS, AntennaPattern, rotation_matrix
from calibray.tracing.settings import Antenna

POSE: Final = "tx:"
"""Beginning of the names of the parameters of transmit antennas."""
FIELDS: Final = ("azimuth", "downtilt", "gain")
EVERY: Final = "*"
"""Name of the transmitter that represents all of them."""


NEW: Final = "new transmitters"
"""Name of the transmitter that represents those without measured links, in a population."""


def concerned(names: NDArray[np.str_], label: str, own: Collection[str]) -> NDArray[np.bool_]:
    """The transmitters that a parameter of the transmitter `label` affects; `own` have their own one of that field."""
    if label == EVERY:
        return np.ones(len(names), dtype=bool)
    return ~np.isin(names, list(own)) if label == NEW else names == label


def turns(name: str) -> bool:
    """Whether a parameter is the error of an antenna's direction or gain, such as "tx:CELL.azimuth"."""
    return name.startswith(POSE) and name.rpartition(".")[2] in FIELDS


class Pose(NamedTuple):
    """Directions of antennas, of P paths or L links.

    Attributes:
        yaw: Rotation about z [rad], from the scene's x axis towards its y axis.
        downtilt: Mechanical downtilt [rad]: the antenna leans forward after it was rotated by `yaw`.
        electrical_downtilt: Shift of the pattern downwards in the antenna's own frame [rad].
        steering: Direction in the antenna's own frame, from its x axis towards its y axis, to which phases steer the
            beam of an array [rad].
    """

    yaw: Any
    downtilt: Any
    electrical_downtilt: Any
    steering: Any


@dataclass(frozen=True, eq=False)
class Mounting:
    """The antennas at one end of L links.

    Attributes:
        antennas: The different antennas; each orientation is that of the antenna in its mount.
        index: Antenna of every link [L].
        pose: Where they point [L].

    Raises:
        InputError: The antennas have different numbers of ports.
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
        angles = paths.departure if end == "tx" else paths.arrival
        jones = stated_jones(mounting.of_paths(paths.link), angles)
        axis = getattr(paths, f"{end}_field").real[:, 0]
        fields[f"{end}_field"] = in_frame(jones, axis, arriving=end == "rx").astype(complex)
    return replace(paths, **fields)


def theta_axis(paths: Paths, mounting: Mounting) -> NDArray[np.float64]:
    """Theta vector of departing paths in the frame of their first interaction [P, 2], from mounted transmit antennas.

    A path that leaves in a perfect null of its antenna has no theta vector, and gets zeros: it stays without power.
    """
    theta, phi = stated_jones(mounting.of_paths(paths.link), paths.departure)[:, 0].T
    field = paths.tx_field[:, 0].real
    # As complex numbers, the field is the axis times the Jones vector (`in_frame`).
    jones = theta + 1j * phi
    axis = np.where(jones == 0, 0.0, (field[:, 0] + 1j * field[:, 1]) / np.where(jones == 0, 1.0, jones))
    return np.stack([np.real(axis), np.imag(axis)], axis=-1)


def stated_jones(mounting: Mounting, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Jones vectors [P, ports, 2] of mounted antennas, each in one direction: zenith and azimuth [P, 2], [rad]."""
    jones = np.zeros((len(angles), mounting.antennas[0].ports, 2))
    for number, antenna in enumerate(mounting.antennas):
        chosen = mounting.index == number
        pose = Pose(*(angle[chosen] for angle in mounting.pose))
        jones[chosen] = jones_vectors(AntennaPattern.of(antenna), wave_basis(angles[chosen]), pose)
    return jones


def wave_basis(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors of waves in the scene frame [3, 3, P]: direction, theta, phi (3GPP TR 38.901, eq. 7.1-12, 7.1-13).

    Angles are zenith and azimuth of the direction [P, 2], [rad].
    """
    (sin_z, sin_a), (cos_z, cos_a) = np.sin(angles.T), np.cos(angles.T)
    zero = np.zeros_like(sin_z)
    return np.array(
        [[sin_z * cos_a, sin_z * sin_a, cos_z], [cos_z * cos_a, cos_z * sin_a, -sin_z], [-sin_a, cos_a, zero]]
    )


def jones_vectors(pattern: AntennaPattern, basis: Any, pose: Pose) -> NDArray[np.float64]:
    """Jones vectors [P, ports, 2] of waves in their basis (theta, phi), seen from a mounted antenna in a pose [P]."""
    return of_ports(pattern.antenna, *antenna_response(pattern, basis, pose))


def antenna_response(
    pattern: AntennaPattern,
    basis: Any,
    pose: Pose,
    xp: Any = np,
    index: Any = None,
    stored: Callable[[Any], Any] = lambda values: values,
) -> tuple[Any, Any, Any]:
    """The response of a mounted antenna: amplitude, cosine and sine of its theta vector in the waves' basis [P] each.

    The basis is that of `wave_basis`. The pose is that of every path, or with `index` [P] a pose that several paths
    share. `xp` is the array library: NumPy, or a namespace of `jax.numpy` within a JAX function, which has derivatives
    by the pose. `stored` keeps intermediate values from being computed again at each use.
    """
    cos_yaw, sin_yaw = xp.cos(pose.yaw), xp.sin(pose.yaw)
    cos_tilt, sin_tilt = xp.cos(pose.downtilt), xp.sin(pose.downtilt)
    to_mount = rotation_matrix(pattern.antenna.orientation).T
    # From the scene into the mount, R_y(downtilt)' R_z(yaw)', then into the antenna (3GPP TR 38.901, eq. 7.1-4).
    mount = (
        (cos_tilt * cos_yaw, cos_tilt * sin_yaw, -sin_tilt),
        (-sin_yaw, cos_yaw, xp.zeros_like(cos_yaw)),
        (sin_tilt * cos_yaw, sin_tilt * sin_yaw, cos_tilt),
    )
    of_paths = (lambda shared: shared) if index is None else (lambda shared: shared[index])
    # Row of the antenna's frame, axis of the scene.
    rotation = stored(
        [[sum(row[k] * mount[k][axis] for k in range(3)) for axis in range(3)] for row in to_mount]
    )
    rotation = [[of_paths(element) for element in row] for row in rotation]
    (x, y, z), theta, phi = stored(
        [[sum(row[axis] * vector[axis] for axis in range(3)) for row in rotation] for vector in basis]
    )
    # A direction along the antenna's own axis has no azimuth; any will do.
    axial = x**2 + y**2 < 1e-20
    rho = xp.sqrt(xp.where(axial, 1.0, x**2 + y**2))
    cos_own, sin_own = xp.where(axial, 1.0, x / rho), xp.where(axial, 0.0, y / rho)
    sin_zenith = xp.where(axial, 0.0, rho)
    tilt, steering = (of_paths(xp.asarray(angle)) for angle in (pose.electrical_downtilt, pose.steering))
    zenith, azimuth = stored((xp.arctan2(sin_zenith, z), xp.arctan2(sin_own, cos_own)))
    amplitude = pattern.amplitude(zenith, azimuth, tilt, steering, xp)
    # The antenna's own theta vector is that of the path turned about the direction.
    cosine, sine = (
        vector[0] * z * cos_own + vector[1] * z * sin_own - vector[2] * sin_zenith for vector in (theta, phi)
    )
    return amplitude, cosine, sine


def of_ports(antenna: Antenna, amplitude: Any, cosine: Any, sine: Any, xp: Any = np) -> Any:
    """Jones vectors [P, ports, 2] of an antenna's ports, whose slant turns the theta vector of `antenna_response`."""
    ports = []
    for slant in SLANTS[antenna.polarization]:
        a, b = np.cos(slant), np.sin(slant)
        ports.append(xp.stack([a * cosine - b * sine, a * sine + b * cosine], axis=-1))
    return amplitude[:, None, None] * xp.stack(ports, axis=1)


def in_frame(jones: Any, axis: Any, arriving: bool, xp: Any = np) -> Any:
    """Jones vectors [P, ports, 2] in the frame of the interaction next to the antenna.

    `axis` is the unit theta vector in that frame [P, 2]: the field of an isotropic vertical antenna. An arriving wave
    travels against its direction, so its phi axis is mirrored.
    """
    sign = -1.0 if arriving else 1.0
    phi = sign * xp.stack([-axis[:, 1], axis[:, 0]], axis=-1)
    return jones[..., :1] * axis[:, None] + jones[..., 1:] * phi[:, None]
