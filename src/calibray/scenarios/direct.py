"""A path program evaluated by NumPy, without compiling.

A family has a path program for each problem, and compiling one takes ten seconds and more where waves diffract:
longer than all that is asked of it. Path loss is that of `calibray.fields` to rounding, at some microseconds an
interaction; derivatives are differences.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light

from calibray.fields import material_table
from calibray.fields.diffraction import affine_form
from calibray.materials import FIELDS
from calibray.parameters import Parameters
from calibray.paths import Kind, Paths

Complex = NDArray[np.complex128]

BLOCK: Final = 200_000
"""Coefficients evaluated at once, which bounds the memory."""

STEP: Final = 1e-6
"""Of a parameter's range, for differences."""

_COLUMN: Final = {name: index for index, name in enumerate(FIELDS)}


def _scatter(
    a: Complex, b: Complex, faces: list[Complex], amplitude: NDArray[np.float64], turn: NDArray[np.float64]
) -> tuple[Complex, Complex]:
    """Diffuse reflection, as strong as a mirror would reflect, times S sqrt(f_s dOmega)."""
    incident = np.abs(a) ** 2 + np.abs(b) ** 2
    kept = np.abs(faces[0] * a) ** 2 + np.abs(faces[1] * b) ** 2
    size = amplitude * np.sqrt(kept / np.where(incident > 0.0, incident, 1.0))
    cos, sin = turn
    return size * (cos * a + sin * b), size * (cos * b - sin * a)


def _diffract(a: Complex, b: Complex, faces: list[Complex], form: Complex) -> tuple[Complex, Complex]:
    """Diffraction, J = C_0 + sum_k R_k C_k."""
    jones = [
        [form[0, i, j] + sum(face * form[k, i, j] for k, face in enumerate(faces, start=1)) for j in range(2)]
        for i in range(2)
    ]
    return jones[0][0] * a + jones[0][1] * b, jones[1][0] * a + jones[1][1] * b


class Direct:
    """Stored paths, evaluated for any candidate; Lambert's law and one polarization direction a port alone.

    Args:
        paths: The path program.
        parameters: What the candidates' components stand for.
    """

    def __init__(self, paths: Paths, parameters: Parameters) -> None:
        self.paths, self.parameters = paths, parameters
        faces = np.flatnonzero(paths.kind == Kind.DIFFRACTION)
        # Coefficients are numbered by interaction; those of the other faces of wedges follow.
        self._material = np.concatenate([paths.material, paths.material[faces]])
        self._cosine = np.concatenate([paths.cos_incidence, paths.diffraction.cos_incidence_n])
        kind = np.concatenate([paths.kind, paths.kind[faces]])
        self._transmitted, self._raw = kind == Kind.REFRACTION, kind == Kind.DIFFUSE
        self._wedge = affine_form(paths.diffraction, np.arange(len(faces)), paths.frequency)
        self._row = np.zeros(paths.num_interactions, dtype=np.int64)
        for special in (Kind.DIFFUSE, Kind.DIFFRACTION):
            at = paths.kind == special
            self._row[at] = np.arange(at.sum())
        self._groups = _by_kinds(paths)
        self._scale = paths.spreading * speed_of_light / paths.frequency / (4.0 * np.pi)
        self._base = material_table(paths)
        self._rows, self._columns = parameters.indices(list(paths.materials))

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.
        """
        rows = max(1, BLOCK // max(len(self._cosine), 1))
        blocks = [candidates[at : at + rows] for at in range(0, len(candidates), rows)]
        power = np.concatenate([self.path_powers(block) for block in blocks])
        to_link = np.zeros((len(power), self.paths.num_links))
        np.add.at(to_link.T, self.paths.link, power.T)
        with np.errstate(divide="ignore"):
            return -10.0 * np.log10(to_link)

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link, and its derivatives by the parameters.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter; 0 where a link has no
            path.
        """
        count, width = candidates.shape
        # Relative to the value: conductivities span decades. Into the box, whose faces physics may bound.
        step = np.where(candidates > self.parameters.start, -STEP, STEP) * np.maximum(candidates, 1e-3)
        moved = candidates[:, None, :] + step[:, :, None] * np.eye(width)
        every = self.path_loss(np.concatenate([candidates, moved.reshape(-1, width)]))
        here, there = every[:count], every[count:].reshape(count, width, -1)
        reached = np.isfinite(here)[:, None]
        rise = np.where(reached, there, 0.0) - np.where(reached, here[:, None], 0.0)
        return here, np.moveaxis(rise / step[:, :, None], 1, -1)

    def path_powers(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Power gain of every path for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Power gains in the order of the path program [n, P], [1].
        """
        tables = np.repeat(self._base[None], len(candidates), axis=0)
        tables[:, self._rows, self._columns] = candidates
        te, tm = self._coefficients(tables)
        scattered = self._scattered(tables)
        found = np.empty((len(candidates), self.paths.num_paths))
        for index, steps in self._groups:
            found[:, index] = self._power(index, steps, te, tm, scattered)
        return found

    def _power(
        self,
        index: NDArray[np.int64],
        steps: NDArray[np.int64],
        te: Complex,
        tm: Complex,
        scattered: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Power gain of paths of one sequence of interactions [k, p], carried along all of them at once [n, p]."""
        paths = self.paths
        a, b = np.moveaxis(paths.tx_field[index], 0, -1).swapaxes(0, 1)[:, None]  # [1, T, p]
        for at in steps:
            cos, sin = paths.rotation[at].T
            a, b = cos * a + sin * b, cos * b - sin * a
            faces, kind, row = [te[:, None, at], tm[:, None, at]], paths.kind[at[0]], self._row[at]
            if kind == Kind.DIFFUSE:
                a, b = _scatter(a, b, faces, scattered[:, None, row], paths.diffuse.rotation[row].T)
            elif kind == Kind.DIFFRACTION:
                other = paths.num_interactions + row
                faces += [te[:, None, other], tm[:, None, other]]
                a, b = _diffract(a, b, faces, self._wedge[..., row])
            else:
                a, b = faces[0] * a, faces[1] * b
        rx = np.conj(np.moveaxis(paths.rx_field[index], 0, -1))[None, :, None]  # [1, R, 1, 2, p]
        gain = (rx[..., 0, :] * a[:, None] + rx[..., 1, :] * b[:, None]) * self._scale[index]
        return (np.abs(gain) ** 2).sum(axis=(1, 2)) / paths.tx_field.shape[1]

    def _coefficients(self, tables: NDArray[np.float64]) -> tuple[Complex, Complex]:
        """Coefficients of reflection or transmission, transverse electric and magnetic [n, J] (ITU-R P.2040-3)."""
        permittivity, conductivity, thickness, scattering = (
            tables[:, self._material, _COLUMN[name]]
            for name in ("relative_permittivity", "conductivity", "thickness", "scattering_coefficient")
        )
        cosine, frequency = self._cosine, self.paths.frequency
        eta = permittivity - 1j * conductivity / (2.0 * np.pi * frequency * epsilon_0)  # eq. 9
        root = np.sqrt(eta - (1.0 - cosine**2))
        phase = np.exp(-2j * np.pi * frequency / speed_of_light * thickness * root)  # e^{-jq}, q of eq. 44
        across = phase**2
        specular = np.where(self._transmitted | self._raw, 1.0, np.sqrt(1.0 - scattering**2))
        found = []
        for weighted in (cosine, eta * cosine):
            half = (weighted - root) / (weighted + root)  # eqs. 37a, 37b
            square = half**2
            through = np.where(self._transmitted, (1.0 - square) * phase, half * (1.0 - across))
            found.append(specular * through / (1.0 - square * across))  # eqs. 43a, 43b
        return found[0], found[1]

    def _scattered(self, tables: NDArray[np.float64]) -> NDArray[np.float64]:
        """S sqrt(f_s dOmega) of the diffuse interactions, by Lambert's law [n, D]."""
        table, material = self.paths.diffuse, self.paths.material[self.paths.kind == Kind.DIFFUSE]
        scattering = tables[:, material, _COLUMN["scattering_coefficient"]]
        return scattering * np.sqrt(np.maximum(table.cos_scattered / np.pi * table.solid_angle, 0.0))


def _by_kinds(paths: Paths) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Paths of the same sequence of kinds [p], and their interactions [k, p]."""
    depth = np.diff(paths.first)
    kinds = np.zeros((paths.num_paths, int(depth.max(initial=0))), dtype=np.int64)
    for step in range(kinds.shape[1]):
        deep = depth > step
        kinds[deep, step] = paths.kind[paths.first[:-1][deep] + step]
    sequences, owner = np.unique(kinds, axis=0, return_inverse=True)
    index = [np.flatnonzero(owner.reshape(-1) == each) for each in range(len(sequences))]
    return [(some, paths.first[some] + np.arange(int(depth[some[0]]))[:, None]) for some in index]
