"""A path program evaluated by NumPy, without compiling.

A family has a path program for each problem, and compiling one takes ten seconds and more where waves diffract:
longer than all that is asked of it. Path loss is that of `calibray.fields` to rounding, at some microseconds an
interaction; derivatives are differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light

from calibray.fields import layout, material_table
from calibray.fields.program import Formula, Group
from calibray.materials import FIELDS
from calibray.parameters import Parameters
from calibray.paths import Paths

Complex = NDArray[np.complex128]

BLOCK: Final = 200_000
"""Coefficients evaluated at once, which bounds the memory."""

STEP: Final = 1e-6
"""Of a parameter's range, for differences."""

_COLUMN: Final = {name: index for index, name in enumerate(FIELDS)}


@dataclass(frozen=True)
class _Group:
    """A group of `calibray.fields.program` in complex numbers of NumPy."""

    signature: str
    tx: Complex
    rx: Complex
    rotation: NDArray[np.float64]
    turn: list[Any]
    wedge: list[Any]

    @staticmethod
    def of(group: Group) -> _Group:
        return _Group(
            group.signature,
            _complex(group.tx),
            _complex(group.rx),
            np.asarray(group.rotation),
            [None if turn is None else np.asarray(turn) for turn in group.turn],
            [None if wedge is None else _complex(wedge) for wedge in group.wedge],
        )


def _complex(parts: Any) -> Complex:
    """Real part, and imaginary part where there is one, as one array."""
    return np.asarray(parts[0]) + 1j * (np.asarray(parts[1]) if len(parts) == 2 else 0.0)


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
        plan = layout(paths)
        # Tables are laid out only where they are asked for.
        source = cast(Formula, plan.program.coefficients)
        self._material, self._cosine, self._transmitted, self._raw = (
            np.asarray(part) for part in (source.material, source.cosine, source.transmitted, source.raw)
        )
        self._groups = [_Group.of(group) for group in plan.program.groups]
        self._positions = np.cumsum([0, *plan.program.positions])
        self._link = paths.link[plan.order]
        self._order = plan.order
        self._diffuse = [np.asarray(part) for part in plan.program.diffuse[:3]]
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
        power = np.concatenate([self._powers(block) for block in blocks])
        to_link = np.zeros((len(power), self.paths.num_links))
        np.add.at(to_link.T, self._link, power.T)
        with np.errstate(divide="ignore"):
            return -10.0 * np.log10(to_link)

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link, and its derivatives by the parameters.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter.
        """
        count, width = candidates.shape
        # Relative to the value: conductivities span decades. Into the box, whose faces physics may bound.
        step = np.where(candidates > self.parameters.start, -STEP, STEP) * np.maximum(candidates, 1e-3)
        moved = candidates[:, None, :] + step[:, :, None] * np.eye(width)
        every = self.path_loss(np.concatenate([candidates, moved.reshape(-1, width)]))
        here, there = every[:count], every[count:].reshape(count, width, -1)
        return here, np.moveaxis((there - here[:, None]) / step[:, :, None], 1, -1)

    def path_powers(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Power gain of every path for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Power gains in the order of the path program [n, P], [1].
        """
        found = np.empty((len(candidates), self.paths.num_paths))
        found[:, self._order] = self._powers(candidates)
        return found

    def _powers(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        tables = np.repeat(self._base[None], len(candidates), axis=0)
        tables[:, self._rows, self._columns] = candidates
        te, tm = self._coefficients(tables)
        scattered = self._scattered(tables)
        parts, place, row = [], 0, 0
        for group in self._groups:
            a, b = (group.tx[None, :, component] for component in range(2))  # [1, T, p]
            for step, letter in enumerate(group.signature):
                cos, sin = group.rotation[step]
                a, b = cos * a + sin * b, cos * b - sin * a
                faces = []
                for _ in range(2 if letter == "d" else 1):
                    where = slice(self._positions[place], self._positions[place + 1])
                    faces += [te[:, None, where], tm[:, None, where]]
                    place += 1
                if letter == "s":
                    where = slice(row, row + a.shape[-1])
                    a, b = _scatter(a, b, faces, scattered[:, None, where], group.turn[step])
                    row = where.stop
                elif letter == "d":
                    a, b = _diffract(a, b, faces, group.wedge[step])
                else:
                    a, b = faces[0] * a, faces[1] * b
            rx = np.conj(group.rx)[None, :, None]  # [1, R, 1, 2, p]
            gain = rx[..., 0, :] * a[:, None] + rx[..., 1, :] * b[:, None]
            power = (np.abs(gain) ** 2).sum(axis=(1, 2)) / len(group.tx)
            parts.append(np.broadcast_to(power, (len(candidates), power.shape[-1])))
        return np.concatenate(parts, axis=1)

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
        material, solid_angle, scattered = self._diffuse
        scattering = tables[:, material.astype(np.int64), _COLUMN["scattering_coefficient"]]
        return scattering * np.sqrt(np.maximum(scattered / np.pi * solid_angle, 0.0))
