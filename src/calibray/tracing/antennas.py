"""Antenna patterns: the field radiated in a direction, and the Jones vectors of departing and arriving paths.

Patterns and polarization are those of Sionna RT, in closed form and double precision. The field is polarized along one
slant angle in every direction of the antenna's frame (3GPP TR 38.901, eq. 7.3-4/5); its amplitude is the square root of
the gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import mul
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from calibray.paths.chains import rotate, spherical_basis, zenith_azimuth
from calibray.tracing.gain_table import read_gain_table
from calibray.tracing.settings import Antenna

SLANTS: Final = {"V": (0.0,), "H": (np.pi / 2,), "VH": (0.0, np.pi / 2), "cross": (-np.pi / 4, np.pi / 4)}
"""Slant angles of the ports by polarization [rad]."""
BEAMWIDTH: Final = np.radians(65)
"""Half-power beamwidth of "tr38901" in both planes [rad] (3GPP TR 38.901, Table 7.3-1)."""


class Amplitude(Protocol):
    """Square root of the gain as a function of zenith and azimuth in (-pi, pi] in the antenna's frame [rad].

    `xp` is the array library: NumPy, or `jax.numpy` within a JAX function.
    """

    def __call__(self, zenith: Any, azimuth: Any, xp: Any = np) -> Any: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class AntennaPattern:
    """An antenna whose radiated field can be evaluated.

    Attributes:
        antenna: The antenna.
        element: Amplitude of its field, which is 1 in every direction for an isotropic one; for an array, of one
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
        """Amplitude of the field in a direction, with an electrical downtilt and a horizontal steering [rad].

        They shift the phases of an array; the pattern of a single antenna is shifted downwards. An array's amplitude
        is relative to its centre and can be negative.
        """
        if not self.antenna.is_array:
            return self.element(xp.clip(zenith - downtilt, 0.0, np.pi), azimuth, xp)
        return self.element(zenith, azimuth, xp) * array_factor(
            self.antenna, zenith, azimuth, downtilt, steering, xp
        )

    def jones_vectors(self, direction: NDArray[np.float64], arriving: bool = False) -> NDArray[np.complex128]:
        """Jones vectors [P, ports, 2] in the wave's basis (theta, phi), for directions seen from the antenna [P, 3].

        The waves arrive from this direction, or depart in it.
        """
        to_world = rotation_matrix(self.antenna.orientation)
        local = direction @ to_world
        zenith, azimuth = np.moveaxis(zenith_azimuth(local), -1, 0)
        slant = np.array(SLANTS[self.antenna.polarization])
        polarization = np.stack([np.cos(slant), np.sin(slant)], axis=-1)
        field = self.amplitude(zenith, azimuth)[:, None, None] * polarization
        antenna_basis = spherical_basis(local, pole_reference=False) @ to_world.T
        wave = rotate_jones(field, rotate(direction, antenna_basis, spherical_basis(direction)))
        # An arriving wave travels against `direction`, so its phi axis points the other way.
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
    vertical_loss_db = xp.minimum(12 * ((zenith - np.pi / 2) / BEAMWIDTH) ** 2, 30)
    horizontal_loss_db = xp.minimum(12 * (azimuth / BEAMWIDTH) ** 2, 30)
    return xp.power(10.0, (8 - xp.minimum(vertical_loss_db + horizontal_loss_db, 30)) / 20)


def array_factor(
    antenna: Antenna, zenith: Any, azimuth: Any, downtilt: Any = 0.0, steering: Any = 0.0, xp: Any = np
) -> Any:
    """Field of a planar array of isotropic antennas, in which equal amplitudes share the power of one antenna.

    Its main direction is `downtilt` below the horizon and `steering` from the x axis towards the y axis [rad]. `xp` has
    cosine and sine. Coupling between the antennas is neglected, as in Sionna RT and 3GPP TR 38.901, section 7.3.
    """
    horizontal, vertical = (2 * np.pi * distance for distance in antenna.spacing)
    of_columns = horizontal * (xp.sin(zenith) * xp.sin(azimuth) - xp.cos(downtilt) * xp.sin(steering))
    of_rows = vertical * (xp.cos(zenith) + xp.sin(downtilt))
    factors = [
        _sum_of_cosines(count, phase, xp) / np.sqrt(count)
        for count, phase in ((antenna.columns, of_columns), (antenna.rows, of_rows))
        if count > 1
    ]
    return reduce(mul, factors)


def _sum_of_cosines(count: int, phase: Any, xp: Any) -> Any:
    """Sum of cos((k - (n - 1) / 2) phase) over n numbers k from 0: the field of a row of antennas, about its centre."""
    half = xp.cos(phase / 2)
    double = 2 * (2 * half * half - 1)
    # cos((m + 1) x) = 2 cos x cos(m x) - cos((m - 1) x), from m = 0, or from m = 1/2 if the number is even.
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
    """Rotation [3, 3] from an antenna's frame into the scene frame (3GPP TR 38.901, eq. 7.1-4)."""
    (cos_z, cos_y, cos_x), (sin_z, sin_y, sin_x) = np.cos(orientation), np.sin(orientation)
    about_z = np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]])
    about_y = np.array([[cos_y, 0, sin_y], [0, 1, 0], [-sin_y, 0, cos_y]])
    about_x = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    return about_z @ about_y @ about_x


def rotate_jones(field: NDArray, rotation: NDArray[np.float64]) -> NDArray:
    """Express Jones vectors [P, ports, 2] in a frame rotated by the angles with (cos, sin) `rotation` [P, 2]."""
    cos, sin = rotation[:, None, 0], rotation[:, None, 1]
    return np.stack(
        [cos * field[..., 0] + sin * field[..., 1], cos * field[..., 1] - sin * field[..., 0]], axis=-1
    )
