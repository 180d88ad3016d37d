"""Antennas: their patterns, their directions on every link, and the Jones vectors of departing and arriving paths.

Patterns and polarizations follow Sionna RT, in closed form and double precision. In every direction of the antenna's
frame, the field has the same slant angle (3GPP TR 38.901, eq. 7.3-4/5), and its amplitude is the square root of the
gain.

The geometry of paths does not depend on the antennas. Paths traced with isotropic, vertically polarized antennas store
the frames of their first and last interactions. The fields for any pattern and orientation therefore follow without
another trace.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import mul
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.paths import Paths
from calibray.paths.chains import rotate, spherical_basis, zenith_azimuth
from calibray.tracing.gain_table import read_gain_table
from calibray.tracing.settings import Antenna

SLANTS: Final = {"V": (0.0,), "H": (np.pi / 2,), "VH": (0.0, np.pi / 2), "cross": (-np.pi / 4, np.pi / 4)}
"""Slant angles of the ports, by polarization [rad]."""
BEAMWIDTH: Final = np.radians(65)
"""Half-power beamwidth of "tr38901" in both planes [rad] (3GPP TR 38.901, Table 7.3-1)."""


class Amplitude(Protocol):
    """Square root of the gain as a function of zenith and azimuth [rad] in the antenna's frame; azimuth in (-pi, pi].

    `xp` is the array library: NumPy, or `jax.numpy` within a JAX function.
    """

    def __call__(self, zenith: Any, azimuth: Any, xp: Any = np) -> Any: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class AntennaPattern:
    """An antenna whose radiated field can be evaluated.

    Attributes:
        antenna: The antenna.
        element: Field amplitude of the antenna, or of one element of an array; 1 in every direction for an isotropic
            antenna.
    """

    antenna: Antenna
    element: Amplitude

    @classmethod
    def of(cls, antenna: Antenna) -> AntennaPattern:
        """Make the pattern of an antenna, and read its gain table if it has one.

        Raises:
            InputError: The gain table cannot be used.
        """
        if antenna.gain_file is None:
            return cls(antenna, _AMPLITUDES[antenna.pattern])
        table = read_gain_table(antenna.gain_file)
        return cls(
            antenna,
            lambda zenith, azimuth, xp=np: xp.power(
                10.0, table.gain(xp.degrees(azimuth), 90 - xp.degrees(zenith), xp) / 20
            ),
        )

    def amplitude(
        self, zenith: Any, azimuth: Any, downtilt: Any = 0.0, steering: Any = 0.0, xp: Any = np
    ) -> Any:
        """Amplitude of the field in a direction, with electrical downtilt and horizontal steering [rad].

        For an array, the phases of the elements steer the beam by both angles. For a single antenna, the downtilt
        shifts the pattern downwards. The phase reference of an array is its centre; the amplitude of an array can be
        negative.
        """
        if not self.antenna.is_array:
            # Zenith angles increase downwards, so the shifted pattern is the given pattern at `zenith - downtilt`.
            return self.element(xp.clip(zenith - downtilt, 0.0, np.pi), azimuth, xp)
        return self.element(zenith, azimuth, xp) * array_factor(
            self.antenna, zenith, azimuth, downtilt, steering, xp
        )

    def jones_vectors(self, direction: NDArray[np.float64], arriving: bool = False) -> NDArray[np.complex128]:
        """Jones vectors [P, ports, 2] in the waves' basis (theta, phi), for directions [P, 3] as seen from the antenna.

        The waves depart in these directions or, if `arriving` is true, arrive from these directions.
        """
        to_world = rotation_matrix(self.antenna.orientation)
        local = direction @ to_world
        zenith, azimuth = np.moveaxis(zenith_azimuth(local), -1, 0)
        slant = np.array(SLANTS[self.antenna.polarization])
        # Components along the antenna's own theta and phi (3GPP TR 38.901, eq. 7.3-4/5).
        polarization = np.stack([np.cos(slant), np.sin(slant)], axis=-1)
        field = self.amplitude(zenith, azimuth)[:, None, None] * polarization
        antenna_basis = spherical_basis(local, pole_reference=False) @ to_world.T
        wave = rotate_jones(field, rotate(direction, antenna_basis, spherical_basis(direction)))
        # An arriving wave travels opposite to `direction`, so its phi axis is reversed.
        return (wave * [1, -1] if arriving else wave).astype(complex)


def iso(zenith: Any, azimuth: Any, xp: Any = np) -> Any:
    """Amplitude of an isotropic antenna; see `Amplitude`."""
    return xp.ones(zenith.shape)


def dipole(zenith: Any, azimuth: Any, xp: Any = np) -> Any:
    """Amplitude of a short dipole (Balanis, Antenna Theory, eq. 4-26a); see `Amplitude`."""
    return np.sqrt(1.5) * xp.abs(xp.sin(zenith))


def hw_dipole(zenith: Any, azimuth: Any, xp: Any = np) -> Any:
    """Amplitude of a half-wave dipole (Balanis, Antenna Theory, eq. 4-84); see `Amplitude`."""
    sine = xp.sin(zenith)
    # cos(pi/2 cos z) / sin z tends to 0 at the poles.
    return np.sqrt(1.643) * xp.abs(xp.cos(np.pi / 2 * xp.cos(zenith)) / xp.where(sine > 1e-5, sine, 1.0))


def tr38901(zenith: Any, azimuth: Any, xp: Any = np) -> Any:
    """Amplitude of a base station's antenna element (3GPP TR 38.901, Table 7.3-1); see `Amplitude`."""
    # In both cuts, the loss is 12 dB at one beamwidth from the main direction and at most 30 dB; the gain is 8 dBi.
    vertical_loss_db = xp.minimum(12 * ((zenith - np.pi / 2) / BEAMWIDTH) ** 2, 30)
    horizontal_loss_db = xp.minimum(12 * (azimuth / BEAMWIDTH) ** 2, 30)
    return xp.power(10.0, (8 - xp.minimum(vertical_loss_db + horizontal_loss_db, 30)) / 20)


def array_factor(
    antenna: Antenna, zenith: Any, azimuth: Any, downtilt: Any = 0.0, steering: Any = 0.0, xp: Any = np
) -> Any:
    """Field of a planar array of isotropic, equally excited elements with the total power of one antenna.

    The array's main direction is `downtilt` below the horizon and `steering` from the x axis towards the y axis [rad].
    `xp` provides the cosine and the sine. Mutual coupling between the elements is neglected, as in Sionna RT and 3GPP
    TR 38.901, section 7.3.
    """
    horizontal, vertical = (2 * np.pi * distance for distance in antenna.spacing)
    # Phase difference of neighbours: 2 pi d / lambda times the direction cosine along y or z minus its value in the
    # main direction.
    of_columns = horizontal * (xp.sin(zenith) * xp.sin(azimuth) - xp.cos(downtilt) * xp.sin(steering))
    of_rows = vertical * (xp.cos(zenith) + xp.sin(downtilt))
    factors = [
        _sum_of_cosines(count, phase, xp) / np.sqrt(count)
        for count, phase in ((antenna.columns, of_columns), (antenna.rows, of_rows))
        if count > 1
    ]
    return reduce(mul, factors)


def _sum_of_cosines(count: int, phase: Any, xp: Any) -> Any:
    """Sum of cos((k - (n - 1) / 2) phase) over k = 0 .. n - 1: field of a row of antennas, referred to its centre."""
    half = xp.cos(phase / 2)
    double = 2 * (2 * half * half - 1)
    # cos((m + 1) x) = 2 cos x cos(m x) - cos((m - 1) x), from m = 0, or from m = 1/2 if `count` is even.
    before, value = (half, half) if count % 2 == 0 else (double / 2, 1.0)
    total = 2 * value if count % 2 == 0 else value
    for _ in range((count - 1) // 2):
        before, value = value, double * value - before
        total = total + 2 * value
    return total


_AMPLITUDES: Final[dict[str, Amplitude]] = {
    "iso": iso,
    "dipole": dipole,
    "hw_dipole": hw_dipole,
    "tr38901": tr38901,
}


def rotation_matrix(orientation: tuple[float, float, float]) -> NDArray[np.float64]:
    """Rotation matrix [3, 3] from an antenna's frame to the scene frame (3GPP TR 38.901, eq. 7.1-4)."""
    (cos_z, cos_y, cos_x), (sin_z, sin_y, sin_x) = np.cos(orientation), np.sin(orientation)
    about_z = np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]])
    about_y = np.array([[cos_y, 0, sin_y], [0, 1, 0], [-sin_y, 0, cos_y]])
    about_x = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    return about_z @ about_y @ about_x


def rotate_jones(field: NDArray, rotation: NDArray[np.float64]) -> NDArray:
    """Express Jones vectors [P, ports, 2] in a rotated frame; `rotation` is the (cos, sin) of each angle [P, 2]."""
    cos, sin = rotation[:, None, 0], rotation[:, None, 1]
    return np.stack(
        [cos * field[..., 0] + sin * field[..., 1], cos * field[..., 1] - sin * field[..., 0]], axis=-1
    )


POSE: Final = "tx:"
"""Prefix of the parameter names of transmit antennas."""
FIELDS: Final = ("azimuth", "downtilt", "gain")
EVERY: Final = "*"
"""Name that represents all transmitters."""


NEW: Final = "new transmitters"
"""Name that represents, in a population, all transmitters without measured links."""


def concerned(names: NDArray[np.str_], label: str, own: Collection[str]) -> NDArray[np.bool_]:
    """Mask of the transmitters that a parameter with this label affects; those in `own` have separate parameters."""
    if label == EVERY:
        return np.ones(len(names), dtype=bool)
    return ~np.isin(names, list(own)) if label == NEW else names == label


def turns(name: str) -> bool:
    """Whether a parameter, such as "tx:CELL.azimuth", is the error of an antenna's direction or gain."""
    return name.startswith(POSE) and name.rpartition(".")[2] in FIELDS


class Pose(NamedTuple):
    """Pointing directions of the antennas of P paths or L links.

    Attributes:
        yaw: Rotation about z [rad], from the scene's x axis towards its y axis.
        downtilt: Mechanical downtilt [rad]: the antenna is tilted forward after its rotation by `yaw`.
        electrical_downtilt: Downward shift of the pattern in the antenna's own frame [rad].
        steering: Azimuth to which the phases of an array steer its beam [rad], measured in the antenna's own frame from
            the x axis towards the y axis.
    """

    yaw: Any
    downtilt: Any
    electrical_downtilt: Any
    steering: Any


@dataclass(frozen=True, eq=False)
class Mounting:
    """The antennas at one end of L links.

    Attributes:
        antennas: The distinct antennas; the orientation of each is relative to the mount.
        index: Index of the antenna of every link [L].
        pose: Directions of the antennas [L].

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
                "end one port each, or two each"
            )

    def of_paths(self, link: NDArray[np.integer]) -> Mounting:
        """Expand the mounting from links to paths, given the link of each path [P]."""
        return Mounting(self.antennas, self.index[link], Pose(*(angle[link] for angle in self.pose)))


def mount(paths: Paths, mountings: Mapping[str, Mounting]) -> Paths:
    """In the fields of paths, replace the isotropic antennas of the trace with the antennas mounted at "tx" or "rx".

    The fields at ends without a mounting are unchanged.
    """
    fields = {}
    for end, mounting in mountings.items():
        angles = paths.departure if end == "tx" else paths.arrival
        jones = stated_jones(mounting.of_paths(paths.link), angles)
        # The stored field of an isotropic, vertically polarized antenna is the theta vector of the path.
        axis = getattr(paths, f"{end}_field").real[:, 0]
        fields[f"{end}_field"] = in_frame(jones, axis, arriving=end == "rx").astype(complex)
    return replace(paths, **fields)


def theta_axis(paths: Paths, mounting: Mounting) -> NDArray[np.float64]:
    """Theta vectors [P, 2] of departing paths in the frames of their first interactions, given the transmit antennas.

    If a path departs in a perfect null of its antenna, its theta vector is undefined. The result is then 0, so the path
    has no power with any antenna.
    """
    theta, phi = stated_jones(mounting.of_paths(paths.link), paths.departure)[:, 0].T
    field = paths.tx_field[:, 0].real
    # As complex numbers, the field is the axis times the Jones vector (`in_frame`).
    jones = theta + 1j * phi
    axis = np.where(jones == 0, 0.0, (field[:, 0] + 1j * field[:, 1]) / np.where(jones == 0, 1.0, jones))
    return np.stack([np.real(axis), np.imag(axis)], axis=-1)


def stated_jones(mounting: Mounting, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Jones vectors [P, ports, 2] of mounted antennas in directions given by zenith and azimuth [P, 2], [rad]."""
    jones = np.zeros((len(angles), mounting.antennas[0].ports, 2))
    for number, antenna in enumerate(mounting.antennas):
        chosen = mounting.index == number
        pose = Pose(*(angle[chosen] for angle in mounting.pose))
        jones[chosen] = jones_vectors(AntennaPattern.of(antenna), wave_basis(angles[chosen]), pose)
    return jones


def wave_basis(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors of waves in the scene frame [3, 3, P]: direction, theta, phi (3GPP TR 38.901, eq. 7.1-12, 7.1-13).

    `angles` are the zenith and azimuth of the direction [P, 2], [rad].
    """
    (sin_z, sin_a), (cos_z, cos_a) = np.sin(angles.T), np.cos(angles.T)
    zero = np.zeros_like(sin_z)
    return np.array(
        [[sin_z * cos_a, sin_z * sin_a, cos_z], [cos_z * cos_a, cos_z * sin_a, -sin_z], [-sin_a, cos_a, zero]]
    )


def jones_vectors(pattern: AntennaPattern, basis: Any, pose: Pose) -> NDArray[np.float64]:
    """Jones vectors [P, ports, 2] in the waves' basis (theta, phi), for a mounted antenna in a pose [P]."""
    return of_ports(pattern.antenna, *antenna_response(pattern, basis, pose))


def antenna_response(
    pattern: AntennaPattern,
    basis: Any,
    pose: Pose,
    xp: Any = np,
    index: Any = None,
    stored: Callable[[Any], Any] = lambda values: values,
) -> tuple[Any, Any, Any]:
    """Response of a mounted antenna: amplitude, and components (cos, sin) of its theta vector in the waves' basis.

    Each result has the shape [P]; `basis` is the result of `wave_basis`. Without `index`, `pose` has one pose for each
    path; otherwise, `index` [P] is the index of each path's pose. `xp` is the array library: NumPy, or `jax.numpy`
    within a JAX function that is differentiated with respect to the pose. The function `stored` is applied to
    intermediate values, so that they are not computed again at each use.
    """
    cos_yaw, sin_yaw = xp.cos(pose.yaw), xp.sin(pose.yaw)
    cos_tilt, sin_tilt = xp.cos(pose.downtilt), xp.sin(pose.downtilt)
    to_mount = rotation_matrix(pattern.antenna.orientation).T
    # From scene to mount, R_y(downtilt)' R_z(yaw)', then to the antenna's frame (3GPP TR 38.901, eq. 7.1-4).
    mount = (
        (cos_tilt * cos_yaw, cos_tilt * sin_yaw, -sin_tilt),
        (-sin_yaw, cos_yaw, xp.zeros_like(cos_yaw)),
        (sin_tilt * cos_yaw, sin_tilt * sin_yaw, cos_tilt),
    )
    of_paths = (lambda shared: shared) if index is None else (lambda shared: shared[index])
    # Rows are axes of the antenna's frame, columns are axes of the scene.
    rotation = stored(
        [[sum(row[k] * mount[k][axis] for k in range(3)) for axis in range(3)] for row in to_mount]
    )
    rotation = [[of_paths(element) for element in row] for row in rotation]
    # The wave's direction, theta and phi in the antenna's own frame.
    (x, y, z), theta, phi = stored(
        [[sum(row[axis] * vector[axis] for axis in range(3)) for row in rotation] for vector in basis]
    )
    # The azimuth of a direction along the antenna's own z axis is undefined; it is set to 0, as in `zenith_azimuth`.
    axial = x**2 + y**2 < 1e-12
    rho = xp.sqrt(xp.where(axial, 1.0, x**2 + y**2))
    cos_own, sin_own = xp.where(axial, 1.0, x / rho), xp.where(axial, 0.0, y / rho)
    sin_zenith = xp.where(axial, 0.0, rho)
    tilt, steering = (of_paths(xp.asarray(angle)) for angle in (pose.electrical_downtilt, pose.steering))
    zenith, azimuth = stored((xp.arctan2(sin_zenith, z), xp.arctan2(sin_own, cos_own)))
    amplitude = pattern.amplitude(zenith, azimuth, tilt, steering, xp)
    # The antenna's theta vector is the path's theta vector rotated about the direction of the wave. In the antenna's
    # frame, it is (z cos_own, z sin_own, -sin_zenith).
    cosine, sine = (
        vector[0] * z * cos_own + vector[1] * z * sin_own - vector[2] * sin_zenith for vector in (theta, phi)
    )
    return amplitude, cosine, sine


def of_ports(antenna: Antenna, amplitude: Any, cosine: Any, sine: Any, xp: Any = np) -> Any:
    """Jones vectors [P, ports, 2] of an antenna's ports: the result of `antenna_response`, rotated by each slant."""
    ports = []
    for slant in SLANTS[antenna.polarization]:
        a, b = np.cos(slant), np.sin(slant)
        ports.append(xp.stack([a * cosine - b * sine, a * sine + b * cosine], axis=-1))
    return amplitude[:, None, None] * xp.stack(ports, axis=1)


def in_frame(jones: Any, axis: Any, arriving: bool, xp: Any = np) -> Any:
    """Jones vectors [P, ports, 2] in the frame of the interaction next to the antenna.

    `axis` [P, 2] is the unit theta vector in this frame, which is the field of an isotropic, vertically polarized
    antenna. An arriving wave travels opposite to the direction of arrival, so its phi axis is mirrored.
    """
    sign = -1.0 if arriving else 1.0
    phi = sign * xp.stack([-axis[:, 1], axis[:, 0]], axis=-1)
    return jones[..., :1] * axis[:, None] + jones[..., 1:] * phi[:, None]
