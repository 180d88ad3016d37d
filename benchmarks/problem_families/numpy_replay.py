"""A path program evaluated by NumPy, without compiling.

Every problem of a family has its path program, and compiling one with diffraction takes more than ten seconds: longer
than all its evaluations. Path loss equals that of `calibray.fields` to rounding, and takes a few microseconds per
interaction. Coefficients and their derivatives follow ITU-R P.2040-3. Derivatives are propagated from the receiver
backwards: at every interaction, the later ones are summarized by one number b per polarization, such that a change dr
of a coefficient changes the power of the path by 2 Re(b dr).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light
from scipy.sparse import csr_matrix

from calibray.fields.diffraction import affine_form
from calibray.materials import FIELDS
from calibray.parameters import Parameters
from calibray.paths import Kind, Paths

Complex = NDArray[np.complex128]

ACTING: Final = ("relative_permittivity", "conductivity", "thickness", "scattering_coefficient")
"""Constants that the coefficients depend on, in the order of the tables below."""


BLOCK: Final = 200_000
"""Coefficients evaluated at once, to bound the memory."""

Wave = tuple[Complex, Complex]
"""Both polarizations of the field along paths, or of its adjoint [n, T, p]."""

_COLUMNS: Final = [list(FIELDS).index(name) for name in ACTING]


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
    """Slabs at the interactions.

    Attributes:
        frequency: Carrier [Hz].
        cosine: Cosine of the angle of incidence [J].
        transmitted: Whether the wave is transmitted [J].
        raw: Whether the reflection is computed without the loss due to scattering [J].
    """

    frequency: float
    cosine: NDArray[np.float64]
    transmitted: NDArray[np.bool_]
    raw: NDArray[np.bool_]

    def coefficients(self, constants: NDArray[np.float64]) -> Pair:
        """Evaluate the coefficients.

        Args:
            constants: Constants of each slab, in the order of `ACTING` [4, n, J].

        Returns:
            The coefficients.
        """
        eta, root, phase = self._wave(constants)
        across, specular = phase**2, self._specular(constants[3])
        pair = []
        for weighted in (self.cosine, eta * self.cosine):
            half = (weighted - root) / (weighted + root)  # eqs. 37a, 37b
            square = half**2
            through = np.where(self.transmitted, (1.0 - square) * phase, half * (1.0 - across))
            pair.append(specular * through / (1.0 - square * across))  # eqs. 43a, 43b
        return Pair(*pair)

    def slopes(self, constants: NDArray[np.float64], bars: Pair) -> list[NDArray[np.float64]]:
        """Derivatives of a real quantity with respect to the constants, from those with respect to the coefficients.

        Args:
            constants: Constants of each slab, in the order of `ACTING` [4, n, J].
            bars: Numbers b such that a change dr of the coefficients changes the quantity by 2 Re(b dr).

        Returns:
            Derivatives with respect to each constant of `ACTING`, 4 times [n, J].
        """
        eta, root, phase = self._wave(constants)
        across, wavenumber = phase**2, 2.0 * np.pi * self.frequency / speed_of_light
        by_eta, by_thickness, by_scattering = 0.0, 0.0, 0.0
        rise = 0.5 / root  # derivative of the root with respect to eta
        turn = -1j * wavenumber * phase  # of the phase factor, with respect to thickness times root
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
        return [2.0 * np.real(part) for part in (by_eta, by_eta * lossy, by_thickness, mirrored)]

    def _wave(self, constants: NDArray[np.float64]) -> tuple[Complex, Complex, Complex]:
        """The relative permittivity, the root in Snell's law, and the phase factor of one crossing."""
        eta = constants[0] - 1j * constants[1] / (2.0 * np.pi * self.frequency * epsilon_0)  # eq. 9
        root = np.sqrt(eta - (1.0 - self.cosine**2))
        # e^{-jq}, q of eq. 44
        phase = np.exp(-2j * np.pi * self.frequency / speed_of_light * constants[2] * root)
        return eta, root, phase

    def _specular(self, scattering: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(self.transmitted | self.raw, 1.0, np.sqrt(1.0 - scattering**2))


class NumpyReplay:
    """Stored paths, evaluated for any candidate; limited to Lambertian scattering and one polarization per port.

    Args:
        paths: The path program.
        parameters: The parameters of a candidate.
    """

    def __init__(self, paths: Paths, parameters: Parameters) -> None:
        self.paths, self.parameters = paths, parameters
        faces = np.flatnonzero(paths.kind == Kind.DIFFRACTION)
        # Coefficients are numbered by interaction; those of the other faces of wedges follow.
        self._material = np.concatenate([paths.material, paths.material[faces]])
        kind = np.concatenate([paths.kind, paths.kind[faces]])
        cosine = np.concatenate([paths.cos_incidence, paths.diffraction.cos_incidence_n])
        self._surfaces = Surfaces(paths.frequency, cosine, kind == Kind.REFRACTION, kind == Kind.DIFFUSE)
        self._wedge = affine_form(paths.diffraction, np.arange(len(faces)), paths.frequency)
        self._row = np.zeros(paths.num_interactions, dtype=np.int64)
        for special in (Kind.DIFFUSE, Kind.DIFFRACTION):
            at = paths.kind == special
            self._row[at] = np.arange(at.sum())
        self._diffuse = np.flatnonzero(paths.kind == Kind.DIFFUSE)
        self._groups = _by_kinds(paths)
        self._scale = paths.spreading * speed_of_light / paths.frequency / (4.0 * np.pi)
        self._base = paths.material_table()
        self._rows, self._columns = parameters.matrix_indices(list(paths.materials))
        link = np.repeat(paths.link, np.diff(paths.first))
        place = np.concatenate([link, link[faces]]) * len(self._base) + self._material
        count = len(place)
        shape = (count, paths.num_links * len(self._base))
        self._gathered = csr_matrix((np.ones(count), (np.arange(count), place)), shape)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.
        """
        return self._loss(np.concatenate([self.path_powers(block) for block in self._blocks(candidates)]))

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link, and its derivatives with respect to the parameters.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter; 0 where a link has no
            path.
        """
        parts = [self._sloped(block) for block in self._blocks(candidates)]
        power, rise = (np.concatenate(part) for part in zip(*parts, strict=True))
        loss = self._loss(power)
        per_power = np.where(np.isfinite(loss), -10.0 / np.log(10.0) * 10.0 ** (0.1 * loss), 0.0)
        return loss, rise * per_power[:, :, None]

    def path_powers(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Power gain of every path for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Power gains in the order of the path program [n, P], [1].
        """
        constants = self._constants(candidates)
        faces, scattered = self._surfaces.coefficients(constants), self._scattered(constants[3])
        powers = np.empty((len(candidates), self.paths.num_paths))
        for index, steps in self._groups:
            gain = self._gain(index, self._carried(index, steps, faces, scattered)[-1])
            powers[:, index] = self._power(gain)
        return powers

    def _blocks(self, candidates: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        rows = max(1, BLOCK // max(len(self._material), 1))
        return [candidates[at : at + rows] for at in range(0, len(candidates), rows)]

    def _loss(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link [n, L] from the powers of the paths [n, P]."""
        to_link = np.zeros((len(power), self.paths.num_links))
        np.add.at(to_link.T, self.paths.link, power.T)
        with np.errstate(divide="ignore"):
            return -10.0 * np.log10(to_link)

    def _constants(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """The constants that every coefficient depends on, in the order of `ACTING` [4, n, J]."""
        tables = np.repeat(self._base[None], len(candidates), axis=0)
        tables[:, self._rows, self._columns] = candidates
        return np.stack([tables[:, self._material, column] for column in _COLUMNS])

    def _scattered(self, scattering: NDArray[np.float64]) -> NDArray[np.float64]:
        """S sqrt(f_s dOmega) of the diffuse interactions, with the Lambertian pattern [n, D]."""
        table = self.paths.diffuse
        by_lambert = np.sqrt(np.maximum(table.cos_scattered / np.pi * table.solid_angle, 0.0))
        return scattering[:, self._diffuse] * by_lambert

    def _carried(
        self, index: NDArray[np.int64], steps: NDArray[np.int64], faces: Pair, scattered: NDArray[np.float64]
    ) -> list[Wave]:
        """Waves along paths with one sequence of interactions [k, p], before each in its frame, and at the end."""
        paths, waves = self.paths, []
        a, b = np.moveaxis(paths.tx_field[index], 0, -1).swapaxes(0, 1)[:, None]  # [1, T, p]
        for at in steps:
            cos, sin = paths.rotation[at].T
            a, b = cos * a + sin * b, cos * b - sin * a
            waves.append((a, b))
            te, tm = faces.te[:, None, at], faces.tm[:, None, at]
            kind, row = paths.kind[at[0]], self._row[at]
            if kind == Kind.DIFFUSE:
                size = _size(a, b, te, tm, scattered[:, None, row])
                cos, sin = paths.diffuse.rotation[row].T
                a, b = size * (cos * a + sin * b), size * (cos * b - sin * a)
            elif kind == Kind.DIFFRACTION:
                jones = self._jones(row, te, tm, faces)
                a, b = jones[0][0] * a + jones[0][1] * b, jones[1][0] * a + jones[1][1] * b
            else:
                a, b = te * a, tm * b
        return [*waves, (a, b)]

    def _gain(self, index: NDArray[np.int64], wave: Wave) -> Complex:
        """Gains of paths, between all ports [n, R, T, p]."""
        rx = self._received(index)
        return (rx[..., 0, :] * wave[0][:, None] + rx[..., 1, :] * wave[1][:, None]) * self._scale[index]

    def _received(self, index: NDArray[np.int64]) -> Complex:
        """Conjugate fields of the receiver's ports [1, R, 1, 2, p]."""
        return np.conj(np.moveaxis(self.paths.rx_field[index], 0, -1))[None, :, None]

    def _power(self, gain: Complex) -> NDArray[np.float64]:
        return (np.abs(gain) ** 2).sum(axis=(1, 2)) / self.paths.tx_field.shape[1]

    def _jones(self, row: NDArray[np.int64], te: Complex, tm: Complex, faces: Pair) -> list[list[Complex]]:
        """Matrices of diffractions, J = C_0 + sum_k R_k C_k."""
        form, other = self._wedge[..., row], self.paths.num_interactions + row
        every = (te, tm, faces.te[:, None, other], faces.tm[:, None, other])
        return [
            [
                form[0, i, j] + sum(face * form[k, i, j] for k, face in enumerate(every, start=1))
                for j in range(2)
            ]
            for i in range(2)
        ]

    def _sloped(self, candidates: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Power gain of every path [n, P], and derivatives of every link's gain [n, L, d]."""
        constants, count = self._constants(candidates), len(candidates)
        faces, scattered = self._surfaces.coefficients(constants), self._scattered(constants[3])
        power = np.empty((count, self.paths.num_paths))
        bars = Pair(*(np.zeros((count, len(self._material)), dtype=complex) for _ in range(2)))
        by_size = np.zeros((count, len(self._diffuse)))
        for index, steps in self._groups:
            waves = self._carried(index, steps, faces, scattered)
            gain = self._gain(index, waves[-1])
            power[:, index] = self._power(gain)
            self._back(index, steps, faces, scattered, waves, gain, bars, by_size)
        slopes = self._surfaces.slopes(constants, bars)
        if len(self._diffuse):
            strength = constants[3][:, self._diffuse]
            slopes[3][:, self._diffuse] += by_size / np.where(strength > 0.0, strength, 1.0)
        shape = (count, self.paths.num_links, len(self._base))
        positions = {column: position for position, column in enumerate(_COLUMNS)}
        by_column = {
            column: (slopes[position] @ self._gathered).reshape(shape)
            for column, position in positions.items()
        }
        pairs = zip(self._rows.tolist(), self._columns.tolist(), strict=True)
        return power, np.stack([by_column[column][:, :, row] for row, column in pairs], axis=-1)

    def _back(
        self,
        index: NDArray[np.int64],
        steps: NDArray[np.int64],
        faces: Pair,
        scattered: NDArray[np.float64],
        waves: list[Wave],
        gain: Complex,
        bars: Pair,
        by_size: NDArray[np.float64],
    ) -> None:
        """Fill in derivatives of path powers with respect to coefficients and the log amplitude of scattering."""
        paths, rx = self.paths, self._received(index)
        ahead = np.conj(gain) * self._scale[index] / paths.tx_field.shape[1]
        a_bar, b_bar = ((ahead * rx[..., k, :]).sum(axis=1) for k in range(2))
        for at, (a, b) in zip(steps[::-1], waves[-2::-1], strict=True):
            te, tm = faces.te[:, None, at], faces.tm[:, None, at]
            kind, row = paths.kind[at[0]], self._row[at]
            if kind == Kind.DIFFUSE:
                size = _size(a, b, te, tm, scattered[:, None, row])
                cos, sin = paths.diffuse.rotation[row].T
                a_bar, b_bar = size * (cos * a_bar - sin * b_bar), size * (sin * a_bar + cos * b_bar)
                change = np.real(
                    a_bar * a + b_bar * b
                )  # half the derivative with respect to the log amplitude
                by_size[:, row] = 2.0 * change.sum(axis=1)
                kept, incident = _powers(a, b, te, tm)
                for bar, face, part in ((bars.te, te, a), (bars.tm, tm, b)):
                    bar[:, at] = (change / kept * np.conj(face) * np.abs(part) ** 2).sum(axis=1)
                a_bar = a_bar + change * np.conj(a) * (np.abs(te) ** 2 / kept - 1.0 / incident)
                b_bar = b_bar + change * np.conj(b) * (np.abs(tm) ** 2 / kept - 1.0 / incident)
            elif kind == Kind.DIFFRACTION:
                form, other = self._wedge[..., row], paths.num_interactions + row
                for k, (bar, place) in enumerate(
                    ((bars.te, at), (bars.tm, at), (bars.te, other), (bars.tm, other)), start=1
                ):
                    into_a, into_b = (form[k, i, 0] * a + form[k, i, 1] * b for i in range(2))
                    bar[:, place] = (a_bar * into_a + b_bar * into_b).sum(axis=1)
                jones = self._jones(row, te, tm, faces)
                a_bar, b_bar = (a_bar * jones[0][j] + b_bar * jones[1][j] for j in range(2))
            else:
                bars.te[:, at], bars.tm[:, at] = (a_bar * a).sum(axis=1), (b_bar * b).sum(axis=1)
                a_bar, b_bar = a_bar * te, b_bar * tm
            cos, sin = paths.rotation[at].T
            a_bar, b_bar = cos * a_bar - sin * b_bar, sin * a_bar + cos * b_bar


def _powers(
    a: Complex, b: Complex, te: Complex, tm: Complex
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power of a specular reflection, and incident power; 1 where it is zero."""
    kept, incident = np.abs(te * a) ** 2 + np.abs(tm * b) ** 2, np.abs(a) ** 2 + np.abs(b) ** 2
    return np.where(kept > 0.0, kept, 1.0), np.where(incident > 0.0, incident, 1.0)


def _size(
    a: Complex, b: Complex, te: Complex, tm: Complex, amplitude: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Amplitude of a diffuse reflection: that of a specular reflection times S sqrt(f_s dOmega)."""
    incident = np.abs(a) ** 2 + np.abs(b) ** 2
    kept = np.abs(te * a) ** 2 + np.abs(tm * b) ** 2
    return amplitude * np.sqrt(kept / np.where(incident > 0.0, incident, 1.0))


def _by_kinds(paths: Paths) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Paths with the same sequence of kinds of interactions [p], and their interactions [k, p]."""
    depth = np.diff(paths.first)
    kinds = np.zeros((paths.num_paths, int(depth.max(initial=0))), dtype=np.int64)
    for step in range(kinds.shape[1]):
        deep = depth > step
        kinds[deep, step] = paths.kind[paths.first[:-1][deep] + step]
    sequences, owner = np.unique(kinds, axis=0, return_inverse=True)
    index = [np.flatnonzero(owner.reshape(-1) == group) for group in range(len(sequences))]
    return [(group, paths.first[group] + np.arange(int(depth[group[0]]))[:, None]) for group in index]
