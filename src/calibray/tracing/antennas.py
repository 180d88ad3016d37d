"""Antennas: the field that they radiate in a direction, and the Jones vectors of paths that leave or arrive.

Patterns and polarization are Sionna RT's, in closed form and double precision. The field is polarized along one slant
angle in every direction of the antenna's own frame (3GPP TR 38.901, eq. 7.3-4/5), its amplitude the root of the gain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.paths.chains import rotate, spherical_basis, zenith_azimuth
from calibray.tracing.gain_table import read_gain_table
from calibray.tracing.settings import Antenna

SLANTS: Final = {"V": (0.0,), "H": (np.pi / 2,), "VH": (0.0, np.pi / 2), "cross": (-np.pi / 4, np.pi / 4)}
"""Slant angles of the ports by polarization [rad]."""
BEAM: Final = np.radians(65)
"""Beamwidth of "tr38901" in both planes [rad] (3GPP TR 38.901, Table 7.3-1)."""


Amplitude = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Root of an antenna's gain, by zenith and azimuth in (-pi, pi] in the antenna's own frame [rad]."""


@dataclass(frozen=True, eq=False)
class Radiator:
    """An antenna ready to radiate, its file of gains read.

    Attributes:
        antenna: The antenna.
        amplitude: Amplitude of its field, 1 in every direction for an isotropic one.
    """

    antenna: Antenna
    amplitude: Amplitude

    @classmethod
    def of(cls, antenna: Antenna) -> Radiator:
        """Make an antenna ready.

        Args:
            antenna: The antenna.

        Returns:
            It, ready to radiate.

        Raises:
            InputError: Its file of gains cannot be used.
        """
        if antenna.gain_file is None:
            return cls(antenna, _AMPLITUDES[antenna.pattern])
        table = read_gain_table(antenna.gain_file)
        return cls(
            antenna,
            lambda zenith, azimuth: 10 ** (table.gain(np.degrees(azimuth), 90 - np.degrees(zenith)) / 20),
        )

    def jones_vectors(self, direction: NDArray[np.float64], arriving: bool = False) -> NDArray[np.complex128]:
        """Jones vectors of the antenna in the basis (theta, phi) of the wave.

        Args:
            direction: Directions, seen from the antenna; unit vectors [P, 3].
            arriving: Whether the waves come from those directions; they leave for them if not.

        Returns:
            The vectors by port [P, ports, 2].
        """
        to_world = rotation_matrix(self.antenna.orientation)
        local = direction @ to_world
        zenith, azimuth = np.moveaxis(zenith_azimuth(local), -1, 0)
        slant = np.array(SLANTS[self.antenna.polarization])
        polarization = np.stack([np.cos(slant), np.sin(slant)], axis=-1)
        field = self.amplitude(zenith, azimuth)[:, None, None] * polarization
        own = spherical_basis(local, pole_reference=False) @ to_world.T
        wave = turned(field, rotate(direction, own, spherical_basis(direction)))
        # Seen from the other side, the second axis points the other way.
        return (wave * [1, -1] if arriving else wave).astype(complex)


def iso(zenith: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of an isotropic antenna; see `Amplitude`."""
    return np.ones(zenith.shape)


def dipole(zenith: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of a short dipole (Balanis, Antenna Theory, eq. 4-26a); see `Amplitude`."""
    return np.sqrt(1.5) * np.abs(np.sin(zenith))


def hw_dipole(zenith: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of a half-wave dipole (Balanis, Antenna Theory, eq. 4-84); see `Amplitude`."""
    sine = np.sin(zenith)
    # Towards the poles the limit is 0.
    return np.sqrt(1.643) * np.abs(np.cos(np.pi / 2 * np.cos(zenith)) / np.where(sine > 1e-5, sine, 1.0))


def tr38901(zenith: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of a base station's element (3GPP TR 38.901, Table 7.3-1); see `Amplitude`."""
    vertical = np.minimum(12 * ((zenith - np.pi / 2) / BEAM) ** 2, 30)
    horizontal = np.minimum(12 * (azimuth / BEAM) ** 2, 30)
    return 10 ** ((8 - np.minimum(vertical + horizontal, 30)) / 20)


_AMPLITUDES: Final[dict[str, Amplitude]] = {
    "iso": iso,
    "dipole": dipole,
    "hw_dipole": hw_dipole,
    "tr38901": tr38901,
}


def rotation_matrix(orientation: tuple[float, float, float]) -> NDArray[np.float64]:
    """Rotation from an antenna's frame into the world (3GPP TR 38.901, eq. 7.1-4).

    Args:
        orientation: Rotation about z, y and x [rad].

    Returns:
        The matrix [3, 3].
    """
    (cos_z, cos_y, cos_x), (sin_z, sin_y, sin_x) = np.cos(orientation), np.sin(orientation)
    about_z = np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]])
    about_y = np.array([[cos_y, 0, sin_y], [0, 1, 0], [-sin_y, 0, cos_y]])
    about_x = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    return about_z @ about_y @ about_x


def turned(field: NDArray, rotation: NDArray[np.float64]) -> NDArray:
    """Jones vectors in a frame that is rotated against theirs.

    Args:
        field: The vectors [P, ports, 2].
        rotation: (cos, sin) of the rotation [P, 2].

    Returns:
        The vectors [P, ports, 2].
    """
    cos, sin = rotation[:, None, 0], rotation[:, None, 1]
    return np.stack(
        [cos * field[..., 0] + sin * field[..., 1], cos * field[..., 1] - sin * field[..., 0]], axis=-1
    )
