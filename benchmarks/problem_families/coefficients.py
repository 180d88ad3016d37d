"""Coefficients of reflection and transmission by NumPy, with their derivatives (ITU-R P.2040-3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light

Complex = NDArray[np.complex128]

ACTING: Final = ("relative_permittivity", "conductivity", "thickness", "scattering_coefficient")
"""The constants of a material that its coefficients depend on, in the order of tables here."""


class Pair(NamedTuple):
    """A number for each polarization.

    Attributes:
        te: Transverse electric [n, J].
        tm: Transverse magnetic [n, J].
    """

    te: Complex
    tm: Complex


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Slabs that waves meet.

    Attributes:
        frequency: Carrier [Hz].
        cosine: Cosine of the angle of incidence [J].
        transmitted: Whether the wave goes through [J].
        raw: Whether the surface reflects all to one side, as before scattering [J].
    """

    frequency: float
    cosine: NDArray[np.float64]
    transmitted: NDArray[np.bool_]
    raw: NDArray[np.bool_]

    def coefficients(self, constants: NDArray[np.float64]) -> Pair:
        """Evaluate the coefficients.

        Args:
            constants: Of each slab, in the order of `ACTING` [4, n, J].

        Returns:
            The coefficients.
        """
        eta, root, phase = self._wave(constants)
        across, specular = phase**2, self._specular(constants[3])
        found = []
        for weighted in (self.cosine, eta * self.cosine):
            half = (weighted - root) / (weighted + root)  # eqs. 37a, 37b
            square = half**2
            through = np.where(self.transmitted, (1.0 - square) * phase, half * (1.0 - across))
            found.append(specular * through / (1.0 - square * across))  # eqs. 43a, 43b
        return Pair(*found)

    def slopes(self, constants: NDArray[np.float64], bars: Pair) -> list[NDArray[np.float64]]:
        """Derivatives of a real number by the constants, from those by the coefficients.

        Args:
            constants: Of each slab, in the order of `ACTING` [4, n, J].
            bars: Numbers b of which a change dr of the coefficients makes the number change by 2 Re(b dr).

        Returns:
            Derivatives by each constant of `ACTING`, 4 times [n, J].
        """
        eta, root, phase = self._wave(constants)
        across, wavenumber = phase**2, 2.0 * np.pi * self.frequency / speed_of_light
        by_eta, by_thickness, by_scattering = 0.0, 0.0, 0.0
        rise = 0.5 / root  # of the root by eta
        turn = -1j * wavenumber * phase  # of the phase factor by thickness times root
        kept = 1.0 - np.where(self.transmitted | self.raw, 0.0, constants[3] ** 2)
        for weighted, steep, bar in ((self.cosine, 0.0, bars.te), (eta * self.cosine, self.cosine, bars.tm)):
            half = (weighted - root) / (weighted + root)
            half_by_eta = 2.0 * (steep * root - weighted * rise) / (weighted + root) ** 2
            square = half**2
            bounced, weight = 1.0 - square * across, bar * np.sqrt(kept)
            weight = weight / bounced**2
            by_half = (1.0 - across) * np.where(self.transmitted, -2.0 * half * phase, 1.0 + square * across)
            inward = np.where(self.transmitted, 1.0 + square * across, -2.0 * half * phase)
            by_phase = (1.0 - square) * inward * turn
            by_eta = by_eta + weight * (by_half * half_by_eta + by_phase * constants[2] * rise)
            by_thickness = by_thickness + weight * by_phase * root
            reflected = half * (1.0 - across) / bounced
            by_scattering = by_scattering - bar * reflected * constants[3] / np.sqrt(kept)
        lossy = -1j / (2.0 * np.pi * self.frequency * epsilon_0)
        mirrored = np.where(self.transmitted | self.raw, 0.0, by_scattering)
        return [2.0 * np.real(each) for each in (by_eta, by_eta * lossy, by_thickness, mirrored)]

    def _wave(self, constants: NDArray[np.float64]) -> tuple[Complex, Complex, Complex]:
        """The relative permittivity, the root that Snell's law gives, and the phase factor of one crossing."""
        eta = constants[0] - 1j * constants[1] / (2.0 * np.pi * self.frequency * epsilon_0)  # eq. 9
        root = np.sqrt(eta - (1.0 - self.cosine**2))
        # e^{-jq}, q of eq. 44
        phase = np.exp(-2j * np.pi * self.frequency / speed_of_light * constants[2] * root)
        return eta, root, phase

    def _specular(self, scattering: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(self.transmitted | self.raw, 1.0, np.sqrt(1.0 - scattering**2))
